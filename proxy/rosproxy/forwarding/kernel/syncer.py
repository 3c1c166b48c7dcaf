"""What the kernel forwards, kept as the endpoints want it.

Level-triggered: `KernelForwards.wake` only says that something may have changed. One worker at a
time compares what is wanted with what the kernel has, and changes it in one transaction. All
endpoints are gone through every few seconds; in between only those that changed, so that a
thousand that come one by one don't make a million.
"""

import asyncio
import contextlib
import itertools
import logging
from collections.abc import Callable, Collection, Iterable

from rosproxy.forwarding.kernel.accounting import KernelBook
from rosproxy.forwarding.kernel.conntrack import Flow
from rosproxy.forwarding.kernel.nft import Counters, NftError
from rosproxy.forwarding.kernel.policy import Changes, kept, unchanged
from rosproxy.forwarding.kernel.table import KernelTable
from rosproxy.forwarding.kernel.targets import KernelTargets
from rosproxy.forwarding.kernel.tools import ToolError
from rosproxy.leases import fast_ports
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.endpoint import Endpoint

log = logging.getLogger(__name__)

SYNC_PATIENCE = 1.0
"""Seconds that a subscriber's requestTopic waits at most for its forward."""


class KernelForwards:
    """The one worker that changes and reads the kernel's table.

    ``on_lost`` is told why the table can't be made any more; it has to say so to ``targets``.
    ``recovered`` is False until the registry is rebuilt: what a former process left then stays.
    """

    def __init__(
        self,
        context: Context,
        table: KernelTable,
        targets: KernelTargets,
        book: KernelBook,
        on_lost: Callable[[str], None],
    ) -> None:
        self._context, self._table, self._targets = context, table, targets
        self._book, self._on_lost = book, on_lost
        self._lock, self._wake, self._done = asyncio.Lock(), asyncio.Event(), asyncio.Event()
        self._changed: set[Endpoint] = set()
        self._all = True
        self.recovered = False

    async def begin(self) -> str | None:
        """Make the table; why that is not possible."""
        async with self._lock:
            try:
                await self._table.begin()
            except ToolError as error:
                return str(error)
        return None

    def wake(self, endpoint: Endpoint | None = None) -> None:
        """Say that an endpoint has changed, or any."""
        if endpoint is not None and self._targets.usable:
            self._changed.add(endpoint)
        else:
            self._all = True
        self._wake.set()

    async def turn(self) -> None:
        """Wait for news, and have the kernel forward what is wanted then."""
        await self._wake.wait()
        await self._sync()

    def reason(self, endpoint: Endpoint) -> str:
        """Why an endpoint's topics are not forwarded by the kernel; nothing if they are."""
        where = self._targets.of(endpoint)
        if isinstance(where, str):
            return where
        if endpoint.fast_port is None:
            return fast_ports.why_none(self._context.registry, endpoint)
        made = self._table.forwards.get(endpoint.fast_port) == where
        return "" if made else "about to be forwarded"

    async def lead(self, endpoint: Endpoint, tcpros_port: int) -> bool:
        """Whether an endpoint's fast port leads to a TCPROS port of its node; waits a moment."""
        if self._leads(endpoint, tcpros_port):
            return True
        self.wake(endpoint)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SYNC_PATIENCE):
                while self._targets.allowed(endpoint) and not self._leads(endpoint, tcpros_port):
                    await self._done.wait()
        return self._leads(endpoint, tcpros_port)

    async def cleared(self, port: int) -> None:
        """Wait a moment until a port is not forwarded any more."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SYNC_PATIENCE):
                while self._targets.usable and port in self._table.forwards:
                    await self._done.wait()

    async def look(self) -> tuple[Counters, list[Flow]] | None:
        """The kernel's counters and connections.

        None if they can't be read; the table is then made again.
        """
        async with self._lock:
            self._book.note_owners(self._context.registry)
            try:
                return await self._table.look(), await self._table.flows(self._has_ipv6())
            except (ToolError, NftError) as error:
                log.warning("%s; making the table again", error)
                self._all = True
                await self._make(self._wanted())
        return None

    async def take_back(self, ports: Collection[int]) -> None:
        """Let user space serve the connections through ports behind which no node answers."""
        for port in ports:
            where = self._table.forwards.get(port)
            if where is not None:
                self._targets.pause(port, where)
        if ports:
            self._all = True
            await self._sync()
            families = itertools.product(ports, (False, True))
            await self._table.forget(families, "SYN_SENT")

    async def cut(self, ports: Iterable[tuple[int, bool]]) -> None:
        """Have the kernel forget the connections through ports, each of IPv6 or not."""
        await self._sync()
        await self._table.forget(ports)

    def _leads(self, endpoint: Endpoint, tcpros_port: int) -> bool:
        where, port = HostPort(endpoint.place.address, tcpros_port), endpoint.fast_port
        return self._targets.usable and port is not None and self._table.forwards.get(port) == where

    def _has_ipv6(self) -> bool:
        return any(":" in endpoint.place.address for endpoint in self._book.owners.values())

    async def _sync(self) -> None:
        async with self._lock:
            self._wake.clear()
            self._book.note_owners(self._context.registry)
            self._targets.keep(self._book.owners)
            if self._targets.usable:
                await self._change()
            done, self._done = self._done, asyncio.Event()
            done.set()

    async def _change(self) -> None:
        wanted = self._wanted()
        try:
            self._log(await self._table.change(wanted))
        except ToolError as error:
            log.warning("%s; making the table again", error)
            await self._make(wanted)

    async def _make(self, wanted: dict[int, HostPort]) -> None:
        try:
            await self._table.make(wanted)
        except ToolError as error:
            self._all = True
            self._on_lost(str(error))

    def _wanted(self) -> dict[int, HostPort]:
        registry, now = self._context.registry, self._table.forwards
        changed, self._changed = self._changed, set()
        if self._all or not self.recovered:
            self._all, changed = False, set(registry)
            wanted = kept(now, changed, self.recovered)
        else:
            wanted = unchanged(now, self._book.owners, changed)
        for endpoint in changed:
            where = self._targets.of(endpoint) if endpoint.fast_port else ""
            held = registry.by_port.get(endpoint.port) is endpoint
            if held and endpoint.fast_port and isinstance(where, HostPort):
                wanted[endpoint.fast_port] = where
        return wanted

    def _log(self, change: Changes) -> None:
        for port in {**change.removed, **change.added}:
            endpoint, where = self._book.owners.get(port), change.added.get(port)
            name = endpoint.label if endpoint else "a node that is gone"
            if where:
                log.info("%s: the kernel forwards port %d to %s", name, port, where)
            else:
                why = self.reason(endpoint) if endpoint else "its endpoint has ended"
                log.info("%s: the kernel no longer forwards port %d: %s", name, port, why)
