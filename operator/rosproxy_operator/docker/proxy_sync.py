"""Keeping each proxy up to date about the containers on its networks, independently of others.

Which addresses may use a proxy as their master is told first and alone: the call of a new container
waits for that, while all other updates may take a proxy long (it asks nodes and its master). Before
both it is told its policy, if that has changed: no container is let in before its policy is known.

A proxy for ROS 2 that had to leave its ports is told which participants had some of them, so that
these are discovered anew: outside ignores other locators of a participant that it knows.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Collection

from rosproxy.admin.status_document import ProxyStatus
from rosproxy.leases.ports import PortRange
from rosproxy.net.tasks import Tasks
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyClient, ProxyError
from rosproxy_operator.common.proxy_session import AllowedCallers, ProxySession
from rosproxy_operator.common.proxy_status import Leases, inside_addresses, leases
from rosproxy_operator.docker.host_document import STARTING
from rosproxy_operator.docker.planner.model import ZENOH, Member
from rosproxy_operator.docker.planner.proxy_update import NetworkFacts, ProxyUpdate, network_facts
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerSnapshot, ProxyAccess

log = logging.getLogger(__name__)

PAUSES = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Seconds until a proxy is asked again that did not answer; the last is repeated."""


class ProxyUpdater:
    """Keeps one run of one proxy up to date. ``answered`` is called when it begins to answer.

    After each look the proxy is told its policy if that has changed, and who may use it as its
    master, whether or not that has, asked for its nodes, and told what is new (`ProxyUpdate`).
    ``silent_since`` is when it ceased to answer (monotonic), or was started; None while it answers.
    ``leases`` are what its participants of ROS 2 have; it is told the ``former_leases`` until it
    has some. ``has_callers``: it is told who may use it.
    """

    def __init__(
        self,
        name: str,
        access: ProxyAccess,
        proxies: ProxyClient,
        answered: Callable[[], None],
        former_leases: Leases,
        has_callers: bool = True,
    ) -> None:
        self.access = access
        self.leases: Leases = {}
        self._former_leases = former_leases
        self.error: ProxyError | None = None
        self.silent_since: float | None = time.monotonic()
        self._name = name
        self._has_callers = has_callers
        self._answered = answered
        self._session = ProxySession(proxies, access.admin, access.token)
        self._update = ProxyUpdate()
        self._status = ProxyStatus()
        self._looked = asyncio.Event()
        self._selecting = asyncio.Event()

    def update(self, network_facts: NetworkFacts) -> None:
        """Take note of what a look has found."""
        self._update.look(network_facts, time.monotonic())
        self._looked.set()
        self._selecting.set()

    async def run(self) -> None:
        """Tell what there is to be told, for good."""
        async with asyncio.TaskGroup() as tasks:
            if self._has_callers:
                tasks.create_task(self._keep_selected())
            tasks.create_task(self._keep_told())

    async def _keep_selected(self) -> None:
        """Tell after each look which addresses may use the proxy as their master."""
        failures = 0
        logged = ""
        while True:
            await self._selecting.wait()
            self._selecting.clear()
            addresses = tuple(self._update.facts.selected)
            try:
                await self._session.tell_policy(self._update.policy)
                former_leases = {} if self.leases else self._former_leases
                callers = AllowedCallers(addresses, former_leases=former_leases)
                await self._session.tell_callers(callers)
                failures = 0
                logged = ""
            except ProxyError as error:
                # Not logged before all pauses are used up, which takes 19 s, and then once.
                if not error.is_unreachable and failures >= len(PAUSES) and str(error) != logged:
                    logged = str(error)
                    text = "proxy not updated: %s, does not know which addresses may use it: %s"
                    log.warning(text, self._name, error, extra={"proxy": self._name})
                self._selecting.set()
                await asyncio.sleep(PAUSES[min(failures, len(PAUSES) - 1)])
                failures += 1

    async def _keep_told(self) -> None:
        """Tell what else is new."""
        failures = 0
        while True:
            pause = self._update.next_due(time.monotonic())
            if failures:
                pause = PAUSES[min(failures, len(PAUSES)) - 1]
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._looked.wait()
            try:
                await self._tell()
                failures = 0
            except ProxyError as error:
                failures += 1
                # It has answered, and only its master can't be asked: that is no silence.
                self._heard(None if error.lacks_master else error)

    async def _tell(self) -> None:
        self._looked.clear()
        refusal: ProxyError | None = await self._policy_refusal()
        try:
            self._status = await self._session.status()
        except ProxyError as error:
            if not error.is_unreadable:
                raise
            refusal = refusal or error  # the proxy is told what is new, by its last status
        status = self._status
        self.leases = leases(status)
        # The facts are not older than need be: its nodes may have come since the last look.
        address = self._update.facts.master_address
        if address and status.master.address != address:
            await self._session.tell_master_address(address)
            text = "master moved: %s, the master is now at %s"
            log.info(text, self._name, address, extra={"proxy": self._name})
        now = time.monotonic()
        body = self._update.body(inside_addresses(status), now)
        if isinstance(refusal, PolicyRefused):
            body.pop("arrived", None)  # adopted nodes would not be kept to the policy
        if body:
            log.debug("updating proxy: %s, %s", self._name, body)
            answer = await self._session.tell_containers(body)
            counts = {change: answer.get(change) for change in ("unregistered", "moved", "adopted")}
            if text := ", ".join(f"{count} {change}" for change, count in counts.items() if count):
                log.info("nodes updated: %s, %s", self._name, text, extra={"proxy": self._name})
        self._update.mark_delivered(now)
        self._heard(refusal)

    async def _policy_refusal(self) -> PolicyRefused | None:
        """Tell the policy; why the proxy does not take it, if it does not. Raises ProxyError."""
        try:
            await self._session.tell_policy(self._update.policy)
        except PolicyRefused as error:
            return error
        return None

    def _heard(self, error: ProxyError | None) -> None:
        """Take note that the proxy has answered, or why not."""
        self.error = error
        if error is not None:
            self.silent_since = self.silent_since or time.monotonic()
        elif self.silent_since is not None:
            self.silent_since = None
            self._answered()


