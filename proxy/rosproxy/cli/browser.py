"""Opens a live page in a browser, for ``rosproxy`` and ``rosproxy-operator``."""

import webbrowser

import click


def open_page(url: str, without_browser: str) -> None:
    """Print the address of a live page, and open a browser if there is one.

    If there is no browser, print ``without_browser`` to stderr.
    """
    click.echo(url)
    if not webbrowser.open(url):
        click.echo(without_browser, err=True)
