"""The command line."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import click

from rosproxy import __version__

Command = Callable[..., Any]


class _OneLineErrors(click.Command):
    """A command that tells what is wrong with its options in one line, for logs of containers."""

    def make_context(self, *arguments: Any, **more: Any) -> click.Context:
        """Parse the command line. Exits with 2 if there is something wrong with it."""
        try:
            return super().make_context(*arguments, **more)
        except click.UsageError as error:
            click.echo(f"rosproxy: {error.format_message()}", err=True)
            sys.exit(2)


class UsageError(click.ClickException):
    """A mistake on the command line, told in one line."""

    exit_code = 2

    def __init__(self, message: str, program: str) -> None:
        super().__init__(message)
        self.program = program

    def show(self, file: Any = None) -> None:
        """Print it."""
        click.echo(f"{self.program}: {self.format_message()}", file, err=True)


class Commands(click.Group):
    """Commands whose usage errors are one line, led by the program's name; click prints four."""

    program = "rosproxy"

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        """Parse the words before the command. Raises UsageError."""
        with _in_one_line(self.program):
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> Any:
        """Parse the command's words and run it. Raises UsageError."""
        with _in_one_line(self.program):
            return super().invoke(ctx)


@contextlib.contextmanager
def _in_one_line(program: str) -> Iterator[None]:
    try:
        yield
    except click.UsageError as error:
        if "\n" in error.format_message():  # the help, for want of a command
            raise
        raise UsageError(error.format_message(), program) from None


def log_options(command: Command) -> Command:
    """The options ``--log-format`` and ``--log-level``."""
    form = click.option(
        "--log-format", type=click.Choice(["text", "json"]), default="text", help="Log format."
    )
    level = click.option(
        "--log-level",
        type=click.Choice(["debug", "info", "warning", "error"], case_sensitive=False),
        default="info",
        help="Least severe messages to log.",
    )
    return form(level(command))


@click.group(
    cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(__version__, prog_name="rosproxy")
def main() -> None:
    """Transparent proxy for ROS 1: nodes behind it and nodes outside talk both ways."""


@main.command(
    cls=_OneLineErrors,
    context_settings={"auto_envvar_prefix": "ROSPROXY", "show_default": True},
)
@click.option("--master-uri", envvar="ROS_MASTER_URI", metavar="URI", help="The real ROS master.")
@click.option(
    "--master-address",
    metavar="ADDRESS",
    help="IP address of the master's host, to use instead of resolving its name.",
)
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
    "--admin-token",
    metavar="TOKEN",
    help="Lets callers that know it change things at --admin-bind, not only those on loopback. "
    "Better given as a variable: command lines can be seen by everybody.",
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
    "--data-plane",
    type=click.Choice(["auto", "kernel", "splice", "copy"]),
    default="auto",
    help="How topics' bytes are forwarded: by the kernel, where the proxy may; spliced; or copied.",
)
@log_options
@click.option("--check", is_flag=True, help="Validate the options and exit.")
def run(check: bool, log_format: str, log_level: str, **options: Any) -> None:
    """Run the proxy.

    Every option has an environment variable: ROSPROXY_ and its name (ROSPROXY_PORT_RANGE); the
    master's is ROS_MASTER_URI, the inside networks' ROSPROXY_INSIDE_NETWORKS.
    """
    from rosproxy.cli.run import run as run_proxy
    from rosproxy.settings import SettingError

    try:
        run_proxy(options, log_format, log_level, check)
    except SettingError as error:
        click.echo(f"rosproxy: {error}", err=True)
        sys.exit(2)


def _admin_option(command: Command) -> Command:
    return click.option(
        "--admin",
        envvar="ROSPROXY_ADMIN",
        show_envvar=True,
        callback=_admin_client,
        metavar="URL",
        help="The proxy's admin endpoint. Default: what ROSPROXY_ADMIN_BIND says, else "
        "http://127.0.0.1:11312.",
    )(command)


def _admin_client(context: click.Context, option: click.Parameter, url: str | None) -> Any:
    from rosproxy.cli.admin_client import AdminClient, default_url

    try:
        return AdminClient(url or default_url())
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


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
    envvar="ROS_MASTER_URI",
    default="",
    metavar="URI",
    help="The master to look at if the proxy can't be asked for its own.",
)
@click.option(
    "--advertise-host",
    envvar="ROSPROXY_ADVERTISE_HOST",
    default="",
    metavar="HOST",
    help="The advertised host if the proxy can't be asked for it.",
)
@click.option(
    "--master-address",
    envvar="ROSPROXY_MASTER_ADDRESS",
    default="",
    metavar="ADDRESS",
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
    master_uri: str,
    advertise_host: str,
    master_address: str,
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
    from rosproxy.cli.doctor import examine
    from rosproxy.doctor.collect import DoctorOptions
    from rosproxy.net.addresses import parse_address
    from rosproxy.ros1.protocol.uris import parse_slave_uri

    if outside and not master_uri:
        raise click.UsageError("--outside needs --master-uri (ROS_MASTER_URI)")
    if master_uri and parse_slave_uri(master_uri) is None:
        raise click.UsageError(f"--master-uri: {master_uri!r} is not of the form http://host:11311")
    absolute = tuple(f"/{name.strip('/')}" for name in names)
    if master_address and parse_address(master_address) is None:
        raise click.UsageError(f"--master-address: {master_address!r} is not an IP address")
    options = DoctorOptions(
        None if outside else admin, master_uri, advertise_host, absolute, master_address or None
    )
    sys.exit(examine(options, as_json))


def _or_exit(ask: Callable[[], object]) -> None:
    """Do something that may find the proxy absent, and say so in one line."""
    from rosproxy.cli.admin_client import AdminError

    try:
        ask()
    except AdminError as error:
        click.echo(f"rosproxy: {error}", err=True)
        sys.exit(1)
