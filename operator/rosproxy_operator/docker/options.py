"""Options of ``rosproxy-operator docker`` that are about what each proxy is made with."""

import click

from rosproxy.cli.options import Command, Parsed
from rosproxy_operator.docker.settings import read_secret

_OPTIONS = (
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
    """The secret of the proxies' tokens."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
