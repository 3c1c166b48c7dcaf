"""Reconciling a cluster: look, plan, carry out, tell. The loop around that is `ControlLoop`.

The way of a RosProxy, in one direction: `watch` tells of events and `event_filter` drops those that
say nothing new; the others wake the loop. A look lists everything anew (`snapshot`), adds what the
proxies say of themselves (`proxy_sync`), decides (`planner.plan`), and carries out what was
decided (`apply`): Services and pods, then the RosProxies' statuses and the Events. Nothing is
decided from an event alone, and nothing here decides.
"""

import logging
import time
from collections.abc import Callable

from msgspec.structs import replace

from rosproxy.net.tasks import Tasks
from rosproxy_operator.common.control_loop import ControlLoop, LookFailed, Pace
from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.common.problem import Problem, ProblemLog
from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.kubernetes.api import Api, ApiAway, ApiError, ApiGone
from rosproxy_operator.kubernetes.apply import ClusterApplier
from rosproxy_operator.kubernetes.event_filter import EventFilter
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.proxy_sync import ClusterProxySync
from rosproxy_operator.kubernetes.resources.model import ClusterSnapshot, ProxyPod
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from rosproxy_operator.kubernetes.snapshot import SnapshotReader
from rosproxy_operator.kubernetes.status.events import stamp
from rosproxy_operator.kubernetes.token_key import TokenKey

log = logging.getLogger(__name__)

DEBOUNCE = 0.1
"""Least seconds between two looks: one roll-out makes dozens of events."""
SETTLED = 1.0
"""Seconds after something was done at which there is one more look, should nobody tell of it."""
LONGEST_LOOK = 90.0
"""Seconds after which a look that has not ended is given up."""


class KubernetesController:
    """Reconciles one cluster. `run` it in an event loop.

    `wake`, `event_filter` and `dead` may be used from other threads, all else only from that loop.
    ``appeared`` is called when the CRD is there that was missing before.
    """

    def __init__(self, settings: KubernetesSettings, api: Api, metrics: ClusterMetrics) -> None:
        self._settings, self._metrics = settings, metrics
        pace = Pace("API server", settings.resync, DEBOUNCE, LONGEST_LOOK)
        self._loop = loop = ControlLoop(pace, metrics)
        self.wake, self.dead, self.unready = loop.wake_threadsafe, loop.dead, loop.unready
        self._tasks, self._proxies = Tasks(), ProxyClient()
        self._key = TokenKey(api, settings.key_secret)
        self._snapshots = SnapshotReader(api, self._key)
        self._applier = ClusterApplier(api, self._proxies, self._tasks, metrics.count)
        self._proxy_sync = ClusterProxySync(self._tasks, self._proxies, loop.wake)
        self.event_filter = EventFilter()
        self.appeared: Callable[[], None] = lambda: None
        self._missing = False
        self._state = ClusterState()
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
            self._missing = self._missing or isinstance(error, ApiGone)
            raise LookFailed(str(error), away=isinstance(error, ApiAway)) from error

    async def _look(self) -> float | None:
        started = time.monotonic()
        seen = await self._snapshots.read()
        self._proxy_sync.follow(seen.proxies, seen.key)
        seen = replace(seen, reports=self._proxy_sync.reports, failures=self._applier.failures)
        planned = plan(seen, self._settings.plan, self._state, time.monotonic(), stamp(time.time()))
        self._state = planned.state
        took = time.monotonic() - started
        self._metrics.look_time.observe(took)
        log.debug("looked in %.3f s", took)
        self.event_filter.last = seen
        self._proxy_sync.report_policies(planned.policies)
        self._proxy_sync.report_callers(planned.callers)
        self._proxy_sync.report_gone(planned.gone)
        await self._applier.carry_out(planned.actions, seen)
        if self._applier.failures != seen.failures:
            self._loop.wake()  # the status is to tell
        elif planned.actions:
            self._loop.wake_in(SETTLED)
        if self._missing:
            self._missing = False
            self.appeared()
        self._report(seen, planned)
        return planned.again_in

    def _report(self, seen: ClusterSnapshot, planned: ClusterPlan) -> None:
        own = (*self._applier.problems.values(), *self._key.problems)
        problems: list[Problem] = [*planned.problems, *own]
        self._log.update(problems)
        metrics = self._metrics
        metrics.rosproxies.set(len(seen.rosproxies))
        metrics.pods.set(len(seen.selected))
        metrics.problems.set(len(problems))
        metrics.show_proxies(map(_proxy_state, seen.proxies))


def _proxy_state(proxy: ProxyPod) -> str:
    if proxy.stuck:
        return "stuck"
    return "ready" if proxy.ready else "starting"
