"""Options of ``rosproxy-operator docker`` that bound labels and proxies, and those for ROS 2."""

import click

from rosproxy.cli.options import Command, Parsed, with_options
from rosproxy_operator.common.ros2 import read_peer_name
from rosproxy_operator.docker.planner.labels.bounds import read_host_pattern
from rosproxy_operator.docker.planner.model import MOST_PORTS
from rosproxy_operator.docker.settings import read_lan, read_memory, read_pids, read_secret

_OPTIONS = (
    click.option(
        "--slave-control",
        type=click.Choice(["any", "master"]),
        default="any",
        help="Who may call shutdown, publisherUpdate and paramUpdate at the nodes of all proxies.",
    ),
    click.option(
        "--allow-master",
        type=Parsed("HOST[:PORT]", read_host_pattern),
        multiple=True,
        help="A master that containers may name, * and ? stand for others (repeatable). Default: "
        "any from port 1024 on.",
    ),
    click.option(
        "--redirect/--no-redirect",
        default=True,
        help="Whether a master that ROS_MASTER_URI gives by address leads to the proxy, by a rule "
        "in the container's network.",
    ),
    click.option(
        "--allow-peer",
        type=Parsed("HOST[:PORT]", read_host_pattern),
        multiple=True,
        help="ROS 2: a host outside that labels may have told of participants, * and ? stand for "
        "others (repeatable). Default: any.",
    ),
    click.option(
        "--max-ports",
        type=click.IntRange(1, MOST_PORTS),
        default=100,
        metavar="N",
        help="Most ports that labels may ask for.",
    ),
    click.option(
        "--allow-data-plane",
        type=click.Choice(["auto", "kernel", "splice", "copy"]),
        multiple=True,
        help="A data plane that labels may ask for (repeatable). Default: all but kernel.",
    ),
    click.option(
        "--ros2-peer",
        type=Parsed("host[:port]", read_peer_name),
        envvar="ROSPROXY_ROS2_PEERS",
        multiple=True,
        help="ROS 2: a host outside that every proxy tells of its participants, or another proxy, "
        "with the first port of its range (repeatable).",
    ),
    click.option(
        "--ros2-lan",
        type=Parsed("address", read_lan),
        default="",
        show_default=False,
        help="ROS 2: this host's address on the LAN whose multicast is heard, or none. Default: "
        "the advertised address, else that towards hosts far away.",
    ),
    click.option(
        "--proxy-memory",
        type=Parsed("size", read_memory),
        default="1g",
        help="Most memory of each proxy; 0: no bound.",
    ),
    click.option(
        "--proxy-pids",
        type=Parsed("number", read_pids),
        default="8192",
        help="Most threads and processes of each proxy; 0: no bound.",
    ),
    click.option(
        "--secret-file",
        "secret",
        type=Parsed("file", read_secret),
        envvar="ROSPROXY_SECRET_FILE",
        default="",
        help="A file with the secret of which the proxies' tokens are made. Default: one that the "
        "uplink network holds.",
    ),
)


def bound_options(command: Command) -> Command:
    """What labels may ask for, ROS 2's hosts outside, bounds of proxies, the tokens' secret."""
    return with_options(command, _OPTIONS)
