"""The proxy's table in the kernel: read, changed in transactions, made anew, removed."""

import asyncio
import logging
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from rosproxy.forwarding.kernel import conntrack
from rosproxy.forwarding.kernel.conntrack import Flow
from rosproxy.forwarding.kernel.decisions import Changes, Forwards, changes
from rosproxy.forwarding.kernel.nft import Counters, Near, NftError, Table, TableState
from rosproxy.forwarding.kernel.tools import ToolError, Tools
from rosproxy.net.interfaces import address_towards

RESET_TIME = 0.3
"""Seconds for which connections are reset before the kernel forgets them."""

log = logging.getLogger(__name__)


@dataclass(slots=True)
class KernelTable:
    """What the kernel has, as far as is known: ``forwards``, and the ports that are ``counted``.

    ``near`` are those who may use the forwards that lead outside.
    """

    table: Table
    tools: Tools
    forwards: Forwards = field(default_factory=dict)
    counted: set[int] = field(default_factory=set)
    near: Near = ()

    async def begin(self) -> None:
        """Make the table with what a former process left in it. Raises ToolError.

        Connections under way go on: the kernel has noted for each of them where it leads.
        """
        try:
            former = await self._read()
        except (ToolError, NftError) as error:
            log.debug("no table of a former process: %s", error)
            former = TableState()
        self.counted = set(former.counters)
        # Only to see, before anything is forwarded, whether conntrack can be run.
        await self._list_flows(False, "--mark", self.table.marks.table_selector)
        await self.make(former.forwards)

    async def make(self, wanted: Forwards) -> None:
        """Put the whole table in place of the one that may be there. Raises ToolError."""
        await self._apply(self.table.made(wanted, self.counted, self.near), wanted)

    async def change(self, wanted: Forwards, near: Near) -> Changes:
        """Have it forward what is wanted, and tell what that changed. Raises ToolError."""
        change = changes(self.forwards, wanted)
        document = self.table.opened(near) if near != self.near else ""
        self.near = near
        if change or document:
            await self._apply(document + self.table.changed(change), wanted)
        return change

    async def look(self, ipv6: bool) -> tuple[Counters, list[Flow]]:
        """Take in what the kernel really has: what was counted by port, and connections.

        Datagrams have no connections; those that go astray are put right. Raises ToolError,
        NftError.
        """
        state, marks = await self._read(), self.table.marks
        self.forwards = state.forwards
        if not self.table.has_connections:
            await self._forget_stray(ipv6)
            return state.counters, []
        text = await self._list_flows(ipv6, "--mark", marks.table_selector)
        return state.counters, conntrack.read(text, marks)

    async def forget(self, ports: Iterable[tuple[int, bool]], state: str = "") -> None:
        """Forget connections through ports, each of IPv6 or not; those of one state if given."""
        state_options = ("--state", state) if state else ()
        for port, ipv6 in ports:
            await self._forget(ipv6, "--mark", self.table.marks.port_selector(port), *state_options)

    async def cut(self, ports: Collection[tuple[int, bool]]) -> None:
        """End the connections through ports, each of IPv6 or not, so that both ends learn of it.

        Who connected gets a reset for what it sends next, even if that only confirms what came: a
        subscriber says nothing else, and some (rospy) try again only when they see their connection
        end. After that whoever sends gets one, since the kernel knows the connection no more.
        """
        numbers = {port for port, _ in ports}
        try:
            await self.tools.nft("-f", "-", document=self.table.cut(numbers))
            await asyncio.sleep(RESET_TIME)
            await self.forget(ports)
            await self.tools.nft("-f", "-", document=self.table.cut(numbers, "delete"))
        except ToolError as error:
            log.warning("connections can't be ended: %s", error)

    async def remove(self) -> None:
        """End what goes through the table, remove it, and forget all connections through it."""
        try:
            if self.forwards and self.table.has_connections:
                await self.tools.nft("-f", "-", document=self.table.ended())
                await asyncio.sleep(RESET_TIME)
            await self.tools.nft("-f", "-", document=self.table.removed())
        except ToolError as error:
            log.warning("table %s can't be removed: %s", self.table.name, error)
        for ipv6 in (False, True):
            await self._forget(ipv6, "--mark", self.table.marks.table_selector)
        self.forwards = {}

    async def _apply(self, document: str, forwards: Forwards) -> None:
        await self.tools.nft("-f", "-", document=document)
        hosts = {target.host for target in (*self.forwards.values(), *forwards.values())}
        self.forwards = dict(forwards)
        self.counted |= set(forwards)
        if not self.table.has_connections:
            await self._forget_stray(any(":" in host for host in hosts))

    async def _forget_stray(self, ipv6: bool) -> None:
        """Forget where stray datagrams go, so that they go by the rules. Raises ToolError."""
        text = await self._list_flows(ipv6)
        unled, misled = conntrack.find_stray_datagrams(text, self.forwards, self.table.marks)
        for dst in unled:
            # Only what was sent to this machine itself, and what no rule has led elsewhere: of that
            # the port that answers is the one that was asked.
            if address_towards(dst.host) == dst.host:
                port = str(dst.port)
                args = "--orig-dst", dst.host, "--orig-port-dst", port, "--reply-port-src", port
                await self._forget(":" in dst.host, *args)
        await self.forget((port, six) for port in misled for six in {False, ipv6})

    async def _list_flows(self, ipv6: bool, *options: str) -> str:
        """The connections of IPv4 and maybe IPv6, as conntrack prints them. Raises ToolError."""
        families, transport = (False, True) if ipv6 else (False,), self.table.transport
        texts = [await self.tools.list_flows(transport, family, *options) for family in families]
        return "".join(texts)

    async def _read(self) -> TableState:
        listed = await self.tools.nft("-j", "list", "table", "inet", self.table.name)
        return self.table.read(listed)

    async def _forget(self, ipv6: bool, *options: str) -> None:
        try:
            await self.tools.forget_flows(self.table.transport, ipv6, *options)
        except ToolError as error:
            log.warning("connections can't be ended: %s", error)
