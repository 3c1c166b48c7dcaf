"""Keeping proxies and operator in step, over the proxies' admin endpoints.

Each proxy's pod that has an address is asked for its ``/status`` every few seconds, by a
`ProxyPoller` of its own, and told its policy (``/policy``), which pods may use it as their master
and which are gone (``/containers``), until it has confirmed that. What it says lands in
`ClusterProxySync.reports`, from where the operator takes it with each look; a report that is
another one than before wakes the operator.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Mapping

from rosproxy.access.layers import PolicyLayer
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.net.addresses import HostPort
from rosproxy.net.tasks import Tasks
from rosproxy.telemetry.text import clean
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyClient, ProxyError
from rosproxy_operator.common.proxy_status import nodes_by_address
from rosproxy_operator.kubernetes.resources.model import ProxyPod, ProxyReport
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, token_of

log = logging.getLogger(__name__)

EVERY = 3.0
"""Seconds between two questions to a proxy."""
EVERY_STARTING = 0.5
"""The same until it has answered for the first time."""
STARTING = 10.0
"""Seconds for which a proxy may be silent after its pod has an address: it is just starting."""
SILENT = 2
"""Unanswered questions in a row before a proxy counts as silent."""
AT_ONCE = 32
"""Proxies that are asked at the same time."""
REPEATED = 30.0
"""Seconds after which a proxy is told anew which pods may use it, though nothing has changed."""
RECENT = 300.0
"""Seconds that a problem counts: a proxy tells the last ones, however old they are."""
_LONGEST = 300
"""Characters of a problem or an error, which may be of any size there."""


class ProxyPoller:
    """Asks one proxy again and again, and tells it what it is to know until it confirms that.

    ``changed`` is called when what is known of it has changed.
    """

    def __init__(
        self,
        proxy: ProxyPod,
        proxies: ProxyClient,
        room: asyncio.Semaphore,
        changed: Callable[[], None],
        key: bytes,
    ) -> None:
        self.where, self.token = address_of(proxy), token_for(proxy, key)
        self.report: ProxyReport | None = None
        self._proxies, self._room, self._changed = proxies, room, changed
        self._gone: set[str] = set()
        self._restarts = proxy.restarts
        self._policy: tuple[PolicyLayer, ...] | None = None
        self._known_policy: tuple[PolicyLayer, ...] | None = None
        self._refusal = ""
        self._callers: tuple[str, ...] | None = None
        self._known: tuple[str, ...] | None = None
        self._known_at = 0.0
        self._pending = asyncio.Event()
        self._recheck, self._failures = False, 0
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

    def report_callers(self, callers: tuple[str, ...]) -> None:
        """Let it know the addresses of all pods that may use it as their master."""
        self._callers = callers
        if callers != self._known:
            self._pending.set()

    def restarted(self, restarts: int) -> None:
        """Take notice of how often its container was started again: it knows nothing then."""
        if restarts != self._restarts:
            self._restarts = restarts
            self._forget()
            self._pending.set()

    async def run(self) -> None:
        """Ask and tell until cancelled."""
        while True:
            async with self._room:
                self._pending.clear()
                if await self._tell_policy():  # nobody is let in whose policy it does not have
                    await self._tell_callers()
                told = await self._tell_gone()
                await self._ask()
                self._recheck = told
            answers = self.report is not None and self.report.answered
            pause = EVERY if answers or self._waited(EVERY * 20) else EVERY_STARTING
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._pending.wait()  # there is something to tell by now

    async def _ask(self) -> None:
        try:
            found = report(await self._proxies.status(self.where), self._refusal)
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
        if found != self.report or self._recheck:
            self.report = found
            self._changed()

    def _forget(self) -> None:
        """Take it that the proxy knows nothing."""
        self._known = self._known_policy = None

    async def _tell_policy(self) -> bool:
        """Tell its policy, if it does not know that; whether it does now."""
        policy = self._policy
        if policy is None or policy == self._known_policy:
            return True
        try:
            await self._proxies.policy(self.where, self.token, policy)
        except PolicyRefused as error:
            self._refusal = _short(str(error))
            return False
        except ProxyError as error:
            log.debug("%s was not told its policy: %s", self.where, error)
            return False
        self._known_policy, self._refusal = policy, ""
        return True

    async def _tell_callers(self) -> None:
        """Tell which pods may use it, if it does not know.

        In a call of its own, before the others: those may wait for the master, but pods wait here.
        """
        callers, recent = self._callers, time.monotonic() - self._known_at < REPEATED
        if callers is None or (callers == self._known and recent):
            return
        try:
            await self._proxies.selected(self.where, self.token, callers)
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
    """All pollers, one for each proxy's pod that has an address."""

    def __init__(self, tasks: Tasks, proxies: ProxyClient, changed: Callable[[], None]) -> None:
        self._tasks, self._proxies, self._changed = tasks, proxies, changed
        self._room = asyncio.Semaphore(AT_ONCE)
        self._all: dict[str, tuple[ProxyPoller, asyncio.Task[None]]] = {}

    @property
    def reports(self) -> dict[str, ProxyReport]:
        """What is known, by the uid of the proxy's pod; of one that is just starting, nothing."""
        return {uid: one.report for uid, (one, _) in self._all.items() if one.report is not None}

    def follow(self, proxies: Iterable[ProxyPod], key: bytes = b"") -> None:
        """Poll these and no others, with tokens made from this key."""
        wanted = {each.pod.uid: each for each in proxies if each.pod.ip and not each.pod.ended}
        for uid in [*self._all]:
            poller, task = self._all[uid]
            known = wanted.get(uid)
            if known is None or _way(known, key) != (poller.where, poller.token):
                task.cancel()
                del self._all[uid]
            else:
                poller.restarted(known.restarts)
        for uid, proxy in wanted.items():
            if uid not in self._all:
                one = ProxyPoller(proxy, self._proxies, self._room, self._changed, key)
                task = self._tasks.spawn(one.run(), f"polling {proxy.pod.id}")
                self._all[uid] = one, task

    def report_policies(self, policies: Mapping[str, tuple[PolicyLayer, ...]]) -> None:
        """Let proxies know, by the uid of their pod, the layers of their policy."""
        for uid, policy in policies.items():
            if uid in self._all:
                self._all[uid][0].report_policy(policy)

    def report_callers(self, callers: Mapping[str, tuple[str, ...]]) -> None:
        """Let proxies know, by the uid of their pod, which addresses may use them."""
        for uid, addresses in callers.items():
            if uid in self._all:
                self._all[uid][0].report_callers(addresses)

    def report_gone(self, gone: Mapping[str, Iterable[str]]) -> None:
        """Let proxies know, by the uid of their pod, which addresses are no pod's any more."""
        for uid, addresses in gone.items():
            if uid in self._all:
                self._all[uid][0].report_gone(addresses)


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


def report(status: ProxyStatus, refusal: str = "") -> ProxyReport:
    """What a proxy says, and why it does not take its policy.

    Nodes that it has given up already are not among its nodes.
    """
    master, nodes = status.master, nodes_by_address(status)
    every = [node for there in nodes.values() for node in there]
    return ProxyReport(
        answered=True,
        master_up=master.up,
        error="" if master.up else _short(master.error or "not asked yet"),
        nodes={
            address: tuple(sorted({name for node in there for name in node.nodes}))
            for address, there in nodes.items()
        },
        topics=frozenset(topic for node in every for topic in node.publishes + node.subscribes),
        refusal=refusal,
        problems=tuple(
            _short(f"{one.subject}: {one.text}") for one in status.problems if one.age <= RECENT
        ),
    )


def no_answer(error: str) -> ProxyReport:
    """What is known of a proxy that does not answer."""
    return ProxyReport(answered=False, error=_short(error))


def _short(text: str) -> str:
    return bounded(clean(text), _LONGEST)
