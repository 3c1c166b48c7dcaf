"""The terminal: prints a text once, or draws a text repeatedly (``--watch``).

On a terminal, ``--watch`` uses a separate screen, and rich colours important words unless NO_COLOR
is set. A pipe or a file gets the plain text. Characters that the encoding lacks are escaped. rich
reads no markup in a text.
"""

import io
import json
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress

from rich.console import Console
from rich.highlighter import RegexHighlighter
from rich.live import Live

from rosproxy.cli.status_table import render
from rosproxy.shared.http.admin_client import AdminClient, AdminError

WATCH_INTERVAL_S = 2.0
"""Seconds between two drawings, and between two measurements of rates in the proxy."""
WIDTH_WITHOUT_TERMINAL = 120


class _StatusHighlighter(RegexHighlighter):
    """Highlights headings and states. The name of a group is the style."""

    highlights = (
        r"(?m)^(?P<bold>(NODE|PROXY|CONTAINER) .*)$",
        r"(?m)^(?P<green>ok)   ",
        r"(?m)(?P<bold>(?P<red>^ERROR\b|\bDOWN\b|^problems\b.*$))",
        r"(?m)^(?P<yellow>WARNING)\b",
    )


def show_status(admin: AdminClient, as_json: bool) -> None:
    """Print the status once. Raises AdminError."""
    if as_json:
        write(json.dumps(admin.status_json(), indent=2))
    else:
        write(render(admin.status(), size()[0]))


def watch_status(admin: AdminClient) -> None:
    """Draw the status every WATCH_INTERVAL_S until Ctrl-C, also while no proxy answers."""

    def draw(columns: int, lines: int | None) -> str:
        try:
            return render(admin.status(), columns, lines)
        except AdminError as error:
            return f"{time.strftime('%H:%M:%S')} {error}"

    watch(draw)


def watch(draw: Callable[[int, int | None], str]) -> None:
    """Show the text of ``draw`` every WATCH_INTERVAL_S until Ctrl-C.

    ``draw`` takes the columns and lines of `size`.
    """
    console = _console()
    live = Live(console=console, screen=True, auto_refresh=False)
    with suppress(KeyboardInterrupt), live if console.is_terminal else nullcontext():
        while True:
            text = draw(*size())
            if console.is_terminal:
                live.update(text, refresh=True)
            else:
                # Into a pipe or a file: all texts, with an empty line after each.
                console.print(text, "", sep="\n", soft_wrap=True)
            time.sleep(WATCH_INTERVAL_S)


def write(text: str) -> None:
    """Print a text; long lines stay whole."""
    _console().print(text, soft_wrap=True)


def size() -> tuple[int, int | None]:
    """Columns and lines of the terminal.

    Lines are None without a terminal, or if the terminal has 5 lines or fewer.
    """
    columns, lines = shutil.get_terminal_size((WIDTH_WITHOUT_TERMINAL, 0))
    return columns, lines if sys.stdout.isatty() and lines > 5 else None


def _console() -> Console:
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    return Console(highlighter=_StatusHighlighter(), markup=False, emoji=False)
