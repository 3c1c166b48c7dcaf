"""Last words of a command that can't do what it is asked for: one line, and exit status 1."""

import contextlib
import sys
from collections.abc import Iterator
from typing import NoReturn

import click

from rosproxy.telemetry.text import clean
from rosproxy_operator.common.control_loop import LookFailed


@contextlib.contextmanager
def one_line(*more: type[Exception]) -> Iterator[None]:
    """Tell in one line that the engine or the API server can't be asked."""
    errors: tuple[type[Exception], ...] = (LookFailed, *more)
    try:
        yield
    except errors as error:
        fail(error)


def fail(reason: object) -> NoReturn:
    """Say why, and exit."""
    click.echo(f"rosproxy-operator: {clean(reason)}", err=True)
    sys.exit(1)
