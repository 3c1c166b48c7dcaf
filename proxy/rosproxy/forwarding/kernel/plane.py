"""What the kernel forwards, as the rest of the proxy sees it: started, asked, looked at.

An endpoint's *fast port* (`rosproxy.leases.fast_ports`) is what the kernel may forward straight to
the node's TCPROS port; for ROS 2 a lease's own port, straight to a participant's locator. Where to
is up to `decisions`, `syncer` keeps the kernel's `table` so, and `accounting` tells what went
through it. It is an acceleration only: whatever the kernel does not forward arrives at the socket
of the same port, and is relayed.

There is a plane for TCP and one for UDP, alike but for this: nobody answers a datagram. So nothing
tells that a filter on the way drops what is forwarded, and nobody has to be told of an end.
"""

import logging
import os
from collections.abc import Callable, Sequence
from typing import Any

from rosproxy.forwarding.kernel import conntrack
from rosproxy.forwarding.kernel.accounting import KernelAccounts
from rosproxy.forwarding.kernel.decisions import Forwards
from rosproxy.forwarding.kernel.nft import Counts, Near
from rosproxy.forwarding.kernel.preflight import find_obstacle
from rosproxy.forwarding.kernel.syncer import SUBJECT, Clock, ForwardSyncer
from rosproxy.forwarding.kernel.table import KernelTable
from rosproxy.leases import fast_ports
from rosproxy.leases.fast_ports import LeaseHolder, LeaseHolders
from rosproxy.net.tasks import Tasks
from rosproxy.settings import Settings
from rosproxy.telemetry.metrics import Traffic
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)

LOOK_INTERVAL = 3.0
"""Seconds between looks at the kernel's counters and connections."""
UNANSWERED_PATIENCE = 3.0
"""Seconds after which a connection that the node does not answer is taken back to user space."""


