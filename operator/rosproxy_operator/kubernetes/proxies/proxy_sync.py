"""Sends the operator's data to the proxies, and reads their status, at their admin endpoints.

Each proxy's pod with an address has a `ProxyPoller`. The poller waits until the proxy reports a
change (``/status/changes``), so an idle proxy causes no calls. The poller polls a proxy that is
starting, does not answer, has not confirmed a call, or does not report changes. Each look reads the
reports (`ClusterProxySync.reports`), and a changed report wakes the operator.

The poller also sends the proxy's policy (``/policy``), the addresses of pods that may use the
proxy, and the addresses of gone pods (``/containers``). The poller repeats each call until the
proxy confirms. An operator that does not lead receives reports, and sends nothing.
"""

import asyncio
import contextlib
import logging
import random
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyClient, ProxyError
from rosproxy_operator.common.proxy_session import AllowedCallers, ProxySession
from rosproxy_operator.kubernetes.planner.briefing import Briefing
from rosproxy_operator.kubernetes.proxies.proxy_report import no_answer, report, short, unreadable
from rosproxy_operator.kubernetes.resources.cluster import ProxyPod, ProxyReport
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, token_of

log = logging.getLogger(__name__)

POLL_INTERVAL_S = 3.0
"""Seconds between two polls while a call is unconfirmed.

Also while the proxy does not answer, after the poller's first minute.
"""
STARTING_POLL_INTERVAL_S = 0.5
"""Seconds between two polls in the poller's first minute, while the proxy does not answer."""
LEAST_REPORT_INTERVAL_S = 0.5
"""Seconds between two reports of changes. A hostile proxy may report changes for ever."""
FORMER_POLL_INTERVAL_S = 15.0
"""Seconds between two polls of a proxy that does not report changes (``/status/changes``)."""
LONGEST_CHANGE_WAIT_S = 1800.0
"""The longest wait for a change, in seconds. Then the proxy answers without a change.

TCP keep-alive finds a proxy that is cut off (`common.proxy_client`).
"""
STARTING_S = 10.0
"""Seconds for which a new proxy counts as starting. Meanwhile, a missing answer is no fault."""
SILENT_AFTER_POLLS = 2
"""The number of polls in a row without an answer after which a proxy counts as silent."""
MOST_SHORT_CALLS = 32
"""The highest number of short calls at the same time, to all proxies."""
MOST_SLOW_CALLS = 256
"""The highest number of calls at the same time that may wait for a master.

These calls have a limit of their own, so that short calls do not wait for a master.
"""
CALLERS_REPEAT_INTERVAL_S = 30.0
"""Seconds after which the poller sends the allowed callers again to a proxy without change reports.

The status of such a proxy does not show that another process of the proxy answers.
"""
_FORMER_RELEASE_STATUSES = (404, 405)
"""HTTP answers to ``/status/changes`` from a proxy of a former release."""
_REFUSED_NOW_STATUSES = (403, 503)
"""HTTP answers from a proxy that does not accept the token now, or has no free slot."""


class CallLimits:
    """Limits of calls at the same time: short calls, and calls that may wait for a master."""

    def __init__(self) -> None:
        self.short = asyncio.Semaphore(MOST_SHORT_CALLS)
        self.slow = asyncio.Semaphore(MOST_SLOW_CALLS)


