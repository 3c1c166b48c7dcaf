"""Keeping the proxies up to date about the containers on their networks, each apart."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Collection

from rosproxy.net.tasks import Tasks
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.proxy_client import Json, ProxyClient, ProxyError
from rosproxy_operator.common.proxy_status import nodes_by_address
from rosproxy_operator.docker.planner.model import Member
from rosproxy_operator.docker.planner.proxy_news import NetworkFacts, ProxyNews, facts
from rosproxy_operator.docker.planner.specs import master
from rosproxy_operator.docker.snapshot import DockerSnapshot, ProxyAccess

log = logging.getLogger(__name__)

PAUSES = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Seconds until a proxy is asked again that did not answer; the last is repeated."""
STARTING = 8.0
"""Seconds for which a proxy may be silent before that is a problem: it may just be starting."""


class ProxyUpdater:
    """Keeps one run of one proxy up to date. ``answered`` is called when it begins to answer.

    The proxy is asked for its nodes after each look, and told what is new (`ProxyNews`).
    """

    def __init__(
        self, name: str, access: ProxyAccess, proxies: ProxyClient, answered: Callable[[], None]
    ) -> None:
        self.name, self.access = name, access
        self.error: ProxyError | None = None
        self._proxies, self._answered = proxies, answered
        self._news = ProxyNews()
        self._heard = False
        self._looked = asyncio.Event()
        self._since = time.monotonic()

    @property
    def silent_for(self) -> float:
        """Seconds since it did not answer any more (or was started); 0 while it does."""
        return 0.0 if self._heard and not self.error else time.monotonic() - self._since

    def update(self, known: NetworkFacts) -> None:
        """Take note of what a look has found."""
        self._news.look(known, time.monotonic())
        self._looked.set()

    async def run(self) -> None:
        """Tell what there is to be told, for good."""
        failures = 0
        while True:
            pause = (
                PAUSES[min(failures, len(PAUSES)) - 1]
                if failures
                else self._news.next_due(time.monotonic())
            )
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._looked.wait()
            try:
                await self._tell()
                failures = 0
            except ProxyError as error:
                failures += 1
                if error.later:
                    self._well()
                else:
                    self._unwell(error)

    async def _tell(self) -> None:
        self._looked.clear()
        where, token = self.access.admin, self.access.token
        status = await self._proxies.status(where)
        # The facts are not older than need be: its nodes may have come since the last look.
        address = self._news.facts.master_address
        if address and status.master.address != address:
            await self._proxies.master_address(where, token, address)
            log.info("%s: its master is now at %s", self.name, address)
        now = time.monotonic()
        body = self._news.body(nodes_by_address(status).keys(), now)
        if body:
            log.debug("%s is told %s", self.name, body)
            self._log(await self._proxies.containers(where, token, body))
        self._news.told(now)
        self._well()

    def _well(self) -> None:
        if self.error is not None or not self._heard:
            self.error, self._heard = None, True
            self._answered()

    def _unwell(self, error: ProxyError) -> None:
        if self.error is None and self._heard:
            self._since = time.monotonic()
        self.error = error

    def _log(self, done: Json) -> None:
        counts = {word: done.get(word) for word in ("unregistered", "moved", "adopted")}
        if any(counts.values()):
            text = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
            log.info("%s: nodes %s", self.name, text)


class DockerProxySync:
    """Keeps all running proxies up to date. ``answered``: one answers that did not before."""

    def __init__(
        self, tasks: Tasks, proxies: ProxyClient, uplink: str, answered: Callable[[], None]
    ) -> None:
        self._tasks, self._proxies = tasks, proxies
        self._uplink, self._answered = uplink, answered
        self._running: dict[str, tuple[ProxyUpdater, asyncio.Task[None]]] = {}

    def update(self, look: DockerSnapshot, members: Collection[Member]) -> None:
        """Begin to tell every running proxy what a look has found."""
        for name, (updater, task) in list(self._running.items()):
            if look.access.get(name) != updater.access:
                task.cancel()
                del self._running[name]
        for proxy in look.state.proxies:
            access = look.access.get(proxy.container.name)
            if access is not None:
                address = look.masters.get(master(proxy.key).host.lower(), "")
                known = facts(look.state, proxy, members, address)
                self._updater(proxy.container.name, access).update(known)

    def answers(self, name: str) -> bool:
        """Whether a proxy answers and knows everything."""
        found = self._running.get(name)
        return found is not None and found[0].silent_for == 0

    def problems(self, look: DockerSnapshot) -> list[Problem]:
        """The proxies that do not answer, and what to do about it."""
        return [
            silence(name, updater.error, look, self._uplink)
            for name, (updater, _) in self._running.items()
            if updater.error is not None and updater.silent_for > STARTING
        ]

    def _updater(self, name: str, access: ProxyAccess) -> ProxyUpdater:
        if name not in self._running:
            updater = ProxyUpdater(name, access, self._proxies, self._answered)
            self._running[name] = updater, self._tasks.spawn(updater.run(), f"updating {name}")
        return self._running[name][0]


def silence(name: str, error: ProxyError, look: DockerSnapshot, uplink: str) -> Problem:
    """The problem of a proxy that does not answer."""
    if error.away and not look.at_host:
        advice = f"attach the operator to network {uplink} or run it with network_mode: host"
    else:
        advice = f"docker logs {name} may say why"
    return Problem(f"proxy {name}", f"its admin endpoint {error}: {advice}")
