"""The command line ``rosproxy-operator``."""

import importlib.util
import logging
import os
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import click

from rosproxy import __version__
from rosproxy.cli.options import (
    BIND_ADDRESS,
    GROUP_SETTINGS,
    HOST,
    PORT_RANGE,
    Commands,
    Parsed,
    Seconds,
    log_options,
    setting_errors,
)
from rosproxy.net.addresses import HostPort
from rosproxy_operator.common.settings import read_bind, read_image
from rosproxy_operator.docker.planner.model import MOST_PORTS
from rosproxy_operator.docker.settings import (
    DEFAULT_ADMIN,
    make_docker_settings,
    read_shared_master_uri,
    read_uplink,
)
from rosproxy_operator.kubernetes.settings import DEFAULT_ADMIN as CLUSTER_ADMIN
from rosproxy_operator.kubernetes.settings import (
    DEFAULT_LIVENESS,
    DEFAULT_WEBHOOK,
    make_kubernetes_settings,
    read_name,
    read_namespace,
    read_object_name,
)

IMAGE = Parsed("image", read_image)
MASTER_URI = Parsed("URI of a master", read_shared_master_uri)
NAME = Parsed("namespace/name", read_name)
NAMESPACE = Parsed("namespace", read_namespace)
OBJECT_NAME = Parsed("name", read_object_name)
UPLINK = Parsed("network", read_uplink)


def _bind(example: HostPort, optional: bool = False) -> Parsed:
    return Parsed("host:port", partial(read_bind, example, optional))


class OperatorCommands(Commands):
    """Commands whose usage errors begin with this program's name."""

    program = "rosproxy-operator"


@click.group(cls=OperatorCommands, context_settings=GROUP_SETTINGS)
@click.version_option(__version__, prog_name="rosproxy-operator")
def main() -> None:
    """Sets up rosproxy by itself for the containers of a host or the pods of a cluster."""


