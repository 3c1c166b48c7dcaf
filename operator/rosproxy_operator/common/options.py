"""Options of both operators by which an administrator says what all proxies do."""

from collections.abc import Sequence

import click

from rosproxy.access.rules import parse_rules
from rosproxy.cli.options import Command, Parsed, with_options


class RulesType(Parsed):
    """Rules of a policy. A variable holds all of them: blanks in it separate no values."""

    def split_envvar_value(self, rv: str) -> Sequence[str]:
        """The one value that a variable holds."""
        return [rv]


_POLICY = (
    click.option(
        "--policy",
        type=RulesType("rules", parse_rules),
        multiple=True,
        help='What outside may see and do at all proxies, and inside take, such as "deny publish '
        '/camera/*" (repeatable; several separated by ;). Others can only narrow it.',
    ),
    click.option(
        "--policy-mode",
        type=click.Choice(["enforce", "audit"]),
        default="enforce",
        help="Whether that is enforced, or the proxies only tell what it would deny.",
    ),
)


def policy_options(command: Command) -> Command:
    """The administrator's policy."""
    return with_options(command, _POLICY)
