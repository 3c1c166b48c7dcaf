"""Options of ``rosproxy-operator docker`` that are about what each proxy is made with."""

import click

from rosproxy.cli.options import Command, Parsed
from rosproxy_operator.docker.settings import read_memory, read_pids, read_secret

_OPTIONS = (
    click.option(
        "--proxy-memory",
        type=Parsed("size", read_memory),
        default="1g",
        help="Most memory of each proxy; 0: no bound.",
    ),
    click.option(
        "--proxy-pids",
        type=Parsed("number", read_pids),
        default="8192",
        help="Most threads and processes of each proxy; 0: no bound.",
    ),
    click.option(
        "--secret-file",
        "secret",
        type=Parsed("file", read_secret),
        envvar="ROSPROXY_SECRET_FILE",
        default="",
        help="A file with the secret of which the proxies' tokens are made. Default: one that the "
        "uplink network holds.",
    ),
)


def bound_options(command: Command) -> Command:
    """What each proxy may take, and the secret of their tokens."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
