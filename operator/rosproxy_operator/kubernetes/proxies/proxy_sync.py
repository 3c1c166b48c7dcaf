"""Keeping proxies and operator in step, over the proxies' admin endpoints.

Each proxy's pod that has an address has a `ProxyPoller` of its own. It waits until the proxy tells
of a change (``/status/changes``), which costs nothing as long as none happens; one that is just
starting, does not answer or is of a former release it asks again and again. And it tells the proxy
its policy (``/policy``), which pods may use it as their master and which are gone
(``/containers``), until that is confirmed. What a proxy says lands in `ClusterProxySync.reports`,
from where the operator takes it with each look; a report that is another one than before wakes the
operator. An operator that does not lead listens as well, and tells nothing.
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
from rosproxy_operator.common.proxy_status import Leases
from rosproxy_operator.kubernetes.proxies.proxy_report import no_answer, report, short
from rosproxy_operator.kubernetes.resources.cluster import ProxyPod, ProxyReport
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, token_of

log = logging.getLogger(__name__)

EVERY = 3.0
"""Seconds between two questions to a proxy."""
EVERY_STARTING = 0.5
"""The same until it has answered for the first time."""
EVERY_FORMER = 15.0
"""The same for one that does not tell of changes."""
WAIT = 300.0
"""Seconds at most, and half of it at least, until a proxy answers that nothing has changed."""
STARTING = 10.0
"""Seconds for which a proxy may be silent after its pod has an address: it is just starting."""
SILENT = 2
"""Unanswered questions in a row before a proxy counts as silent."""
AT_ONCE = 32
"""Proxies that are asked at the same time."""
SLOW_AT_ONCE = 256
"""The same of calls that may take as long as a proxy's master: they keep no others waiting."""
REPEATED = 30.0
"""Seconds after which one that does not tell of changes is told anew which pods may use it."""


_KNOWS_NO_CHANGES = (403, 404, 405, 503)
"""HTTP answers of one that is of a former release, or for which too many wait already."""
_Callers = tuple[tuple[str, ...], tuple[str, ...] | None, Leases]
"""Addresses that may use a proxy, its peers of ROS 2, None for one without, and former ports."""


class Room:
    """How many calls are under way at once: questions, and those that may wait for a master."""

    def __init__(self) -> None:
        self.questions = asyncio.Semaphore(AT_ONCE)
        self.slow = asyncio.Semaphore(SLOW_AT_ONCE)


