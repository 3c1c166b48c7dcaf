"""Topics forwarded by the kernel: one nftables table, kept as the endpoints want it.

Level-triggered: `wake` only says that something may have changed. One worker at a time compares
what is wanted with what the kernel has, and changes it in one transaction. All endpoints are gone
through every few seconds; in between only those that changed, so that a thousand that come one by
one don't make a million.
"""

import asyncio
import contextlib
import itertools
import logging
import os
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

from rosproxy.context import Context
from rosproxy.core import conntrack, fast_ports
from rosproxy.core.kernel_book import KernelBook
from rosproxy.core.kernel_plane import Changes, Pauses, World, destination, kept, unchanged
from rosproxy.core.nft import NftError, Table
from rosproxy.core.registry import Endpoint
from rosproxy.core.uris import HostPort
from rosproxy.kernel_conditions import forwarding, why_not
from rosproxy.kernel_table import KernelTable
from rosproxy.kernel_tools import ToolError, Tools
from rosproxy.metrics import KernelTally, Traffic
from rosproxy.network import address_towards

log = logging.getLogger(__name__)

LOOK_INTERVAL = 3.0
"""Seconds between looks at the kernel's counters and connections."""
RETRY_LOST = 30.0
"""Seconds between attempts to get a kernel plane back that was lost."""
SYNC_PATIENCE = 1.0
"""Seconds that a subscriber's requestTopic waits at most for its forward."""
UNANSWERED_PATIENCE = 3.0
"""Seconds after which a connection that the node does not answer is taken back to user space."""
OWN_TTL = 60.0
"""Seconds for which it is remembered which addresses are the proxy's own."""
OPTION = "--data-plane"


