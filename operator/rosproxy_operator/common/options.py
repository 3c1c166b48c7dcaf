"""Options of both operators by which an administrator says what all proxies do."""

import click

from rosproxy import values
from rosproxy.cli.options import Command, click_type, with_options
from rosproxy_operator.common.proxy_bounds import OWN_BOUNDS

_POLICY = (
    click.option(
        "--policy",
        type=click_type(values.POLICY_RULES),
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


_BOUNDS = (
    click.option(
        "--proxy-max-buffered",
        type=click_type(values.MEBIBYTES),
        default=OWN_BOUNDS.max_buffered,
        help="Memory of each proxy for calls and replies that are read.",
    ),
    click.option(
        "--proxy-max-body",
        type=click_type(values.MEBIBYTES),
        default=OWN_BOUNDS.max_body,
        help="Longest parameter that passes a proxy.",
    ),
    click.option(
        "--proxy-max-connections-per-source",
        type=click_type(values.CONNECTIONS),
        default=OWN_BOUNDS.max_connections_per_source,
        help="Connections of one address to a proxy.",
    ),
    click.option(
        "--proxy-max-connections-per-lease",
        type=click_type(values.CONNECTIONS),
        default=OWN_BOUNDS.max_connections_per_lease,
        help="Connections to one port of a proxy.",
    ),
)


def proxy_bound_options(command: Command) -> Command:
    """What each proxy may take."""
    return with_options(command, _BOUNDS)


def policy_options(command: Command) -> Command:
    """The administrator's policy."""
    return with_options(command, _POLICY)