class ProxyPoller:
    """Asks one proxy again and again, and tells it what it is to know until it confirms that.

    ``changed`` is called when what is known of it has changed.
    """

    def __init__(
        self,
        proxy: ProxyPod,
        proxies: ProxyClient,
        room: Room,
        changed: Callable[[], None],
        key: bytes,
        leads: Callable[[], bool] = lambda: True,
    ) -> None:
        self._leads = leads
        self.where, self.token = address_of(proxy), token_for(proxy, key)
        self.name = str(proxy.pod.id)
        self.report: ProxyReport | None = None
        self._proxies, self._room, self._changed = proxies, room, changed
        self._gone: set[str] = set()
        self._restarts = proxy.restarts
        self._policy: tuple[PolicyLayer, ...] | None = None
        self._known_policy: tuple[PolicyLayer, ...] | None = None
        self._refusal = ""
        self._callers: _Callers | None = None
        self._known: _Callers | None = None
        self._known_at = 0.0
        self._pending = asyncio.Event()
        self._recheck, self._failures = False, 0
        self._tells, self._version, self._instance = True, "", ""
        self._since = time.monotonic()

    def report_gone(self, gone: Iterable[str]) -> None:
        """Let it know that the pods with these addresses are no more."""
        self._gone |= set(gone)
        if self._gone:
            self._pending.set()

    def report_policy(self, policy: tuple[PolicyLayer, ...]) -> None:
        """Let it know all layers of its policy."""
        self._policy = policy
        if policy != self._known_policy:
            self._pending.set()

    def report_callers(
        self,
        callers: tuple[str, ...],
        peers: tuple[str, ...] | None = None,
        former: Leases | None = None,
    ) -> None:
        """Let it know the addresses of all pods that may use it as their master.

        And, if it is for ROS 2, its peers, and which ports participants had at the one before.
        """
        self._callers = callers, peers, former or {}
        if self._callers != self._known:
            self._pending.set()

    def restarted(self, restarts: int) -> None:
        """Take notice of how often its container was started again: it knows nothing then."""
        if restarts != self._restarts:
            self._restarts = restarts
            self._forget()
            self._pending.set()

    async def run(self) -> None:
        """Listen and tell until cancelled."""
        news: asyncio.Task[None] | None = None
        try:
            while True:
                told = await self._tell()
                if self._listens and not told:
                    news = news or asyncio.create_task(self._ask(_some_time()))
                    await self._either(news)
                    if news.done():
                        news = news.result()
                    continue
                # What it was told may take it a moment: then it is looked at once more, not now.
                self._recheck = self._recheck and not told
                async with self._room.questions:
                    await self._ask()
                self._recheck = told
                if not self._listens:
                    await self._rest()
        finally:
            if news is not None:
                news.cancel()

    @property
    def _listens(self) -> bool:
        """Whether it is waited until the proxy tells of a change, instead of asking it."""
        answers = self.report is not None and self.report.answered
        return answers and self._tells and not self._is_busy

    @property
    def _is_busy(self) -> bool:
        """Whether it is yet to answer, or to confirm what it was told."""
        known = self._policy in (None, self._known_policy) and self._callers in (None, self._known)
        return bool(self._failures or self._recheck or self._gone) or not known

    async def _either(self, news: asyncio.Task[None]) -> None:
        """Wait for news, or until there is something to tell."""
        pending = asyncio.create_task(self._pending.wait())
        try:
            await asyncio.wait({news, pending}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            pending.cancel()

    async def _rest(self) -> None:
        """Wait until it is to be asked again, or until there is something to tell."""
        answers = self.report is not None and self.report.answered
        pause = EVERY if answers or self._waited(EVERY * 20) else EVERY_STARTING
        if answers and not self._is_busy:
            pause = EVERY_FORMER
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause):
                await self._pending.wait()

    async def _tell(self) -> bool:
        """Tell all that it is to know and has not confirmed yet; whether some pods are gone."""
        self._pending.clear()
        if await self._tell_policy():  # nobody is let in whose policy it does not have
            await self._tell_callers()
        return await self._tell_gone()

    async def _ask(self, within: float = 0.0) -> None:
        """Ask for its status, or wait for a change of it."""
        try:
            status = await self._question(within)
            found = report(status, self._refusal)
            self._failures = 0
        except ProxyError as error:
            self._forget()  # who answers next may have been started meanwhile
            self._failures += 1
            if self._failures < SILENT or not (self.report or self._waited(STARTING)):
                return
            found = no_answer(str(error))
        starting = self.report is None and not self._waited(STARTING)
        if starting and found.answered and not found.master_up:
            return  # it may not have asked its master yet
        # A process may outlive its pod for a moment: then the next look tells it again.
        recheck, self._recheck = self._recheck, False
        if found != self.report or recheck:
            self.report = found
            self._changed()

    async def _question(self, within: float) -> ProxyStatus:
        if self._tells:
            try:
                since = self._version if within else ""
                found = await self._proxies.changes(self.where, self.token, since, within)
            except ProxyError as error:
                if error.status not in _KNOWS_NO_CHANGES:
                    raise
                self._tells = False
            else:
                self._version, status = found
                self._met(status.instance)
                return status
        return await self._proxies.status(self.where)

    def _met(self, instance: str) -> None:
        """Take notice of which process it is: one that was started again knows nothing."""
        if self._instance and instance != self._instance:
            self._forget()
            self._pending.set()
        self._instance = instance

    def _forget(self) -> None:
        """Take it that the proxy knows nothing."""
        self._known = self._known_policy = None
        self._tells = True

    async def _tell_policy(self) -> bool:
        """Tell its policy, if it does not know that; whether it does now."""
        policy = self._policy
        if policy is None or policy == self._known_policy:
            return True
        try:
            async with self._room.slow:
                if not self._leads():
                    return False
                await self._proxies.policy(self.where, self.token, policy)
        except PolicyRefused as error:
            self._refusal = short(str(error))
            return False
        except ProxyError as error:
            log.debug("%s was not told its policy: %s", self.where, error)
            return False
        self._recheck = self._recheck or bool(self._refusal)  # it has another report now
        self._known_policy, self._refusal = policy, ""
        return True

    async def _tell_callers(self) -> None:
        """Tell which pods may use it, if it does not know.

        In a call of its own, before the others: those may wait for the master, but pods wait here.
        """
        callers = self._callers
        recent = self._tells or time.monotonic() - self._known_at < REPEATED
        if callers is None or (callers == self._known and recent):
            return
        try:
            async with self._room.questions:
                if not self._leads():  # the call before may have taken long
                    return
                await self._proxies.selected(self.where, self.token, *callers)
        except ProxyError as error:
            log.debug("%s was not told that %s may use it: %s", self.where, callers, error)
            return
        self._known, self._known_at = callers, time.monotonic()

    async def _tell_gone(self) -> bool:
        """Tell which pods are gone, if any are; whether it has confirmed that."""
        gone = sorted(self._gone)
        if not gone:
            return False
        try:
            async with self._room.slow:
                if not self._leads():
                    return False
                told = await self._proxies.containers(self.where, self.token, {"gone": gone})
        except ProxyError as error:
            # It may just be without its master; it is told again with the next question.
            log.debug("%s was not told that %s are gone: %s", self.where, gone, error)
            return False
        self._gone -= set(gone)
        log.debug("%s was told that %s are gone: %s", self.where, gone, told)
        return True

    def _waited(self, seconds: float) -> bool:
        return time.monotonic() - self._since > seconds


