"""Options of ``rosproxy-operator kubernetes`` that say who reaches proxies.

The rest is in `rosproxy_operator.cli`.
"""

from collections.abc import Callable

import click

from rosproxy.cli.options import Command, Parsed
from rosproxy_operator.kubernetes.settings import read_name


def own_options(command: Command) -> Command:
    """How the operator proves to proxies who it is."""
    return _with(
        command,
        click.option(
            "--key-secret",
            type=Parsed("namespace/name", read_name),
            help="An existing Secret in which the key of the proxies' tokens is kept over "
            "restarts.",
        ),
    )


def _with(command: Command, *options: Callable[[Command], Command]) -> Command:
    for option in reversed(options):
        command = option(command)
    return command
