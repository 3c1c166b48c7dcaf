"""The command line: ``rosproxy run``, ``status``, ``health`` and ``doctor``.

Commands import what they need when they run, so that a health check starts fast.
"""

import sys
from collections.abc import Callable
from typing import Any

import click

from rosproxy import __version__
from rosproxy.cli import options
from rosproxy.cli.options import Command


@click.group(cls=options.Commands, context_settings=options.GROUP_SETTINGS)
@click.version_option(__version__, prog_name="rosproxy")
def main() -> None:
    """Transparent proxy for ROS 1: nodes behind it and nodes outside talk both ways."""


def _time(name: str, least: float, default: float, text: str) -> Callable[..., Command]:
    return click.option(name, type=options.Seconds(least), default=default, help=text)


@main.command(context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True})
@click.option(
    "--master-uri",
    type=options.MASTER_URI,
    required=True,
    envvar="ROS_MASTER_URI",
    help="The real ROS master, e.g. http://robot:11311.",
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
    help="Where /healthz, /readyz, /metrics and /status are served.",
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
@options.log_options
@click.option("--check", is_flag=True, help="Validate the options and exit.")
def run(check: bool, log_format: str, log_level: str, **values: Any) -> None:
    """Run the proxy.

    Every option has an environment variable: ROSPROXY_ and its name (ROSPROXY_PORT_RANGE); the
    master's is ROS_MASTER_URI, the inside networks' ROSPROXY_INSIDE_NETWORKS.
    """
    from rosproxy import app
    from rosproxy.settings import make_settings
    from rosproxy.telemetry import logs

    with options.setting_errors():
        settings = make_settings(**values)
        logs.set_up(log_format, log_level)
        if not check:
            app.run(settings)


def _admin_client(context: click.Context, option: click.Parameter, url: str | None) -> Any:
    from rosproxy.admin.client import AdminClient, default_url

    try:
        return AdminClient(url or default_url())
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


_admin_option = click.option(
    "--admin",
    envvar="ROSPROXY_ADMIN",
    show_envvar=True,
    callback=_admin_client,
    metavar="URL",
    help="The proxy's admin endpoint. Default: what ROSPROXY_ADMIN_BIND says, else "
    "http://127.0.0.1:11312.",
)


@main.command()
@_admin_option
@click.option("--json", "as_json", is_flag=True, help="Print the state as JSON.")
@click.option("--watch", is_flag=True, help="Show it anew every two seconds, until Ctrl-C.")
def status(admin: Any, as_json: bool, watch: bool) -> None:
    """Show the master, the ports, and the nodes behind the proxy."""
    if as_json and watch:
        raise click.UsageError("--json or --watch, not both")
    from rosproxy.cli import terminal

    if watch:
        terminal.watch_status(admin)
    else:
        _or_exit(lambda: terminal.show_status(admin, as_json))


@main.command()
@_admin_option
def health(admin: Any) -> None:
    """Exit with 0 if the proxy is alive, with 1 if not; for container health checks."""
    _or_exit(lambda: admin.get("/healthz", within=3.0))


@main.command()
@click.argument("names", nargs=-1, metavar="[TOPIC|NODE|SERVICE]...")
@_admin_option
@click.option(
    "--master-uri",
    type=options.MASTER_URI,
    envvar="ROS_MASTER_URI",
    help="The master to look at if the proxy can't be asked for its own.",
)
@click.option(
    "--advertise-host",
    type=options.HOST,
    envvar="ROSPROXY_ADVERTISE_HOST",
    help="The advertised host if the proxy can't be asked for it.",
)
@click.option(
    "--master-address",
    type=options.ADDRESS,
    envvar="ROSPROXY_MASTER_ADDRESS",
    help="The IP address of the master's host if the proxy can't be asked for it.",
)
@click.option(
    "--outside",
    is_flag=True,
    help="Look from here as a machine outside does, for example from a robot; ask no proxy.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON.")
def doctor(
    names: tuple[str, ...],
    admin: Any,
    master_uri: str | None,
    advertise_host: str | None,
    master_address: str | None,
    outside: bool,
    as_json: bool,
) -> None:
    """Find out why A can't hear B, and say what mends it.

    Looks at the proxy, its ports, the master and all nodes. With names: who publishes and who
    subscribes to that topic; that node's topics; or what two nodes have to say to each other,
    and which of them are not connected, and why.

    Run it where the proxy runs: docker exec CONTAINER rosproxy doctor. What outside machines see
    is told by running it there with --outside. Exits with 0 if nothing is wrong, with 1 if
    something is.
    """
    import asyncio
    import json

    from rosproxy.cli import terminal
    from rosproxy.doctor import findings, rules
    from rosproxy.doctor.collect import collect

    if outside and not master_uri:
        raise click.UsageError("--outside needs --master-uri (ROS_MASTER_URI)")
    asked = collect(
        None if outside else admin,
        master_uri or "",
        advertise_host or "",
        tuple(f"/{name.strip('/')}" for name in names),
        master_address,
    )
    found = rules.diagnose(asyncio.run(asked))
    if as_json:
        terminal.write(json.dumps(findings.as_json(found), indent=2))
    else:
        terminal.write(findings.render(found, terminal.size()[0]))
    sys.exit(1 if findings.failed(found) else 0)


def _or_exit(ask: Callable[[], object]) -> None:
    """Do something that may find the proxy absent, and say so in one line."""
    from rosproxy.admin.client import AdminError

    try:
        ask()
    except AdminError as error:
        click.echo(f"rosproxy: {error}", err=True)
        sys.exit(1)
