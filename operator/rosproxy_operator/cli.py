"""The command line ``rosproxy-operator``."""

import importlib.util
import logging
import os
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import click

from rosproxy import __version__, values
from rosproxy.cli.main import main as proxy_main
from rosproxy.cli.options import (
    GROUP_SETTINGS,
    Command,
    Commands,
    Parsed,
    Seconds,
    click_type,
    config_option,
    log_options,
    setting_errors,
    unknown_variables,
)
from rosproxy.net.addresses import HostPort, parse_host_port
from rosproxy_operator.common.options import policy_options, proxy_bound_options
from rosproxy_operator.common.words import exit_on_error, fail
from rosproxy_operator.docker import commands as docker_commands
from rosproxy_operator.docker.options import bound_options
from rosproxy_operator.docker.planner.model import MOST_PORTS, PlanSettings
from rosproxy_operator.docker.settings import (
    DEFAULT_ADMIN,
    make_plan_settings,
    read_shared_master_uri,
    read_uplink,
)
from rosproxy_operator.kubernetes import commands as kubernetes_commands
from rosproxy_operator.kubernetes.options import administrators_options, own_options, ros2_options
from rosproxy_operator.kubernetes.settings import DEFAULT_ADMIN as CLUSTER_ADMIN
from rosproxy_operator.kubernetes.settings import (
    DEFAULT_LIVENESS,
    DEFAULT_WEBHOOK,
    make_kubernetes_settings,
    read_name,
    read_namespace,
    read_object_name,
)


def _read_image(text: str) -> str:
    """The name of a container image. Raises ValueError."""
    if not text or any(c.isspace() for c in text):
        raise ValueError(f"{text!r} is not the name of an image")
    return text


def _read_bind(example: HostPort, optional: bool, text: str) -> HostPort | None:
    """``host:port`` to listen on; ``none`` is None where ``optional``. Raises ValueError."""
    listener = parse_host_port(text)
    if listener is None and not (optional and text == "none"):
        raise ValueError(f"{text!r} is not of the form {example}")
    return listener


IMAGE = Parsed("image", _read_image)
NAME = Parsed("namespace/name", read_name)


def _bind_option(
    name: str, example: HostPort, text: str, optional: bool = False
) -> Callable[[Command], Command]:
    """Where to listen: by default at the example, or if that is ``optional`` nowhere."""
    kind = Parsed("address:port", partial(_read_bind, example, optional))
    return click.option(name, type=kind, default="none" if optional else str(example), help=text)


def _admin_option(default: HostPort) -> Callable[[Command], Command]:
    return _bind_option(
        "--admin-bind", default, "Where /healthz, /readyz, /metrics and the live page are served."
    )


def _image_option(text: str) -> Callable[[Command], Command]:
    return click.option("--proxy-image", type=IMAGE, default="rosproxy:latest", help=text)


_resync_option = click.option(
    "--resync", type=Seconds(1.0), default=30.0, metavar="S", help="Longest time between two looks."
)


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
    type=Parsed("URI", read_shared_master_uri),
    envvar=["ROSPROXY_MASTER_URI", "ROS_MASTER_URI"],
    help="The real ROS master of containers that name none.",
)
@click.option(
    "--advertise-host",
    type=click_type(values.HOST),
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
    type=click_type(values.PORT_RANGE),
    default="11412-65535",
    metavar="A-B",
    help="Where ranges of ports are looked for.",
)
@click.option(
    "--publish-address",
    type=click_type(values.BIND_ADDRESS),
    multiple=True,
    default=("0.0.0.0",),
    metavar="ADDRESS",
    help="Address of this host on which ports are published (repeatable).",
)
@_image_option("The proxies' image.")
@click.option(
    "--data-plane",
    type=click.Choice(["auto", "kernel", "splice", "copy"]),
    default="auto",
    help="How proxies forward topics. kernel: they get the capability NET_ADMIN for it.",
)
@click.option(
    "--direction",
    type=click.Choice(["out", "both"]),
    default="out",
    help="Who needs no route to the other side: outside alone, or (both) containers as well. Those "
    "on an internal network get both by themselves.",
)
@click.option(
    "--udp",
    is_flag=True,
    help="Proxies of both directions publish their ports for UDP as well, so that UDPROS of nodes "
    "outside reaches containers.",
)
@bound_options
@proxy_bound_options
@policy_options
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
@_resync_option
@click.option(
    "--uplink",
    type=Parsed("network", read_uplink),
    default="0-rosproxy",
    help="Network that is created for the proxies; it has to sort before all others.",
)
@_admin_option(DEFAULT_ADMIN)
@log_options
@config_option
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
    for library in ("docker", "urllib3"):  # they log each request otherwise
        logging.getLogger(library).setLevel(logging.INFO)
    unknown_variables(main, proxy_main)
    with setting_errors():
        context.obj = make_plan_settings(options)
    if context.invoked_subcommand is None:
        _run(context.obj, options["resync"], options["admin_bind"], once)
    elif once:
        raise click.UsageError(f"--once has no meaning for {context.invoked_subcommand}")


