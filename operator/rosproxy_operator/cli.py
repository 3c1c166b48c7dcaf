"""The command line ``rosproxy-operator``."""

import importlib.util
import logging
import os
from collections.abc import Callable
from functools import partial
from typing import Any

import click
from click.core import ParameterSource

from rosproxy import __version__
from rosproxy.cli.main import main as proxy_main
from rosproxy.cli.options import (
    GROUP_SETTINGS,
    Command,
    Commands,
    Parsed,
    Seconds,
    config_option,
    log_options,
    setting_errors,
    settings_options,
    unknown_variables,
)
from rosproxy.cli.variables import UnknownVariable
from rosproxy.shared.addresses import HostPort, parse_host_port
from rosproxy_operator.common.command_errors import exit_on_error, exit_with, fail
from rosproxy_operator.common.problem import (
    UNKNOWN_NAME,
    Problem,
)
from rosproxy_operator.common.proxy_options import policy_options, proxy_bound_options
from rosproxy_operator.docker import commands as docker_commands
from rosproxy_operator.docker.settings import DEFAULT_ADMIN, PlanSettings, make_plan_settings
from rosproxy_operator.kubernetes import commands as kubernetes_commands
from rosproxy_operator.kubernetes.settings import (
    DEFAULT_WEBHOOK,
    Bounds,
    ClusterSettings,
    KubernetesSettings,
    WebhookSettings,
    make_kubernetes_settings,
)


def _read_bind(example: HostPort, optional: bool, text: str) -> HostPort | None:
    """Parse ``host:port``. With ``optional``, the text ``none`` gives None. Raises ValueError."""
    listener = parse_host_port(text)
    if listener is None and not (optional and text == "none"):
        raise ValueError(f"{text!r} is not of the form {example}")
    return listener


def _bind_option(
    name: str, example: HostPort, text: str, optional: bool = False
) -> Callable[[Command], Command]:
    """An option for an address and port.

    The default is ``example``; with ``optional``, the text ``none``.
    """
    kind = Parsed("address:port", partial(_read_bind, example, optional))
    return click.option(name, type=kind, default="none" if optional else str(example), help=text)


_resync_option = click.option(
    "--resync",
    type=Seconds(1.0),
    default=30.0,
    metavar="S",
    help="Longest time between two looks at the host.",
)


class OperatorCommands(Commands):
    """Commands whose usage errors begin with ``rosproxy-operator``."""

    program = "rosproxy-operator"


@click.group(cls=OperatorCommands, context_settings=GROUP_SETTINGS)
@click.version_option(__version__, prog_name="rosproxy-operator")
def main() -> None:
    """Set up proxies for the labelled containers of a host or the labelled pods of a cluster."""


@main.group(
    cls=OperatorCommands,
    invoke_without_command=True,
    context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True},
)
@settings_options(PlanSettings)
@proxy_bound_options
@policy_options
@_resync_option
@_bind_option(
    "--admin-bind",
    DEFAULT_ADMIN,
    "Address and port of /healthz, /readyz, /metrics and the live page of all proxies.",
)
@log_options
@config_option
@click.option(
    "--once",
    is_flag=True,
    help="Apply the labels once, and exit: with 0 if nothing is wrong, else with 1.",
)
@click.pass_context
def docker(
    context: click.Context, /, once: bool, log_format: str, log_level: str, **options: Any
) -> None:
    """Run proxies for the labelled containers of a Docker engine.

    The engine is that of DOCKER_HOST, else that of this host. Every option has an environment
    variable: ROSPROXY_ and the option's name, such as ROSPROXY_PORTS. --master-uri also has
    ROS_MASTER_URI.
    """
    from rosproxy.shared.output import logs

    _require_library("docker", "docker")
    logs.set_up(log_format, log_level)
    for library in ("docker", "urllib3"):  # these would log each request
        logging.getLogger(library).setLevel(logging.INFO)
    runs = context.invoked_subcommand is None
    unknown = _unknown_variables(log=not runs)
    with setting_errors():
        settings = make_plan_settings(options)
    # With options, a command shows the plan of an operator with these options, even if another
    # operator is running.
    sources = (context.get_parameter_source(name) for name in options if name != "admin_bind")
    context.obj = docker_commands.CommandContext(
        settings, options["admin_bind"], ParameterSource.COMMANDLINE in sources, options["resync"]
    )
    if runs:
        mistakes = [
            Problem(
                f"variable {v.name}",
                v.text,
                "Correct the name, or unset the variable",
                fatal=False,
                reason=UNKNOWN_NAME,
            )
            for v in unknown
        ]
        _run(settings, options["resync"], options["admin_bind"], once, mistakes)
    elif once:
        raise click.UsageError(
            f"--once and {context.invoked_subcommand} exclude each other. Omit --once"
        )


