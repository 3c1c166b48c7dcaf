"""Reconciles a Docker host: look, plan, act, report. The loop is `ControlLoop`.

How a label takes effect:

1. The engine reports an event (`engine_client`), which wakes the loop.
2. A look lists all containers and networks, and reads the labels (`snapshot`).
3. `planner.plan` decides.
4. The running proxies get the changes (`proxy_sync`).
5. The actions of the plan start (`executor`), and may go on during later looks.
"""

import asyncio
import contextlib
import logging
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from rosproxy import __version__
from rosproxy.page.page_document import Document
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.control_loop import (
    ControlLoop,
    LookFailed,
    LookImpossible,
    Pace,
)
from rosproxy_operator.common.master_resolver import UNRESOLVED_RETRY_S, MasterResolver
from rosproxy_operator.common.operator_admin import OperatorAdminServer
from rosproxy_operator.common.operator_metrics import DockerMetrics
from rosproxy_operator.common.operator_page import operator_page
from rosproxy_operator.common.problem import (
    SILENT,
    Problem,
    ProblemLog,
)
from rosproxy_operator.common.proxy_client import Json, ProxyClient
from rosproxy_operator.docker import engine_json
from rosproxy_operator.docker.engine_client import DockerClient, listen
from rosproxy_operator.docker.errors import EngineError, FormerSocket, Unavailable
from rosproxy_operator.docker.executor import DockerActions, Executor
from rosproxy_operator.docker.host_document import container_names, host_document, just_started
from rosproxy_operator.docker.operator_sign import publish_sign
from rosproxy_operator.docker.planner.labels.members import LabelReading
from rosproxy_operator.docker.planner.model import HostState
from rosproxy_operator.docker.planner.plan import DockerPlan, Group, plan
from rosproxy_operator.docker.planner.specs import proxy_name
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.planner.uninstall import Uninstall
from rosproxy_operator.docker.proxy_sync import DockerProxySync, ask_proxies
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerObserver, DockerSnapshot

log = logging.getLogger(__name__)

LEAST_LOOK_INTERVAL_S = 0.05
"""Least seconds from a look to the next: ``compose up`` causes dozens of events."""
EVENT_RECHECK_S = 0.25
"""Seconds from an event to a further look: some events come before the engine's lists change."""
LOOK_TIMEOUT_S = 60.0
"""Seconds after which the loop cancels a look."""
COMMAND_TIMEOUT_S = 60.0
"""Seconds in which ``--once`` and ``uninstall`` must finish."""
LOOK_MESSAGE = "look ended in %.3f s: %d actions, next look in %s s"
"""The log line of a look, with its duration, its actions, and the seconds to the next look."""

Decide = Callable[[HostState, LabelReading, PlanSettings, DockerMemory, float], DockerPlan]
"""Returns the plan from the state, the labels, the settings, the memory, and the monotonic time."""


def run_once(settings: PlanSettings, resync: float, mistakes: Sequence[Problem]) -> list[Problem]:
    """Look and act until no step is left or a step fails, for `COMMAND_TIMEOUT_S` at most.

    Return the fatal problems. Raises LookFailed if the operator can't reach the engine. ``resync``
    and ``mistakes`` are as in `run`.
    """
    controller = DockerController(settings, resync, DockerMetrics(), mistakes=mistakes)
    return asyncio.run(controller.run_once(COMMAND_TIMEOUT_S))


def uninstall(settings: PlanSettings, resync: float) -> list[Problem]:
    """Remove everything that operators created on this host. Return the fatal problems.

    Raises LookFailed if the operator can't reach the engine. ``resync`` is as in `run`.
    """
    controller = DockerController(settings, resync, DockerMetrics(), decide=Uninstall())
    return asyncio.run(controller.run_once(COMMAND_TIMEOUT_S))


def run(
    settings: PlanSettings, resync: float, admin: HostPort, mistakes: Sequence[Problem]
) -> None:
    """Run the operator until SIGINT or SIGTERM. The proxies go on without the operator.

    ``resync`` is the longest time in seconds between two looks. ``admin`` is the address of the
    admin endpoint. The operator reports ``mistakes``, problems with environment variables. Raises
    SettingError, and LookImpossible if only a restart of the operator's container can help.
    """
    asyncio.run(_run(settings, resync, admin, mistakes))


