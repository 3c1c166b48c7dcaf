"""The command line."""

import asyncio
import contextlib
import signal
import sys
from collections.abc import Callable, Coroutine
from typing import Any, cast

import click

from rosproxy import __version__


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="rosproxy")
def main() -> None:
    """Transparent proxy for ROS 1: nodes behind it and nodes outside talk both ways."""


@main.command(context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True})
@click.option("--master-uri", envvar="ROS_MASTER_URI", metavar="URI", help="The real ROS master.")
@click.option(
    "--advertise-host",
    metavar="HOST",
    help="Name or address under which outside nodes and the master reach this host.",
)
@click.option(
    "--master-port", type=int, default=11311, help="Where inside nodes find their master."
)
@click.option(
    "--port-range",
    default="45000-45099",
    metavar="A-B",
    help="Ports to listen on, one per inside node.",
)
@click.option(
    "--advertise-port-range",
    metavar="A-B",
    help="The same ports as outside sees them, if it differs; as many as in --port-range.",
)
@click.option(
    "--publish-master",
    type=int,
    metavar="PORT",
    help="Also offer the master itself to outside on this port (where it runs inside).",
)
@click.option("--bind", default="0.0.0.0", metavar="ADDRESS", help="Address to listen on.")
@click.option(
    "--admin-bind",
    default="127.0.0.1:11312",
    metavar="ADDRESS:PORT",
    help="Where /healthz, /readyz, /metrics and /status are served.",
)
@click.option(
    "--inside-network",
    envvar="ROSPROXY_INSIDE_NETWORKS",
    multiple=True,
    metavar="CIDR",
    help="A network inside which nodes reach each other directly (repeatable). Default: the "
    "networks of the proxy's own interfaces.",
)
@click.option(
    "--probe-interval", type=float, default=5.0, metavar="S", help="Time between probes of a node."
)
@click.option(
    "--probe-timeout", type=float, default=3.0, metavar="S", help="Time that a node has to answer."
)
@click.option(
    "--cleanup-after",
    type=float,
    default=30.0,
    metavar="S",
    help="Time after which a node that is gone is unregistered at the master (0: never).",
)
@click.option(
    "--linger",
    type=float,
    default=30.0,
    metavar="S",
    help="Time for which a port is kept after its node has ended.",
)
@click.option(
    "--master-interval",
    type=float,
    default=2.0,
    metavar="S",
    help="Time between looks at the master.",
)
@click.option(
    "--slave-control",
    type=click.Choice(["any", "master"]),
    default="any",
    help="Who may call shutdown, publisherUpdate and paramUpdate at inside nodes.",
)
@click.option(
    "--log-format", type=click.Choice(["text", "json"]), default="text", help="Log format."
)
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"], case_sensitive=False),
    default="info",
    help="Least severe messages to log.",
)
@click.option("--check", is_flag=True, help="Validate the options and exit.")
def run(check: bool, log_format: str, log_level: str, **options: Any) -> None:
    """Run the proxy.

    Every option has an environment variable: ROSPROXY_ and its name (ROSPROXY_PORT_RANGE); the
    master's is ROS_MASTER_URI, the inside networks' ROSPROXY_INSIDE_NETWORKS.
    """
    from rosproxy import logs
    from rosproxy.app import serve
    from rosproxy.core.settings import SettingError, parse_settings

    logs.set_up(log_format, log_level)
    try:
        settings = parse_settings(options)
        if not check:
            _run_until_signal(lambda stopped: serve(settings, stopped))
    except SettingError as error:
        click.echo(f"rosproxy: {error}", err=True)
        sys.exit(2)


Serve = Callable[[asyncio.Event], Coroutine[Any, Any, None]]


def _run_until_signal(serve: Serve) -> None:
    with asyncio.Runner(loop_factory=_loop_factory()) as runner:
        runner.run(_with_signals(serve))


async def _with_signals(serve: Serve) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    await serve(stopped)


def _loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    with contextlib.suppress(ImportError):
        import uvloop

        return cast(Callable[[], asyncio.AbstractEventLoop], uvloop.new_event_loop)
    return None
