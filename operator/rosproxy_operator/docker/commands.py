"""The commands below ``rosproxy-operator docker``: they tell what there is, and change nothing.

They import what they need when they run: the Docker SDK may not be installed.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import click

from rosproxy.cli.options import Command, Seconds
from rosproxy.net.addresses import HostPort
from rosproxy_operator.common.command_errors import exit_on_error, exit_with, fail
from rosproxy_operator.docker.settings import PlanSettings


@dataclass(frozen=True, slots=True)
class CommandContext:
    """What was given before a command.

    ``admin`` is where an operator would listen. One is to be asked for its status there unless
    options were ``given``; ``settings`` count then, and where none answers. ``resync`` in seconds.
    """

    settings: PlanSettings
    admin: HostPort
    given: bool
    resync: float

    @property
    def operator(self) -> HostPort | None:
        """Where an operator is to be asked; None for nowhere."""
        return None if self.given else self.admin


_json_option = click.option("--json", "as_json", is_flag=True, help="Print it as JSON.")


def _wait_option(text: str) -> Callable[[Command], Command]:
    return click.option("--wait", type=Seconds(0), default=0, help=text, allow_from_autoenv=False)


@click.command()
@_json_option
@click.option("--watch", is_flag=True, help="Show it anew every two seconds, until Ctrl-C.")
@_wait_option("Time in which all may come to be as wanted, before it is shown.")
@click.pass_obj
def status(context: CommandContext, as_json: bool, watch: bool, wait: float) -> None:
    """Show the proxies, the labelled containers, their nodes, and what is wrong.

    The running operator tells it. Where none answers at --admin-bind, or options are given before
    this command, it is what an operator with those options would see. Exits with 0 if all is as
    wanted: nothing is wrong or left to be done, every proxy answers and has its master, and none is
    cut off from outside; else with 1.
    """
    if as_json and watch:
        raise click.UsageError("--json or --watch, not both")
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import HostStatus, show_status, watch_status

    host = HostStatus(context.settings, context.operator)
    if watch:
        watch_status(host)
        return
    with exit_on_error(EngineError):
        sys.exit(show_status(host, as_json, wait))


@click.command()
@_json_option
@_wait_option("Time in which all may come to be done and well, before it is shown.")
@click.pass_obj
def plan(context: CommandContext, as_json: bool, wait: float) -> None:
    """Show what the operator would do now, and change nothing.

    The running operator tells it, as status does. Exits with 0 if there is nothing to do, with 3 if
    there is, with 1 if something is wrong that the operator can't mend.
    """
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import HostStatus, show_plan

    with exit_on_error(EngineError):
        sys.exit(show_plan(HostStatus(context.settings, context.operator), as_json, wait))


@click.command()
@click.pass_obj
def uninstall(context: CommandContext) -> None:
    """Remove all that the operator has made on this host: run it once the operator has ended.

    That is: redirects in containers' networks, proxies, which unregister their nodes at the master
    first, and their networks. Labelled containers stay as they are. Exits with 0 if nothing is
    left, else with 1.
    """
    from rosproxy_operator.docker.controller import uninstall as remove_all
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import ask_operators

    if document := ask_operators(context.admin):
        fail(
            f"an operator is running at {document['operator']} and would make all anew: end it "
            "first (docker rm -f rosproxy-operator, or docker compose stop operator), then "
            "uninstall again"
        )
    with exit_on_error(EngineError):
        problems = remove_all(context.settings, context.resync)
    exit_with(problems)


@click.command()
@click.argument("names", nargs=-1, metavar="[TOPIC|NODE|SERVICE]...")
@_json_option
@click.pass_obj
def doctor(context: CommandContext, names: tuple[str, ...], as_json: bool) -> None:
    """Find out what is wrong on this host, and say what mends it, the first cause first.

    Looks at images, networks, masters and labels, and asks the doctor of each proxy, in its
    container. With names: about those nodes, topics and services. Exits with 0 if nothing is wrong,
    with 1 if something is.
    """
    from rosproxy.cli.questions import print_findings
    from rosproxy_operator.docker.doctor import examine
    from rosproxy_operator.docker.errors import EngineError
    from rosproxy_operator.docker.host_status import HostStatus

    with exit_on_error(EngineError):
        findings = examine(HostStatus(context.settings, context.operator), names)
    print_findings(findings, as_json)
