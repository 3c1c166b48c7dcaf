"""The commands that ask a running proxy: ``rosproxy status``, ``health`` and ``doctor``.

Commands import other modules when they run, so that a health check starts fast.
"""

import os
import sys
import time
from collections.abc import Callable
from typing import Any, NoReturn

import click

from rosproxy.cli import options
from rosproxy.shared import setting_kinds as kinds

WAIT_INTERVAL_S = 0.5
"""Seconds between two requests of ``status --wait``."""


def _admin_client(context: click.Context, option: click.Parameter, url: str | None) -> Any:
    from rosproxy.shared.http.admin_client import AdminClient, default_url

    # As for the proxy itself, the command line and the variable override the file.
    bound = None if url or "ROSPROXY_ADMIN_BIND" in os.environ else _bound_by_file()
    try:
        return AdminClient(url or default_url(bound))
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


def _bound_by_file() -> str | None:
    """The ``admin-bind`` in the file of ROSPROXY_CONFIG.

    Empty if the file does not have the option; None without a file that can be read.
    """
    path = os.environ.get("ROSPROXY_CONFIG")
    if not path:
        return None
    import tomllib

    try:
        with open(path, "rb") as file:
            return str(tomllib.load(file).get("admin-bind", ""))
    except (OSError, ValueError):
        return None  # `rosproxy run` reports the fault of the file


_admin_option = click.option(
    "--admin",
    envvar="ROSPROXY_ADMIN",
    show_envvar=True,
    callback=_admin_client,
    metavar="URL",
    help="The proxy's admin endpoint. Default: the address in ROSPROXY_ADMIN_BIND, else "
    "http://127.0.0.1:11312.",
)


@click.command(cls=options.CommandShowingVariables)
@_admin_option
@click.option("--json", "as_json", is_flag=True, help="Print the state as JSON.")
@click.option("--watch", is_flag=True, help="Show the state again every two seconds, until Ctrl-C.")
@click.option(
    "--wait",
    type=options.Seconds(0),
    default=0,
    help="Time to wait until the proxy is ready, before the state is shown.",
)
@click.option("--open", "opens", is_flag=True, help="Open the live page in a browser instead.")
def status(admin: Any, as_json: bool, watch: bool, wait: float, opens: bool) -> None:
    """Show the master, the ports, and the nodes behind the proxy.

    Exits with 0 if the proxy is ready for nodes. Exits with 1 if the proxy or its master does not
    answer, or if the routers for rmw_zenoh do not run.
    """
    if as_json + watch + opens > 1:
        raise click.UsageError("--json, --watch and --open exclude each other; give one of them")
    from rosproxy.cli import terminal

    if opens:
        _or_exit(lambda: _open_page(admin))
        return
    if watch:
        terminal.watch_status(admin)
        return
    end = time.monotonic() + wait
    while (error := _why_not_ready(admin)) and time.monotonic() < end:
        time.sleep(WAIT_INTERVAL_S)
    _or_exit(lambda: terminal.show_status(admin, as_json))
    if error:
        _fail(error)


def _open_page(admin: Any) -> None:
    """Print the address of the live page, and open a browser if there is one."""
    from rosproxy.cli.browser import open_page

    text = "No browser was found here. In a container, the address leads to the container itself. "
    text += "The page of the operator shows all proxies: rosproxy-operator docker status. "
    open_page(admin.page(), f"{text}Without an operator, see docs/guide/live-page.md.")


def _why_not_ready(admin: Any) -> str:
    """The reason why nodes can't use the proxy; empty if nodes can."""
    from rosproxy.shared.http.admin_client import AdminError

    try:
        admin.get("/readyz")
    except AdminError as error:
        return str(error)
    return ""


@click.command(cls=options.CommandShowingVariables)
@_admin_option
def health(admin: Any) -> None:
    """Exit with 0 if the proxy is alive, with 1 if not; for container health checks."""
    _or_exit(lambda: admin.get("/healthz", within=3.0))


@click.command(cls=options.CommandShowingVariables)
@click.argument("names", nargs=-1, metavar="[TOPIC|NODE|SERVICE]...")
@_admin_option
@click.option(
    "--master-uri",
    type=options.click_type(kinds.MASTER_URI),
    envvar="ROS_MASTER_URI",
    help="Master to examine if the proxy does not answer, or with --outside.",
)
@click.option(
    "--advertise-host",
    type=options.click_type(kinds.HOST),
    envvar="ROSPROXY_ADVERTISE_HOST",
    help="Advertised host of the proxy if the proxy does not answer, or with --outside.",
)
@click.option(
    "--master-address",
    type=options.click_type(kinds.ADDRESS),
    envvar="ROSPROXY_MASTER_ADDRESS",
    help="IP address of the master's host if the proxy does not answer, or with --outside.",
)
@click.option(
    "--outside",
    is_flag=True,
    help="Examine from this machine as an outside machine, for example on a robot. Ask no proxy.",
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
    """Find out why A can't hear B, and print the fix.

    Examines the proxy, its ports, the master and all nodes. With a topic: its publishers and
    subscribers. With a node: the topics of that node. With two nodes: the topics between them.
    The report shows which pairs are not connected, and why.

    Run this command where the proxy runs: docker exec CONTAINER rosproxy doctor. To see what an
    outside machine sees, run the command on that machine with --outside. Exits with 0 if no
    error was found, else with 1.
    """
    import asyncio

    from rosproxy.doctor import rules
    from rosproxy.doctor.collect import collect

    if outside and not master_uri:
        raise click.UsageError("--outside needs --master-uri (ROS_MASTER_URI)")
    collecting = collect(
        None if outside else admin,
        master_uri or "",
        advertise_host or "",
        # The master's names are global; users leave the slash out.
        tuple(f"/{name.strip('/')}" for name in names),
        master_address,
    )
    unknown = options.unknown_variables(click.get_current_context().find_root().command, log=False)
    findings = rules.diagnose(asyncio.run(collecting))
    print_findings([*findings, *(rules.unknown_variable(v.name, v.text) for v in unknown)], as_json)


def print_findings(findings: Any, as_json: bool) -> NoReturn:
    """Print findings, and exit with 1 if there is an error, else with 0."""
    import json

    from rosproxy.cli import terminal
    from rosproxy.doctor import presentation
    from rosproxy.shared.documents.doctor_finding import failed

    if as_json:
        terminal.write(json.dumps(presentation.as_json(findings), indent=2))
    else:
        terminal.write(presentation.render(findings, terminal.size()[0]))
    sys.exit(1 if failed(findings) else 0)


def _or_exit(ask: Callable[[], object]) -> None:
    """Call a function; on an AdminError, print the message and exit with 1."""
    from rosproxy.shared.http.admin_client import AdminError

    try:
        ask()
    except AdminError as error:
        _fail(error)


def _fail(reason: object) -> NoReturn:
    click.echo(f"rosproxy: {reason}", err=True)
    sys.exit(1)
