"""Reconciles a cluster: look, plan, carry out, report. `ControlLoop` repeats the looks.

Data flows in one direction. Watches deliver objects to the store (`watch`), and wake the loop if an
object concerns a RosProxy. A look takes a snapshot of the store, adds the proxies' reports
(`proxies`), plans (`planner.plan`), and carries out the plan (`apply`). For each RosProxy, the
Services and pods come first, then the status and the Events. A look plans only the changed parts of
the cluster (`planner.partition`), and every ``--resync`` seconds all parts. This module makes no
decisions, and no decision depends on a single event.

Of several operators, only the leader acts, for a term (`leader_election`). The other operators
follow the cluster and the proxies' reports, so the next leader begins at once. At the end of a term
the operator forgets the state of the term, except the former ports of participants.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator

from msgspec.structs import replace

from rosproxy.page.page_document import Document
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.control_loop import ControlLoop, LookFailed, Pace
from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.problem import Problem, ProblemLog
from rosproxy_operator.common.proxy_client import ProxyClient
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import Api, ApiError, ApiUnavailable
from rosproxy_operator.kubernetes.apply import ClusterApplier
from rosproxy_operator.kubernetes.plan_schedule import PlanSchedule
from rosproxy_operator.kubernetes.planner.partition import (
    Partition,
    merge_state,
    partition_snapshot,
    partition_state,
)
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan, stand_by
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.proxies.hub_certificate import hub_certificates
from rosproxy_operator.kubernetes.proxies.proxy_sync import ClusterProxySync
from rosproxy_operator.kubernetes.proxies.sandbox import SandboxFailures
from rosproxy_operator.kubernetes.proxies.token_key import TokenKey
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    ProxyPod,
    WebhookState,
)
from rosproxy_operator.kubernetes.resources.model import ClusterFinding
from rosproxy_operator.kubernetes.resources.names import PLURAL
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from rosproxy_operator.kubernetes.status.events import stamp
from rosproxy_operator.kubernetes.status.findings import WARNS
from rosproxy_operator.kubernetes.status.rosproxy_status import participants
from rosproxy_operator.kubernetes.watch.reflector import Reflector, watched_collections
from rosproxy_operator.kubernetes.watch.store import ClusterStore

log = logging.getLogger(__name__)

LEAST_LOOK_INTERVAL_S = 0.1
"""Least seconds between two looks: a roll-out makes dozens of events."""
RECHECK_AFTER_ACTION_S = 1.0
"""Seconds from an action to another look, in case no watch reports the effect."""
LOOK_TIMEOUT_S = 90.0
"""Seconds after which the loop gives up a look."""
STANDBY_INTERVAL_S = 5.0
"""Seconds between two looks of an operator that does not lead."""
KEY_CHECK_INTERVAL_S = 30.0
"""Seconds between two checks whether the key of the proxies' tokens has changed."""


