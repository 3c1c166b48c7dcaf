"""The commands ``status`` and ``plan``: what there is on a host.

The operator that runs is asked for it: it has its own options, and remembers what it has tried.
Where none answers, or options are given that another one might have, the command looks for itself.

Their exit codes tell scripts: of ``status`` 0 if all is as wanted, of ``plan`` 0 if nothing is to
be done and STEPS_LEFT if something is; 1 of both if something is wrong.
"""

import asyncio
import json
import time
from collections.abc import Callable

from rosproxy import __version__
from rosproxy.admin.admin_client import AdminClient, AdminError, default_url
from rosproxy.cli.terminal import size, watch, write
from rosproxy.net.addresses import HostPort
from rosproxy.telemetry.text import clean
from rosproxy_operator.common.master_resolver import MasterResolver
from rosproxy_operator.common.proxy_client import Json, ProxyClient
from rosproxy_operator.docker.engine_client import DockerClient
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.host_document import host_document
from rosproxy_operator.docker.operator_sign import operators
from rosproxy_operator.docker.planner.plan import plan
from rosproxy_operator.docker.planner.report import render
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.proxy_sync import ask_proxies
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerObserver

STEPS_LEFT = 3
"""The exit code of ``plan`` if there is something to do."""
WAIT_INTERVAL = 1.0
"""Seconds between two looks of ``--wait``."""
ASKING = 10.0
"""Seconds that the operator gets: it looks anew, and asks its proxies."""
PATIENCE = 3.0
"""Seconds to wait for inspections: there is no second look."""


class HostStatus:
    """What there is on a host, from the operator that listens at ``operator``, None for no such.

    Else by a look of its own, with the plan that an operator with these settings would have.
    """

    def __init__(self, settings: PlanSettings, operator: HostPort | None) -> None:
        self.settings = settings
        self.operator = operator

    async def now(self) -> Json:
        """The document (`host_document`), with ``operator``: who has told it, or None.

        Raises EngineError.
        """
        return await asyncio.to_thread(self._ask_operator) or {
            **await survey(self.settings),
            "operator": None,
        }

    def _ask_operator(self) -> Json | None:
        """What the operator says; None if none answers, or not one of this version."""
        document = ask_operators(self.operator) if self.operator else None
        # One of another version may tell other things.
        return document if document and document.get("version") == __version__ else None


def ask_operators(first: HostPort) -> Json | None:
    """What the first operator of this machine that answers tells; None without one.

    As ``operator`` it has that one's URL. ``first`` is asked before those that have put up signs.
    """
    return next(filter(None, map(_ask, operators(first, DockerClient().url))), None)


def _ask(endpoint: HostPort) -> Json | None:
    client = AdminClient(default_url(str(endpoint)))
    try:
        document = json.loads(client.get("/status", within=ASKING))
    except (AdminError, ValueError, RecursionError):
        return None
    # A proxy may listen there: its status has no uplink.
    is_document = isinstance(document, dict) and "uplink" in document
    return {**document, "operator": client.url} if is_document else None


def show_plan(host: HostStatus, as_json: bool, wait: float) -> int:
    """Print what would be done now, and what is wrong; the exit code. Raises EngineError.

    ``wait`` are the seconds in which there may come to be nothing to do and nothing wrong: a proxy
    that has just been started does not answer yet.
    """
    status = _await(host, wait, lambda status: not status["actions"] and not _is_wrong(status))
    shown = {key: status[key] for key in ("actions", "problems")}
    if as_json:
        write(json.dumps(shown, indent=2))
    else:
        # Names of labels are whatever an image says, and stand in texts of problems.
        write("\n".join(map(clean, status["actions"])) or "Nothing to do.")
        for problem in status["problems"]:
            write(clean(f"{problem['subject']}: {problem['text']}"))
    return STEPS_LEFT if status["actions"] else int(_is_wrong(status))


def show_status(host: HostStatus, as_json: bool, wait: float) -> int:
    """Print what there is on the host; the exit code. Raises EngineError.

    ``wait`` are the seconds in which all may come to be as wanted.
    """
    status = _await(host, wait, _is_as_wanted)
    write(json.dumps(status, indent=2) if as_json else render(status, size()[0]))
    return int(not _is_as_wanted(status))


def _await(host: HostStatus, seconds: float, good: Callable[[Json], bool]) -> Json:
    """A status that is good, or the last one after so many seconds. Raises EngineError."""
    end = time.monotonic() + seconds
    while not good(status := asyncio.run(host.now())) and time.monotonic() < end:
        time.sleep(WAIT_INTERVAL)
    return status


def _is_as_wanted(status: Json) -> bool:
    """Whether nothing is left to do, nothing is wrong, and every proxy can do its work."""
    works = all(map(_works, status["proxies"]))
    return works and not status["actions"] and not _is_wrong(status)


def _works(proxy: Json) -> bool:
    """Whether a proxy answers, and nothing shows that its master or outside is cut off from it."""
    links = proxy["links"].values()
    return proxy["reachable"] and False not in (proxy["master_up"], proxy["reached"], *links)


def _is_wrong(status: Json) -> bool:
    return any(problem["fatal"] for problem in status["problems"])


def watch_status(host: HostStatus) -> None:
    """Draw the status again and again until interrupted, also while no engine answers."""

    def draw(columns: int, lines: int | None) -> str:
        try:
            return render(asyncio.run(host.now()), columns, lines)
        except EngineError as error:
            return f"{time.strftime('%H:%M:%S')} {clean(error)}"

    watch(draw)


async def survey(settings: PlanSettings) -> Json:
    """The document of a host, as an operator with these settings would see it. Raises EngineError.

    It has none of the memory of an operator that runs.
    """
    proxies = ProxyClient()
    # Nobody has to be woken: there is no second look.
    observer = DockerObserver(DockerClient(), settings, MasterResolver(lambda: None), lambda: None)
    try:
        snapshot = await observer.look(PATIENCE)
        answers = await ask_proxies(proxies, snapshot, settings.uplink)
    finally:
        await proxies.close()
    planned = plan(snapshot.state, snapshot.labels, settings, DockerMemory(), time.monotonic())
    return host_document(snapshot.state, planned, planned.problems, answers, settings, time.time())
