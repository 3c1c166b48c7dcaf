"""Ends a command with exit status 0, or with 1 and a line for each problem."""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from typing import NoReturn

import click

from rosproxy.shared.output.text import clean
from rosproxy_operator.common.control_loop import LookFailed
from rosproxy_operator.common.problem import Problem


@contextlib.contextmanager
def exit_on_error(*expected: type[Exception]) -> Iterator[None]:
    """On a LookFailed or ``expected`` error in the ``with`` block, print a line and exit with 1."""
    errors: tuple[type[Exception], ...] = (LookFailed, *expected)
    try:
        yield
    except errors as error:
        fail(error)


def fail(reason: object) -> NoReturn:
    """Print the reason, and exit with 1."""
    click.echo(f"rosproxy-operator: {clean(reason)}", err=True)
    sys.exit(1)


def exit_with(problems: Sequence[Problem]) -> NoReturn:
    """Print a line for each problem. Exit with 1 if there are problems, else with 0."""
    for problem in problems:
        click.echo(f"rosproxy-operator: {clean(problem)}", err=True)
    sys.exit(1 if problems else 0)
