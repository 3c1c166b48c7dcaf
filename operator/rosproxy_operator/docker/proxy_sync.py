"""Keeps each proxy up to date about the containers on its networks.

Each proxy has separate tasks, so a slow proxy delays no other proxy. The operator sends three kinds
of updates, in this order:

1. The policy, if changed. The proxy must know the policy before any container may use the proxy.
2. The addresses that may use the proxy as their master. A call of a new container waits for this
   update.
3. All other updates, in a separate task. The proxy may ask nodes and the master first, which can
   take long.

If a ROS 2 proxy had to leave its ports, the operator also sends the former ports of participants.
With these ports, the proxy knows which participants outside has to discover again: outside ignores
new locators of a participant that is already known.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Collection

from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.ports import PortRange
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.problem import (
    REFUSES,
    SILENT,
    Problem,
    silent,
)
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyClient, ProxyError
from rosproxy_operator.common.proxy_session import AllowedCallers, ProxySession
from rosproxy_operator.common.proxy_status import Leases, inside_addresses, leases
from rosproxy_operator.docker.host_document import PROXY_STARTING_S
from rosproxy_operator.docker.planner.model import Member
from rosproxy_operator.docker.planner.proxy_update import NetworkFacts, ProxyUpdate, network_facts
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerSnapshot, ProxyAccess
from rosproxy_operator.proxy_spec.place import ZENOH

log = logging.getLogger(__name__)

RETRY_PAUSES_S = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Seconds until the operator asks a silent proxy again. The last pause is repeated."""


class ProxyUpdater:
    """Keeps one run of one proxy up to date.

    Calls ``answered`` when the proxy begins to answer, or answers that the proxy has retired.

    After each look, the updater sends the policy if the policy has changed, and always sends the
    allowed callers. Then the updater reads the status and sends what is new (`ProxyUpdate`).
    ``has_callers`` is False for a proxy without a list of allowed callers.

    ``silent_since`` is the monotonic time in seconds at which the updater was made, or the proxy
    began to fail. A refusal of the policy counts as a failure. None: the proxy answers. ``leases``
    are the ports of the proxy's ROS 2 participants. The updater sends ``former_leases`` until a
    status has leases.
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
        self._nodes_due = asyncio.Event()
        self._callers_due = asyncio.Event()

    @property
    def retired(self) -> bool:
        """Whether the last status says that the proxy accepts no nodes any more."""
        return self._status.retired

    def update(self, network_facts: NetworkFacts) -> None:
        """Store the facts of a look, and wake both tasks."""
        self._update.record(network_facts, time.monotonic())
        self._nodes_due.set()
        self._callers_due.set()

    async def run(self) -> None:
        """Send updates until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            if self._has_callers:
                tasks.create_task(self._keep_callers_updated())
            tasks.create_task(self._keep_nodes_updated())

    async def _keep_callers_updated(self) -> None:
        """Send a changed policy and then the allowed addresses, after each look."""
        failures = 0
        logged = ""
        while True:
            await self._callers_due.wait()
            self._callers_due.clear()
            addresses = tuple(self._update.facts.selected)
            try:
                await self._session.send_policy(self._update.policy)
                former_leases = {} if self.leases else self._former_leases
                callers = AllowedCallers(addresses, former_leases=former_leases)
                await self._session.send_callers(callers)
                failures = 0
                logged = ""
            except ProxyError as error:
                # Log each error once, and only after all pauses (19 s): the proxy may be starting.
                if (
                    not error.is_unreachable
                    and failures >= len(RETRY_PAUSES_S)
                    and str(error) != logged
                ):
                    logged = str(error)
                    text = "proxy not updated: %s, does not know which addresses may use it: %s"
                    log.warning(text, self._name, error, extra={"proxy": self._name})
                self._callers_due.set()
                await asyncio.sleep(RETRY_PAUSES_S[min(failures, len(RETRY_PAUSES_S) - 1)])
                failures += 1

    async def _keep_nodes_updated(self) -> None:
        """Read the status and send all other updates, after each look and when an update is due."""
        failures = 0
        while True:
            pause = self._update.next_due(time.monotonic())
            if failures:
                pause = RETRY_PAUSES_S[min(failures, len(RETRY_PAUSES_S)) - 1]
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._nodes_due.wait()
            try:
                await self._send_updates()
                failures = 0
            except ProxyError as error:
                failures += 1
                # HTTP 503: the proxy is not silent, but can't reach the master.
                self._note_answer(None if error.lacks_master else error)

    async def _send_updates(self) -> None:
        self._nodes_due.clear()
        refusal: ProxyError | None = await self._policy_refusal()
        had_retired = self.retired
        try:
            self._status = await self._session.status()
        except ProxyError as error:
            if not error.is_unreadable:
                raise
            refusal = refusal or error  # go on with the last status that was readable
        if self.retired and not had_retired:
            self._answered()  # before other calls: a retired proxy may refuse these
        status = self._status
        self.leases = leases(status)
        # Read the facts only now: a look may have ended while the calls above waited.
        address = self._update.facts.master_address
        if address and status.master.address != address:
            await self._session.send_master_address(address)
            text = "master moved: %s, the master is now at %s"
            log.info(text, self._name, address, extra={"proxy": self._name})
        now = time.monotonic()
        body = self._update.body(inside_addresses(status), now)
        if isinstance(refusal, PolicyRefused):
            body.pop("arrived", None)  # the proxy would adopt nodes without checking the policy
        if body:
            log.debug("updating proxy: %s, %s", self._name, body)
            answer = await self._session.send_containers(body)
            counts = {change: answer.get(change) for change in ("unregistered", "moved", "adopted")}
            if text := ", ".join(f"{count} {change}" for change, count in counts.items() if count):
                log.info("nodes updated: %s, %s", self._name, text, extra={"proxy": self._name})
        self._update.mark_delivered(now)
        self._note_answer(refusal)

    async def _policy_refusal(self) -> PolicyRefused | None:
        """Send the policy. Return the refusal, or None if the proxy accepts. Raises ProxyError."""
        try:
            await self._session.send_policy(self._update.policy)
        except PolicyRefused as error:
            return error
        return None

    def _note_answer(self, error: ProxyError | None) -> None:
        """Note that the proxy has answered (None), or why the call failed."""
        self.error = error
        if error is not None:
            self.silent_since = self.silent_since or time.monotonic()
        elif self.silent_since is not None:
            self.silent_since = None
            self._answered()


