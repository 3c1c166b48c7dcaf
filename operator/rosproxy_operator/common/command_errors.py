"""How a command that fails ends: with one line that says why, and exit status 1."""

import contextlib
import sys
from collections.abc import Iterator
from typing import NoReturn

import click

from rosproxy.telemetry.text import clean
from rosproxy_operator.common.control_loop import LookFailed


@contextlib.contextmanager
def exit_on_error(*expected: type[Exception]) -> Iterator[None]:
    """Exit with one line if the engine or the API server can't be asked."""
    errors: tuple[type[Exception], ...] = (LookFailed, *expected)
    try:
        yield
    except errors as error:
        fail(error)


def fail(reason: object) -> NoReturn:
    """Say why, and exit."""
    click.echo(f"rosproxy-operator: {clean(reason)}", err=True)
    sys.exit(1)
