"""Options of both operators by which an administrator says what all proxies do."""

import click

from rosproxy.cli.options import POLICY_RULES, Command, with_options

_POLICY = (
    click.option(
        "--policy",
        type=POLICY_RULES,
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