class KernelPlane:
    """What the kernel forwards for the endpoints, and why it doesn't.

    ``why_not`` tells why it forwards nothing at all; None while it may.
    """

    def __init__(self, context: Context, tools: Tools | None = None) -> None:
        self._context, self._tools = context, tools or Tools()
        self._table = KernelTable(Table(context.settings.master_port), self._tools)
        self._book, self._pauses = KernelBook(), Pauses()
        self._watch = conntrack.Watch(UNANSWERED_PATIENCE)
        self._lock, self._wake, self._done = asyncio.Lock(), asyncio.Event(), asyncio.Event()
        self._world = World()
        self._own: dict[str, bool] = {}
        self._changed: set[Endpoint] = set()
        self._told: dict[Endpoint, str] = {}
        self._all = True
        self._recovered = self._lost = False
        self._retry_at = self._own_until = 0.0
        self._traffic = Traffic()
        self.why_not: str | None = "the proxy has not started yet"

    @property
    def usable(self) -> bool:
        """Whether the kernel may forward at all."""
        return self.why_not is None

    async def start(self) -> None:
        """Make the table if that is possible; to be called before any port listens.

        The kernel has to see every connection to a fast port from its beginning. Forwards that a
        former process left stay until it is known whose they are.
        """
        mode, self._world = self._context.settings.data_plane, forwarding()
        if not self._wanted:
            self.why_not = f"{OPTION} {mode}"
            return
        self.why_not = await why_not(mode, self._tools) or await self._begin()
        self._report()
        if self.usable:
            repeat = self._context.tasks.repeat
            repeat(self._turn, 0, "forwarding in the kernel")
            repeat(self.look, LOOK_INTERVAL, "looking at the kernel's counters")

    async def stop(self) -> None:
        """Take the table away, and what the kernel knows of connections through it.

        To be called when no task runs any more.
        """
        was, self.why_not = self.usable, "the proxy has stopped"
        await self._tools.settled()
        if was:
            await self._table.remove()

    def wake(self, endpoint: Endpoint | None = None) -> None:
        """Say that an endpoint has changed, or any."""
        if endpoint is not None and self.usable:
            self._changed.add(endpoint)
        else:
            self._all = True
        self._wake.set()

    def recovered(self, endpoints: Sequence[Endpoint]) -> None:
        """Note that the registry is rebuilt; what it holds gets the fast ports that it had.

        Also where the kernel may not forward now: subscribers may be connected to them.
        """
        if self._wanted:
            for endpoint in endpoints:
                fast_ports.claim(self._context.registry, endpoint)
        self._recovered = True
        self.wake()

    def may_forward(self, endpoint: Endpoint) -> bool:
        """Whether an endpoint's topics could be forwarded if it had a fast port."""
        return self.usable and isinstance(self._destination(endpoint), HostPort)

    async def forwards(self, endpoint: Endpoint, tcpros_port: int) -> bool:
        """Whether an endpoint's fast port leads to a TCPROS port of its node; waits a moment."""
        if self._leads(endpoint, tcpros_port):
            return True
        self.wake(endpoint)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SYNC_PATIENCE):
                while self.may_forward(endpoint) and not self._leads(endpoint, tcpros_port):
                    await self._done.wait()
        return self._leads(endpoint, tcpros_port)

    def tell(self, endpoint: Endpoint) -> None:
        """Log why an endpoint's topics are not forwarded, if that has not been said yet."""
        why = self._reason(endpoint)
        if why and self.usable and self._told.get(endpoint) != why:
            self._told[endpoint] = why
            log.info("%s: the proxy forwards its topics: %s", endpoint.label, why)

    async def cleared(self, port: int) -> None:
        """Wait a moment until a port is not forwarded any more."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SYNC_PATIENCE):
                while self.usable and port in self._table.forwards:
                    await self._done.wait()

    def cut(self, endpoint: Endpoint) -> None:
        """Have the kernel forget an endpoint's connections; who sends next gets a reset."""
        ports, ipv6 = self._book.ports_of(endpoint), ":" in endpoint.place.address
        if self.usable and ports:
            work = self._cut([(port, ipv6) for port in ports])
            self._context.tasks.spawn(work, f"cutting {endpoint.uri}")

    async def look(self) -> None:
        """Take in the kernel's counters and connections, and put right what is not as wanted."""
        self._world = forwarding()
        if self._context.now() > self._own_until:
            self._own, self._own_until = {}, self._context.now() + OWN_TTL
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
        return {"mode": mode, "plane": plane, "reason": self.why_not or ""}

    def status_of(self, endpoint: Endpoint) -> dict[str, Any]:
        """The plane of one endpoint's topics, as JSON; bytes of IP packets."""
        account = self._book.account(endpoint)
        reason, port = self._reason(endpoint), endpoint.fast_port
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

    def _reason(self, endpoint: Endpoint) -> str:
        """Why an endpoint's topics are not forwarded by the kernel; nothing if they are."""
        where = self._destination(endpoint)
        if self.why_not is not None:
            return self.why_not
        if isinstance(where, str):
            return where
        if endpoint.fast_port is None:
            return fast_ports.why_none(self._context.registry, endpoint)
        made = self._table.forwards.get(endpoint.fast_port) == where
        return "" if made else "about to be forwarded"

    def _destination(self, endpoint: Endpoint) -> HostPort | str:
        address = endpoint.place.address
        own = {address} if self._is_own(address) else ()
        where = destination(endpoint, replace(self._world, own=own))
        if isinstance(where, str) or endpoint.fast_port is None:
            return where
        return self._pauses.why(endpoint.fast_port, where, self._context.now()) or where

    def _is_own(self, address: str) -> bool:
        if address not in self._own:
            self._own[address] = address_towards(address) == address
        return self._own[address]

    def _leads(self, endpoint: Endpoint, tcpros_port: int) -> bool:
        where, port = HostPort(endpoint.place.address, tcpros_port), endpoint.fast_port
        return self.usable and port is not None and self._table.forwards.get(port) == where

    def _wanted_forwards(self) -> dict[int, HostPort]:
        registry, now = self._context.registry, self._table.forwards
        changed, self._changed = self._changed, set()
        if self._all or not self._recovered:
            self._all, changed = False, set(registry)
            wanted = kept(now, changed, self._recovered)
        else:
            wanted = unchanged(now, self._book.owners, changed)
        for endpoint in changed:
            where = self._destination(endpoint) if endpoint.fast_port else ""
            held = registry.by_port.get(endpoint.port) is endpoint
            if held and endpoint.fast_port and isinstance(where, HostPort):
                wanted[endpoint.fast_port] = where
        return wanted

    async def _turn(self) -> None:
        await self._wake.wait()
        await self._sync()

    async def _sync(self) -> None:
        """Have the kernel forward what is wanted now."""
        async with self._lock:
            self._wake.clear()
            self._book.note_owners(self._context.registry)
            self._pauses.keep(self._book.owners)
            if self.usable:
                await self._change()
            done, self._done = self._done, asyncio.Event()
            done.set()

    async def _change(self) -> None:
        wanted = self._wanted_forwards()
        try:
            self._log_changes(await self._table.change(wanted))
        except ToolError as error:
            log.warning("%s; making the table again", error)
            await self._make(wanted)

    async def _make(self, wanted: dict[int, HostPort]) -> None:
        try:
            await self._table.make(wanted)
        except ToolError as error:
            self._lose(str(error))

    async def _begin(self) -> str | None:
        """Make the table; why that is not possible."""
        try:
            await self._table.begin()
        except ToolError as error:
            return str(error)
        return None

    async def _look(self) -> None:
        async with self._lock:
            self._book.note_owners(self._context.registry)
            try:
                counters = await self._table.look()
                flows = await self._table.flows(self._has_ipv6())
            except (ToolError, NftError) as error:
                log.warning("%s; making the table again", error)
                self._all = True
                await self._make(self._wanted_forwards())
                return
        for name, sent, received in self._book.count(counters, self._context.now()):
            self._traffic.add("node", name, sent, received)
        self._book.note_peers(flows)
        unanswered = self._watch.look(flows, self._context.now())
        await self._take_back({*self._book.silent, *(flow.port for flow in unanswered)})

    def _has_ipv6(self) -> bool:
        return any(":" in endpoint.place.address for endpoint in self._book.owners.values())

    async def _take_back(self, ports: Collection[int]) -> None:
        """Let user space serve the connections through ports behind which no node answers."""
        for port in ports:
            where = self._table.forwards.get(port)
            if where is not None:
                why = f"nothing came back from the node at {where} through the kernel"
                self._pauses.note(port, where, why, self._context.now())
        if ports:
            self._all = True
            await self._sync()
            families = itertools.product(ports, (False, True))
            await self._table.forget(families, "SYN_SENT")

    async def _cut(self, ports: Sequence[tuple[int, bool]]) -> None:
        await self._sync()
        await self._table.forget(ports)

    async def _regain(self) -> None:
        if not self._lost or self._context.now() < self._retry_at:
            return
        async with self._lock:
            self.why_not = await self._begin()
        self._lost, self._retry_at = not self.usable, self._context.now() + RETRY_LOST
        if self.usable:
            self._report()

    def _lose(self, why: str) -> None:
        self.why_not, self._lost, self._all = why, True, True
        self._book.note_peers([])
        self._retry_at = self._context.now() + RETRY_LOST
        text = f"topics are no longer forwarded by the kernel: {why}"
        log.error("%s", text)
        self._context.problems.add(OPTION, text)

    def _report(self) -> None:
        plane, why = self._user_plane, self.why_not
        if why is None:
            log.info("the kernel forwards topics: nftables table %s", self._table.table.name)
            self._context.problems.solved(OPTION)
        elif self._context.settings.data_plane == "kernel":
            text = f"the kernel forwards no topics, the proxy does ({plane}): {why}"
            log.error("%s kernel: %s", OPTION, text)
            self._context.problems.add(OPTION, text)
        else:
            log.info("the proxy forwards topics (%s), not the kernel: %s", plane, why)

    def _log_changes(self, change: Changes) -> None:
        for port in {**change.removed, **change.added}:
            endpoint, where = self._book.owners.get(port), change.added.get(port)
            name = endpoint.label if endpoint else "a node that is gone"
            if where:
                log.info("%s: the kernel forwards port %d to %s", name, port, where)
            else:
                why = self._reason(endpoint) if endpoint else "its endpoint has ended"
                log.info("%s: the kernel no longer forwards port %d: %s", name, port, why)
