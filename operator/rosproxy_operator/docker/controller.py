"""The controller: look, plan, carry out, tell; again whenever something has happened."""

import asyncio
import contextlib
import logging
import time

from rosproxy.net.tasks import Tasks
from rosproxy_operator.common.metrics import Metrics
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.problem_log import ProblemLog
from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.common.resolver import AGAIN_UNRESOLVED, MasterResolver
from rosproxy_operator.docker.apply import Applier
from rosproxy_operator.docker.client import DockerClient
from rosproxy_operator.docker.details import Inspector
from rosproxy_operator.docker.errors import EngineError, Unavailable
from rosproxy_operator.docker.events import Events
from rosproxy_operator.docker.executor import Executor
from rosproxy_operator.docker.planner.actions import Create
from rosproxy_operator.docker.planner.model import Proxy, Sandbox
from rosproxy_operator.docker.planner.plan import Group, Plan, plan
from rosproxy_operator.docker.planner.specs import master, proxy_name
from rosproxy_operator.docker.planner.state import Memory
from rosproxy_operator.docker.proxy_sync import ProxySync
from rosproxy_operator.docker.sense import sense, unresolved
from rosproxy_operator.docker.snapshot import Look, Observer
from rosproxy_operator.settings import DockerSettings

log = logging.getLogger(__name__)