class KernelPlane:
    """What the kernel forwards for the endpoints, and why it doesn't.

    ``traffic`` are the bytes of IP packets by node, ``total`` is what was counted in all. ``near``
    tells who may use the forwards that lead outside. ``user_plane`` is what forwards all else.
    """

    def __init__(
        self,
        settings: Settings,
        endpoints: LeaseHolders[LeaseHolder],
        tasks: Tasks,
        problems: Problems,
        clock: Clock,
        table: KernelTable,
        near: Callable[[], Near] = tuple,
    ) -> None:
        self._settings = settings
        self.holders = endpoints
        self._tasks = tasks
        self._problems = problems
        self._clock = clock
        self._table = table
        self._accounts = KernelAccounts()
        self.syncer = ForwardSyncer(endpoints, table, self._accounts, problems, clock, near)
        self._unanswered = conntrack.Watch(UNANSWERED_PATIENCE)
        self.traffic = Traffic()
        self.total = Counts()
        self._is_wanted = settings.data_plane in ("auto", "kernel")
        splices = table.has_connections and hasattr(os, "splice")
        copies = settings.data_plane == "copy" or not splices
        self.user_plane = "copy" if copies else "splice"

    async def start(self) -> None:
        """Make the table if that is possible; to be called before any port listens.

        The kernel has to see every connection to a fast port from its beginning. Forwards that a
        former process left stay until it is known whose they are.
        """
        mode = self._settings.data_plane
        self.syncer.look_around()
        if not self._is_wanted:
            self.syncer.why_not = f"{SUBJECT} {mode}"
            return
        if why := await find_obstacle(mode, self._table.tools):
            self.syncer.why_not = why
        else:
            await self.syncer.begin()
        self._report()
        if self.syncer.usable:
            self._tasks.repeat(self.syncer.run_once, 0, f"forwarding {self.syncer.traffic}")
            self._tasks.repeat(self.look, LOOK_INTERVAL, "reading the kernel's counters")

    async def stop(self) -> None:
        """Take the table away, and what the kernel knows of connections through it.

        To be called when no task runs any more.
        """
        was_usable = self.syncer.usable
        self.syncer.why_not = "the proxy has stopped"
        await self._table.tools.settled()
        if was_usable:
            await self._table.remove()

    @property
    def forwards(self) -> Forwards:
        """What the kernel forwards now, as far as is known."""
        return self._table.forwards if self.syncer.usable else {}

    def recovered(self, endpoints: Sequence[LeaseHolder]) -> None:
        """Note that the registry is rebuilt; what it holds gets the fast ports that it had.

        Also where the kernel may not forward now: subscribers may be connected to them.
        """
        if self._is_wanted:
            for endpoint in endpoints:
                fast_ports.claim(self.holders.pool, endpoint)
        self.syncer.recovered = True
        self.syncer.note_change()

    def cut(self, endpoint: LeaseHolder) -> None:
        """Have the kernel forget an endpoint's connections; who sends next gets a reset."""
        ports = self._accounts.ports_of(endpoint)
        ipv6 = ":" in endpoint.address
        if self.syncer.usable and ports:
            work = self.syncer.cut([(port, ipv6) for port in ports])
            self._tasks.spawn(work, f"cutting {endpoint.label}")

    async def look(self) -> None:
        """Take in the kernel's counters and connections, and put right what is not as wanted."""
        self.syncer.look_around()
        if not self.syncer.usable:
            if await self.syncer.regain():
                self._report()
        elif self._table.forwards or self._accounts.owners:
            await self._look()
        self.syncer.note_change()

    def status(self) -> dict[str, Any]:
        """The plane as a whole, as JSON."""
        plane = "kernel" if self.syncer.usable else self.user_plane
        mode = self._settings.data_plane
        return {"mode": mode, "plane": plane, "reason": self.syncer.why_not or ""}

    def status_of(self, endpoint: LeaseHolder) -> dict[str, Any]:
        """The plane of one endpoint's topics, as JSON; bytes of IP packets."""
        account = self._accounts.account(endpoint)
        reason = self.syncer.reason(endpoint)
        port = endpoint.fast_port
        # Ports of nodes outside are for inside alone: they are not published, and have no offset.
        return {
            "plane": self.user_plane if reason else "kernel",
            "port": self._settings.ports.advertised(port) if endpoint.inside and port else port,
            "reason": reason,
            "connections": endpoint.fast_connections,
            "sent": account.sent,
            "received": account.received,
            "received_packets": account.packets,
            "sent_rate": round(account.rates[0], 1),
            "received_rate": round(account.rates[1], 1),
        }

    async def _look(self) -> None:
        reading = await self.syncer.read_kernel()
        if reading is None:
            return
        counters, survey = reading
        for name, delta in self._accounts.count(counters, self._clock()):
            self.traffic.add("node", name, delta.sent, delta.received)
            self.total = Counts(*map(sum, zip(self.total, delta, strict=True)))
        if survey is None:
            return
        self._accounts.note_peers(survey.open)
        unanswered = self._unanswered.look(survey.waiting, self._clock())
        await self.syncer.take_back(
            {*self._accounts.unanswered, *(flow.port for flow in unanswered)}
        )

    def _report(self) -> None:
        plane = self.user_plane
        reason = self.syncer.why_not
        traffic = self.syncer.traffic
        if reason is None:
            log.info("the kernel forwards %s: nftables table %s", traffic, self._table.table.name)
            self._problems.solved(self.syncer.subject)
            if self._table.weakness:
                log.warning("%s: %s", self.syncer.subject, self._table.weakness)
                self._problems.add(self.syncer.subject, self._table.weakness)
        elif self._settings.data_plane == "kernel":
            text = f"the proxy forwards {traffic} ({plane}), not the kernel: {reason}"
            log.error("%s kernel: %s", SUBJECT, text)
            self._problems.add(self.syncer.subject, text)
        else:
            log.info("the proxy forwards %s (%s), not the kernel: %s", traffic, plane, reason)
