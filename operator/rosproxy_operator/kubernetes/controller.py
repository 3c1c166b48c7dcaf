"""Reconciling a cluster: look, plan, carry out, tell. The loop around that is `ControlLoop`.

The way of a RosProxy, in one direction: watches tell of it, and what they tell is
kept (`watch`), which wakes the loop if it concerns anybody. A look takes the cluster from there,
adds what the proxies say of themselves (`proxies`), decides (`planner.plan`), and carries out
what was decided (`apply`): Services and pods, then the RosProxies' statuses and the Events. Only
the parts that something has happened to are planned (`planner.parts`), and now and then all of
them. Nothing is decided from an event alone, and nothing here decides.

Of several operators one acts, for a term (`leader`). The others keep up with the cluster and with
what the proxies say, so that the next one begins at once; what it remembers of a term it forgets
with that.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Iterable

from msgspec.structs import replace

from rosproxy.net.tasks import Tasks
from rosproxy.page.document import Document
from rosproxy_operator.common.control_loop import ControlLoop, LookFailed, Pace
from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.common.problem import Problem, ProblemLog
from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.client import Api, ApiAway, ApiError
from rosproxy_operator.kubernetes.apply import ClusterApplier
from rosproxy_operator.kubernetes.due import Due
from rosproxy_operator.kubernetes.planner.parts import Part, cut, cut_state, joined
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan, stand_by
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.proxies.proxy_sync import ClusterProxySync
from rosproxy_operator.kubernetes.proxies.sandbox import SandboxFailures
from rosproxy_operator.kubernetes.proxies.token_key import TokenKey
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPod
from rosproxy_operator.kubernetes.resources.model import ClusterFinding
from rosproxy_operator.kubernetes.resources.names import PLURAL
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from rosproxy_operator.kubernetes.status.events import stamp
from rosproxy_operator.kubernetes.status.status import participants
from rosproxy_operator.kubernetes.watch.reflector import Reflector, every_kind
from rosproxy_operator.kubernetes.watch.store import ClusterStore

log = logging.getLogger(__name__)

DEBOUNCE = 0.1
"""Least seconds between two looks: one roll-out makes dozens of events."""
SETTLED = 1.0
"""Seconds after something was done at which there is one more look, should nobody tell of it."""
LONGEST_LOOK = 90.0
"""Seconds after which a look that has not ended is given up."""
STANDING_BY = 5.0
"""Seconds between two looks of an operator that does not lead."""


class KubernetesController:
    """Reconciles one cluster. `run` it in an event loop.

    `wake` and `dead` may be used from other threads, all else only from that loop.
    """

    def __init__(
        self,
        settings: KubernetesSettings,
        api: Api,
        metrics: ClusterMetrics,
        term: Callable[[], int] = lambda: 1,
    ) -> None:
        self._settings, self._api, self._metrics = settings, api, metrics
        self._term, self._acting = term, 0
        pace = Pace("API server", settings.resync, DEBOUNCE, LONGEST_LOOK)
        self._loop = loop = ControlLoop(pace, metrics)
        self.wake, self.dead, self.unready = loop.wake_threadsafe, loop.dead, loop.unready
        self.retry = loop.retry
        self._tasks, self._proxies = Tasks(), ProxyClient()
        self._key = TokenKey(api, settings.key_secret)
        kinds, corrected = every_kind(api), metrics.view_corrections.inc
        self._store = ClusterStore(kinds, api.places(PLURAL), loop.wake, loop.retry, corrected)
        self._sandbox = SandboxFailures(api)
        self._applier = doing = ClusterApplier(
            api, self._proxies, self._tasks, metrics.count, self._doubt
        )
        metrics.watch_jobs(lambda: doing.busy, lambda: doing.failed)
        leads = self._leads
        self._proxy_sync = ClusterProxySync(self._tasks, self._proxies, self._news, leads)
        self._state, self._due, self._stood_by = ClusterState(), Due(), -STANDING_BY
        self._reflectors: list[Reflector] = []
        self._secret = b""
        self._problems: dict[str, list[ClusterFinding]] = {}
        self._log = ProblemLog()

    async def run(self) -> None:
        """Look after the cluster until cancelled. Proxies go on without an operator."""
        soon = asyncio.get_running_loop().call_soon_threadsafe
        lost = self._metrics.watch_restarts.inc
        self._reflectors = reflectors = [
            Reflector(self._api, what, self._store, soon, lost) for what in every_kind(self._api)
        ]
        for one in reflectors:
            one.start()
        try:
            await self._loop.run(self.look)
        finally:
            for one in reflectors:
                one.stop()
            await self._tasks.cancel()
            await self._proxies.close()
            for one in reflectors:
                await in_thread(one.join)

    async def stop_acting(self) -> None:
        """End what goes on beside the looks. The next one finds that it leads no more."""
        await self._tasks.cancel()

    async def documents(self) -> dict[str, Document | str]:
        """What the live pages of all proxies show, or why one can't be asked."""
        return await self._proxies.documents(self._proxy_sync.ways)

    async def look(self) -> float | None:
        """One look and what follows from it; when to look again. Raises LookFailed."""
        try:
            return await self._look()
        except ApiError as error:
            raise LookFailed(str(error), away=isinstance(error, ApiAway)) from error
        except BaseException:
            self._due.all()
            raise

    async def _look(self) -> float | None:
        if self._term() != self._acting:
            await self._turn()  # also while the API server is away: then another one may lead
        await self._store.check()
        return await (self._act() if self._acting else self._stand_by())

    def _leads(self) -> bool:
        return self._term() != 0

    async def _turn(self) -> None:
        """Begin a term, or end one: of that nothing is to be left."""
        if self._acting:
            await self._tasks.cancel()
            await self._proxy_sync.forget()
            self._applier.forget()
            self._problems, self._log = {}, ProblemLog()  # nothing is solved by that
            self._state = ClusterState(former=self._state.former)
            self._report(ClusterSnapshot())
        self._acting, self._stood_by = self._term(), -STANDING_BY
        self._due.all()

    async def _stand_by(self) -> float:
        """Remember what the next term needs; in how many seconds again."""
        left = self._stood_by + STANDING_BY - time.monotonic()
        if left > 0:
            return left
        self._secret = await in_thread(self._key.read)
        self._store.touched()
        seen = self._store.snapshot(self._secret)
        self._proxy_sync.follow(seen.proxies, seen.key)
        seen = replace(seen, reports=self._proxy_sync.reports)
        self._stood_by = time.monotonic()
        self._state = stand_by(seen, self._settings.plan, self._state, self._stood_by)
        return STANDING_BY

    async def _act(self) -> float | None:
        started = time.monotonic()
        if self._due.is_all(started, self._settings.resync):
            self._secret = await in_thread(self._key.read)
        self._due.at_once(await self._sandbox.read(self._store.snapshot()))
        # From here on nothing is waited for: what has changed is what is seen.
        touched, seen = self._store.touched(), self._store.snapshot(self._secret)
        seen = self._sandbox.shown(seen)
        self._proxy_sync.follow(seen.proxies, seen.key)
        seen = replace(seen, reports=self._proxy_sync.reports, failures=self._applier.failures)
        part = self._due.part(seen, touched.namespaces, touched.nodes, time.monotonic())
        planned = self._planned(seen, part)
        took = time.monotonic() - started
        self._metrics.look_time.observe(took)
        log.debug("looked in %.3f s, %s", took, "at all" if part is None else part.namespaces)
        await self._carry_out(planned, seen, part)
        self._report(seen)
        return self._due.again_in(time.monotonic(), self._sandbox.again_in())

    def _planned(self, seen: ClusterSnapshot, part: Part | None) -> ClusterPlan:
        """The plan for a part, None for all; what it remembers is kept."""
        now, said, settings = time.monotonic(), stamp(time.time()), self._settings.plan
        if part is None:
            planned = plan(seen, settings, self._state, now, said)
            self._state, self._problems = planned.state, {}
        else:
            before = cut_state(self._state, part)
            planned = plan(cut(seen, part), settings, before, now, said)
            self._state = joined(self._state, part, planned.state)
            for namespace in part.namespaces:
                self._problems.pop(namespace, None)
        for one in planned.problems:
            self._problems.setdefault(one.of.namespace, []).append(one)
        self._due.planned(part, seen, planned.again_in, now)
        return planned

    async def _carry_out(
        self, planned: ClusterPlan, seen: ClusterSnapshot, part: Part | None
    ) -> None:
        self._proxy_sync.report_policies(planned.policies)
        self._proxy_sync.report_callers(planned.callers, planned.peers, planned.former)
        self._proxy_sync.report_gone(planned.gone)
        await self._applier.carry_out(planned.actions, seen)
        concerned = {action.of.namespace for action in planned.actions}
        if self._applier.failures != seen.failures:
            self._news(concerned)  # the status is to tell
        else:
            self._due.soon(concerned, time.monotonic() + SETTLED)

    def _news(self, namespaces: Iterable[str]) -> None:
        """Something is known of these that no watch has told."""
        self._due.at_once(namespaces)
        self._loop.wake()

    def _doubt(self) -> None:
        """What is known is not so: have everything listed anew."""
        for one in self._reflectors:
            one.doubt()

    def _report(self, seen: ClusterSnapshot) -> None:
        own = (*self._applier.problems.values(), *self._key.problems)
        found = [one for _, some in sorted(self._problems.items()) for one in some]
        problems: list[Problem] = [*found, *own]
        self._log.update(problems)
        metrics = self._metrics
        metrics.rosproxies.set(len(seen.rosproxies))
        metrics.pods.set(len(seen.selected))
        metrics.problems.set(len(problems))
        metrics.show_proxies(map(_proxy_state, seen.proxies))
        metrics.show_participants(participants(seen))


def _proxy_state(proxy: ProxyPod) -> str:
    if proxy.stuck:
        return "stuck"
    return "ready" if proxy.ready else "starting"
