"""The command line: ``rosproxy run`` and ``ear``; what asks a running proxy is in `questions`.

Commands import what they need when they run, so that a health check starts fast.
"""

from collections.abc import Callable
from typing import Any

import click

from rosproxy import __version__
from rosproxy.cli import options, questions
from rosproxy.cli.options import Command


@click.group(cls=options.Commands, context_settings=options.GROUP_SETTINGS)
@click.version_option(__version__, prog_name="rosproxy")
def main() -> None:
    """Transparent proxy for ROS: nodes behind it and nodes outside talk both ways."""


def _time(name: str, least: float, default: float, text: str) -> Callable[..., Command]:
    return click.option(name, type=options.Seconds(least), default=default, help=text)


@main.command(context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True})
@click.option(
    "--ros",
    type=click.Choice(["1", "2"]),
    multiple=True,
    default=["1"],
    help="Version of ROS that it is for (repeatable: for both).",
)
@click.option(
    "--master-uri",
    type=options.MASTER_URI,
    envvar="ROS_MASTER_URI",
    help="The real ROS master, e.g. http://robot:11311; ROS 1 needs it.",
)
@click.option(
    "--master-address",
    type=options.ADDRESS,
    help="IP address of the master's host, to use instead of resolving its name.",
)
@click.option(
    "--advertise-host",
    type=options.HOST,
    required=True,
    help="Name or address under which outside nodes and the master reach this host.",
)
@click.option(
    "--master-port", type=options.PORT, default=11311, help="Where inside nodes find their master."
)
@click.option(
    "--port-range",
    type=options.PORT_RANGE,
    default="11000-11099",
    help="Ports to listen on, one per inside node.",
)
@click.option(
    "--advertise-port-range",
    type=options.PORT_RANGE,
    help="The same ports as outside sees them, if it differs; as many as in --port-range.",
)
@click.option(
    "--publish-master",
    type=options.PORT,
    help="Also offer the master itself to outside on this port (where it runs inside).",
)
@click.option(
    "--bind",
    type=options.BIND_ADDRESS,
    default="0.0.0.0",
    metavar="ADDRESS",
    help="Address to listen on.",
)
@click.option(
    "--admin-bind",
    type=options.HOST_PORT,
    default="127.0.0.1:11312",
    help="Where the live page, /healthz, /readyz, /metrics and /status are served.",
)
@click.option(
    "--admin-token",
    type=options.TOKEN,
    help="Lets callers that know it change things at --admin-bind, not only those on loopback. "
    "Better given as a variable: command lines can be seen by everybody.",
)
@click.option(
    "--admin-token-hash",
    type=options.TOKEN_HASH,
    help="The same where the proxy is not to hold the token: its SHA-256 in hex digits.",
)
@click.option(
    "--inside-network",
    type=options.NETWORK,
    envvar="ROSPROXY_INSIDE_NETWORKS",
    multiple=True,
    help="A network inside which nodes reach each other directly (repeatable). Default: the "
    "networks of the proxy's own interfaces.",
)
@_time("--probe-interval", 0.05, 5.0, "Time between probes of a node.")
@_time("--probe-timeout", 0.05, 3.0, "Time that a node has to answer.")
@_time(
    "--cleanup-after",
    0,
    30.0,
    "Time after which a node that is gone is unregistered at the master (0: never).",
)
@_time("--linger", 0, 30.0, "Time for which a port is kept after its node has ended.")
@_time("--master-interval", 0.05, 2.0, "Time between looks at the master.")
@click.option(
    "--slave-control",
    type=click.Choice(["any", "master"]),
    default="any",
    help="Who may call shutdown, publisherUpdate and paramUpdate at inside nodes.",
)
@click.option(
    "--policy",
    type=options.POLICY_RULES,
    multiple=True,
    help="What outside may see and do, and what inside may take from outside: rules such as "
    "'deny publish /camera/*', separated by ; (repeatable).",
)
@click.option(
    "--policy-mode",
    type=click.Choice(["enforce", "audit"]),
    default="enforce",
    help="Whether the rules of --policy and --policy-file are enforced, or only told.",
)
@click.option(
    "--policy-file",
    type=click.Path(),
    help="A file with more such rules, a line each; it is read again when it changes.",
)
@click.option(
    "--policy-layers",
    type=options.POLICY_LAYERS,
    default=(),
    show_default=False,
    help="For operators: the layers of rules at the start, as POST /policy takes them.",
)
@_time(
    "--await-policy",
    0,
    0.0,
    "For operators: time at the start in which nothing is registered before POST /policy has come.",
)
@click.option(
    "--data-plane",
    type=click.Choice(["auto", "kernel", "splice", "copy"]),
    default="auto",
    help="How topics' bytes are forwarded: by the kernel, where the proxy may; spliced; or copied.",
)
@click.option(
    "--direction",
    type=click.Choice(["out", "both"]),
    default="out",
    help="Who needs no route to the other side: outside alone, or (both) the nodes inside as well.",
)
@click.option(
    "--udp",
    is_flag=True,
    help="With --direction both: the range is published for UDP, too, so that UDPROS from outside "
    "comes in.",
)
@click.option(
    "--max-lease-call",
    type=options.MEBIBYTES,
    default=1,
    help="Longest call of outside to a node, with 10,000 XML elements for each MiB.",
)
@click.option(
    "--max-master-call",
    type=options.MEBIBYTES,
    default=4,
    help="Longest call of a node to the master that holds addresses, with 5,000 elements for each "
    "MiB.",
)
@click.option(
    "--max-body",
    type=options.MEBIBYTES,
    default=64,
    help="Longest parameter, or other call or reply without addresses, that passes.",
)
@click.option(
    "--max-buffered",
    type=options.MEBIBYTES,
    default=32,
    help="Memory for all calls and replies that are read; one source gets half.",
)
@click.option(
    "--max-connections-per-source",
    type=options.CONNECTIONS,
    default=4096,
    help="Connections from one address.",
)
@click.option(
    "--max-connections-per-lease",
    type=options.CONNECTIONS,
    default=2048,
    help="Connections to one port of the range.",
)
@click.option(
    "--ros2-domain",
    type=options.DOMAIN,
    envvar=["ROSPROXY_ROS2_DOMAINS", "ROS_DOMAIN_ID"],
    multiple=True,
    help="ROS 2: a domain (repeatable); they share out the range. Default: 0.",
)
@click.option(
    "--ros2-peer",
    type=options.PEER,
    envvar="ROSPROXY_ROS2_PEERS",
    multiple=True,
    help="ROS 2: a host outside that is told of participants inside, or another proxy, with the "
    "first port of its range (repeatable).",
)
@click.option(
    "--ros2-ear",
    type=options.HOST_PORT,
    help="ROS 2: where rosproxy ear listens, which carries announcements from and to the LAN.",
)
@options.log_options
@options.config_option
@click.option(
    "--check",
    is_flag=True,
    allow_from_autoenv=False,
    help="Validate the options and the policy's file, and exit.",
)
@click.option(
    "--deep",
    is_flag=True,
    allow_from_autoenv=False,
    help="With --check: also look up the hosts, bind the ports, ask the master, and have the range "
    "tried from outside; exit with 1 if something is wrong.",
)
def run(check: bool, deep: bool, log_format: str, log_level: str, **values: Any) -> None:
    """Run the proxy.

    What is given twice counts as on the command line, else as in the variable, else as in the file
    of --config.
    """
    from rosproxy.settings import make_settings
    from rosproxy.telemetry import logs

    if deep and not check:
        raise click.UsageError("--deep goes with --check")
    with options.setting_errors():
        settings = make_settings(**values)
        logs.set_up(log_format, log_level)
        unknown = options.unknown_variables(main)
        if not check:
            from rosproxy.app import proxy

            proxy.run(settings, {variable.name: variable.text for variable in unknown})
        else:
            _check(settings, deep)


