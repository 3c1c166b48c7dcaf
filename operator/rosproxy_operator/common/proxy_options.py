"""Options of both operators: the administrator's policy, and the bounds of all proxies.

The values are the values of the options of ``rosproxy run``.
"""

import click

from rosproxy.cli.options import Command, click_option, click_type, with_options
from rosproxy.shared.setting_kinds import POLICY_RULES, declared
from rosproxy.shared.settings import Settings
from rosproxy_operator.common.proxy_bounds import OPTION_PREFIX, ProxyBounds

_POLICY = (
    click.option(
        "--policy",
        type=click_type(POLICY_RULES),
        multiple=True,
        help="Rules for all proxies about what outside may see and do, and what inside may take "
        'from outside, for example "deny publish /camera/*". Repeatable; ; separates rules. '
        "Other policies can only narrow these rules.",
    ),
    click.option(
        "--policy-mode",
        type=click.Choice(["enforce", "audit"]),
        default="enforce",
        help="enforce: the proxies enforce the rules of --policy. audit: the proxies only report "
        "what the rules would deny.",
    ),
)
_BOUNDS = [
    click_option(setting, OPTION_PREFIX)
    for setting in declared(Settings)
    if setting.field in ProxyBounds.__struct_fields__
]


def proxy_bound_options(command: Command) -> Command:
    """Add the options with the bounds of each proxy."""
    return with_options(command, _BOUNDS)


def policy_options(command: Command) -> Command:
    """Add the options with the administrator's policy."""
    return with_options(command, _POLICY)
