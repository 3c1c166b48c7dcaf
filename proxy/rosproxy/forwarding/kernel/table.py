"""The proxy's table in the kernel: read, changed in transactions, made anew, removed."""

import asyncio
import logging
from collections.abc import Iterable
from dataclasses import dataclass, field

from rosproxy.forwarding.kernel import conntrack
from rosproxy.forwarding.kernel.conntrack import Flow
from rosproxy.forwarding.kernel.nft import Counters, NftError, Table, TableState
from rosproxy.forwarding.kernel.policy import Changes, Forwards, changes
from rosproxy.forwarding.kernel.tools import ToolError, Tools

ENDING = 0.3
"""Seconds for which connections are reset before the table goes."""

log = logging.getLogger(__name__)


@dataclass(slots=True)
class KernelTable:
    """What the kernel has, as far as is known: ``forwards``, and the ports that are ``counted``."""

    table: Table
    tools: Tools
    forwards: Forwards = field(default_factory=dict)
    counted: set[int] = field(default_factory=set)

    async def begin(self) -> None:
        """Make the table with what a former process left in it. Raises ToolError.

        Connections under way go on: the kernel has noted for each of them where it leads.
        """
        try:
            before = await self._read()
        except (ToolError, NftError) as error:
            log.debug("no table of a former process: %s", error)
            before = TableState()
        self.counted = set(before.counters)
        await self.tools.list_flows(self.table.marks.all, False)
        await self.make(before.forwards)

    async def make(self, wanted: Forwards) -> None:
        """Put the whole table in place of the one that may be there. Raises ToolError."""
        await self._apply(self.table.made(wanted, self.counted), wanted)

    async def change(self, wanted: Forwards) -> Changes:
        """Have it forward what is wanted, and tell what that changed. Raises ToolError."""
        change = changes(self.forwards, wanted)
        if change:
            await self._apply(self.table.changed(change), wanted)
        return change

    async def look(self) -> Counters:
        """Take in what the kernel really has; the bytes by port. Raises ToolError, NftError."""
        state = await self._read()
        self.forwards = state.forwards
        return state.counters

    async def flows(self, ipv6: bool) -> list[Flow]:
        """The connections that it forwards, of IPv4 and maybe IPv6. Raises ToolError."""
        marks = self.table.marks
        text = await self.tools.list_flows(marks.all, False)
        if ipv6:
            text += await self.tools.list_flows(marks.all, True)
        return conntrack.read(text, marks)

    async def forget(self, ports: Iterable[tuple[int, bool]], state: str = "") -> None:
        """Forget connections through ports, each of IPv6 or not; those of one state if given."""
        for port, ipv6 in ports:
            await self._forget(self.table.marks.one(port), ipv6, state)

    async def remove(self) -> None:
        """End what goes through the table, remove it, and forget all connections through it."""
        try:
            if self.forwards:
                await self.tools.nft("-f", "-", document=self.table.ended())
                await asyncio.sleep(ENDING)
            await self.tools.nft("-f", "-", document=self.table.removed())
        except ToolError as error:
            log.warning("table %s can't be removed: %s", self.table.name, error)
        for ipv6 in (False, True):
            await self._forget(self.table.marks.all, ipv6)
        self.forwards = {}

    async def _apply(self, document: str, forwards: Forwards) -> None:
        await self.tools.nft("-f", "-", document=document)
        self.forwards = dict(forwards)
        self.counted |= set(forwards)

    async def _read(self) -> TableState:
        listed = await self.tools.nft("-j", "list", "table", "inet", self.table.name)
        return self.table.read(listed)

    async def _forget(self, mark: str, ipv6: bool, state: str = "") -> None:
        try:
            await self.tools.forget_flows(mark, ipv6, state)
        except ToolError as error:
            log.warning("connections can't be ended: %s", error)
