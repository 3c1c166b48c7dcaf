"""Options of ``rosproxy-operator kubernetes`` that bound what RosProxies get and who reaches them.

The rest is in `rosproxy_operator.cli`.
"""

import click

from rosproxy import values
from rosproxy.cli.options import Command, Parsed, click_type, with_options
from rosproxy_operator.kubernetes.resources.spec import MOST_PORTS
from rosproxy_operator.kubernetes.settings import EVERY_PORT, read_glob, read_name, read_peers

GLOB = Parsed("glob", read_glob)


def administrators_options(command: Command) -> Command:
    """What a RosProxy may ask for: the administrator's word."""
    options = (
        click.option(
            "--allow-master",
            type=GLOB,
            multiple=True,
            help="Masters that a RosProxy may name, as http://192.0.2.*:11311 (repeatable). "
            "Default: any.",
        ),
        click.option(
            "--max-ports",
            type=click.IntRange(1, MOST_PORTS),
            default=MOST_PORTS,
            metavar="N",
            help="Most ports that a RosProxy may ask for.",
        ),
        click.option(
            "--allow-port-window",
            type=click_type(values.PORT_RANGE),
            default=f"{EVERY_PORT}",
            metavar="A-B",
            help="Where a RosProxy may have hostPorts: its portWindow and its master's port.",
        ),
        click.option(
            "--allow-data-plane",
            type=click.Choice(["auto", "kernel", "splice", "copy"]),
            multiple=True,
            default=("auto", "splice", "copy"),
            help="Data planes that a RosProxy may ask for (repeatable); kernel takes NET_ADMIN.",
        ),
        click.option(
            "--allow-image",
            type=GLOB,
            multiple=True,
            help="Images that a RosProxy may name besides --proxy-image (repeatable).",
        ),
        click.option(
            "--slave-control",
            type=click.Choice(["any", "master"]),
            default="any",
            help="Who may control ROS nodes from outside; a RosProxy may only narrow it.",
        ),
    )
    return with_options(command, options)


def ros2_options(command: Command) -> Command:
    """What a RosProxy may ask for of ROS 2."""
    options = (
        click.option(
            "--allow-peer",
            type=GLOB,
            multiple=True,
            help="Hosts that a RosProxy may name as peers of ROS 2, as 192.0.2.* (repeatable). "
            "Default: any.",
        ),
        click.option(
            "--allow-multicast/--no-allow-multicast",
            default=True,
            help="Whether a RosProxy may hear the nodes' LAN, by pods in the nodes' own network.",
        ),
    )
    return with_options(command, options)


def own_options(command: Command) -> Command:
    """Who may reach the proxies, and how the operator proves to them who it is."""
    options = (
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
        click.option(
            "--lease",
            type=Parsed("namespace/name", read_name),
            help="The Lease by which several operators choose the one that acts. Default: there is "
            "no other.",
        ),
    )
    return with_options(command, options)
