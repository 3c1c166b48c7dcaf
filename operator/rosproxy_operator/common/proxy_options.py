"""Options of both operators by which an administrator says what all proxies do.

They are those of ``rosproxy run``, but for the words.
"""

import click

from rosproxy.cli.options import Command, click_option, click_type, with_options
from rosproxy.setting_kinds import POLICY_RULES, declared
from rosproxy.settings import Settings
from rosproxy_operator.common.proxy_bounds import PREFIX, ProxyBounds

_POLICY = (
    click.option(
        "--policy",
        type=click_type(POLICY_RULES),
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
_BOUNDS = [
    click_option(setting, PREFIX)
    for setting in declared(Settings)
    if setting.field in ProxyBounds.__struct_fields__
]


def proxy_bound_options(command: Command) -> Command:
    """What each proxy may take."""
    return with_options(command, _BOUNDS)


def policy_options(command: Command) -> Command:
    """The administrator's policy."""
    return with_options(command, _POLICY)
