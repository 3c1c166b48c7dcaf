"""The command line ``rosproxy-controller``."""

import importlib.util
import logging
import os
import sys
from collections.abc import Callable
from typing import Any

import click

from rosproxy import __version__
from rosproxy.cli import Commands as ProxyCommands
from rosproxy.cli import log_options

DEFAULT_ADMIN = "http://127.0.0.1:11313"


class Commands(ProxyCommands):
    """Commands whose usage errors begin with this program's name."""

    program = "rosproxy-controller"


@click.group(
    cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(__version__, prog_name="rosproxy-controller")
def main() -> None:
    """Sets up rosproxy by itself for the containers of a host."""


@main.group(
    cls=Commands,
    invoke_without_command=True,
    context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True},
)
@click.option(
    "--master-uri",
    envvar=["ROSPROXY_MASTER_URI", "ROS_MASTER_URI"],
    metavar="URI",
    help="The real ROS master of containers that name none.",
)
@click.option(
    "--advertise-host",
    metavar="HOST",
    help="Name or address under which outside nodes and masters reach this host. Default: this "
    "host's address towards the master.",
)
@click.option(
    "--ports", type=int, default=32, metavar="N", help="Ports of a proxy, one per node behind it."
)
@click.option(
    "--port-window",
    default="11400-65535",
    metavar="A-B",
    help="Where ranges of ports are looked for.",
)
@click.option(
    "--publish-address",
    multiple=True,
    default=("0.0.0.0",),
    metavar="ADDRESS",
    help="Address of this host on which ports are published (repeatable).",
)
@click.option(
    "--proxy-image", default="rosproxy:latest", metavar="IMAGE", help="The proxies' image."
)
@click.option(
    "--expose-by-default",
    is_flag=True,
    help="Also serve containers without rosproxy.enable=true if they have ROS_MASTER_URI set.",
)
@click.option(
    "--grace",
    type=float,
    default=60.0,
    metavar="S",
    help="Time for which a proxy outlives its last container.",
)
@click.option(
    "--resync", type=float, default=30.0, metavar="S", help="Longest time between two looks."
)
@click.option(
    "--uplink",
    default="0-rosproxy",
    metavar="NETWORK",
    help="Network that is created for the proxies; it has to sort before all others.",
)
@click.option(
    "--admin-bind",
    default="127.0.0.1:11313",
    metavar="ADDRESS:PORT",
    help="Where /healthz, /readyz and /metrics are served.",
)
@log_options
@click.option(
    "--once",
    is_flag=True,
    help="Do what is to be done now and exit: with 0 if all is as wanted, with 1 if not.",
)
@click.pass_context
def docker(
    context: click.Context, /, once: bool, log_format: str, log_level: str, **options: Any
) -> None:
    """Look after the labelled containers of a Docker engine.

    The engine is the one that DOCKER_HOST names, else this host's. Every option has an
    environment variable: ROSPROXY_ and its name (ROSPROXY_PORTS); the master's is also
    ROS_MASTER_URI.
    """
    from rosproxy import logs
    from rosproxy.core.settings import SettingError
    from rosproxy_operator.settings import parse_docker_settings

    _need("docker")
    logs.set_up(log_format, log_level)
    logging.getLogger("docker").setLevel(logging.INFO)  # the SDK tells of each request otherwise
    logging.getLogger("urllib3").setLevel(logging.INFO)
    try:
        context.obj = parse_docker_settings(options)
    except SettingError as error:
        raise click.UsageError(str(error)) from None
    if context.invoked_subcommand is None:
        _run(context.obj, once)
    elif once:
        raise click.UsageError(f"--once has no meaning for {context.invoked_subcommand}")


def _need(library: str) -> None:
    """Say how to install a library that one kind of controller needs, if it is not there."""
    if importlib.util.find_spec(library) is None:
        click.echo(
            f"rosproxy-controller: the Python package {library} is not installed here: "
            f"pip install 'rosproxy[{library}]' (in its sources: pip install '.[{library}]')",
            err=True,
        )
        sys.exit(1)


def _run(settings: Any, once: bool) -> None:
    from rosproxy.core.settings import SettingError
    from rosproxy_operator.docker.run import run, run_once

    if not once:
        try:
            run(settings)
        except SettingError as error:
            raise click.UsageError(str(error)) from None
        return
    problems = _or_exit(lambda: run_once(settings))
    for problem in problems:
        click.echo(f"rosproxy-controller: {problem.subject}: {problem.text}", err=True)
    sys.exit(1 if problems else 0)


@docker.command()
@click.option("--json", "as_json", is_flag=True, help="Print it as JSON.")
@click.option("--watch", is_flag=True, help="Show it anew every two seconds, until Ctrl-C.")
@click.pass_obj
def status(settings: Any, as_json: bool, watch: bool) -> None:
    """Show the proxies, the labelled containers, their nodes, and what is wrong.

    Needs no running controller.
    """
    if as_json and watch:
        raise click.UsageError("--json or --watch, not both")
    from rosproxy_operator.docker import run

    if watch:
        run.watch_status(settings.plan)
    else:
        _or_exit(lambda: run.show_status(settings.plan, as_json))


@docker.command()
@click.pass_obj
def plan(settings: Any) -> None:
    """Show what the controller would do now, and change nothing."""
    from rosproxy_operator.docker import run

    _or_exit(lambda: run.show_plan(settings.plan))


@main.command()
def health() -> None:
    """Exit with 0 if the controller is alive, with 1 if not; for container health checks."""
    from rosproxy.admin_client import AdminClient, AdminError, default_url

    url = default_url() if os.environ.get("ROSPROXY_ADMIN_BIND") else DEFAULT_ADMIN
    try:
        AdminClient(url).get("/healthz", within=3.0)
    except AdminError as error:
        reason = str(error) if "HTTP" in str(error) else f"no controller answers at {url}"
        click.echo(f"rosproxy-controller: {reason}", err=True)
        sys.exit(1)


def _or_exit(work: Callable[[], Any]) -> Any:
    """Do something that may find no engine, and say so in one line."""
    from rosproxy_operator.docker.errors import EngineError

    try:
        return work()
    except EngineError as error:
        click.echo(f"rosproxy-controller: {error}", err=True)
        sys.exit(1)
