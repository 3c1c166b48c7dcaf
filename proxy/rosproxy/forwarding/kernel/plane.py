"""Topics forwarded by the kernel, as the rest of the proxy sees it: started, asked, looked at.

`KernelTargets` decides where each endpoint's topics may go, `KernelForwards` has the kernel do it.
"""

import logging
import os
from collections.abc import Sequence
from typing import Any

from rosproxy.forwarding.kernel import conntrack
from rosproxy.forwarding.kernel.accounting import KernelBook
from rosproxy.forwarding.kernel.nft import Table
from rosproxy.forwarding.kernel.preflight import why_not
from rosproxy.forwarding.kernel.syncer import KernelForwards
from rosproxy.forwarding.kernel.table import KernelTable
from rosproxy.forwarding.kernel.targets import KernelTargets
from rosproxy.forwarding.kernel.tools import Tools
from rosproxy.leases import fast_ports
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.telemetry.metrics import KernelTally, Traffic

log = logging.getLogger(__name__)

LOOK_INTERVAL = 3.0
"""Seconds between looks at the kernel's counters and connections."""
RETRY_LOST = 30.0
"""Seconds between attempts to get a kernel plane back that was lost."""
UNANSWERED_PATIENCE = 3.0
"""Seconds after which a connection that the node does not answer is taken back to user space."""
OPTION = "--data-plane"


