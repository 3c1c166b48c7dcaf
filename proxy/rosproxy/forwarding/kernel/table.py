"""The proxy's table in the kernel: read, changed in transactions, made anew, removed."""

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable

from rosproxy.forwarding.kernel.connection_table import ConnectionTable
from rosproxy.forwarding.kernel.conntrack import Survey
from rosproxy.forwarding.kernel.decisions import Changes, Forwards, changes
from rosproxy.forwarding.kernel.nft import Counters, NftError, Surroundings, Table, TableState
from rosproxy.forwarding.kernel.tools import ToolError, Tools

RESET_TIME = 0.3
"""Seconds for which connections are reset before the kernel forgets them."""

log = logging.getLogger(__name__)


class KernelTable:
    """What the kernel has, as far as is known: ``forwards``, and the ports that are ``counted``."""

    has_connections = False
    """Whether the kernel tracks what it forwards: answered, and ended by a reset."""
    weakness = ""
    """What the table lacks although it forwards, and what to do about that; mostly nothing."""

    def __init__(self, table: Table, tools: Tools) -> None:
        self.table = table
        self.tools = tools
        self.forwards: Forwards = {}
        self.counted: set[int] = set()
        self._surroundings = Surroundings()

    async def begin(self, surroundings: Callable[[Forwards], Surroundings]) -> None:
        """Make the table with what a former process left in it. Raises ToolError.

        ``surroundings`` tells those of forwards.
        """
        try:
            former = await self._read()
        except (ToolError, NftError) as error:
            log.debug("the kernel has no table of a former process: %s", error)
            former = TableState()
        self.counted = set(former.counters)
        await self.make(former.forwards, surroundings(former.forwards))

    async def make(self, wanted: Forwards, surroundings: Surroundings) -> None:
        """Put the whole table in place of the one that may be there. Raises ToolError."""
        self._surroundings = surroundings
        await self._apply(self.table.made(wanted, surroundings, self.counted), wanted)

    async def change(self, wanted: Forwards, surroundings: Surroundings) -> Changes:
        """Have it forward what is wanted, and tell what that changed. Raises ToolError."""
        change = changes(self.forwards, wanted)
        if change or surroundings != self._surroundings:
            self._surroundings = surroundings
            document = self.table.changed(change) + self.table.adapted(wanted, surroundings)
            await self._apply(document, wanted)
        return change

    async def look(self, ipv6: bool) -> tuple[Counters, Survey | None]:
        """Take in what the kernel really has: what was counted by port, and connections.

        Raises ToolError, NftError.
        """
        state = await self._read()
        self.forwards = state.forwards
        return state.counters, None

    async def forget(self, ports: Iterable[tuple[int, bool]], state: str = "") -> None:
        """Do nothing: a datagram has no connection."""

    async def cut(self, ports: Collection[tuple[int, bool]]) -> None:
        """Do nothing: a datagram has no connection."""

    async def remove(self) -> None:
        """Remove the table."""
        try:
            await self.tools.nft("-f", "-", document=self.table.removed())
        except ToolError as error:
            log.warning("table %s can't be removed: %s", self.table.name, error)
        self.forwards = {}

    async def _apply(self, document: str, forwards: Forwards) -> None:
        await self.tools.nft("-f", "-", document=document)
        self.forwards = dict(forwards)
        self.counted |= set(forwards)

    async def _read(self) -> TableState:
        listed = await self.tools.nft("-j", "list", "table", "inet", self.table.name)
        return self.table.read(listed)


class TrackedTable(KernelTable):
    """A table whose connections the kernel tracks."""

    has_connections = True

    def __init__(self, table: ConnectionTable, tools: Tools) -> None:
        super().__init__(table, tools)
        self._connections = table

    async def begin(self, surroundings: Callable[[Forwards], Surroundings]) -> None:
        """Make the table with what a former process left in it. Raises ToolError.

        Connections under way go on: the kernel has noted for each of them where it leads.
        """
        # Only to see, before anything is forwarded, whether conntrack can be run.
        await self._list_flows(lambda lines: None, False)
        self._connections.limits_new = True
        self.weakness = ""
        try:
            await super().begin(surroundings)
        except ToolError as error:
            self._connections.limits_new = False
            await super().begin(surroundings)
            self.weakness = (
                f"the kernel forwards new connections without a limit ({error}), so forged SYN "
                "packets can keep new subscribers out: load the module nft_limit on the host"
            )

    async def look(self, ipv6: bool) -> tuple[Counters, Survey | None]:
        """Take in what the kernel really has: what was counted by port, and connections.

        Raises ToolError, NftError.
        """
        counters, _ = await super().look(ipv6)
        survey = Survey(self._connections.marks)
        for family in (False, True) if ipv6 else (False,):
            await self._list_flows(survey.add, family)
        return counters, survey

    async def forget(self, ports: Iterable[tuple[int, bool]], state: str = "") -> None:
        """Forget connections through ports, each of IPv6 or not; those of one state if given."""
        state_options = ("--state", state) if state else ()
        for port, ipv6 in ports:
            selector = self._connections.marks.port_selector(port)
            await self._forget(ipv6, "--mark", selector, *state_options)

    async def cut(self, ports: Collection[tuple[int, bool]]) -> None:
        """End the connections through ports, each of IPv6 or not, so that both ends learn of it.

        Who connected gets a reset for what it sends next, even if that only confirms what came: a
        subscriber says nothing else, and some (rospy) try again only when they see their connection
        end. After that whoever sends gets one, since the kernel knows the connection no more.
        """
        numbers = {port for port, _ in ports}
        try:
            await self.tools.nft("-f", "-", document=self._connections.cut(numbers))
            await asyncio.sleep(RESET_TIME)
            await self.forget(ports)
            await self.tools.nft("-f", "-", document=self._connections.cut(numbers, "delete"))
        except ToolError as error:
            log.warning("the connections through the kernel can't be ended: %s", error)

    async def remove(self) -> None:
        """End what goes through the table, remove it, and forget all connections through it."""
        if self.forwards:
            try:
                await self.tools.nft("-f", "-", document=self._connections.ended())
                await asyncio.sleep(RESET_TIME)
            except ToolError as error:
                log.warning("the connections through the kernel can't be ended: %s", error)
        await super().remove()
        for ipv6 in (False, True):
            await self._forget(ipv6, "--mark", self._connections.marks.table_selector)

    async def _list_flows(self, take: Callable[[str], None], ipv6: bool) -> None:
        """Pass the table's connections to ``take``, as conntrack prints them. Raises ToolError."""
        selector = self._connections.marks.table_selector
        await self.tools.list_flows(take, ipv6, "--mark", selector)

    async def _forget(self, ipv6: bool, *options: str) -> None:
        try:
            await self.tools.forget_flows(ipv6, *options)
        except ToolError as error:
            log.warning("the connections through the kernel can't be ended: %s", error)
