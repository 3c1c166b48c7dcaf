"""Reconciling a Docker host: look, plan, carry out, report. The loop is `ControlLoop`.

How a label takes effect: the engine's events (`engine_client`) tell that something has changed and
wake the loop. A look lists everything anew and reads the labels (`snapshot`), decides
(`planner.plan`), begins to carry out what was decided (`executor`), and brings the running proxies
up to date (`proxy_sync`). Work goes on beside later looks; nothing here decides.
"""

import asyncio
import contextlib
import logging
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from rosproxy import __version__
from rosproxy.net.addresses import HostPort
from rosproxy.net.tasks import Tasks
from rosproxy.page.page_document import Document
from rosproxy_operator.common.control_loop import (
    ControlLoop,
    LookFailed,
    LookImpossible,
    Pace,
)
from rosproxy_operator.common.health_server import HealthServer
from rosproxy_operator.common.master_resolver import AGAIN_UNRESOLVED, MasterResolver
from rosproxy_operator.common.operator_metrics import DockerMetrics
from rosproxy_operator.common.operator_page import operator_page
from rosproxy_operator.common.problem import Problem, ProblemLog
from rosproxy_operator.common.proxy_client import Json, ProxyClient
from rosproxy_operator.docker import engine_json
from rosproxy_operator.docker.engine_client import DockerClient, listen
from rosproxy_operator.docker.errors import EngineError, FormerSocket, Unavailable
from rosproxy_operator.docker.executor import DockerApplier, Executor
from rosproxy_operator.docker.host_document import host_document, just_started
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

DEBOUNCE = 0.05
"""Least seconds between two looks: one ``compose up`` makes dozens of events."""
SETTLED = 0.25
"""Seconds after an event at which there is one more look: an engine tells of some things before it
lists them."""
LONGEST_LOOK = 60.0
"""Seconds after which a look that has not ended is given up."""
ONCE = 60.0
"""Seconds that ``--once`` and ``uninstall`` have to reach what is wanted."""

Decide = Callable[[HostState, LabelReading, PlanSettings, DockerMemory, float], DockerPlan]
"""From what a look has seen, settings, memory and the time to what is to be done: `plan`."""


def run_once(settings: PlanSettings, resync: float, mistakes: Sequence[Problem]) -> list[Problem]:
    """Look and act until nothing is left to do; what is not as wanted. Raises LookFailed.

    ``mistakes`` as of `run`.
    """
    controller = DockerController(settings, resync, DockerMetrics(), mistakes=mistakes)
    return asyncio.run(controller.run_once(ONCE))


def uninstall(settings: PlanSettings, resync: float) -> list[Problem]:
    """Remove all that operators have made on this host; what is left. Raises LookFailed."""
    controller = DockerController(settings, resync, DockerMetrics(), decide=Uninstall())
    return asyncio.run(controller.run_once(ONCE))


def run(
    settings: PlanSettings, resync: float, admin: HostPort, mistakes: Sequence[Problem]
) -> None:
    """Run the operator until a signal ends it; its proxies go on.

    Raises SettingError, and LookImpossible where only a new start of its container can help.
    ``resync`` is in seconds: how long it waits at most between two looks. ``admin`` is where it
    serves its own health. ``mistakes`` are what is wrong with how it was started, to be told.
    """
    asyncio.run(_run(settings, resync, admin, mistakes))


async def _run(
    settings: PlanSettings, resync: float, admin: HostPort, mistakes: Sequence[Problem]
) -> None:
    metrics = DockerMetrics()
    controller = DockerController(settings, resync, metrics, mistakes=mistakes)
    page = operator_page(controller.documents, "docker logs {}".format)
    health = HealthServer(
        metrics.registry, controller.dead, controller.unready, page, controller.status
    )
    await health.start(admin)
    sign = publish_sign(admin, controller.engine_url)
    log.info("rosproxy-operator %s: health and metrics at http://%s", __version__, admin)
    running = asyncio.create_task(controller.run())
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, running.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await running  # raises what it died of
    if sign:
        sign.close()
    await health.stop()