class DockerProxySync:
    """Keeps all running proxies up to date. ``answered``: one answers that did not before."""

    def __init__(
        self,
        tasks: Tasks,
        proxies: ProxyClient,
        settings: PlanSettings,
        answered: Callable[[], None],
    ) -> None:
        self._tasks = tasks
        self._proxies = proxies
        self._settings = settings
        self._answered = answered
        self._running: dict[str, tuple[ProxyUpdater, asyncio.Task[None]]] = {}
        self._leases: dict[str, Leases] = {}

    def update(self, snapshot: DockerSnapshot, members: Collection[Member]) -> None:
        """Begin to tell every running proxy what a look has found."""
        for name, (updater, task) in list(self._running.items()):
            # A task that has ended by an error of ours is begun anew, as the log says why.
            if snapshot.access.get(name) != updater.access or task.done():
                task.cancel()
                del self._running[name]
                if updater.leases:
                    self._leases[name] = updater.leases
        for proxy in snapshot.state.proxies:
            name = proxy.container.name
            if name not in snapshot.access:
                continue
            if name not in self._running:
                updater = ProxyUpdater(
                    name,
                    snapshot.access[name],
                    self._proxies,
                    self._answered,
                    self._former_leases(name, proxy.range),
                    has_callers=proxy.key != ZENOH,  # routers of zenoh ask nobody
                )
                self._running[name] = updater, self._tasks.spawn(updater.run(), f"updating {name}")
            facts = network_facts(snapshot.state, proxy, members, self._settings.policy)
            self._running[name][0].update(facts)

    def _former_leases(self, name: str, ports: PortRange) -> Leases:
        """What its participants had, unless the proxy has all of these ports now."""
        previous = self._leases.get(name, {})
        is_kept = all(port in ports for leased in previous.values() for port in leased)
        return {} if is_kept else previous

    def answers(self, name: str) -> bool:
        """Whether a proxy answers and knows everything."""
        return name in self._running and self._running[name][0].silent_since is None

    def problems(self, snapshot: DockerSnapshot) -> list[Problem]:
        """The proxies that do not answer, and what to do about it."""
        lately = time.monotonic() - STARTING
        return [
            silence(name, updater.error, snapshot, self._settings.uplink)
            for name, (updater, _) in self._running.items()
            if updater.error and updater.silent_since and updater.silent_since < lately
        ]


async def ask_proxies(
    proxies: ProxyClient, snapshot: DockerSnapshot, uplink: str
) -> dict[str, ProxyStatus | Problem]:
    """The status of each proxy that runs, by name, or the problem that it does not answer."""

    async def ask(name: str, access: ProxyAccess) -> ProxyStatus | Problem:
        try:
            return await proxies.status(access.admin)
        except ProxyError as error:
            return silence(name, error, snapshot, uplink)

    answers = await asyncio.gather(*(ask(*proxy) for proxy in snapshot.access.items()))
    return dict(zip(snapshot.access, answers, strict=True))


def silence(name: str, error: ProxyError, snapshot: DockerSnapshot, uplink: str) -> Problem:
    """The problem of a proxy that does not answer, or not as it should."""
    if isinstance(error, PolicyRefused):
        return Problem(f"proxy {name}", str(error))
    if error.is_unreachable and not snapshot.at_host:
        advice = (
            f"Attach the operator to network {uplink}, or run the operator with network_mode: host"
        )
    else:
        advice = f"Read docker logs {name}"
    return Problem(f"proxy {name}", f"admin endpoint {error}. {advice}")
