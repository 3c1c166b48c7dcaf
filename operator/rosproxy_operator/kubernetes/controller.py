"""The controller: look, plan, carry out, tell; again whenever something has happened."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable

from rosproxy.net.tasks import Tasks
from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.problem_log import ProblemLog
from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.kubernetes.api import Api
from rosproxy_operator.kubernetes.apply import ClusterApplier
from rosproxy_operator.kubernetes.errors import ApiError, ErrorKind
from rosproxy_operator.kubernetes.event_filter import EventFilter
from rosproxy_operator.kubernetes.events import stamp
from rosproxy_operator.kubernetes.planner.model import ClusterSnapshot, ProxyPod
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.proxy_sync import ClusterProxySync
from rosproxy_operator.kubernetes.snapshot import Cluster, SnapshotReader
from rosproxy_operator.settings import KubernetesSettings

log = logging.getLogger(__name__)

DEBOUNCE = 0.1
"""Least seconds between two looks: one roll-out makes dozens of events."""
SETTLED = 1.0
"""Seconds after something was done at which there is one more look, should nobody tell of it."""
PAUSES = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Seconds until an API server is asked again that did not answer; the last is repeated."""
LONGEST_LOOK = 90.0
"""Seconds after which a look that has not ended means that the controller hangs."""
LONGEST_BEAT = 20.0
"""Seconds after which an event loop that does nothing hangs."""


class KubernetesController:
    """A controller of one cluster. `run` it in an event loop.

    `wake`, `concern` and `dead` may be called from other threads, all else only from that loop.
    ``appeared`` is called when the CRD is there that was missing before.
    """

    def __init__(self, settings: KubernetesSettings, api: Api, metrics: ClusterMetrics) -> None:
        self._settings, self._metrics = settings, metrics
        self._again = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._tasks = Tasks()
        self._proxies = ProxyClient()
        self._observer = SnapshotReader(api)
        self._applier = ClusterApplier(api, self._proxies, self._tasks, metrics.count)
        self._conversations = ClusterProxySync(self._tasks, self._proxies, self._again.set)
        self.concern = EventFilter()
        self.appeared: Callable[[], None] = lambda: None
        self._missing = False
        self._timer: asyncio.TimerHandle | None = None
        self._state = ClusterState()
        self._log = ProblemLog()
        self._failures = 0
        self._looking_since: float | None = None
        self._looked_at = 0.0
        self._beat_at = time.monotonic()
        self._error: str | None = "has not looked yet"
        self._again_in: float | None = None

    async def run(self) -> None:
        """Look after the cluster until cancelled. Proxies go on without a controller."""
        self._loop = asyncio.get_running_loop()
        self._tasks.repeat(self._beat, 1.0, "the heartbeat")
        try:
            while True:
                await self._look_safely()
                await self._pause()
        finally:
            await self._close()

    def wake(self) -> None:
        """Let it look again soon."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._again.set)

    def dead(self) -> str | None:
        """Why this controller is not alive; None if it is."""
        now, since = time.monotonic(), self._looking_since
        if now - self._beat_at > LONGEST_BEAT:
            return f"the event loop has not run for {now - self._beat_at:.0f} s"
        if since is not None and now - since > LONGEST_LOOK:
            return f"looking at the cluster for {now - since:.0f} s"
        return None

    def unready(self) -> str | None:
        """Why the last look was no success; None if it was."""
        return self._error

    async def _look_safely(self) -> None:
        """Look, and go on whatever becomes of it: a mistake of ours must not end the controller."""
        try:
            async with asyncio.timeout(LONGEST_LOOK):
                await self.look()
        except ApiError as error:
            self._failed(error)
        except TimeoutError:
            self._failed(
                ApiError(ErrorKind.AWAY, f"the API server took more than {LONGEST_LOOK:.0f} s")
            )
        except Exception as error:
            if not self._failures:
                log.exception("a look failed; going on")
            self._failed(ApiError(ErrorKind.OTHER, f"the controller failed: {error!r}"))

    async def look(self) -> None:
        """One look and what follows from it. Raises ApiError."""
        self._again.clear()
        self._looking_since = started = time.monotonic()
        try:
            cluster = await self._observer.look()
            self._conversations.hold(cluster.proxies)
            observed = cluster.observed(self._conversations.answers, self._applier.failures)
            planned = plan(
                observed, self._settings.plan, self._state, time.monotonic(), stamp(time.time())
            )
            self._state, self._again_in = planned.state, planned.again_in
            self._metrics.look_time.observe(time.monotonic() - started)
            log.debug("looked in %.3f s", time.monotonic() - started)
            self.concern.learn(cluster)
            self._conversations.tell(planned.gone)
            await self._act(planned, observed)
        finally:
            self._looking_since, self._looked_at = None, time.monotonic()
        self._looked(cluster, planned)

    async def _act(self, planned: ClusterPlan, observed: ClusterSnapshot) -> None:
        before = dict(self._applier.failures)
        await self._applier.carry_out(planned.actions, observed)
        if self._applier.failures != before:
            self._again.set()  # the status is to tell
        elif planned.actions:
            self._look_in(SETTLED)

    def _looked(self, cluster: Cluster, planned: ClusterPlan) -> None:
        if self._failures:
            log.info("looking works again")
        self._failures, self._error = 0, None
        if self._missing:
            self._missing = False
            self.appeared()
        problems: list[Problem] = [*planned.problems, *self._applier.problems.values()]
        self._log.update(problems)
        metrics = self._metrics
        metrics.looks.labels("ok").inc()
        metrics.api_up.set(1)
        metrics.rosproxies.set(len(cluster.rosproxies))
        metrics.pods.set(len(cluster.selected))
        metrics.problems.set(len(problems))
        metrics.show_proxies(map(_proxy_state, cluster.proxies))

    def _failed(self, error: ApiError) -> None:
        away = error.kind is ErrorKind.AWAY
        if str(error) != self._error:
            log.log(logging.WARNING if away else logging.ERROR, "%s", error)
        self._failures += 1
        self._missing = self._missing or error.kind is ErrorKind.GONE
        self._error = str(error)
        self._metrics.looks.labels("unavailable" if away else "failed").inc()
        self._metrics.api_up.set(0 if away else 1)

    async def _pause(self) -> None:
        """Wait until it is time for another look."""
        if self._failures:
            # Events of an API server that has just come back don't matter: it is asked soon.
            await asyncio.sleep(PAUSES[min(self._failures, len(PAUSES)) - 1])
            return
        resync, soon = self._settings.resync, self._again_in
        seconds = resync if soon is None else min(resync, soon)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._again.wait()
        await asyncio.sleep(self._looked_at + DEBOUNCE - time.monotonic())

    async def _beat(self) -> None:
        self._beat_at = time.monotonic()

    def _look_in(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(seconds, self._again.set)

    async def _close(self) -> None:
        await self._tasks.cancel()
        await self._proxies.close()


def _proxy_state(proxy: ProxyPod) -> str:
    if proxy.stuck:
        return "stuck"
    return "ready" if proxy.ready else "starting"
