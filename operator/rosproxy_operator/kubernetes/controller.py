"""Reconciling a cluster: look, plan, carry out, tell. The loop around that is `ControlLoop`."""

import logging
import time
from collections.abc import Callable

from rosproxy.net.tasks import Tasks
from rosproxy_operator.common.control_loop import ControlLoop, LookFailed, Pace
from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.problem_log import ProblemLog
from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.kubernetes.api import Api
from rosproxy_operator.kubernetes.apply import Applier
from rosproxy_operator.kubernetes.errors import ApiError, Kind
from rosproxy_operator.kubernetes.event_filter import EventFilter
from rosproxy_operator.kubernetes.events import stamp
from rosproxy_operator.kubernetes.planner.model import Observed, ProxyPod
from rosproxy_operator.kubernetes.planner.plan import Plan, plan
from rosproxy_operator.kubernetes.planner.state import Memory
from rosproxy_operator.kubernetes.proxy_sync import ProxySync
from rosproxy_operator.kubernetes.snapshot import Cluster, Observer
from rosproxy_operator.settings import KubernetesSettings

log = logging.getLogger(__name__)

DEBOUNCE = 0.1
"""Least seconds between two looks: one roll-out makes dozens of events."""
SETTLED = 1.0
"""Seconds after something was done at which there is one more look, should nobody tell of it."""
LONGEST_LOOK = 90.0
"""Seconds after which a look that has not ended is given up."""


class KubernetesController:
    """Reconciles one cluster. `run` it in an event loop.

    `wake`, `concern` and `dead` may be called from other threads, all else only from that loop.
    ``appeared`` is called when the CRD is there that was missing before.
    """

    def __init__(self, settings: KubernetesSettings, api: Api, metrics: ClusterMetrics) -> None:
        self._settings, self._metrics = settings, metrics
        self._loop = loop = ControlLoop(
            Pace("API server", settings.resync, DEBOUNCE, LONGEST_LOOK), metrics
        )
        self.wake, self.dead, self.unready = loop.wake_threadsafe, loop.dead, loop.unready
        self._tasks = Tasks()
        self._proxies = ProxyClient()
        self._observer = Observer(api)
        self._applier = Applier(api, self._proxies, self._tasks, metrics.count)
        self._conversations = ProxySync(self._tasks, self._proxies, loop.wake)
        self.concern = EventFilter()
        self.appeared: Callable[[], None] = lambda: None
        self._missing = False
        self._memory = Memory()
        self._log = ProblemLog()

    async def run(self) -> None:
        """Look after the cluster until cancelled. Proxies go on without an operator."""
        try:
            await self._loop.run(self.look)
        finally:
            await self._tasks.cancel()
            await self._proxies.close()

    async def look(self) -> float | None:
        """One look and what follows from it; when to look again. Raises LookFailed."""
        try:
            return await self._look()
        except ApiError as error:
            self._missing = self._missing or error.kind is Kind.GONE
            raise LookFailed(str(error), away=error.kind is Kind.AWAY) from error

    async def _look(self) -> float | None:
        started = time.monotonic()
        cluster = await self._observer.look()
        self._conversations.hold(cluster.proxies)
        observed = cluster.observed(self._conversations.answers, self._applier.failures)
        planned = plan(
            observed, self._settings.plan, self._memory, time.monotonic(), stamp(time.time())
        )
        self._memory = planned.memory
        self._metrics.look_time.observe(time.monotonic() - started)
        log.debug("looked in %.3f s", time.monotonic() - started)
        self.concern.learn(cluster)
        self._conversations.tell(planned.gone)
        await self._act(planned, observed)
        self._looked(cluster, planned)
        return planned.again_in

    async def _act(self, planned: Plan, observed: Observed) -> None:
        before = dict(self._applier.failures)
        await self._applier.carry_out(planned.actions, observed)
        if self._applier.failures != before:
            self._loop.wake()  # the status is to tell
        elif planned.actions:
            self._loop.wake_in(SETTLED)

    def _looked(self, cluster: Cluster, planned: Plan) -> None:
        if self._missing:
            self._missing = False
            self.appeared()
        problems: list[Problem] = [*planned.problems, *self._applier.problems.values()]
        self._log.update(problems)
        metrics = self._metrics
        metrics.rosproxies.set(len(cluster.rosproxies))
        metrics.pods.set(len(cluster.selected))
        metrics.problems.set(len(problems))
        metrics.show_proxies(map(_state, cluster.proxies))


def _state(proxy: ProxyPod) -> str:
    if proxy.stuck:
        return "stuck"
    return "ready" if proxy.ready else "starting"
