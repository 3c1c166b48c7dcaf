"""Keeps proxies and operator in step, over the proxies' admin endpoints.

Each proxy's pod that has an address has a `ProxyPoller` of its own. It waits until the proxy
reports a change (``/status/changes``), which costs nothing as long as none happens; a proxy that is
just starting, does not answer or is of a former release is polled. The poller also sends the proxy
its policy (``/policy``), which pods may use it as their master and which are gone
(``/containers``), until the proxy confirms. Reports land in `ClusterProxySync.reports`, from where
each look takes them; one that has changed wakes the operator. An operator that does not lead
listens as well, and sends nothing.
"""

import asyncio
import contextlib
import logging
import random
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from rosproxy.access.layers import PolicyLayer
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.net.addresses import HostPort
from rosproxy.net.tasks import Tasks
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyClient, ProxyError
from rosproxy_operator.common.proxy_session import AllowedCallers, ProxySession
from rosproxy_operator.kubernetes.planner.briefing import Briefing
from rosproxy_operator.kubernetes.proxies.proxy_report import no_answer, report, short, unreadable
from rosproxy_operator.kubernetes.resources.cluster import ProxyPod, ProxyReport
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, token_of

log = logging.getLogger(__name__)

EVERY = 3.0
"""Seconds between two polls of a proxy."""
EVERY_STARTING = 0.5
"""The same until it has answered for the first time."""
LEAST_INTERVAL = 0.5
"""Seconds between two changes that are taken: a hostile proxy may report them for ever."""
EVERY_FORMER = 15.0
"""The same for one that does not report changes (``/status/changes``)."""
WAIT = 1800.0
"""Longest wait for a change, in seconds, until a proxy answers in any case.

Keep-alive probes of TCP find a proxy that is cut off (`common.proxy_client`).
"""
STARTING = 10.0
"""Seconds for which a proxy may be silent after its pod has an address: it is just starting."""
SILENT = 2
"""Unanswered polls in a row before a proxy counts as silent."""
AT_ONCE = 32
"""Proxies that are polled at the same time."""
SLOW_AT_ONCE = 256
"""The same for calls that may wait for a proxy's master: so they hold up no other calls."""
REPEATED = 30.0
"""Seconds after which a proxy that does not report changes is sent anew which pods may use it."""
_KNOWS_NO_CHANGES = (403, 404, 405, 503)
"""HTTP answers of a proxy of a former release, or of one at which too many wait already."""


class CallLimits:
    """Limits of calls at the same time: short questions, and calls that may wait for a master."""

    def __init__(self) -> None:
        self.questions = asyncio.Semaphore(AT_ONCE)
        self.slow = asyncio.Semaphore(SLOW_AT_ONCE)