def _check(settings: Any, deep: bool) -> None:
    """Say what is wrong with settings before anything runs. Raises SettingError."""
    from rosproxy.app.policy_sources import read_policy_file

    read_policy_file(settings)
    if deep:
        from rosproxy.cli.deep_check import deep_check
        from rosproxy.cli.questions import print_findings

        print_findings(deep_check(settings), as_json=False)


@main.command(context_settings={"auto_envvar_prefix": "ROSPROXY_EAR", "show_default": True})
@click.option("--domain", type=options.DOMAIN, default=0, help="The domain of DDS.")
@click.option("--lan", type=options.ADDRESS, required=True, help="This host's address on the LAN.")
@click.option(
    "--bind",
    type=options.HOST_PORT,
    required=True,
    help="Address and port that the proxy reaches, its --ros2-ear.",
)
@click.option(
    "--proxy",
    type=options.HOST_PORT,
    required=True,
    help="The proxy's address, as this host reaches it, and the first port of its range.",
)
@options.log_options
@options.config_option
def ear(log_format: str, log_level: str, **values: Any) -> None:
    """Carry announcements of ROS 2 between a LAN and the proxy; runs in the host's network.

    Nothing else: what users send goes through the ports that the host publishes.
    """
    from rosproxy.app.ear import run_ear
    from rosproxy.ros2.servers.ear import EarSettings
    from rosproxy.telemetry import logs

    with options.setting_errors():
        logs.set_up(log_format, log_level)
        options.unknown_variables(main)
        run_ear(EarSettings(**values))


for command in (questions.status, questions.health, questions.doctor):
    main.add_command(command)