class ProxyPoller:
    """Polls a single proxy, and repeats policy, callers and gone pods until the proxy confirms.

    The poller calls ``changed`` when the report has changed. ``key`` is the key of the proxies'
    tokens. While ``leads`` returns False, the poller sends nothing.
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
        self._callers_sent_at = 0.0
        self._pending = asyncio.Event()
        self._recheck = False
        self._failures = 0
        self._tells_changes = True
        self._is_former = False
        self._version = ""
        self._instance = ""
        self._since = time.monotonic()

    def brief(self, briefing: Briefing) -> None:
        """Send the proxy the parts of a briefing that the proxy has not confirmed.

        A briefing is all that the operator sends to a proxy (`planner.briefing`).
        """
        self._gone |= {*briefing.gone}
        if briefing.policy is not None:
            self._policy = briefing.policy
        if briefing.callers is not None:
            self._callers = AllowedCallers(briefing.callers, briefing.peers, briefing.former_ports)
        if self._gone or not self._is_confirmed:
            self._pending.set()

    def restarted(self, restarts: int) -> None:
        """Note the restarts of the container: a restarted proxy has no policy and no callers."""
        if restarts != self._restarts:
            self._restarts = restarts
            self._forget()
            self._pending.set()

    async def run(self) -> None:
        """Poll the proxy, and send policy, callers and gone pods, until cancelled."""
        long_poll: asyncio.Task[None] | None = None
        try:
            while True:
                confirmed_gone = await self._send_all()
                if self._listens and not confirmed_gone:
                    long_poll = long_poll or asyncio.create_task(self._read_status(_random_wait()))
                    await self._wait_for_either(long_poll)
                    if long_poll.done():
                        long_poll = long_poll.result()  # None; raises the error of a failed task
                        await self._wait_for_update(LEAST_REPORT_INTERVAL_S)
                    continue
                # The proxy may need a moment to act on gone pods. So the next poll, not this poll,
                # calls `changed` even if the report is the same.
                self._recheck = self._recheck and not confirmed_gone
                async with self._limits.short:
                    await self._read_status()
                self._recheck = confirmed_gone
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
        """Whether the proxy still has to answer, or to confirm policy, callers or gone pods."""
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
        """Wait for a change, or until the poller has something to send."""
        pending = asyncio.create_task(self._pending.wait())
        try:
            await asyncio.wait({long_poll, pending}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            pending.cancel()

    async def _pause(self) -> None:
        """Wait until the next poll is due, or until the poller has something to send."""
        answers = self.report is not None and self.report.answered
        pause = (
            POLL_INTERVAL_S
            if answers or self._has_waited(POLL_INTERVAL_S * 20)
            else STARTING_POLL_INTERVAL_S
        )
        if answers and not self._is_busy:
            pause = FORMER_POLL_INTERVAL_S
        await self._wait_for_update(pause)

    async def _wait_for_update(self, seconds: float) -> None:
        """Wait for some seconds, or until the poller has something to send."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._pending.wait()

    async def _send_all(self) -> bool:
        """Send all unconfirmed parts. Return whether the proxy has now confirmed gone pods."""
        self._pending.clear()
        if await self._send_policy():  # no pod gets in before the policy is in force
            await self._send_callers()
        return await self._send_gone()

    async def _read_status(self, within: float = 0.0) -> None:
        """Request the status, or wait up to ``within`` seconds for a changed status."""
        try:
            status = await self._fetch_status(within)
            new_report = report(status, self._refusal)
            self._failures = 0
        except ProxyError as error:
            self._failures += 1
            if error.is_unreadable and self.report:
                new_report = unreadable(self.report, str(error))
            else:
                self._forget()  # the next answer may come from a new process
                if self._failures < SILENT_AFTER_POLLS or not (
                    self.report or self._has_waited(STARTING_S)
                ):
                    return
                new_report = no_answer(str(error))
        starting = self.report is None and not self._has_waited(STARTING_S)
        if starting and new_report.answered and not new_report.master_up:
            return  # the proxy may not have asked its master yet
        # A gone pod's process may run on for a moment and register again. So wake the operator: its
        # next look sends the gone address again if nodes there are registered.
        recheck = self._recheck
        self._recheck = False
        if new_report != self.report or recheck:
            self.report = new_report
            self._changed()

    async def _fetch_status(self, within: float) -> ProxyStatus:
        """Request ``/status/changes``, or ``/status`` if the proxy refuses. Raises ProxyError.

        After `_REFUSED_NOW_STATUSES`, the next poll requests ``/status/changes`` again.
        """
        if not self._is_former:
            try:
                since = self._version if within else ""
                self._version, status = await self.session.changes(since, within)
            except ProxyError as error:
                if error.status not in (*_FORMER_RELEASE_STATUSES, *_REFUSED_NOW_STATUSES):
                    raise
                self._tells_changes = False
                self._is_former = error.status in _FORMER_RELEASE_STATUSES
            else:
                self._tells_changes = True
                self._note_instance(status.instance)
                return status
        return await self.session.status()

    def _note_instance(self, instance: str) -> None:
        """Note which process answers: a new process has no policy and no callers."""
        if self._instance and instance != self._instance:
            self._forget()
            self._pending.set()
        self._instance = instance

    def _forget(self) -> None:
        """Assume that the proxy has confirmed nothing, and may report changes."""
        self.session.forget()
        self._tells_changes = True
        self._is_former = False

    async def _send_policy(self) -> bool:
        """Send the policy, unless confirmed. Return whether the proxy has the policy."""
        policy = self._policy
        if policy is None or self.session.has_policy(policy):
            return True
        try:
            async with self._limits.slow:
                if not self._leads():
                    return False
                await self.session.send_policy(policy)
        except PolicyRefused as error:
            self._refusal = short(str(error))
            return False
        except ProxyError as error:
            log.debug("policy not sent: proxy %s: %s", self.session.admin, error)
            return False
        self._recheck = self._recheck or bool(self._refusal)  # the next report has no refusal
        self._refusal = ""
        return True

    async def _send_callers(self) -> None:
        """Send the addresses of pods that may use the proxy, unless confirmed.

        New pods wait for this call, and the call about gone pods may wait for the master. So the
        two calls are separate, and this call comes first.
        """
        callers = self._callers
        recent = (
            self._tells_changes
            or time.monotonic() - self._callers_sent_at < CALLERS_REPEAT_INTERVAL_S
        )
        if callers is None or (self.session.has_callers(callers) and recent):
            return
        try:
            async with self._limits.short:
                if not self._leads():  # sending the policy may have taken long
                    return
                await self.session.send_callers(callers)
        except ProxyError as error:
            text = "allowed callers not sent: proxy %s, %s: %s"
            log.debug(text, self.session.admin, callers, error)
            return
        self._callers_sent_at = time.monotonic()

    async def _send_gone(self) -> bool:
        """Send the addresses of gone pods, if any. Return whether the proxy has confirmed."""
        gone = sorted(self._gone)
        if not gone:
            return False
        try:
            async with self._limits.slow:
                if not self._leads():
                    return False
                answer = await self.session.send_containers({"gone": gone})
        except ProxyError as error:
            # The proxy may have no master at the moment. The next poll sends the addresses again.
            log.debug("gone addresses not sent: proxy %s, %s: %s", self.session.admin, gone, error)
            return False
        self._gone -= set(gone)
        log.debug("gone addresses sent: proxy %s, %s: %s", self.session.admin, gone, answer)
        return True

    def _has_waited(self, seconds: float) -> bool:
        return time.monotonic() - self._since > seconds