def _unknown_variables(log: bool = True) -> list[UnknownVariable]:
    # The variables of the proxy have the same prefix, ROSPROXY_, so these are no mistakes here.
    return unknown_variables(main, proxy_main, log=log)


def _require_library(library: str, extra: str) -> None:
    """If a library is not installed, print how to install it, and exit."""
    if importlib.util.find_spec(library) is None:
        fail(
            f"the Python package {library} is not installed. Run pip install 'rosproxy[{extra}]' "
            f"(in the sources of rosproxy: pip install '.[{extra}]')"
        )


def _run(
    settings: PlanSettings, resync: float, admin: HostPort, once: bool, mistakes: list[Problem]
) -> None:
    from rosproxy_operator.docker.controller import run, run_once

    if not once:
        with setting_errors(), exit_on_error():
            run(settings, resync, admin, mistakes)
        return
    from rosproxy_operator.docker.errors import EngineError

    with exit_on_error(EngineError):
        problems = run_once(settings, resync, mistakes)
    exit_with(problems)


for command in (
    docker_commands.status,
    docker_commands.plan,
    docker_commands.doctor,
    docker_commands.uninstall,
):
    docker.add_command(command)


@main.group(
    cls=OperatorCommands,
    invoke_without_command=True,
    context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True},
)
@settings_options(ClusterSettings, Bounds, KubernetesSettings)
@proxy_bound_options
@policy_options
@_bind_option(
    "--webhook-bind",
    DEFAULT_WEBHOOK,
    "Address and port of the admission webhook that wires pods. none: no webhook.",
    optional=True,
)
@settings_options(WebhookSettings)
@log_options
@config_option
@click.pass_context
def kubernetes(context: click.Context, /, log_format: str, log_level: str, **options: Any) -> None:
    """Run the proxies of the RosProxies in a Kubernetes cluster.

    The cluster is that of the pod in which this program runs, else that of KUBECONFIG. Every option
    has an environment variable: ROSPROXY_ and the option's name, such as ROSPROXY_PROXY_IMAGE.
    """
    for library in ("kubernetes", "kopf", "cryptography"):
        _require_library(library, "kubernetes")
    with setting_errors():
        settings = make_kubernetes_settings(options)
        if context.invoked_subcommand is None:
            _run_kubernetes(settings, log_format, log_level)
        else:
            _unknown_variables()
    context.obj = settings.namespaces


kubernetes.add_command(kubernetes_commands.doctor)


def _run_kubernetes(settings: Any, log_format: str, log_level: str) -> None:
    from rosproxy.shared.output import logs
    from rosproxy_operator.kubernetes.api.api_client import ApiError
    from rosproxy_operator.kubernetes.run import run
    from rosproxy_operator.kubernetes.serving import quiet_library_logs

    logs.set_up(log_format, log_level)
    _unknown_variables()
    quiet_library_logs()
    with exit_on_error(ApiError):
        run(settings)


@main.command()
def health() -> None:
    """Exit with 0 if the operator is alive, with 1 if not; for container health checks."""
    from rosproxy.shared.http.admin_client import AdminClient, AdminError, default_url

    # Without the variable, default_url() has port 11312, of a proxy. The operator listens on 11313.
    url = default_url() if os.environ.get("ROSPROXY_ADMIN_BIND") else f"http://{DEFAULT_ADMIN}"
    try:
        AdminClient(url).get("/healthz", within=3.0)
    except AdminError as error:
        # If the operator has answered with an HTTP status, the text says what is wrong.
        fail(error if "HTTP" in str(error) else f"no operator answers at {url}")
