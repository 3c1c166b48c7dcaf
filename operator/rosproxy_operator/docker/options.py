"""Options of ``rosproxy-operator docker`` by which an administrator bounds labels and proxies."""

import click

from rosproxy.cli.options import Command, Parsed, with_options
from rosproxy_operator.docker.planner.labels.bounds import read_master_pattern
from rosproxy_operator.docker.planner.model import MOST_PORTS
from rosproxy_operator.docker.settings import read_memory, read_pids, read_secret

_OPTIONS = (
    click.option(
        "--slave-control",
        type=click.Choice(["any", "master"]),
        default="any",
        help="Who may call shutdown, publisherUpdate and paramUpdate at the nodes of all proxies.",
    ),
    click.option(
        "--allow-master",
        type=Parsed("HOST[:PORT]", read_master_pattern),
        multiple=True,
        help="A master that containers may name, * and ? stand for others (repeatable). Default: "
        "any from port 1024 on.",
    ),
    click.option(
        "--max-ports",
        type=click.IntRange(1, MOST_PORTS),
        default=100,
        metavar="N",
        help="Most ports that labels may ask for.",
    ),
    click.option(
        "--allow-data-plane",
        type=click.Choice(["auto", "kernel", "splice", "copy"]),
        multiple=True,
        help="A data plane that labels may ask for (repeatable). Default: all but kernel.",
    ),
    click.option(
        "--proxy-memory",
        type=Parsed("size", read_memory),
        default="1g",
        help="Most memory of each proxy; 0: no bound.",
    ),
    click.option(
        "--proxy-pids",
        type=Parsed("number", read_pids),
        default="8192",
        help="Most threads and processes of each proxy; 0: no bound.",
    ),
    click.option(
        "--secret-file",
        "secret",
        type=Parsed("file", read_secret),
        envvar="ROSPROXY_SECRET_FILE",
        default="",
        help="A file with the secret of which the proxies' tokens are made. Default: one that the "
        "uplink network holds.",
    ),
)


def bound_options(command: Command) -> Command:
    """What labels may ask for, what each proxy may take, and the secret of their tokens."""
    return with_options(command, _OPTIONS)
