"""Topics forwarded by the kernel, as the rest of the proxy sees it: started, asked, looked at.

An endpoint's *fast port* (`rosproxy.leases.fast_ports`) is what the kernel may forward straight to
the node's TCPROS port. `policy` decides where to, `syncer` keeps the kernel's `table` so, and
`accounting` tells what went through it. It is an acceleration only: whatever the kernel does not
forward arrives at the listening socket of the same port, and is relayed.
"""

import logging
import os
from collections.abc import Sequence
from typing import Any

from rosproxy.forwarding.kernel import conntrack
from rosproxy.forwarding.kernel.accounting import KernelAccounts
from rosproxy.forwarding.kernel.endpoints import ForwardedEndpoint, ForwardedEndpoints
from rosproxy.forwarding.kernel.nft import Table
from rosproxy.forwarding.kernel.preflight import why_not
from rosproxy.forwarding.kernel.syncer import OPTION, Clock, ForwardSyncer
from rosproxy.forwarding.kernel.table import KernelTable
from rosproxy.forwarding.kernel.tools import Tools
from rosproxy.leases import fast_ports
from rosproxy.net.tasks import Tasks
from rosproxy.settings import Settings
from rosproxy.telemetry.metrics import KernelTally, Traffic
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)

LOOK_INTERVAL = 3.0
"""Seconds between looks at the kernel's counters and connections."""
UNANSWERED_PATIENCE = 3.0
"""Seconds after which a connection that the node does not answer is taken back to user space."""