DEBOUNCE = 0.05
"""Least seconds between two looks: one ``compose up`` makes dozens of events."""
SETTLED = 0.25
"""Seconds after an event at which there is one more look: an engine tells of some things before it
lists them."""
PAUSES = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Seconds until an engine is asked again that did not answer; the last is repeated."""
LONGEST_LOOK = 60.0
"""Seconds after which a look that has not ended means that the controller hangs."""


class DockerController:
    """A controller of one engine. `run` it in an event loop."""

    def __init__(self, settings: DockerSettings, metrics: Metrics) -> None:
        self._settings, self._metrics = settings, metrics
        self._again = asyncio.Event()
        self._tasks = Tasks()
        engine = DockerClient()
        self._proxies = ProxyClient()
        self._masters = MasterResolver(self._wake)
        self._inspector = Inspector(engine, self._wake)
        self._observer = Observer(engine, settings.plan, self._inspector)
        self._applier = Applier(engine, settings.plan, self._proxies, self._masters)
        self._work = Executor(self._tasks, self._wake, self._port_taken, metrics.count)
        uplink = settings.plan.uplink
        self._teller = ProxySync(self._tasks, self._proxies, self._masters, uplink, self._wake)
        self._events = Events(engine, self._happened)
        self._timer: asyncio.TimerHandle | None = None
        self._memory = Memory()
        self._shown: list[Problem] = []
        self._log = ProblemLog()
        self._failures = 0
        self._looking_since: float | None = None
        self._looked_at = 0.0
        self._error: str | None = "has not looked yet"
        self._last: tuple[Look, Plan] | None = None

    async def run(self) -> None:
        """Look after the engine until cancelled. Proxies go on without a controller."""
        self._events.start()
        self._tasks.repeat(self._masters.refresh, AGAIN_UNRESOLVED, "resolving masters")
        try:
            while True:
                await self._look_safely()
                await self._pause()
        finally:
            await self._close()

    async def _look_safely(self) -> None:
        """Look, and go on whatever becomes of it: a mistake of ours must not end the controller."""
        try:
            await self.look()
        except Exception as error:
            if not self._failures:
                log.exception("a look failed; going on")
            self._failed(EngineError(f"the controller failed: {error!r}"))

    async def run_once(self, seconds: float) -> list[Problem]:
        """Look and act until nothing is left to do, for so many seconds at most.

        Returns what is not as it should be. Raises Unavailable.
        """
        self._events.start()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    while not self._settled(await self.look(patient=False)):
                        await self._pause(1.0)
            return self._unsolved()
        finally:
            await self._close()

    async def look(self, patient: bool = True) -> bool:
        """One look and what follows from it; whether the engine could be asked.

        Raises Unavailable if not ``patient``.
        """
        self._again.clear()
        self._looking_since = started = time.monotonic()
        try:
            look = await sense(self._observer, self._masters, self._settings.plan)
            planned = plan(look.observed, self._settings.plan, self._memory, time.monotonic())
        except EngineError as error:
            if isinstance(error, Unavailable) and not patient:
                raise
            self._failed(error)
            return False
        finally:
            self._looking_since, self._looked_at = None, time.monotonic()
        self._metrics.look_time.observe(time.monotonic() - started)
        self._memory = planned.memory
        self._act(look, planned, started)
        self._looked(look, planned)
        return True

    def dead(self) -> str | None:
        """Why this controller is not alive; None if it is."""
        since = self._looking_since
        if since is not None and time.monotonic() - since > LONGEST_LOOK:
            return f"looking at the engine for {time.monotonic() - since:.0f} s"
        return None

    def unready(self) -> str | None:
        """Why the last look was no success; None if it was."""
        return self._error

    def _act(self, look: Look, planned: Plan, seen: float) -> None:
        """Begin what is to be done and told."""
        groups = [group for group in planned.groups if self._possible(group, look)]
        log.debug(
            "looked in %.3f s: %d actions, %d of them possible now, again in %s s",
            time.monotonic() - seen,
            len(planned.actions),
            sum(len(group.actions) for group in groups),
            planned.again_in,
        )
        if look.unsure and not self._inspector.waiting:
            self._look_in(SETTLED)  # nobody is going to tell when the list is right
        self._work.start(groups, lambda action: self._applier.carry_out(action, look), seen)
        self._teller.tell(look, planned.wishes)

    def _possible(self, group: Group, look: Look) -> bool:
        """Whether a group can be carried out already.

        Not without the address of a master that has a name: the proxy would find itself by it. Not
        on a container of which not everything is known.
        """
        if group.key is None:
            return True
        needs = any(isinstance(action, Create) for action in group.actions)
        if needs and not self._masters.address(master(group.key).host):
            return False
        own: list[Sandbox | Proxy] = [*look.observed.sandboxes, *look.observed.proxies]
        return not any(o.key == group.key and o.container.name in look.unsure for o in own)

    def _looked(self, look: Look, planned: Plan) -> None:
        if self._failures:
            log.info("looking works again")
        self._failures, self._error, self._last = 0, None, (look, planned)
        problems = self._current(look, planned)
        self._log.update(problems)
        metrics = self._metrics
        metrics.looks.labels("ok").inc()
        metrics.engine_up.set(1)
        metrics.containers.set(sum(wish.alive for wish in planned.wishes))
        metrics.problems.set(len(problems))
        metrics.show_proxies(proxy.container.state for proxy in look.observed.proxies)

    def _current(self, look: Look, planned: Plan) -> list[Problem]:
        """All problems; those of what is being worked on as they were before.

        What a look finds and plans in the midst of it is outdated a moment later.
        """
        found = [
            *planned.problems,
            *unresolved(look, self._masters, self._settings.plan),
            *self._work.problems,
            *self._teller.problems(look),
        ]
        busy = self._work.subjects
        self._shown = [
            *(problem for problem in found if problem.subject not in busy),
            *(problem for problem in self._shown if problem.subject in busy),
        ]
        return self._shown

    def _failed(self, error: EngineError) -> None:
        if str(error) != self._error:
            log.error("%s", error)
        self._failures += 1
        self._error = str(error)
        away = isinstance(error, Unavailable)
        self._metrics.looks.labels("unavailable" if away else "failed").inc()
        self._metrics.engine_up.set(0 if away else 1)

    async def _pause(self, most: float | None = None) -> None:
        """Wait until it is time for another look."""
        times = [most or self._settings.resync, self._work.again_in]
        if self._failures:
            times = [PAUSES[min(self._failures, len(PAUSES)) - 1]]
        elif self._last:
            times.append(self._last[1].again_in)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(min(each for each in times if each is not None)):
                await self._again.wait()
        await asyncio.sleep(self._looked_at + DEBOUNCE - time.monotonic())

    def _settled(self, looked: bool) -> bool:
        """Whether nothing is left to be done or waited for."""
        if not looked or self._last is None or self._work.busy or self._again.is_set():
            return False
        look, planned = self._last
        if self._work.problems or self._teller.problems(look):
            return True
        if look.unsure or self._inspector.waiting:
            return False
        doing = any(self._possible(group, look) for group in planned.groups)
        return not doing and not self._silent(planned)

    def _silent(self, planned: Plan) -> list[str]:
        """The proxies that are wanted and do not answer."""
        names = (proxy_name(desired.key) for desired in planned.desired if desired.live)
        return [name for name in names if not self._teller.answers(name)]

    def _unsolved(self) -> list[Problem]:
        if self._last is None:
            return [Problem("engine", self._error or "was not looked at")]
        look, planned = self._last
        problems = [problem for problem in self._current(look, planned) if problem.fatal]
        told = {problem.subject for problem in problems}
        problems += [
            Problem(f"proxy {name}", "does not answer")
            for name in self._silent(planned)
            if f"proxy {name}" not in told
        ]
        if planned.groups and not problems:
            problems.append(Problem("controller", "there was not enough time for all actions"))
        return problems

    def _port_taken(self, name: str, port: int | None) -> None:
        ports = None if port is None else [port]
        self._memory = self._memory.port_taken(name, ports, time.monotonic())

    def _happened(self) -> None:
        self._look_in(SETTLED)
        self._wake()

    def _look_in(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(seconds, self._wake)

    def _wake(self) -> None:
        self._again.set()

    async def _close(self) -> None:
        await self._tasks.cancel()
        await self._proxies.close()
