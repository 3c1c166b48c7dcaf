"""The proxy's table in the kernel: make, read, change in transactions, remove."""

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable

from rosproxy.forwarding.kernel.connection_table import ConnectionTable
from rosproxy.forwarding.kernel.conntrack import Survey
from rosproxy.forwarding.kernel.decisions import Changes, Forwards, changes
from rosproxy.forwarding.kernel.nft import Counters, NftError, Surroundings, Table, TableState
from rosproxy.forwarding.kernel.tools import ToolError, Tools

RESET_PERIOD_S = 0.3
"""Seconds for which the table resets connections before the kernel forgets these connections."""

log = logging.getLogger(__name__)


class KernelTable:
    """A table of the proxy in the kernel; this class itself has no connection tracking.

    ``forwards``: the table's forwards, as of the last change or read. ``counted``: ports whose
    traffic the table counts, also after the end of a forward. ``former``: the ports that `begin`
    has found in the table, with the host of the target; None if the forward had ended.
    """

    has_connections = False
    """Whether the kernel tracks connections: knows whether a node has answered, and resets."""
    weakness = ""
    """A fault of a table that still forwards, with advice; usually empty."""

    def __init__(self, table: Table, tools: Tools) -> None:
        self.table = table
        self.tools = tools
        self.forwards: Forwards = {}
        self.counted: set[int] = set()
        self.former: dict[int, str | None] = {}
        self._surroundings = Surroundings()

    async def begin(self, surroundings: Callable[[Forwards], Surroundings]) -> None:
        """Make the table, with the forwards that an earlier process left. Raises ToolError.

        ``surroundings`` returns the surroundings of forwards.
        """
        try:
            former = await self._read()
        except (ToolError, NftError) as error:
            log.debug("the kernel has no table of a former process: %s", error)
            former = TableState()
        self.counted = set(former.counters)
        self.former = dict.fromkeys(former.counters)
        self.former |= {port: target.host for port, target in former.forwards.items()}
        await self.make(former.forwards, surroundings(former.forwards))

    async def make(self, wanted: Forwards, surroundings: Surroundings) -> None:
        """Make the whole table, and replace an earlier table. Raises ToolError."""
        self._surroundings = surroundings
        await self._apply(self.table.made(wanted, surroundings, self.counted), wanted)

    async def change(self, wanted: Forwards, surroundings: Surroundings) -> Changes:
        """Change the table to the wanted forwards, and return the changes. Raises ToolError."""
        change = changes(self.forwards, wanted)
        if change or surroundings != self._surroundings:
            self._surroundings = surroundings
            document = self.table.changed(change) + self.table.adapted(wanted, surroundings)
            await self._apply(document, wanted)
        return change

    async def look(self, ipv6: bool) -> tuple[Counters, Survey | None]:
        """Read the table: update ``forwards``, and return the counters, without a survey.

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
        """Make the table, with the forwards that an earlier process left. Raises ToolError.

        Open connections continue: the kernel has the target of each tracked connection.
        """
        # A test before the first forward: raises ToolError if conntrack can't run.
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
        """Read the table: update ``forwards``, and return the counters and the connections.

        Raises ToolError, NftError.
        """
        counters, _ = await super().look(ipv6)
        survey = Survey(self._connections.marks)
        for family in (False, True) if ipv6 else (False,):
            await self._list_flows(survey.add, family)
        return counters, survey

    async def forget(self, ports: Iterable[tuple[int, bool]], state: str = "") -> None:
        """Have the kernel forget connections through ports.

        ``ports`` are pairs of a port and True for IPv6. ``state``: only connections in this state
        of conntrack, such as SYN_SENT.
        """
        state_options = ("--state", state) if state else ()
        for port, ipv6 in ports:
            selector = self._connections.marks.port_selector(port)
            await self._forget(ipv6, "--mark", selector, *state_options)

    async def cut(self, ports: Collection[tuple[int, bool]]) -> None:
        """End the connections through ports with resets.

        ``ports`` are pairs of a port and True for IPv6. For RESET_PERIOD_S, the next packet of the
        peer gets a reset. A mere acknowledgement is enough: a subscriber sends nothing else, and
        rospy connects again only after the end of its connection. Then the kernel forgets the
        connections, and a packet from either end gets a reset.
        """
        numbers = {port for port, _ in ports}
        try:
            await self.tools.nft("-f", "-", document=self._connections.cut(numbers))
            await asyncio.sleep(RESET_PERIOD_S)
            await self.forget(ports)
            await self.tools.nft("-f", "-", document=self._connections.cut(numbers, "delete"))
        except ToolError as error:
            log.warning("the connections through the kernel can't be ended: %s", error)

    async def remove(self) -> None:
        """Reset the connections through the table, remove the table, and forget the connections."""
        if self.forwards:
            try:
                await self.tools.nft("-f", "-", document=self._connections.ended())
                await asyncio.sleep(RESET_PERIOD_S)
            except ToolError as error:
                log.warning("the connections through the kernel can't be ended: %s", error)
        await super().remove()
        for ipv6 in (False, True):
            await self._forget(ipv6, "--mark", self._connections.marks.table_selector)

    async def _list_flows(self, take: Callable[[str], None], ipv6: bool) -> None:
        """Pass conntrack's list of the table's connections to ``take``. Raises ToolError."""
        selector = self._connections.marks.table_selector
        await self.tools.list_flows(take, ipv6, "--mark", selector)

    async def _forget(self, ipv6: bool, *options: str) -> None:
        try:
            await self.tools.forget_flows(ipv6, *options)
        except ToolError as error:
            log.warning("the connections through the kernel can't be ended: %s", error)