class KernelPlane:
    """What the kernel forwards for the endpoints, and why it doesn't."""

    def __init__(
        self,
        settings: Settings,
        endpoints: ForwardedEndpoints,
        tasks: Tasks,
        problems: Problems,
        clock: Clock,
        tools: Tools | None = None,
    ) -> None:
        self._settings, self._endpoints = settings, endpoints
        self._tasks, self._problems, self._clock = tasks, problems, clock
        self._tools = tools or Tools()
        self._table = KernelTable(Table(settings.master_port), self._tools)
        self._accounts = KernelAccounts()
        self._syncer = ForwardSyncer(endpoints, self._table, self._accounts, problems, clock)
        self._unanswered = conntrack.Watch(UNANSWERED_PATIENCE)
        self._logged: dict[ForwardedEndpoint, str] = {}
        self._traffic = Traffic()

    @property
    def usable(self) -> bool:
        """Whether the kernel may forward at all."""
        return self._syncer.usable

    async def start(self) -> None:
        """Make the table if that is possible; to be called before any port listens.

        The kernel has to see every connection to a fast port from its beginning. Forwards that a
        former process left stay until it is known whose they are.
        """
        mode = self._settings.data_plane
        self._syncer.read_host()
        if not self._wanted:
            self._syncer.refuse(f"{OPTION} {mode}")
            return
        if why := await why_not(mode, self._tools):
            self._syncer.refuse(why)
        else:
            await self._syncer.begin()
        self._report()
        if self.usable:
            self._tasks.repeat(self._syncer.run_once, 0, "forwarding in the kernel")
            self._tasks.repeat(self.look, LOOK_INTERVAL, "looking at the kernel's counters")

    async def stop(self) -> None:
        """Take the table away, and what the kernel knows of connections through it.

        To be called when no task runs any more.
        """
        was = self.usable
        self._syncer.refuse("the proxy has stopped")
        await self._tools.settled()
        if was:
            await self._table.remove()

    def note_change(self, endpoint: ForwardedEndpoint | None = None) -> None:
        """Note that an endpoint has changed, or any."""
        self._syncer.note_change(endpoint)

    def recovered(self, endpoints: Sequence[ForwardedEndpoint]) -> None:
        """Note that the registry is rebuilt; what it holds gets the fast ports that it had.

        Also where the kernel may not forward now: subscribers may be connected to them.
        """
        if self._wanted:
            for endpoint in endpoints:
                fast_ports.claim(self._endpoints.pool, endpoint)
        self._syncer.recovered = True
        self._syncer.note_change()

    def may_forward(self, endpoint: ForwardedEndpoint) -> bool:
        """Whether an endpoint's topics could be forwarded if it had a fast port."""
        return self._syncer.may_forward(endpoint)

    async def forwards(self, endpoint: ForwardedEndpoint, tcpros_port: int) -> bool:
        """Whether an endpoint's fast port leads to a TCPROS port of its node; waits a moment."""
        return await self._syncer.forwards(endpoint, tcpros_port)

    async def cleared(self, port: int) -> None:
        """Wait a moment until a port is not forwarded any more."""
        await self._syncer.cleared(port)

    def log_reason(self, endpoint: ForwardedEndpoint) -> None:
        """Log why an endpoint's topics are not forwarded, if that has not been said yet."""
        why = self._syncer.reason(endpoint)
        if why and self.usable and self._logged.get(endpoint) != why:
            self._logged[endpoint] = why
            log.info("%s: the proxy forwards its topics: %s", endpoint.label, why)

    def cut(self, endpoint: ForwardedEndpoint) -> None:
        """Have the kernel forget an endpoint's connections; who sends next gets a reset."""
        ports, ipv6 = self._accounts.ports_of(endpoint), ":" in endpoint.address
        if self.usable and ports:
            work = self._syncer.cut([(port, ipv6) for port in ports])
            self._tasks.spawn(work, f"cutting {endpoint.label}")

    async def look(self) -> None:
        """Take in the kernel's counters and connections, and put right what is not as wanted."""
        self._syncer.read_host()
        there = set(self._endpoints)
        self._logged = {e: why for e, why in self._logged.items() if e in there}
        if not self.usable:
            if await self._syncer.regain():
                self._report()
        elif self._table.forwards or self._accounts.owners:
            await self._look()
        self._syncer.note_change()

    def tally(self) -> KernelTally:
        """What the metrics say of it."""
        connections = sum(endpoint.fast_connections for endpoint in self._endpoints)
        return KernelTally(self.usable, connections, self._traffic)

    def status(self) -> dict[str, Any]:
        """The plane as a whole, as JSON."""
        plane = "kernel" if self.usable else self._user_plane
        mode = self._settings.data_plane
        return {"mode": mode, "plane": plane, "reason": self._syncer.why_not or ""}

    def status_of(self, endpoint: ForwardedEndpoint) -> dict[str, Any]:
        """The plane of one endpoint's topics, as JSON; bytes of IP packets."""
        account = self._accounts.account(endpoint)
        reason, port = self._syncer.reason(endpoint), endpoint.fast_port
        return {
            "plane": self._user_plane if reason else "kernel",
            "port": None if port is None else self._settings.ports.advertised(port),
            "reason": reason,
            "connections": endpoint.fast_connections,
            "sent": account.sent,
            "received": account.received,
            "sent_rate": round(account.rates[0], 1),
            "received_rate": round(account.rates[1], 1),
        }

    @property
    def _wanted(self) -> bool:
        return self._settings.data_plane in ("auto", "kernel")

    @property
    def _user_plane(self) -> str:
        copies = self._settings.data_plane == "copy" or not hasattr(os, "splice")
        return "copy" if copies else "splice"

    async def _look(self) -> None:
        seen = await self._syncer.read_kernel()
        if seen is None:
            return
        counters, flows = seen
        for name, sent, received in self._accounts.count(counters, self._clock()):
            self._traffic.add("node", name, sent, received)
        self._accounts.note_peers(flows)
        unanswered = self._unanswered.look(flows, self._clock())
        await self._syncer.take_back(
            {*self._accounts.unanswered, *(flow.port for flow in unanswered)}
        )

    def _report(self) -> None:
        plane, why = self._user_plane, self._syncer.why_not
        if why is None:
            log.info("the kernel forwards topics: nftables table %s", self._table.table.name)
            self._problems.solved(OPTION)
        elif self._settings.data_plane == "kernel":
            text = f"the kernel forwards no topics, the proxy does ({plane}): {why}"
            log.error("%s kernel: %s", OPTION, text)
            self._problems.add(OPTION, text)
        else:
            log.info("the proxy forwards topics (%s), not the kernel: %s", plane, why)
