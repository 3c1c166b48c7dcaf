"""The kernel plane: the interface for the other packages of the proxy.

The kernel forwards the *fast port* of an endpoint (`rosproxy.forwarding.fast_ports`) directly to
the TCPROS port of the node. For ROS 2, the kernel forwards a port mapping directly to a locator of
the participant. `decisions` chooses the target, `syncer` keeps the kernel's `table` up to date, and
`accounting` counts. The plane only makes traffic faster: if the kernel does not forward, the socket
at the same port receives the bytes, and the proxy relays.

There is a plane for TCP and a plane for UDP. The difference: UDP has no replies and no end of a
connection. So the plane for UDP does not notice a filter that drops forwarded datagrams, and resets
no connections.
"""

import logging
import os
from collections.abc import Callable, Sequence
from typing import Any

from rosproxy.forwarding import fast_ports
from rosproxy.forwarding.fast_ports import LeaseHolder, LeaseHolders
from rosproxy.forwarding.kernel import conntrack
from rosproxy.forwarding.kernel.accounting import KernelAccounts
from rosproxy.forwarding.kernel.decisions import Forwards
from rosproxy.forwarding.kernel.nft import Counts, Near
from rosproxy.forwarding.kernel.preflight import find_obstacle
from rosproxy.forwarding.kernel.syncer import SUBJECT, Clock, ForwardSyncer, IsDenied
from rosproxy.forwarding.kernel.table import KernelTable
from rosproxy.shared.output.problems import Problems
from rosproxy.shared.settings import Settings
from rosproxy.shared.tasks import Tasks
from rosproxy.telemetry.metrics import Traffic

log = logging.getLogger(__name__)

READ_INTERVAL_S = 3.0
"""Seconds between readings of the kernel's counters and connections."""
UNANSWERED_TIMEOUT_S = 3.0
"""Seconds after which user space takes over a connection that the node does not answer."""


class KernelPlane:
    """The kernel plane of a transport: forwards, counts and reasons.

    ``traffic`` has the bytes of IP packets by node, ``total`` the sum. ``near`` returns the
    networks that may use the forwards to outside. ``user_plane`` is the plane for the rest: splice
    or copy.
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
        self._unanswered = conntrack.Watch(UNANSWERED_TIMEOUT_S)
        self.traffic = Traffic()
        self.total = Counts()
        self._is_wanted = settings.data_plane in ("auto", "kernel")
        splices = table.has_connections and hasattr(os, "splice")
        copies = settings.data_plane == "copy" or not splices
        self.user_plane = "copy" if copies else "splice"

    async def start(self) -> None:
        """Make the table if possible. Call this before any port listens.

        The kernel has to see each connection to a fast port from the first packet. Forwards of an
        earlier process stay until the registry knows the endpoints.
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
            self._tasks.repeat(self.look, READ_INTERVAL_S, "reading the kernel's counters")

    async def stop(self) -> None:
        """Remove the table, and end the connections. Call this after the end of all tasks."""
        was_usable = self.syncer.usable
        self.syncer.why_not = "the proxy has stopped"
        await self._table.tools.settled()
        if was_usable:
            await self._table.remove()

    @property
    def forwards(self) -> Forwards:
        """The forwards of the kernel, as of the last change or reading."""
        return self._table.forwards if self.syncer.usable else {}

    def recovered(self, endpoints: Sequence[LeaseHolder]) -> None:
        """Note that the registry is rebuilt, and give the endpoints their earlier fast ports.

        The endpoints get the ports even if the kernel may not forward now, because subscribers may
        use these ports.
        """
        if self._is_wanted:
            for endpoint in endpoints:
                fast_ports.claim(self.holders.pool, endpoint)
        self.syncer.recovered = True
        self.syncer.note_change()

    def cut(self, endpoint: LeaseHolder) -> None:
        """Have the kernel end the connections of an endpoint; the next packet gets a reset."""
        ports = self._accounts.ports_of(endpoint)
        ipv6 = ":" in endpoint.address
        if self.syncer.usable and ports:
            work = self.syncer.cut([(port, ipv6) for port in ports])
            self._tasks.spawn(work, f"cutting {endpoint.label}")
            self._accounts.forget_lost_ports(endpoint)

    def cut_former(self, is_denied: IsDenied) -> None:
        """Have the kernel end what a killed process left, as far as ``is_denied`` says.

        The table of that process says nothing about topics. The policy may have changed since.
        """
        if self.syncer.usable:
            work = self.syncer.cut_former(is_denied)
            self._tasks.spawn(work, "cutting connections from before the start")

    @property
    def owners(self) -> set[LeaseHolder]:
        """The endpoints with a fast port, or with connections through a port that they have lost.

        As of the last change or reading.
        """
        return set(self._accounts.owners.values())

    async def look(self) -> None:
        """Read the kernel's counters and connections, and correct the forwards."""
        self.syncer.look_around()
        if not self.syncer.usable:
            if await self.syncer.regain():
                self._report()
        elif self._table.forwards or self._accounts.owners:
            await self._look()
        self.syncer.note_change()

    def status(self) -> dict[str, Any]:
        """The state of the plane, as the fields of DataPlaneStatus."""
        plane = "kernel" if self.syncer.usable else self.user_plane
        mode = self._settings.data_plane
        return {"mode": mode, "plane": plane, "reason": self.syncer.why_not or ""}

    def status_of(self, endpoint: LeaseHolder) -> dict[str, Any]:
        """The plane of an endpoint, as the fields of NodePlaneStatus; bytes are of IP packets.

        In addition, ``received_packets`` and ``packet_rate`` (per second), for datagrams.
        """
        account = self._accounts.account(endpoint)
        reason = self.syncer.reason(endpoint)
        port = endpoint.fast_port
        # Only inside uses the ports of nodes outside: unpublished ports, without an offset.
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
            "packet_rate": round(account.packet_rate, 1),
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
            self._problems.add(self.syncer.subject, text, holds=True)
        else:
            log.info("the proxy forwards %s (%s), not the kernel: %s", traffic, plane, reason)
