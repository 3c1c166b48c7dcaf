"""The commands of ``rosproxy-operator docker``. Only ``uninstall`` changes something.

Each command imports its modules when the command runs, because the Docker SDK may be missing.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import click

from rosproxy.cli.options import Command, Seconds
from rosproxy.shared.addresses import HostPort
from rosproxy_operator.common.command_errors import exit_on_error, exit_with, fail
from rosproxy_operator.docker.settings import PlanSettings


@dataclass(frozen=True, slots=True)
class CommandContext:
    """The options before a command.

    A command asks the operator whose admin endpoint is ``admin`` for the status. If that operator
    does not answer, the command looks at the host itself, with ``settings``. ``has_options``: the
    command line has options, so the command asks no operator. ``resync`` is in seconds.
    """

    settings: PlanSettings
    admin: HostPort
    has_options: bool
    resync: float

    @property
    def operator(self) -> HostPort | None:
        """The admin endpoint of the operator to ask; None: ask no operator."""
        return None if self.has_options else self.admin


_json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def _wait_option(text: str) -> Callable[[Command], Command]:
    return click.option("--wait", type=Seconds(0), default=0, help=text, allow_from_autoenv=False)


@click.command()
@_json_option
@click.option(
    "--watch", is_flag=True, help="Draw the status again every two seconds, until Ctrl-C."
)
@_wait_option("Longest time to wait until nothing is wrong and no step is left, before printing.")
@click.option(
    "--open", "opens", is_flag=True, help="Open the live page of all proxies in a browser instead."
)
@click.pass_obj
def status(context: CommandContext, as_json: bool, watch: bool, wait: float, opens: bool) -> None:
    """Show the proxies, the labelled containers, their nodes, and the problems.

    The running operator reports the status. If no operator answers at --admin-bind, or if options
    stand before this command, the status is what an operator with those options would see.

    Exits with 0 if nothing is wrong, no step is left, and every proxy works; else with 1. A proxy
    works if it answers, reaches its master and routers, and outside reaches its ports. A check
    without a result counts as passed.
    """
    if as_json + watch + opens > 1:
        raise click.UsageError("--json, --watch and --open exclude each other. Give one option")
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import HostStatus, show_status, watch_status

    if opens:
        _open_page(context.admin)
        return
    host = HostStatus(context.settings, context.operator)
    if watch:
        watch_status(host)
        return
    with exit_on_error(EngineError):
        sys.exit(show_status(host, as_json, wait))


def _open_page(admin: HostPort) -> None:
    """Open the live page of the operator that runs here; exit if no operator answers."""
    from rosproxy.cli.browser import open_page
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import ask_operators

    with exit_on_error(EngineError):
        document = ask_operators(admin)
    if document is None:
        fail(
            f"no operator answers at http://{admin}, so there is no live page of all proxies. "
            "Start the operator (docs/guide/docker.md)"
        )
    text = "No browser was found here. Open the address on this host. From another machine, "
    tunnel = f"ssh -L {admin.port}:127.0.0.1:{admin.port} HOST"
    open_page(f"{document['operator']}/", f"{text}use a tunnel: {tunnel}")


@click.command()
@_json_option
@_wait_option("Longest time to wait until no step is left and nothing is wrong, before printing.")
@click.pass_obj
def plan(context: CommandContext, as_json: bool, wait: float) -> None:
    """Show the steps that the operator would take now, and change nothing.

    The running operator reports the steps, as for status. Exits with 0 if no step is left, with 3
    if steps are left, with 1 if something is wrong that the operator can't repair.
    """
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import HostStatus, show_plan

    with exit_on_error(EngineError):
        sys.exit(show_plan(HostStatus(context.settings, context.operator), as_json, wait))


@click.command()
@click.pass_obj
def uninstall(context: CommandContext) -> None:
    """Remove everything that the operator has created on this host. Stop the operator first.

    The command removes the redirects in networks of containers, the proxies, and the operator's
    networks. Each proxy first unregisters its nodes at the master. Labelled containers stay as they
    are. Exits with 0 if nothing is left, else with 1.
    """
    from rosproxy_operator.docker.controller import uninstall as remove_all
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import ask_operators

    if document := ask_operators(context.admin):
        fail(
            f"an operator is running at {document['operator']} and would create everything again. "
            "Stop that operator (docker rm -f rosproxy-operator, or docker compose stop operator), "
            "then run uninstall again"
        )
    with exit_on_error(EngineError):
        problems = remove_all(context.settings, context.resync)
    exit_with(problems)


@click.command()
@click.argument("names", nargs=-1, metavar="[TOPIC|NODE|SERVICE]...")
@_json_option
@click.pass_obj
def doctor(context: CommandContext, names: tuple[str, ...], as_json: bool) -> None:
    """Find faults on this host, and print how to repair each, the first cause first.

    The command checks images, networks, masters and labels, and runs the doctor of each proxy in
    the proxy's container. If names are given, the doctors of the proxies check only those nodes,
    topics and services. Exits with 0 if no error was found, else with 1.
    """
    from rosproxy.cli.questions import print_findings
    from rosproxy_operator.docker.doctor import examine
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import HostStatus

    with exit_on_error(EngineError):
        findings = examine(HostStatus(context.settings, context.operator), names)
    print_findings(findings, as_json)
