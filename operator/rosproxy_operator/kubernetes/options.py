"""Options of ``rosproxy-operator kubernetes`` that say who reaches proxies.

The rest is in `rosproxy_operator.cli`.
"""

from collections.abc import Callable

import click

from rosproxy.cli.options import Command, Parsed
from rosproxy_operator.kubernetes.settings import read_name, read_peers


def own_options(command: Command) -> Command:
    """Who may reach the proxies, and how the operator proves to them who it is."""
    return _with(
        command,
        click.option(
            "--network-policy/--no-network-policy",
            default=True,
            help="Whether the proxies of each RosProxy get a NetworkPolicy.",
        ),
        click.option(
            "--admin-from",
            type=Parsed("JSON", read_peers),
            help="Who may reach proxies' admin endpoints, as a JSON list of NetworkPolicyPeers. "
            "Default: everybody.",
        ),
        click.option(
            "--key-secret",
            type=Parsed("namespace/name", read_name),
            help="An existing Secret in which the key of the proxies' tokens is kept over "
            "restarts.",
        ),
    )


def _with(command: Command, *options: Callable[[Command], Command]) -> Command:
    for option in reversed(options):
        command = option(command)
    return command