class KubernetesController:
    """Reconciles a cluster. Call `run` in an event loop.

    `wake` and `dead` are safe in any thread. All other methods belong to the event loop. ``term``
    returns the number of this operator's present term, or 0 if the operator does not lead.
    ``webhook_since`` returns since when this operator serves the webhook (see `WebhookState`).
    """

    def __init__(
        self,
        settings: KubernetesSettings,
        api: Api,
        metrics: ClusterMetrics,
        term: Callable[[], int] = lambda: 1,
        webhook_since: Callable[[], str] = lambda: "",
    ) -> None:
        self._settings = settings
        self._api = api
        self._metrics = metrics
        self._term = term
        self._webhook_since = webhook_since
        self._acting = 0
        pace = Pace("API server", settings.resync, LEAST_LOOK_INTERVAL_S, LOOK_TIMEOUT_S)
        self._loop = loop = ControlLoop(pace, metrics)
        self.wake = loop.wake_threadsafe
        self.dead = loop.dead
        self.unready = loop.unready
        self.retry = loop.retry
        self._tasks = Tasks()
        self._proxies = ProxyClient()
        self._key = TokenKey(api, settings.key_secret)
        kinds = watched_collections(api)
        corrected = metrics.view_corrections.inc
        self._store = ClusterStore(
            kinds, api.namespaces_of(PLURAL), loop.wake, loop.retry, corrected
        )
        self._sandbox = SandboxFailures(api)
        self._applier = applier = ClusterApplier(
            api, self._proxies, self._tasks, metrics.count, self._relist
        )
        metrics.watch_jobs(lambda: applier.busy, lambda: applier.failed)
        leads = self._leads
        self._proxy_sync = ClusterProxySync(self._tasks, self._proxies, self._wake_for, leads)
        self._state = ClusterState()
        self._due = PlanSchedule()
        self._last_standby_at = -STANDBY_INTERVAL_S
        self._reflectors: list[Reflector] = []
        self._secret = b""
        self._problems: dict[str, list[ClusterFinding]] = {}
        self._log = ProblemLog()

    async def run(self) -> None:
        """Reconcile the cluster until cancelled. The proxies keep running without an operator."""
        call_soon = asyncio.get_running_loop().call_soon_threadsafe
        count_restart = self._metrics.watch_restarts.inc
        self._reflectors = reflectors = [
            Reflector(self._api, collection, self._store, call_soon, count_restart)
            for collection in watched_collections(self._api)
        ]
        for reflector in reflectors:
            reflector.start()
        checks = Tasks()  # not in self._tasks, whose tasks end with each term
        checks.repeat(
            self._check_key, KEY_CHECK_INTERVAL_S, "checking the key of the proxies' tokens"
        )
        try:
            await self._loop.run(self.look)
        finally:
            await checks.cancel()
            for reflector in reflectors:
                reflector.stop()
            await self._tasks.cancel()
            await self._proxies.close()
            for reflector in reflectors:
                await in_thread(reflector.join)

    async def _check_key(self) -> None:
        """Plan everything after a change of the key. No watch covers the key's Secret."""
        with contextlib.suppress(ApiError):  # the next look reports the error
            if self._acting and await in_thread(self._key.read) != self._secret:
                self._due.mark_all_due()
                self._loop.wake()

    async def stop_acting(self) -> None:
        """Cancel the tasks beside the looks. The next look ends the term."""
        await self._tasks.cancel()

    async def documents(self) -> dict[str, Document | str]:
        """Return the live page's document of each proxy, or the reason of a failure, by pod."""
        return await self._proxies.documents(self._proxy_sync.admin_endpoints)

    def places(self) -> dict[str, str]:
        """Return the names of pods by address, in namespaces with a RosProxy."""
        return self._store.pod_names()

    def problems(self) -> dict[Problem, float]:
        """Return the problems of the last look for the live page; none on standby.

        The values are the monotonic times at which the operator first saw the problems. Warnings
        of the proxies are left out: the operator only repeats these warnings.
        """
        shown = [*self._findings(WARNS), *self._own_problems()] if self._acting else []
        return {problem: self._log.since.get(problem, time.monotonic()) for problem in shown}

    async def look(self) -> float | None:
        """Look and act. Return the seconds until the next look. Raises LookFailed.

        None: the next look is at an event, or after ``--resync`` seconds.
        """
        try:
            return await self._look()
        except ApiError as error:
            raise LookFailed(str(error), away=isinstance(error, ApiUnavailable)) from error
        except BaseException:
            # The store reports each change only once, and this look may have planned no change.
            self._due.mark_all_due()
            raise

    async def _look(self) -> float | None:
        if self._term() != self._acting:
            await self._change_term()  # also if the API server is away: another operator may lead
        await self._store.check()
        return await (self._act() if self._acting else self._stand_by())

    def _leads(self) -> bool:
        return self._term() != 0

    async def _change_term(self) -> None:
        """End the present term, if any, and forget its state. Then begin the next term, if any.

        The former ports of participants stay: the next term needs them.
        """
        if self._acting:
            await self._tasks.cancel()
            await self._proxy_sync.forget()
            self._applier.forget()
            # A new log does not report these problems as solved: the end of a term solves nothing.
            self._problems = {}
            self._log = ProblemLog()
            self._state = ClusterState(former=self._state.former)
            self._report(ClusterSnapshot())
        self._acting = self._term()
        self._last_standby_at = -STANDBY_INTERVAL_S
        self._due.mark_all_due()

    async def _stand_by(self) -> float:
        """Remember what the next term needs. Return the seconds until the next call."""
        remaining = self._last_standby_at + STANDBY_INTERVAL_S - time.monotonic()
        if remaining > 0:
            return remaining
        self._secret = await in_thread(self._key.read)
        self._store.take_changes()  # drop the changes: a term begins by planning everything
        observed = self._store.snapshot(self._secret)
        self._proxy_sync.follow(observed.proxies, observed.key)
        observed = replace(observed, reports=self._proxy_sync.reports)
        self._last_standby_at = time.monotonic()
        self._state = stand_by(observed, self._settings.plan, self._state, self._last_standby_at)
        return STANDBY_INTERVAL_S

    async def _act(self) -> float | None:
        started = time.monotonic()
        if self._due.is_all_due(started, self._settings.resync):
            self._secret = await in_thread(self._key.read)
        self._due.mark_due_now(await self._sandbox.read(self._store.snapshot()))
        # No await from here until the plan is made. So the snapshot has exactly these changes.
        touched = self._store.take_changes()
        observed = self._store.snapshot(self._secret)
        observed = self._sandbox.with_messages(observed)
        self._proxy_sync.follow(observed.proxies, observed.key)
        observed = replace(
            observed,
            reports=self._proxy_sync.reports,
            failures=self._applier.failures,
            hub_certificates=hub_certificates(observed.rosproxies, observed.key),
            webhook=WebhookState(self._settings.webhook is not None, self._webhook_since()),
        )
        scope = self._due.due_partition(
            observed, touched.namespaces, touched.nodes, time.monotonic()
        )
        planned = self._planned(observed, scope)
        took = time.monotonic() - started
        self._metrics.look_time.observe(took)
        text = "look ended in %.3f s: %s"
        log.debug(text, took, "all namespaces" if scope is None else scope.namespaces)
        await self._carry_out(planned, observed, scope)
        self._report(observed)
        return self._due.again_in(time.monotonic(), self._sandbox.again_in())

    def _planned(self, observed: ClusterSnapshot, scope: Partition | None) -> ClusterPlan:
        """Return the plan for ``scope`` (None: everything). Store the new state and problems."""
        now = time.monotonic()
        timestamp = stamp(time.time())
        settings = self._settings.plan
        if scope is None:
            planned = plan(observed, settings, self._state, now, timestamp)
            self._state = planned.state
            self._problems = {}
        else:
            state = partition_state(self._state, scope)
            planned = plan(partition_snapshot(observed, scope), settings, state, now, timestamp)
            self._state = merge_state(self._state, scope, planned.state)
            for namespace in scope.namespaces:
                self._problems.pop(namespace, None)
        for problem in planned.problems:
            self._problems.setdefault(problem.of.namespace, []).append(problem)
        self._due.note_plan(scope, observed, planned.next_look_in, now)
        return planned

    async def _carry_out(
        self, planned: ClusterPlan, observed: ClusterSnapshot, scope: Partition | None
    ) -> None:
        self._proxy_sync.brief(planned.briefings)
        await self._applier.carry_out(planned.actions, observed)
        concerned = {action.of.namespace for action in planned.actions}
        if self._applier.failures != observed.failures:
            self._wake_for(concerned)  # the statuses have to show the failures
        else:
            self._due.mark_due_at(concerned, time.monotonic() + RECHECK_AFTER_ACTION_S)

    def _wake_for(self, namespaces: Iterable[str]) -> None:
        """Plan these namespaces soon, after a change that no watch reports."""
        self._due.mark_due_now(namespaces)
        self._loop.wake()

    def _relist(self) -> None:
        """Let all reflectors list again: the watched state is wrong."""
        for reflector in self._reflectors:
            reflector.relist()

    def _report(self, observed: ClusterSnapshot) -> None:
        problems: list[Problem] = [*self._findings(), *self._own_problems()]
        self._log.update(problems, time.monotonic())
        metrics = self._metrics
        metrics.rosproxies.set(len(observed.rosproxies))
        metrics.pods.set(len(observed.selected))
        metrics.problems.set(len(problems))
        metrics.show_proxies(map(_proxy_state, observed.proxies))
        metrics.show_participants(participants(observed))

    def _findings(self, *without: str) -> Iterator[ClusterFinding]:
        """Yield the findings of all RosProxies, except findings with the reasons ``without``."""
        for _, group in sorted(self._problems.items()):
            yield from (finding for finding in group if finding.reason not in without)

    def _own_problems(self) -> tuple[Problem, ...]:
        """Return the failures of requests, and the problems with the key of the tokens."""
        return (*self._applier.problems.values(), *self._key.problems)


def _proxy_state(proxy: ProxyPod) -> str:
    if proxy.stuck:
        return "stuck"
    return "ready" if proxy.ready else "starting"