def _need(library: str, extra: str) -> None:
    """Say how to install a library that one kind of controller needs, if it is not there."""
    if importlib.util.find_spec(library) is None:
        fail(
            f"the Python package {library} is not installed here: "
            f"pip install 'rosproxy[{extra}]' (in its sources: pip install '.[{extra}]')"
        )


def _run(settings: PlanSettings, resync: float, admin: HostPort, once: bool) -> None:
    from rosproxy.telemetry.text import clean
    from rosproxy_operator.docker.controller import run, run_once

    if not once:
        with setting_errors():
            run(settings, resync, admin)
        return
    from rosproxy_operator.docker.errors import EngineError

    with exit_on_error(EngineError):
        problems = run_once(settings, resync)
    for problem in problems:
        text = clean(f"{problem.subject}: {problem.text}")
        click.echo(f"rosproxy-operator: {text}", err=True)
    sys.exit(1 if problems else 0)


for command in (docker_commands.status, docker_commands.plan, docker_commands.doctor):
    docker.add_command(command)


@main.group(
    cls=OperatorCommands,
    invoke_without_command=True,
    context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True},
)
@click.option(
    "--namespace",
    type=Parsed("name", read_namespace),
    multiple=True,
    help="Look after the RosProxies of this namespace only (repeatable). Default: of all.",
)
@_image_option("Image of the proxies whose RosProxy names none.")
@click.option(
    "--proxy-image-pull-policy",
    type=click.Choice(["Always", "IfNotPresent", "Never"]),
    help="Their imagePullPolicy. Default: left to Kubernetes.",
)
@click.option(
    "--node-port-range",
    type=click_type(values.PORT_RANGE),
    default="30000-32767",
    metavar="A-B",
    help="The API server's --service-node-port-range: no proxy gets a port of it.",
)
@click.option(
    "--ephemeral-range",
    type=click_type(values.PORT_RANGE),
    default="32768-60999",
    metavar="A-B",
    help="The nodes' net.ipv4.ip_local_port_range: no proxy gets a port of it.",
)
@administrators_options
@ros2_options
@proxy_bound_options
@policy_options
@own_options
@_resync_option
@_bind_option(
    "--webhook-bind",
    DEFAULT_WEBHOOK,
    "Where the admission webhook is served that wires pods; none: it is not.",
    optional=True,
)
@click.option(
    "--webhook-service",
    type=NAME,
    help="The webhook's Service: the names for which its certificate is made.",
)
@click.option(
    "--webhook-secret",
    type=NAME,
    help="An existing Secret in which that certificate is kept over restarts.",
)
@click.option(
    "--webhook-configuration",
    type=Parsed("name", read_object_name),
    help="The MutatingWebhookConfiguration into which its CA is written.",
)
@click.option(
    "--webhook-cert-dir",
    metavar="DIR",
    help="Take the certificate from here instead (tls.crt, tls.key), anew when it changes.",
)
@_admin_option(CLUSTER_ADMIN)
@_bind_option(
    "--liveness-bind",
    DEFAULT_LIVENESS,
    "Where /healthz is served for the kubelet: it fails when any part hangs.",
)
@log_options
@config_option
@click.pass_context
def kubernetes(context: click.Context, /, log_format: str, log_level: str, **options: Any) -> None:
    """Look after the RosProxies of a Kubernetes cluster.

    The cluster is the one that this runs in, else the one that KUBECONFIG names. Every option has
    an environment variable: ROSPROXY_ and its name (ROSPROXY_PROXY_IMAGE).
    """
    for library in ("kubernetes", "kopf", "cryptography"):
        _need(library, "kubernetes")
    with setting_errors():
        settings = make_kubernetes_settings(options)
        if context.invoked_subcommand is None:
            _run_kubernetes(settings, log_format, log_level)
    context.obj = settings.namespaces


kubernetes.add_command(kubernetes_commands.doctor)


def _run_kubernetes(settings: Any, log_format: str, log_level: str) -> None:
    from rosproxy.telemetry import logs
    from rosproxy_operator.kubernetes.api.client import ApiError
    from rosproxy_operator.kubernetes.run import run
    from rosproxy_operator.kubernetes.serving import quiet_library_logs

    logs.set_up(log_format, log_level)
    unknown_variables(main, proxy_main)
    quiet_library_logs()
    with exit_on_error(ApiError):
        run(settings)


@main.command()
def health() -> None:
    """Exit with 0 if the operator is alive, with 1 if not; for container health checks."""
    from rosproxy.admin.client import AdminClient, AdminError, default_url

    url = default_url() if os.environ.get("ROSPROXY_ADMIN_BIND") else f"http://{DEFAULT_ADMIN}"
    try:
        AdminClient(url).get("/healthz", within=3.0)
    except AdminError as error:
        fail(error if "HTTP" in str(error) else f"no operator answers at {url}")