class DockerProxySync:
    """Keeps all running proxies up to date. Calls ``answered`` as `ProxyUpdater` does."""

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
        self._retired_runs: set[str] = set()

    def update(self, snapshot: DockerSnapshot, members: Collection[Member]) -> None:
        """Begin to send each running proxy the facts of a look.

        A proxy that was started again gets a new updater.
        """
        for name, (updater, task) in list(self._running.items()):
            # A task that is done has failed by a bug, which `Tasks` has logged. Start another task.
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
                    has_callers=proxy.place != ZENOH,  # routers of zenoh have no list of callers
                )
                self._running[name] = updater, self._tasks.spawn(updater.run(), f"updating {name}")
            facts = network_facts(snapshot.state, proxy, members, self._settings.policy)
            self._running[name][0].update(facts)

    def _former_leases(self, name: str, ports: PortRange) -> Leases:
        """Return the ports of the former run; empty if ``ports`` contains all of these ports."""
        previous = self._leases.get(name, {})
        is_kept = all(port in ports for leased in previous.values() for port in leased)
        return {} if is_kept else previous

    def retired(self, snapshot: DockerSnapshot) -> frozenset[str]:
        """Return the names of the proxies that have retired, by the last status of each proxy.

        The updater of a proxy ends if the operator gives the container another name, so the runs of
        the proxies are kept.
        """
        updaters = (updater for updater, _ in self._running.values())
        self._retired_runs |= {updater.access.run for updater in updaters if updater.retired}
        self._retired_runs &= {access.run for access in snapshot.access.values()}
        running = snapshot.access.items()
        return frozenset(name for name, access in running if access.run in self._retired_runs)

    def answers(self, name: str) -> bool:
        """Whether the last exchange of updates with a proxy succeeded."""
        return name in self._running and self._running[name][0].silent_since is None

    def problems(self, snapshot: DockerSnapshot) -> list[Problem]:
        """Return a problem for each proxy that has failed for `PROXY_STARTING_S` seconds."""
        latest = time.monotonic() - PROXY_STARTING_S
        return [
            silent_proxy_problem(name, updater.error, snapshot, self._settings.uplink)
            for name, (updater, _) in self._running.items()
            if updater.error and updater.silent_since and updater.silent_since < latest
        ]


async def ask_proxies(
    proxies: ProxyClient, snapshot: DockerSnapshot, uplink: str
) -> dict[str, ProxyStatus | Problem]:
    """Return the status of each running proxy, by name; of a silent proxy, the problem."""

    async def ask(name: str, access: ProxyAccess) -> ProxyStatus | Problem:
        try:
            return await proxies.status(access.admin)
        except ProxyError as error:
            return silent_proxy_problem(name, error, snapshot, uplink)

    answers = await asyncio.gather(*(ask(*proxy) for proxy in snapshot.access.items()))
    return dict(zip(snapshot.access, answers, strict=True))


def silent_proxy_problem(
    name: str, error: ProxyError, snapshot: DockerSnapshot, uplink: str
) -> Problem:
    """Return the problem and the fix for a proxy that does not answer, or answers an error."""
    if isinstance(error, PolicyRefused):
        return Problem(f"proxy {name}", str(error), reason=REFUSES)
    if error.is_unreachable and not snapshot.at_host:
        advice = (
            f"Attach the operator to network {uplink}, or run the operator with network_mode: host"
        )
    else:
        advice = f"Read docker logs {name}"
    return Problem(f"proxy {name}", *silent(str(error), advice), reason=SILENT)