async def _run(
    settings: PlanSettings, resync: float, admin: HostPort, mistakes: Sequence[Problem]
) -> None:
    metrics = DockerMetrics()
    controller = DockerController(settings, resync, metrics, mistakes=mistakes)
    page = operator_page(
        controller.documents, "docker logs {}".format, controller.places, controller.problems
    )
    admin_server = OperatorAdminServer(
        metrics.registry, controller.dead, controller.unready, page, controller.status
    )
    await admin_server.start(admin)
    sign = publish_sign(admin, controller.engine_url)
    log.info("rosproxy-operator %s: health and metrics at http://%s", __version__, admin)
    running = asyncio.create_task(controller.run())
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, running.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await running  # raises the exceptions of the controller
    if sign:
        sign.close()
    await admin_server.stop()


class DockerController:
    """Reconciles the host of an engine with the plans of ``decide``."""

    def __init__(
        self,
        settings: PlanSettings,
        resync: float,
        metrics: DockerMetrics,
        decide: Decide = plan,
        mistakes: Sequence[Problem] = (),
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._decide = decide
        self._mistakes = mistakes
        pace = Pace("engine", resync, LEAST_LOOK_INTERVAL_S, LOOK_TIMEOUT_S)
        self._loop = loop = ControlLoop(pace, metrics)
        self.dead = loop.dead
        self.unready = loop.unready
        self._tasks = Tasks()
        self._engine = engine = DockerClient()
        self.engine_url = engine.url
        self._proxies = ProxyClient()
        self._masters = MasterResolver(loop.wake)
        self._observer = DockerObserver(engine, settings, self._masters, loop.wake)
        self._docker_actions = DockerActions(engine, settings, self._proxies)
        self._executor = jobs = Executor(self._tasks, loop.wake, self._port_taken, metrics.count)
        metrics.watch_jobs(lambda: len(jobs.busy), lambda: len(jobs.problems))
        self._proxy_sync = DockerProxySync(self._tasks, self._proxies, settings, loop.wake)
        self._memory = DockerMemory()
        self._shown: list[Problem] = []
        self._log = ProblemLog()
        self._last: tuple[DockerSnapshot, DockerPlan] | None = None

    async def run(self) -> None:
        """Reconcile until cancelled. The proxies go on without the operator."""
        listen(self._engine, self._note_event)
        self._tasks.repeat(self._masters.refresh, UNRESOLVED_RETRY_S, "resolving masters")
        try:
            await self._loop.run(self.look)
        finally:
            await self._close()

    async def run_once(self, seconds: float) -> list[Problem]:
        """Look and act until no step is left or a step fails, for at most ``seconds``.

        Return the fatal problems, with a problem for each proxy that does not answer, or for steps
        that are left. Raises LookFailed if the operator can't reach the engine.
        """
        listen(self._engine, self._note_event)
        try:
            await self._loop.run_until(self.look, self._settled, seconds)
            return self._unsolved_problems()
        finally:
            await self._close()

    async def documents(self) -> dict[str, Document | str]:
        """Return the page document of each proxy by name, or why there is no document.

        A proxy that has just started is missing until it answers.
        """
        if self._last is None:
            return {}
        snapshot = self._last[0]
        endpoints = {name: (p.admin, p.token) for name, p in snapshot.access.items()}
        stopped = {
            proxy.container.name: f"the proxy's container is {proxy.container.state}"
            for proxy in snapshot.state.proxies
            if proxy.container.state not in ("created", "running")
        }
        answers = await self._proxies.documents(endpoints)
        silent = {name for name, answer in answers.items() if isinstance(answer, str)}
        starting = silent & just_started(snapshot.state, time.time())
        return stopped | {name: answers[name] for name in answers if name not in starting}

    def places(self) -> dict[str, str]:
        """Return the names of the containers at each address, from the last look."""
        return container_names(self._last[0].state) if self._last else {}

    def problems(self) -> dict[Problem, float]:
        """Return the problems of the last look.

        The values are the monotonic times at which the operator first saw the problems.
        """
        return self._log.since

    async def status(self) -> Json:
        """Look anew, ask all proxies, and return the status document. Raises LookFailed."""
        await self._loop.look_anew()  # the last look may lack a new container
        if self._last is None:
            raise LookFailed("the operator has not looked at the engine yet")
        snapshot, planned = self._last
        answers = await ask_proxies(self._proxies, snapshot, self._settings.uplink)
        problems = self._current(snapshot, planned)
        return host_document(
            snapshot.state, planned, problems, answers, self._settings, time.time()
        )

    async def look(self) -> float | None:
        """Look, plan, and start the actions. Return the longest time in seconds to the next look.

        None: the resync interval. Raises LookFailed, and LookImpossible if the operator's container
        has the socket of a former engine.
        """
        started = time.monotonic()
        try:
            snapshot = await self._observer.look()
        except FormerSocket as error:
            raise LookImpossible(str(error), away=True) from error
        except EngineError as error:
            raise LookFailed(str(error), away=isinstance(error, Unavailable)) from error
        retired = self._proxy_sync.retired(snapshot)
        snapshot = replace(snapshot, state=replace(snapshot.state, retired=retired))
        planned = self._decide(
            snapshot.state, snapshot.labels, self._settings, self._memory, time.monotonic()
        )
        took = time.monotonic() - started
        log.debug(LOOK_MESSAGE, took, len(planned.actions), planned.again_in)
        self._memory = planned.memory
        self._last = (snapshot, planned)
        if snapshot.state.busy and not self._observer.waiting:
            self._loop.wake_in(EVENT_RECHECK_S)  # no event reports that the list is up to date
        self._proxy_sync.update(snapshot, planned.members)  # first: calls of new nodes wait
        self._executor.start(
            planned.groups, lambda action: self._docker_actions.carry_out(action, snapshot), started
        )
        problems = self._current(snapshot, planned)
        self._log.update(problems, started)
        metrics = self._metrics
        metrics.look_time.observe(took)
        metrics.containers.set(sum(member.container.alive for member in planned.members))
        metrics.problems.set(len(problems))
        metrics.show_proxies(proxy.container.state for proxy in snapshot.state.proxies)
        times = (planned.again_in, self._executor.again_in)
        return min((t for t in times if t is not None), default=None)

    def _current(self, snapshot: DockerSnapshot, planned: DockerPlan) -> list[Problem]:
        """Return all problems. While an action on an object runs, its earlier problems stay.

        A look during the action would report problems that are outdated a moment later.
        """
        latest = [
            *self._mistakes,
            *planned.problems,
            *self._executor.problems,
            *self._proxy_sync.problems(snapshot),
        ]
        busy = self._executor.busy
        self._shown = [
            *(problem for problem in latest if problem.subject not in busy),
            *(problem for problem in self._shown if problem.subject in busy),
        ]
        return self._shown

    def _settled(self) -> bool:
        """Whether no required step is left and all wanted proxies answer, or a step has failed."""
        if self._last is None or self._executor.busy or self._loop.woken:
            return False
        snapshot, planned = self._last
        # --once does not wait until the operator retries a failed step, but reports the failure.
        failed = any(problem.fatal for problem in self._executor.problems)
        if failed or self._proxy_sync.problems(snapshot):
            return True
        waiting = snapshot.state.busy or self._observer.waiting
        return not waiting and not _required(planned) and not self._silent(planned)

    def _silent(self, planned: DockerPlan) -> list[str]:
        """Return the names of the wanted proxies that do not answer."""
        names = (proxy_name(desired.place) for desired in planned.desired if desired.live)
        return [name for name in names if not self._proxy_sync.answers(name)]

    def _unsolved_problems(self) -> list[Problem]:
        """Return the fatal problems, also those of silent proxies and of steps that are left."""
        if self._last is None:
            reason = self._loop.unready() or "the operator has not looked at the engine yet"
            return [Problem("engine", reason, reason="EngineUnreachable")]
        snapshot, planned = self._last
        problems = [problem for problem in self._current(snapshot, planned) if problem.fatal]
        subjects = {problem.subject for problem in problems}
        problems += [
            Problem(f"proxy {name}", "does not answer", f"Read docker logs {name}", reason=SILENT)
            for name in self._silent(planned)
            if f"proxy {name}" not in subjects
        ]
        unfinished = _required(planned) or planned.deferred or snapshot.state.busy
        if unfinished and not problems:
            text = "not all steps were done in time"
            fix = "Run this command again"
            problems.append(Problem("operator", text, fix, reason="StepsLeft"))
        return problems

    def _port_taken(self, name: str, port: int | None) -> None:
        self._memory = self._memory.with_refusal(name, port, time.monotonic())

    def _note_event(self, event: Json | None) -> None:
        """Note an event. None: a new connection to the engine, so earlier events may be missing."""
        if event is None:
            self._observer.note_event(None)
            self._memory = replace(self._memory, engine_returned=True)
            self._loop.retry()
        elif container := engine_json.container_of(event):
            self._observer.note_event(container)
        self._loop.wake()
        self._loop.wake_in(EVENT_RECHECK_S)

    async def _close(self) -> None:
        await self._tasks.cancel()
        await self._proxies.close()


def _required(planned: DockerPlan) -> list[Group]:
    """Return the groups of a plan whose failure is a fatal problem."""
    return [group for group in planned.groups if group.fatal]
