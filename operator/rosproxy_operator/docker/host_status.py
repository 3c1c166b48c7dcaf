"""The commands ``status`` and ``plan``, which show a host and the next actions of the operator.

A command asks the running operator, which knows its own options and failures. If no operator
answers, or if options stand before the command, the command looks at the host itself.

Exit codes for scripts: ``status`` returns 0 if no action is left, nothing is wrong and all proxies
work, else 1. ``plan`` returns STEPS_LEFT if actions are left, else 1 if something is wrong, else 0.
"""

import asyncio
import json
import time
from collections.abc import Callable
from dataclasses import replace

from rosproxy import __version__
from rosproxy.cli.terminal import size, watch, write
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.http.admin_client import AdminClient, AdminError, default_url
from rosproxy.shared.output.text import clean
from rosproxy_operator.common.master_resolver import MasterResolver
from rosproxy_operator.common.proxy_client import Json, ProxyClient
from rosproxy_operator.docker.engine_client import DockerClient
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.host_document import host_document
from rosproxy_operator.docker.operator_sign import operators
from rosproxy_operator.docker.planner.plan import plan
from rosproxy_operator.docker.planner.report import message_of, render
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.proxy_sync import ask_proxies
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerObserver

STEPS_LEFT = 3
"""The exit code of ``plan`` if actions are left."""
WAIT_INTERVAL_S = 1.0
"""Seconds between two looks of ``--wait``."""
OPERATOR_ANSWER_TIMEOUT_S = 10.0
"""Seconds that the operator has to answer: the operator looks anew, and asks all proxies."""
STATUS_INSPECTION_WAIT_S = 3.0
"""Seconds to wait for the inspection of containers: there is no second look."""


class HostStatus:
    """The status of a host, from the operator that listens at ``operator``.

    If ``operator`` is None, has another version, or does not answer, the status is what an operator
    with ``settings`` would see and plan.
    """

    def __init__(self, settings: PlanSettings, operator: HostPort | None) -> None:
        self.settings = settings
        self.operator = operator

    async def now(self) -> Json:
        """Return the document (`host_document`). Raises EngineError.

        The field ``operator`` is the URL of the operator that has answered, or None.
        """
        return await asyncio.to_thread(self._ask_operator) or {
            **await survey(self.settings),
            "operator": None,
        }

    def _ask_operator(self) -> Json | None:
        """Return the document of the operator; None if no operator of this version answers."""
        document = ask_operators(self.operator) if self.operator else None
        # The document of another version may have other fields.
        return document if document and document.get("version") == __version__ else None


def ask_operators(first: HostPort) -> Json | None:
    """Return the document of the first operator on this machine that answers; None without answer.

    The field ``operator`` has the URL of that operator. ``first`` is asked before the operators
    with signs.
    """
    return next(filter(None, map(_ask, operators(first, DockerClient().url))), None)


def _ask(endpoint: HostPort) -> Json | None:
    client = AdminClient(default_url(str(endpoint)))
    try:
        document = json.loads(client.get("/status", within=OPERATOR_ANSWER_TIMEOUT_S))
    except (AdminError, ValueError, RecursionError):
        return None
    # A proxy may listen at this endpoint. The status of a proxy has no field uplink.
    is_document = isinstance(document, dict) and "uplink" in document
    return {**document, "operator": client.url} if is_document else None


def show_plan(host: HostStatus, as_json: bool, wait: float) -> int:
    """Print the next actions and the problems, and return the exit code. Raises EngineError.

    Wait up to ``wait`` seconds until nothing is left to do and nothing is wrong: a proxy that has
    just started does not answer yet.
    """
    status = _await(host, wait, lambda status: not status["actions"] and not _is_wrong(status))
    shown = {key: status[key] for key in ("actions", "problems")}
    if as_json:
        write(json.dumps(shown, indent=2))
    else:
        # Problems quote names of labels. An image can put control characters into these names.
        write("\n".join(map(clean, status["actions"])) or "Nothing to do.")
        for problem in status["problems"]:
            write(clean(f"{problem['subject']}: {message_of(problem)}"))
    return STEPS_LEFT if status["actions"] else int(_is_wrong(status))


def show_status(host: HostStatus, as_json: bool, wait: float) -> int:
    """Print the status of the host, and return the exit code. Raises EngineError.

    Wait up to ``wait`` seconds until the exit code is 0.
    """
    status = _await(host, wait, _is_as_wanted)
    write(json.dumps(status, indent=2) if as_json else render(status, size()[0]))
    return int(not _is_as_wanted(status))


def _await(host: HostStatus, seconds: float, good: Callable[[Json], bool]) -> Json:
    """Return the first status that is ``good``, or the status after ``seconds``.

    Raises EngineError.
    """
    end = time.monotonic() + seconds
    while not good(status := asyncio.run(host.now())) and time.monotonic() < end:
        time.sleep(WAIT_INTERVAL_S)
    return status


def _is_as_wanted(status: Json) -> bool:
    """Return whether no action is left, nothing is wrong, and every proxy works."""
    works = all(map(_works, status["proxies"]))
    return works and not status["actions"] and not _is_wrong(status)


def _works(proxy: Json) -> bool:
    """Return whether a proxy answers, reaches its master and routers, and is reached by outside.

    Checks without a result (None) count as passed.
    """
    links = proxy["links"].values()
    return proxy["reachable"] and False not in (proxy["master_up"], proxy["reached"], *links)


def _is_wrong(status: Json) -> bool:
    return any(problem["fatal"] for problem in status["problems"])


def watch_status(host: HostStatus) -> None:
    """Draw the status again and again until interrupted. An engine error does not end the loop."""

    def draw(columns: int, lines: int | None) -> str:
        try:
            return render(asyncio.run(host.now()), columns, lines)
        except EngineError as error:
            return f"{time.strftime('%H:%M:%S')} {clean(error)}"

    watch(draw)


async def survey(settings: PlanSettings) -> Json:
    """Return the document of a host, as an operator with these settings would see the host.

    Unlike a running operator, the survey has no memory of earlier looks. Raises EngineError.
    """
    proxies = ProxyClient()
    # The callbacks would wake a control loop. Here is no loop, because there is no second look.
    observer = DockerObserver(DockerClient(), settings, MasterResolver(lambda: None), lambda: None)
    try:
        snapshot = await observer.look(STATUS_INSPECTION_WAIT_S)
        answers = await ask_proxies(proxies, snapshot, settings.uplink)
    finally:
        await proxies.close()
    retired = (name for name, a in answers.items() if isinstance(a, ProxyStatus) and a.retired)
    state = replace(snapshot.state, retired=frozenset(retired))
    planned = plan(state, snapshot.labels, settings, DockerMemory(), time.monotonic())
    return host_document(state, planned, planned.problems, answers, settings, time.time())