class ClusterProxySync:
    """The pollers of all proxies whose pods have an address.

    When a report has changed, the poller calls ``changed`` with a list: the proxy's namespace.
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
        """The reports by the uids of the proxies' pods, without proxies that are starting."""
        return {uid: p.report for uid, (p, _) in self._pollers.items() if p.report is not None}

    @property
    def admin_endpoints(self) -> dict[str, tuple[HostPort, str]]:
        """The admin endpoint and the token of each proxy, by the name of the proxy's pod."""
        sessions = {poller.name: poller.session for poller, _ in self._pollers.values()}
        return {name: (session.admin, session.token) for name, session in sessions.items()}

    def follow(self, proxies: Iterable[ProxyPod], key: bytes = b"") -> None:
        """Poll exactly these proxies, with tokens computed from ``key``.

        Proxies whose pod has no address or has ended are left out. If the address or the token of a
        proxy changes, the proxy gets a new poller.
        """
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
        """End all pollers, and forget what the proxies have confirmed.

        Another operator may send to the proxies until this operator leads again.
        """
        tasks = [task for _, task in self._pollers.values()]
        self._pollers.clear()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def brief(self, briefings: Mapping[str, Briefing]) -> None:
        """Send briefings to proxies, by the uid of the proxy's pod."""
        for uid, briefing in briefings.items():
            if uid in self._pollers:
                self._pollers[uid][0].brief(briefing)


def _random_wait() -> float:
    """Return the seconds to wait for a change: random, because all pollers begin together."""
    return LONGEST_CHANGE_WAIT_S * random.random()  # noqa: S311 - no secret


def address_of(proxy: ProxyPod) -> HostPort:
    """Return the address and port of a proxy's admin endpoint."""
    return HostPort(proxy.pod.ip, ADMIN_PORT)


def token_for(proxy: ProxyPod, key: bytes) -> str:
    """Return the token of a proxy's admin endpoint.

    A former operator wrote the token into the pod; otherwise the token is computed from ``key``.
    """
    return proxy.token or token_of(key, proxy.pod.id, proxy.node)


def _admin_endpoint(proxy: ProxyPod, key: bytes) -> tuple[HostPort, str]:
    return address_of(proxy), token_for(proxy, key)