class ClusterProxySync:
    """All pollers, one for each proxy's pod that has an address.

    ``changed`` is called with the namespaces of proxies of which something new is known.
    """

    def __init__(
        self,
        tasks: Tasks,
        proxies: ProxyClient,
        changed: Callable[[Iterable[str]], None],
        leads: Callable[[], bool] = lambda: True,
    ) -> None:
        self._tasks, self._proxies, self._changed, self._leads = tasks, proxies, changed, leads
        self._room = Room()
        self._all: dict[str, tuple[ProxyPoller, asyncio.Task[None]]] = {}

    @property
    def reports(self) -> dict[str, ProxyReport]:
        """What is known, by the uid of the proxy's pod; of one that is just starting, nothing."""
        return {uid: one.report for uid, (one, _) in self._all.items() if one.report is not None}

    @property
    def ways(self) -> dict[str, tuple[HostPort, str]]:
        """Where each proxy is asked, and the token, by the names of their pods."""
        return {one.name: (one.where, one.token) for one, _ in self._all.values()}

    def follow(self, proxies: Iterable[ProxyPod], key: bytes = b"") -> None:
        """Poll these and no others, with tokens made from this key."""
        wanted = {each.pod.uid: each for each in proxies if each.pod.ip and not each.pod.ended}
        for uid in [*self._all]:
            poller, task = self._all[uid]
            known = wanted.get(uid)
            way = _way(known, key) if known else None
            if known is None or way != (poller.where, poller.token) or task.done():
                task.cancel()
                del self._all[uid]
            else:
                poller.restarted(known.restarts)
        for uid, proxy in wanted.items():
            if uid not in self._all:
                changed = partial(self._changed, [proxy.of.namespace])
                one = ProxyPoller(proxy, self._proxies, self._room, changed, key, self._leads)
                task = self._tasks.spawn(one.run(), f"polling {proxy.pod.id}")
                self._all[uid] = one, task

    async def forget(self) -> None:
        """Take it that no proxy knows anything: another operator has told them meanwhile."""
        tasks = [task for _, task in self._all.values()]
        self._all.clear()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def report_policies(self, policies: Mapping[str, tuple[PolicyLayer, ...]]) -> None:
        """Let proxies know, by the uid of their pod, the layers of their policy."""
        for uid, policy in policies.items():
            if uid in self._all:
                self._all[uid][0].report_policy(policy)

    def report_callers(
        self,
        callers: Mapping[str, tuple[str, ...]],
        peers: Mapping[str, tuple[str, ...]],
        former: Mapping[str, Leases],
    ) -> None:
        """Let proxies know, by the uid of their pod, which addresses may use them, and peers."""
        for uid, addresses in callers.items():
            if uid in self._all:
                self._all[uid][0].report_callers(addresses, peers.get(uid), former.get(uid))

    def report_gone(self, gone: Mapping[str, Iterable[str]]) -> None:
        """Let proxies know, by the uid of their pod, which addresses are no pod's any more."""
        for uid, addresses in gone.items():
            if uid in self._all:
                self._all[uid][0].report_gone(addresses)


def _some_time() -> float:
    """Seconds to wait for news: not the same for all, which begin together."""
    return WAIT * random.uniform(0.5, 1.0)  # noqa: S311 - no secret


def address_of(proxy: ProxyPod) -> HostPort:
    """Where a proxy answers the operator."""
    return HostPort(proxy.pod.ip, ADMIN_PORT)


def token_for(proxy: ProxyPod, key: bytes) -> str:
    """The token of a proxy's admin endpoint, by the operator's key.

    One that a former operator has made has it in its pod.
    """
    return proxy.token or token_of(key, proxy.pod.id, proxy.on)


def _way(proxy: ProxyPod, key: bytes) -> tuple[HostPort, str]:
    return address_of(proxy), token_for(proxy, key)