class KernelPlane:
    """What the kernel forwards for the endpoints, and why it doesn't."""

    def __init__(self, context: Context, tools: Tools | None = None) -> None:
        self._context, self._tools = context, tools or Tools()
        self._table = KernelTable(Table(context.settings.master_port), self._tools)
        self._targets, self._book = KernelTargets(context), KernelBook()
        self._forwards = KernelForwards(context, self._table, self._targets, self._book, self._lose)
        self._watch = conntrack.Watch(UNANSWERED_PATIENCE)
        self._told: dict[Endpoint, str] = {}
        self._lost, self._retry_at = False, 0.0
        self._traffic = Traffic()

    @property
    def usable(self) -> bool:
        """Whether the kernel may forward at all."""
        return self._targets.usable

    async def start(self) -> None:
        """Make the table if that is possible; to be called before any port listens.

        The kernel has to see every connection to a fast port from its beginning. Forwards that a
        former process left stay until it is known whose they are.
        """
        mode, targets = self._context.settings.data_plane, self._targets
        targets.refresh()
        if not self._wanted:
            targets.why_not = f"{OPTION} {mode}"
            return
        targets.why_not = await why_not(mode, self._tools) or await self._forwards.begin()
        self._report()
        if self.usable:
            repeat = self._context.tasks.repeat
            repeat(self._forwards.turn, 0, "forwarding in the kernel")
            repeat(self.look, LOOK_INTERVAL, "looking at the kernel's counters")

    async def stop(self) -> None:
        """Take the table away, and what the kernel knows of connections through it.

        To be called when no task runs any more.
        """
        was, self._targets.why_not = self.usable, "the proxy has stopped"
        await self._tools.settled()
        if was:
            await self._table.remove()

    def wake(self, endpoint: Endpoint | None = None) -> None:
        """Say that an endpoint has changed, or any."""
        self._forwards.wake(endpoint)

    def recovered(self, endpoints: Sequence[Endpoint]) -> None:
        """Note that the registry is rebuilt; what it holds gets the fast ports that it had.

        Also where the kernel may not forward now: subscribers may be connected to them.
        """
        if self._wanted:
            for endpoint in endpoints:
                fast_ports.claim(self._context.registry, endpoint)
        self._forwards.recovered = True
        self.wake()

    def may_forward(self, endpoint: Endpoint) -> bool:
        """Whether an endpoint's topics could be forwarded if it had a fast port."""
        return self._targets.allowed(endpoint)

    async def forwards(self, endpoint: Endpoint, tcpros_port: int) -> bool:
        """Whether an endpoint's fast port leads to a TCPROS port of its node; waits a moment."""
        return await self._forwards.lead(endpoint, tcpros_port)

    async def cleared(self, port: int) -> None:
        """Wait a moment until a port is not forwarded any more."""
        await self._forwards.cleared(port)

    def tell(self, endpoint: Endpoint) -> None:
        """Log why an endpoint's topics are not forwarded, if that has not been said yet."""
        why = self._forwards.reason(endpoint)
        if why and self.usable and self._told.get(endpoint) != why:
            self._told[endpoint] = why
            log.info("%s: the proxy forwards its topics: %s", endpoint.label, why)

    def cut(self, endpoint: Endpoint) -> None:
        """Have the kernel forget an endpoint's connections; who sends next gets a reset."""
        ports, ipv6 = self._book.ports_of(endpoint), ":" in endpoint.place.address
        if self.usable and ports:
            work = self._forwards.cut([(port, ipv6) for port in ports])
            self._context.tasks.spawn(work, f"cutting {endpoint.uri}")

    async def look(self) -> None:
        """Take in the kernel's counters and connections, and put right what is not as wanted."""
        self._targets.refresh()
        there = set(self._context.registry)
        self._told = {e: why for e, why in self._told.items() if e in there}
        if not self.usable:
            await self._regain()
        elif self._table.forwards or self._book.owners:
            await self._look()
        self.wake()

    def tally(self) -> KernelTally:
        """What the metrics say of it."""
        registry = self._context.registry
        connections = sum(endpoint.fast_connections for endpoint in registry)
        return KernelTally(self.usable, connections, self._traffic)

    def status(self) -> dict[str, Any]:
        """The plane as a whole, as JSON."""
        plane = "kernel" if self.usable else self._user_plane
        mode = self._context.settings.data_plane
        return {"mode": mode, "plane": plane, "reason": self._targets.why_not or ""}

    def status_of(self, endpoint: Endpoint) -> dict[str, Any]:
        """The plane of one endpoint's topics, as JSON; bytes of IP packets."""
        account = self._book.account(endpoint)
        reason, port = self._forwards.reason(endpoint), endpoint.fast_port
        return {
            "plane": self._user_plane if reason else "kernel",
            "port": None if port is None else self._context.settings.ports.advertised(port),
            "reason": reason,
            "connections": endpoint.fast_connections,
            "sent": account.sent,
            "received": account.received,
            "sent_rate": round(account.rates[0], 1),
            "received_rate": round(account.rates[1], 1),
        }

    @property
    def _wanted(self) -> bool:
        return self._context.settings.data_plane in ("auto", "kernel")

    @property
    def _user_plane(self) -> str:
        copies = self._context.settings.data_plane == "copy" or not hasattr(os, "splice")
        return "copy" if copies else "splice"

    async def _look(self) -> None:
        seen = await self._forwards.look()
        if seen is None:
            return
        counters, flows = seen
        for name, sent, received in self._book.count(counters, self._context.now()):
            self._traffic.add("node", name, sent, received)
        self._book.note_peers(flows)
        unanswered = self._watch.look(flows, self._context.now())
        await self._forwards.take_back({*self._book.silent, *(flow.port for flow in unanswered)})

    async def _regain(self) -> None:
        if not self._lost or self._context.now() < self._retry_at:
            return
        self._targets.why_not = await self._forwards.begin()
        self._lost, self._retry_at = not self.usable, self._context.now() + RETRY_LOST
        if self.usable:
            self._report()

    def _lose(self, why: str) -> None:
        self._targets.why_not, self._lost = why, True
        self._book.note_peers([])
        self._retry_at = self._context.now() + RETRY_LOST
        text = f"topics are no longer forwarded by the kernel: {why}"
        log.error("%s", text)
        self._context.problems.add(OPTION, text)

    def _report(self) -> None:
        plane, why = self._user_plane, self._targets.why_not
        if why is None:
            log.info("the kernel forwards topics: nftables table %s", self._table.table.name)
            self._context.problems.solved(OPTION)
        elif self._context.settings.data_plane == "kernel":
            text = f"the kernel forwards no topics, the proxy does ({plane}): {why}"
            log.error("%s kernel: %s", OPTION, text)
            self._context.problems.add(OPTION, text)
        else:
            log.info("the proxy forwards topics (%s), not the kernel: %s", plane, why)