@main.group(
    cls=OperatorCommands,
    invoke_without_command=True,
    context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True},
)
@click.option(
    "--master-uri",
    type=MASTER_URI,
    envvar=["ROSPROXY_MASTER_URI", "ROS_MASTER_URI"],
    metavar="URI",
    help="The real ROS master of containers that name none.",
)
@click.option(
    "--advertise-host",
    type=HOST,
    metavar="HOST",
    help="Name or address under which outside nodes and masters reach this host. Default: this "
    "host's address towards the master.",
)
@click.option(
    "--ports",
    type=click.IntRange(1, MOST_PORTS),
    default=32,
    metavar="N",
    help="Ports of a proxy, one per node behind it.",
)
@click.option(
    "--port-window",
    type=PORT_RANGE,
    default="11400-65535",
    metavar="A-B",
    help="Where ranges of ports are looked for.",
)
@click.option(
    "--publish-address",
    type=BIND_ADDRESS,
    multiple=True,
    default=("0.0.0.0",),
    metavar="ADDRESS",
    help="Address of this host on which ports are published (repeatable).",
)
@click.option(
    "--proxy-image",
    type=IMAGE,
    default="rosproxy:latest",
    metavar="IMAGE",
    help="The proxies' image.",
)
@click.option(
    "--data-plane",
    type=click.Choice(["auto", "kernel", "splice", "copy"]),
    default="auto",
    help="How proxies forward topics. kernel: they get the capability NET_ADMIN for it.",
)
@click.option(
    "--expose-by-default",
    is_flag=True,
    help="Also serve containers without rosproxy.enable=true if they have ROS_MASTER_URI set.",
)
@click.option(
    "--grace",
    type=Seconds(0.0),
    default=60.0,
    metavar="S",
    help="Time for which a proxy outlives its last container.",
)
@click.option(
    "--resync", type=Seconds(1.0), default=30.0, metavar="S", help="Longest time between two looks."
)
@click.option(
    "--uplink",
    type=UPLINK,
    default="0-rosproxy",
    metavar="NETWORK",
    help="Network that is created for the proxies; it has to sort before all others.",
)
@click.option(
    "--admin-bind",
    type=_bind(DEFAULT_ADMIN),
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
    from rosproxy.telemetry import logs

    _need("docker", "docker")
    logs.set_up(log_format, log_level)
    logging.getLogger("docker").setLevel(logging.INFO)  # the SDK tells of each request otherwise
    logging.getLogger("urllib3").setLevel(logging.INFO)
    with setting_errors():
        context.obj = make_docker_settings(options)
    if context.invoked_subcommand is None:
        _run(context.obj, once)
    elif once:
        raise click.UsageError(f"--once has no meaning for {context.invoked_subcommand}")


def _need(library: str, extra: str) -> None:
    """Say how to install a library that one kind of controller needs, if it is not there."""
    if importlib.util.find_spec(library) is None:
        click.echo(
            f"rosproxy-operator: the Python package {library} is not installed here: "
            f"pip install 'rosproxy[{extra}]' (in its sources: pip install '.[{extra}]')",
            err=True,
        )
        sys.exit(1)


def _run(settings: Any, once: bool) -> None:
    from rosproxy_operator.docker.run import run, run_once

    if not once:
        with setting_errors():
            run(settings)
        return
    problems = _or_exit(lambda: run_once(settings))
    for problem in problems:
        click.echo(f"rosproxy-operator: {problem.subject}: {problem.text}", err=True)
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
    """Show what the operator would do now, and change nothing."""
    from rosproxy_operator.docker import run

    _or_exit(lambda: run.show_plan(settings.plan))


@main.command(context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True})
@click.option(
    "--namespace",
    type=NAMESPACE,
    multiple=True,
    metavar="NAME",
    help="Look after the RosProxies of this namespace only (repeatable). Default: of all.",
)
@click.option(
    "--proxy-image",
    type=IMAGE,
    default="rosproxy:latest",
    metavar="IMAGE",
    help="Image of the proxies whose RosProxy names none.",
)
@click.option(
    "--proxy-image-pull-policy",
    type=click.Choice(["Always", "IfNotPresent", "Never"]),
    help="Their imagePullPolicy. Default: left to Kubernetes.",
)
@click.option(
    "--node-port-range",
    type=PORT_RANGE,
    default="30000-32767",
    metavar="A-B",
    help="The API server's --service-node-port-range: no proxy gets a port of it.",
)
@click.option(
    "--ephemeral-range",
    type=PORT_RANGE,
    default="32768-60999",
    metavar="A-B",
    help="The nodes' net.ipv4.ip_local_port_range: no proxy gets a port of it.",
)
@click.option(
    "--resync", type=Seconds(1.0), default=30.0, metavar="S", help="Longest time between two looks."
)
@click.option(
    "--webhook-bind",
    type=_bind(DEFAULT_WEBHOOK, optional=True),
    default="none",
    metavar="ADDRESS:PORT",
    help="Where the admission webhook is served that wires pods; none: it is not.",
)
@click.option(
    "--webhook-service",
    type=NAME,
    metavar="NAMESPACE/NAME",
    help="The webhook's Service: the names for which its certificate is made.",
)
@click.option(
    "--webhook-secret",
    type=NAME,
    metavar="NAMESPACE/NAME",
    help="An existing Secret in which that certificate is kept over restarts.",
)
@click.option(
    "--webhook-configuration",
    type=OBJECT_NAME,
    metavar="NAME",
    help="The MutatingWebhookConfiguration into which its CA is written.",
)
@click.option(
    "--webhook-cert-dir",
    metavar="DIR",
    help="Take the certificate from here instead (tls.crt, tls.key), anew when it changes.",
)
@click.option(
    "--admin-bind",
    type=_bind(CLUSTER_ADMIN),
    default="0.0.0.0:11313",
    metavar="ADDRESS:PORT",
    help="Where /healthz, /readyz and /metrics are served.",
)
@click.option(
    "--liveness-bind",
    type=_bind(DEFAULT_LIVENESS),
    default="0.0.0.0:8080",
    metavar="ADDRESS:PORT",
    help="Where /healthz is served for the kubelet: it fails when any part hangs.",
)
@log_options
def kubernetes(log_format: str, log_level: str, **options: Any) -> None:
    """Look after the RosProxies of a Kubernetes cluster.

    The cluster is the one that this runs in, else the one that KUBECONFIG names. Every option has
    an environment variable: ROSPROXY_ and its name (ROSPROXY_PROXY_IMAGE).
    """
    for library in ("kubernetes", "kopf", "cryptography"):
        _need(library, "kubernetes")
    with setting_errors():
        _run_kubernetes(make_kubernetes_settings(options), log_format, log_level)


def _run_kubernetes(settings: Any, log_format: str, log_level: str) -> None:
    from rosproxy.telemetry import logs
    from rosproxy_operator.kubernetes.api import ApiError
    from rosproxy_operator.kubernetes.run import run
    from rosproxy_operator.kubernetes.watch import quieten

    logs.set_up(log_format, log_level)
    quieten()
    try:
        run(settings)
    except ApiError as error:
        click.echo(f"rosproxy-operator: {error}", err=True)
        sys.exit(1)


@main.command()
def health() -> None:
    """Exit with 0 if the operator is alive, with 1 if not; for container health checks."""
    from rosproxy.admin.client import AdminClient, AdminError, default_url

    url = default_url() if os.environ.get("ROSPROXY_ADMIN_BIND") else f"http://{DEFAULT_ADMIN}"
    try:
        AdminClient(url).get("/healthz", within=3.0)
    except AdminError as error:
        reason = str(error) if "HTTP" in str(error) else f"no operator answers at {url}"
        click.echo(f"rosproxy-operator: {reason}", err=True)
        sys.exit(1)


def _or_exit(work: Callable[[], Any]) -> Any:
    """Do something that may find no engine, and say so in one line."""
    from rosproxy_operator.common.control_loop import LookFailed
    from rosproxy_operator.docker.errors import EngineError

    try:
        return work()
    except (EngineError, LookFailed) as error:
        click.echo(f"rosproxy-operator: {error}", err=True)
        sys.exit(1)