class ProxyPoller:
    """Polls one proxy, and sends it what it is to know until it confirms that.

    ``changed`` is called when its report has changed.
    """

    def __init__(
        self,
        proxy: ProxyPod,
        proxies: ProxyClient,
        limits: CallLimits,
        changed: Callable[[], None],
        key: bytes,
        leads: Callable[[], bool] = lambda: True,
    ) -> None:
        self._leads = leads
        self.session = ProxySession(proxies, *_admin_endpoint(proxy, key))
        self.name = str(proxy.pod.id)
        self.report: ProxyReport | None = None
        self._limits = limits
        self._changed = changed
        self._gone: set[str] = set()
        self._restarts = proxy.restarts
        self._policy: tuple[PolicyLayer, ...] | None = None
        self._refusal = ""
        self._callers: AllowedCallers | None = None
        self._callers_told_at = 0.0
        self._pending = asyncio.Event()
        self._recheck = False
        self._failures = 0
        self._tells_changes = True
        self._version = ""
        self._instance = ""
        self._since = time.monotonic()

    def brief(self, briefing: Briefing) -> None:
        """Have the proxy told what is new of this."""
        self._gone |= {*briefing.gone}
        if briefing.policy is not None:
            self._policy = briefing.policy
        if briefing.callers is not None:
            self._callers = AllowedCallers(briefing.callers, briefing.peers, briefing.former_ports)
        if self._gone or not self._is_confirmed:
            self._pending.set()

    def restarted(self, restarts: int) -> None:
        """Note how often its container was started again: a proxy knows nothing after that."""
        if restarts != self._restarts:
            self._restarts = restarts
            self._forget()
            self._pending.set()

    async def run(self) -> None:
        """Poll the proxy and send to it until cancelled."""
        long_poll: asyncio.Task[None] | None = None
        try:
            while True:
                told_gone = await self._tell()
                if self._listens and not told_gone:
                    long_poll = long_poll or asyncio.create_task(self._ask(_random_wait()))
                    await self._wait_for_either(long_poll)
                    if long_poll.done():
                        long_poll = long_poll.result()  # None, or raises what it died of
                        await self._wait_for_update(LEAST_INTERVAL)
                    continue
                # Acting on that may take the proxy a moment: the next poll rechecks, not this one.
                self._recheck = self._recheck and not told_gone
                async with self._limits.questions:
                    await self._ask()
                self._recheck = told_gone
                if not self._listens:
                    await self._pause()
        finally:
            if long_poll is not None:
                long_poll.cancel()

    @property
    def _listens(self) -> bool:
        """Whether to wait until the proxy reports a change, instead of polling it."""
        answers = self.report is not None and self.report.answered
        return answers and self._tells_changes and not self._is_busy

    @property
    def _is_busy(self) -> bool:
        """Whether the proxy is yet to answer, or to confirm what it was sent."""
        return bool(self._failures or self._recheck or self._gone) or not self._is_confirmed

    @property
    def _is_confirmed(self) -> bool:
        """Whether the proxy has confirmed its policy and its callers."""
        policy = self._policy
        callers = self._callers
        return (policy is None or self.session.has_policy(policy)) and (
            callers is None or self.session.has_callers(callers)
        )

    async def _wait_for_either(self, long_poll: asyncio.Task[None]) -> None:
        """Wait for a change, or until there is something to send."""
        pending = asyncio.create_task(self._pending.wait())
        try:
            await asyncio.wait({long_poll, pending}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            pending.cancel()

    async def _pause(self) -> None:
        """Wait until the next poll is due, or until there is something to send."""
        answers = self.report is not None and self.report.answered
        pause = EVERY if answers or self._has_waited(EVERY * 20) else EVERY_STARTING
        if answers and not self._is_busy:
            pause = EVERY_FORMER
        await self._wait_for_update(pause)

    async def _wait_for_update(self, seconds: float) -> None:
        """Wait for so long, or until there is something to send."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._pending.wait()

    async def _tell(self) -> bool:
        """Send all that is not confirmed yet. Returns whether gone pods were confirmed now."""
        self._pending.clear()
        if await self._tell_policy():  # nobody is let in before the policy is known
            await self._tell_callers()
        return await self._tell_gone()

    async def _ask(self, within: float = 0.0) -> None:
        """Request its status, or wait for a change of it for ``within`` seconds."""
        try:
            status = await self._fetch_status(within)
            new_report = report(status, self._refusal)
            self._failures = 0
        except ProxyError as error:
            self._failures += 1
            if error.is_unreadable and self.report:
                new_report = unreadable(self.report, str(error))
            else:
                self._forget()  # the process that answers next may be a new one
                if self._failures < SILENT or not (self.report or self._has_waited(STARTING)):
                    return
                new_report = no_answer(str(error))
        starting = self.report is None and not self._has_waited(STARTING)
        if starting and new_report.answered and not new_report.master_up:
            return  # it may not have asked its master yet
        # A process may outlive its pod for a moment: then the next look tells it again.
        recheck = self._recheck
        self._recheck = False
        if new_report != self.report or recheck:
            self.report = new_report
            self._changed()

    async def _fetch_status(self, within: float) -> ProxyStatus:
        if self._tells_changes:
            try:
                since = self._version if within else ""
                change = await self.session.changes(since, within)
            except ProxyError as error:
                if error.status not in _KNOWS_NO_CHANGES:
                    raise
                self._tells_changes = False
            else:
                self._version, status = change
                self._note_instance(status.instance)
                return status
        return await self.session.status()

    def _note_instance(self, instance: str) -> None:
        """Note which process answers: one that was started again knows nothing."""
        if self._instance and instance != self._instance:
            self._forget()
            self._pending.set()
        self._instance = instance

    def _forget(self) -> None:
        """Assume that the proxy knows nothing."""
        self.session.forget()
        self._tells_changes = True

    async def _tell_policy(self) -> bool:
        """Send its policy, if it does not have that. Returns whether it has it now."""
        policy = self._policy
        if policy is None or self.session.has_policy(policy):
            return True
        try:
            async with self._limits.slow:
                if not self._leads():
                    return False
                await self.session.tell_policy(policy)
        except PolicyRefused as error:
            self._refusal = short(str(error))
            return False
        except ProxyError as error:
            log.debug("policy not sent: proxy %s: %s", self.session.admin, error)
            return False
        self._recheck = self._recheck or bool(self._refusal)  # it has another report now
        self._refusal = ""
        return True

    async def _tell_callers(self) -> None:
        """Send which pods may use it, if it does not know.

        In a call of its own, before the others: those may wait for the master, and pods for this.
        """
        callers = self._callers
        recent = self._tells_changes or time.monotonic() - self._callers_told_at < REPEATED
        if callers is None or (self.session.has_callers(callers) and recent):
            return
        try:
            async with self._limits.questions:
                if not self._leads():  # the call before may have taken long
                    return
                await self.session.tell_callers(callers)
        except ProxyError as error:
            text = "allowed callers not sent: proxy %s, %s: %s"
            log.debug(text, self.session.admin, callers, error)
            return
        self._callers_told_at = time.monotonic()

    async def _tell_gone(self) -> bool:
        """Send which pods are gone, if any are. Returns whether the proxy has confirmed that."""
        gone = sorted(self._gone)
        if not gone:
            return False
        try:
            async with self._limits.slow:
                if not self._leads():
                    return False
                answer = await self.session.tell_containers({"gone": gone})
        except ProxyError as error:
            # It may just be without its master; it is sent again with the next poll.
            log.debug("gone addresses not sent: proxy %s, %s: %s", self.session.admin, gone, error)
            return False
        self._gone -= set(gone)
        log.debug("gone addresses sent: proxy %s, %s: %s", self.session.admin, gone, answer)
        return True

    def _has_waited(self, seconds: float) -> bool:
        return time.monotonic() - self._since > seconds


class ClusterProxySync:
    """All pollers, one for each proxy's pod that has an address.

    ``changed`` is called with the namespaces of proxies whose reports have changed.
    """

    def __init__(
        self,
        tasks: Tasks,
        proxies: ProxyClient,
        changed: Callable[[Iterable[str]], None],
        leads: Callable[[], bool] = lambda: True,
    ) -> None:
        self._tasks = tasks
        self._proxies = proxies
        self._changed = changed
        self._leads = leads
        self._limits = CallLimits()
        self._pollers: dict[str, tuple[ProxyPoller, asyncio.Task[None]]] = {}

    @property
    def reports(self) -> dict[str, ProxyReport]:
        """The reports by the uids of the proxies' pods; none of a proxy that is just starting."""
        return {uid: p.report for uid, (p, _) in self._pollers.items() if p.report is not None}

    @property
    def admin_endpoints(self) -> dict[str, tuple[HostPort, str]]:
        """Each proxy's admin endpoint and the token for it, by the names of their pods."""
        sessions = {poller.name: poller.session for poller, _ in self._pollers.values()}
        return {name: (session.admin, session.token) for name, session in sessions.items()}

    def follow(self, proxies: Iterable[ProxyPod], key: bytes = b"") -> None:
        """Poll these and no others, with tokens made from this key."""
        wanted = {p.pod.uid: p for p in proxies if p.pod.ip and not p.pod.ended}
        for uid in [*self._pollers]:
            poller, task = self._pollers[uid]
            current = wanted.get(uid)
            endpoint = _admin_endpoint(current, key) if current else None
            session = poller.session
            if current is None or endpoint != (session.admin, session.token) or task.done():
                task.cancel()
                del self._pollers[uid]
            else:
                poller.restarted(current.restarts)
        for uid, proxy in wanted.items():
            if uid not in self._pollers:
                changed = partial(self._changed, [proxy.of.namespace])
                added = ProxyPoller(proxy, self._proxies, self._limits, changed, key, self._leads)
                task = self._tasks.spawn(added.run(), f"polling {proxy.pod.id}")
                self._pollers[uid] = added, task

    async def forget(self) -> None:
        """Assume that no proxy knows anything: another operator has sent to them meanwhile."""
        tasks = [task for _, task in self._pollers.values()]
        self._pollers.clear()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def brief(self, briefings: Mapping[str, Briefing]) -> None:
        """Have proxies told what is new, by the uid of their pods."""
        for uid, briefing in briefings.items():
            if uid in self._pollers:
                self._pollers[uid][0].brief(briefing)


def _random_wait() -> float:
    """Seconds to wait for a change: not the same for all pollers, which begin together."""
    return WAIT * random.random()  # noqa: S311 - no secret


def address_of(proxy: ProxyPod) -> HostPort:
    """A proxy's admin endpoint."""
    return HostPort(proxy.pod.ip, ADMIN_PORT)


def token_for(proxy: ProxyPod, key: bytes) -> str:
    """The token of a proxy's admin endpoint: by the key, or in the pod of a former operator's."""
    return proxy.token or token_of(key, proxy.pod.id, proxy.node)


def _admin_endpoint(proxy: ProxyPod, key: bytes) -> tuple[HostPort, str]:
    return address_of(proxy), token_for(proxy, key)
