"""How a command ends: with exit status 0, or with 1 and a line each that says why."""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from typing import NoReturn

import click

from rosproxy.telemetry.text import clean
from rosproxy_operator.common.control_loop import LookFailed
from rosproxy_operator.common.problem import Problem


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


def exit_with(problems: Sequence[Problem]) -> NoReturn:
    """Tell what is not as it ought to be, a line each; exit with 1 if anything is, else with 0."""
    for problem in problems:
        text = clean(f"{problem.subject}: {problem.text}")
        click.echo(f"rosproxy-operator: {text}", err=True)
    sys.exit(1 if problems else 0)