class DockerController:
    """Reconciles one engine's host, as ``decide`` says. `run` it in an event loop."""

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
        pace = Pace("engine", resync, DEBOUNCE, LONGEST_LOOK)
        self._loop = loop = ControlLoop(pace, metrics)
        self.dead = loop.dead
        self.unready = loop.unready
        self._tasks = Tasks()
        self._engine = engine = DockerClient()
        self.engine_url = engine.url
        self._proxies = ProxyClient()
        self._masters = MasterResolver(loop.wake)
        self._observer = DockerObserver(engine, settings, self._masters, loop.wake)
        self._applier = DockerApplier(engine, settings, self._proxies)
        self._executor = jobs = Executor(self._tasks, loop.wake, self._port_taken, metrics.count)
        metrics.watch_jobs(lambda: len(jobs.busy), lambda: len(jobs.problems))
        self._proxy_sync = DockerProxySync(self._tasks, self._proxies, settings, loop.wake)
        self._memory = DockerMemory()
        self._shown: list[Problem] = []
        self._log = ProblemLog()
        self._last: tuple[DockerSnapshot, DockerPlan] | None = None

    async def run(self) -> None:
        """Look after the engine until cancelled. Proxies go on without an operator."""
        listen(self._engine, self._hear)
        self._tasks.repeat(self._masters.refresh, AGAIN_UNRESOLVED, "resolving masters")
        try:
            await self._loop.run(self.look)
        finally:
            await self._close()

    async def run_once(self, seconds: float) -> list[Problem]:
        """Look and act until nothing is left to do, for so many seconds at most.

        Returns what is not as it should be. Raises LookFailed if the engine can't be reached.
        """
        listen(self._engine, self._hear)
        try:
            await self._loop.run_until(self.look, self._settled, seconds)
            return self._unsolved()
        finally:
            await self._close()

    async def documents(self) -> dict[str, Document | str]:
        """What the live pages of all proxies show, or why one can't be asked.

        A proxy that has just been started is left out until it answers.
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

    async def status(self) -> Json:
        """What a new look sees and plans, and what proxies say now. Raises LookFailed."""
        await self._loop.look_anew()  # the last one may not have seen a container just started
        if self._last is None:
            raise LookFailed("the operator has not looked at the engine yet")
        snapshot, planned = self._last
        answers = await ask_proxies(self._proxies, snapshot, self._settings.uplink)
        problems = self._current(snapshot, planned)
        return host_document(
            snapshot.state, planned, problems, answers, self._settings, time.time()
        )

    async def look(self) -> float | None:
        """One look and what follows from it; when to look again.

        Raises LookFailed; LookImpossible where this container has the socket of a former engine.
        """
        started = time.monotonic()
        try:
            snapshot = await self._observer.look()
        except FormerSocket as error:
            raise LookImpossible(str(error), away=True) from error
        except EngineError as error:
            raise LookFailed(str(error), away=isinstance(error, Unavailable)) from error
        planned = self._decide(
            snapshot.state, snapshot.labels, self._settings, self._memory, time.monotonic()
        )
        took = time.monotonic() - started
        log.debug(
            "look ended in %.3f s: %d actions, next look in %s s",
            took,
            len(planned.actions),
            planned.again_in,
        )
        self._memory = planned.memory
        self._last = (snapshot, planned)
        if snapshot.state.busy and not self._observer.waiting:
            self._loop.wake_in(SETTLED)  # no event says when the list is right
        self._proxy_sync.update(snapshot, planned.members)  # first, as new containers' calls wait
        self._executor.start(
            planned.groups, lambda action: self._applier.carry_out(action, snapshot), started
        )
        problems = self._current(snapshot, planned)
        self._log.update(problems)
        metrics = self._metrics
        metrics.look_time.observe(took)
        metrics.containers.set(sum(member.container.alive for member in planned.members))
        metrics.problems.set(len(problems))
        metrics.show_proxies(proxy.container.state for proxy in snapshot.state.proxies)
        times = (planned.again_in, self._executor.again_in)
        return min((t for t in times if t is not None), default=None)

    def _current(self, snapshot: DockerSnapshot, planned: DockerPlan) -> list[Problem]:
        """All problems; those of what is being worked on as they were before.

        What a look finds and plans in the midst of it is outdated a moment later.
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
        """Whether nothing is left to be done or waited for."""
        if self._last is None or self._executor.busy or self._loop.woken:
            return False
        snapshot, planned = self._last
        # --once does not wait for what has failed to be tried again: it ends and tells of it.
        failed = any(problem.fatal for problem in self._executor.problems)
        if failed or self._proxy_sync.problems(snapshot):
            return True
        waiting = snapshot.state.busy or self._observer.waiting
        return not waiting and not _required(planned) and not self._silent(planned)

    def _silent(self, planned: DockerPlan) -> list[str]:
        """The proxies that are wanted and do not answer."""
        names = (proxy_name(desired.key) for desired in planned.desired if desired.live)
        return [name for name in names if not self._proxy_sync.answers(name)]

    def _unsolved(self) -> list[Problem]:
        if self._last is None:
            reason = self._loop.unready() or "the operator has not looked at the engine yet"
            return [Problem("engine", reason)]
        snapshot, planned = self._last
        problems = [problem for problem in self._current(snapshot, planned) if problem.fatal]
        subjects = {problem.subject for problem in problems}
        problems += [
            Problem(f"proxy {name}", "does not answer")
            for name in self._silent(planned)
            if f"proxy {name}" not in subjects
        ]
        unfinished = _required(planned) or planned.deferred or snapshot.state.busy
        if unfinished and not problems:
            text = "not all steps were done in time. Run this command again"
            problems.append(Problem("operator", text))
        return problems

    def _port_taken(self, name: str, port: int | None) -> None:
        self._memory = self._memory.port_taken(name, port, time.monotonic())

    def _hear(self, event: Json | None) -> None:
        """Take note of an event; None is a new connection: what happened before was missed."""
        if event is None:
            self._observer.mark_doubtful(None)
            self._memory = replace(self._memory, engine_returned=True)
            self._loop.retry()
        elif container := engine_json.container_of(event):
            self._observer.mark_doubtful(container)
        self._loop.wake()
        self._loop.wake_in(SETTLED)

    async def _close(self) -> None:
        await self._tasks.cancel()
        await self._proxies.close()


def _required(planned: DockerPlan) -> list[Group]:
    """The groups of a plan without which something is not as wanted."""
    return [group for group in planned.groups if group.fatal]
