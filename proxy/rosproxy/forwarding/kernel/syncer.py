"""Keeps the forwards of the kernel in step with the endpoints.

Level-triggered: `ForwardSyncer.note_change` only says that an endpoint may have changed. A single
worker (`run_once`) compares the wanted forwards with the forwards of the kernel, and applies the
difference in a transaction. Every few seconds the worker compares all endpoints, in between only
the changed endpoints. Otherwise a thousand endpoints, each new in turn, would take a million steps.

`decisions` decides the target of an endpoint. This module keeps the input: what this network
namespace forwards, the routes to nodes, recent failures, and the reason against all forwards
(``why_not``). Only three events set ``why_not``: `begin`, a failure to make the table again, and
the start or stop of `plane`.
"""

import asyncio
import contextlib
import itertools
import logging
from collections.abc import Callable, Collection

from rosproxy.forwarding import fast_ports
from rosproxy.forwarding.fast_ports import LeaseHolder, LeaseHolders
from rosproxy.forwarding.kernel import decisions
from rosproxy.forwarding.kernel.accounting import KernelAccounts
from rosproxy.forwarding.kernel.conntrack import Survey
from rosproxy.forwarding.kernel.decisions import Changes, Forwards, HostForwarding
from rosproxy.forwarding.kernel.nft import Counters, Near, NftError, Surroundings
from rosproxy.forwarding.kernel.preflight import read_forwarding
from rosproxy.forwarding.kernel.table import KernelTable
from rosproxy.forwarding.kernel.tools import ToolError
from rosproxy.shared.addresses import HostPort, Route, is_loopback
from rosproxy.shared.machine.interfaces import route_towards
from rosproxy.shared.output.problems import Problems

log = logging.getLogger(__name__)

Clock = Callable[[], float]
"""Seconds of the monotonic clock."""
IsDenied = Callable[[int, str | None], bool]
"""Whether a port may lead to a denied topic. Gets the port and the host of its target, or None."""
SUBJECT = "data plane"
LOST_TABLE_RETRY_S = 30.0
"""Seconds between attempts to make a lost table again."""

FORWARD_TIMEOUT_S = 1.0
"""Most seconds for which the requestTopic of a subscriber waits for the forward."""
DATAGRAM_PAUSE_S = 0.1
"""Seconds after a comparison of all ports for datagrams in which no further comparison begins. A
participant may change its ports with each announcement. Meanwhile user space passes the datagrams
at a new port, and the kernel still forwards a port that has changed to the former locator."""
MOST_LINES = 200
"""Changed forwards that the log names in `LINES_PERIOD_S`. A node may change its ports again and
again."""
LINES_PERIOD_S = 60.0
"""Seconds after which the log names changed forwards again."""
ROUTE_AGE_S = 60.0
"""Seconds after which the routes to nodes are read again."""


class ForwardSyncer:
    """The only worker that changes and reads the kernel's table.

    ``why_not``: the reason against all forwards; None if the kernel may forward. ``recovered`` is
    False until the registry is rebuilt: until then the forwards of an earlier process stay.
    ``near`` returns the networks that may use the forwards to outside. ``traffic``: what the table
    forwards (topics or datagrams), for messages. ``subject`` is the subject of problems.
    """

    def __init__(
        self,
        endpoints: LeaseHolders[LeaseHolder],
        table: KernelTable,
        accounts: KernelAccounts,
        problems: Problems,
        clock: Clock,
        near: Callable[[], Near],
    ) -> None:
        self._endpoints = endpoints
        self._table = table
        self._accounts = accounts
        self._problems = problems
        self._clock = clock
        self._near = near
        self._lock = asyncio.Lock()
        self._wake = asyncio.Event()
        self._synced = asyncio.Event()
        self._changed: set[LeaseHolder] = set()
        self._denied: set[int] = set()
        """Ports whose forwards, from before the start, have to end."""
        self._all_changed = True
        self._host = HostForwarding()
        self._pauses = decisions.Pauses()
        self._routes: dict[str, Route] = {}
        # inf: only a lost table is made again, not a table that failed at the start.
        self._retry_at = float("inf")
        self._routes_until = 0.0
        self._logged: dict[LeaseHolder, str] = {}
        self._lines = self._unnamed = 0
        """The changed forwards since `_lines_since` with a line in the log, and without."""
        self._lines_since = clock()
        self.traffic = "topics" if table.has_connections else "datagrams"
        self.subject = SUBJECT if table.has_connections else f"{SUBJECT} for UDP"
        self.why_not: str | None = "the proxy has not started yet"
        self.recovered = False

    @property
    def usable(self) -> bool:
        """Whether the kernel may forward."""
        return self.why_not is None

    async def begin(self) -> None:
        """Make the table, and set ``why_not`` to the reason of a failure, or to None."""
        async with self._lock:
            try:
                await self._table.begin(self._surroundings)
            except ToolError as error:
                self.why_not = str(error)
            else:
                self.why_not = None

    async def regain(self) -> bool:
        """Make a lost table again, once LOST_TABLE_RETRY_S have passed; return True on success."""
        if self._clock() < self._retry_at:
            return False
        await self.begin()
        self._retry_at = float("inf") if self.usable else self._clock() + LOST_TABLE_RETRY_S
        return self.usable

    def look_around(self) -> None:
        """Read what this network namespace forwards, and drop old routes and ended endpoints.

        Also log how many changed forwards had no line of their own.
        """
        self._begin_lines_period()
        endpoints = set(self._endpoints)
        self._logged = {e: why for e, why in self._logged.items() if e in endpoints}
        self._host = read_forwarding()
        if self._clock() > self._routes_until:
            self._routes = {}
            self._routes_until = self._clock() + ROUTE_AGE_S

    def note_change(self, endpoint: LeaseHolder | None = None) -> None:
        """Note that an endpoint may have changed; None: any number of endpoints."""
        if endpoint is None or not self.usable:
            self._all_changed = True
        elif endpoint.fast_port is None and not self._accounts.owns(endpoint):
            return  # no forward exists, and none is possible
        else:
            self._changed.add(endpoint)
        self._wake.set()

    async def run_once(self) -> None:
        """Wait for a change, and bring the kernel's forwards up to date."""
        await self._wake.wait()
        await self._sync()
        if not self._table.has_connections:
            await asyncio.sleep(DATAGRAM_PAUSE_S)

    def may_forward(self, endpoint: LeaseHolder) -> bool:
        """Whether the kernel could forward the topics of an endpoint through a fast port."""
        return isinstance(self._target(endpoint), HostPort)

    def reason(self, endpoint: LeaseHolder) -> str:
        """The reason why the kernel does not forward for an endpoint; empty if the kernel does."""
        target = self._target(endpoint)
        if isinstance(target, str):
            return target
        if endpoint.fast_port is None:
            return fast_ports.why_no_fast_port(self._endpoints.pool, endpoint)
        is_forwarded = self._table.forwards.get(endpoint.fast_port) == target
        return "" if is_forwarded else "the kernel's table is being updated"

    def log_reason(self, endpoint: LeaseHolder) -> None:
        """Log why the kernel does not forward for an endpoint; a reason is logged once in a row.

        Log nothing if the kernel forwards, or if ``why_not`` is against all forwards.
        """
        why = self.reason(endpoint)
        if why and self.usable and self._logged.get(endpoint) != why:
            self._logged[endpoint] = why
            log.info("%s: the proxy forwards the topics, not the kernel: %s", endpoint.label, why)

    async def forwards(self, endpoint: LeaseHolder, node_port: int) -> bool:
        """Whether the fast port of an endpoint leads to a TCPROS port of the node.

        Waits for the forward for FORWARD_TIMEOUT_S at most.
        """

        def leads() -> bool:
            target = HostPort(endpoint.address, node_port)
            port = endpoint.fast_port
            return self.usable and port is not None and self._table.forwards.get(port) == target

        if not leads():
            self.note_change(endpoint)
            await self._wait_until(lambda: leads() or not self.may_forward(endpoint))
        return leads()

    async def wait_until_unforwarded(self, port: int) -> None:
        """Wait until the kernel no longer forwards a port, for FORWARD_TIMEOUT_S at most."""
        await self._wait_until(lambda: not self.usable or port not in self._table.forwards)

    async def read_kernel(self) -> tuple[Counters, Survey | None] | None:
        """Read the kernel's counters and connections; None if the table had to be made again.

        Without connection tracking, the survey of the connections is None.
        """
        async with self._lock:
            self._accounts.note_owners(self._endpoints)
            ipv6 = any(":" in endpoint.address for endpoint in self._accounts.owners.values())
            try:
                return await self._table.look(ipv6)
            except (ToolError, NftError) as error:
                log.warning("%s; making the table again", error)
                self._all_changed = True
                await self._make(self._wanted())
        return None

    async def take_back(self, ports: Collection[int]) -> None:
        """Let user space serve the connections through ports whose node does not answer."""
        for port in ports:
            target = self._table.forwards.get(port)
            if target is not None:
                why = f"the node at {target} did not answer through the kernel"
                self._pauses.note(port, target, why, self._clock())
        if ports:
            self._all_changed = True
            await self._sync()
            # Only unanswered connections: the others continue through the kernel.
            families = itertools.product(ports, (False, True))
            await self._table.forget(families, "SYN_SENT")

    async def cut_former(self, is_denied: IsDenied) -> None:
        """End forwards and connections from before the start, as far as ``is_denied`` says.

        If a port has an owner, the owner's topics are known, and the port stays (`cut`).
        """
        self._accounts.note_owners(self._endpoints)
        former = self._table.former
        unowned = former.keys() - self._accounts.owners.keys()
        denied = {port for port in unowned if is_denied(port, former[port])}
        if denied:
            for port in denied:
                del former[port]
            self._denied |= denied
            self._all_changed = True
            await self.cut([*itertools.product(sorted(denied), (False, True))])

    async def cut(self, ports: Collection[tuple[int, bool]]) -> None:
        """End the connections through ports, which are pairs of a port and True for IPv6."""
        # Before the cut: an old forward would take new connections of the same peers.
        await self._sync()
        await self._table.cut(ports)

    def _target(self, endpoint: LeaseHolder) -> HostPort | str:
        """The target for the fast port of an endpoint, or the reason against a forward."""
        if self.why_not is not None:
            return self.why_not
        route = self._route(endpoint.address)
        has_connections = self._table.has_connections
        target = decisions.destination(endpoint, self._host, route, has_connections)
        if isinstance(target, str) or endpoint.fast_port is None:
            return target
        return self._pauses.reason(endpoint.fast_port, target, self._clock()) or target

    def _route(self, address: str) -> Route:
        route = self._routes.get(address) or route_towards(address)
        # Without a route, look again: the proxy may join the network of a node later.
        if not is_loopback(route.source):
            self._routes[address] = route
        return route

    def _surroundings(self, forwards: Forwards) -> Surroundings:
        hosts = {target.host for target in forwards.values()}
        return Surroundings(self._near(), {host: self._route(host).source for host in hosts})

    async def _wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait until the worker has made a condition true, for FORWARD_TIMEOUT_S at most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FORWARD_TIMEOUT_S):
                while not condition():
                    await self._synced.wait()

    async def _sync(self) -> None:
        async with self._lock:
            self._wake.clear()
            self._accounts.note_owners(self._endpoints)
            self._pauses.keep(self._accounts.owners)
            if self.usable:
                await self._change()
            # Each round has a new event, which wakes all waiting tasks once.
            synced = self._synced
            self._synced = asyncio.Event()
            synced.set()

    async def _change(self) -> None:
        wanted = self._wanted()
        try:
            self._log(await self._table.change(wanted, self._surroundings(wanted)))
        except ToolError as error:
            log.warning("%s; making the table again", error)
            await self._make(wanted)

    async def _make(self, wanted: dict[int, HostPort]) -> None:
        try:
            await self._table.make(wanted, self._surroundings(wanted))
        except ToolError as error:
            self._all_changed = True
            self.why_not = str(error)
            self._retry_at = self._clock() + LOST_TABLE_RETRY_S
            self._accounts.note_peers({})
            text = f"the kernel no longer forwards {self.traffic}: {error}"
            log.error("%s", text)
            self._problems.add(self.subject, text, holds=True)  # until the table is regained

    def _wanted(self) -> dict[int, HostPort]:
        denied = self._denied
        self._denied = set()
        current = {p: t for p, t in self._table.forwards.items() if p not in denied}
        changed = self._changed
        self._changed = set()
        if self._all_changed or not self.recovered:
            self._all_changed = False
            changed = set(self._endpoints)
            wanted = decisions.forwards_to_keep(current, changed, self.recovered)
        else:
            wanted = decisions.unchanged_forwards(current, self._accounts.owners, changed)
        by_port = self._endpoints.by_port
        for endpoint in changed:
            if endpoint.fast_port and by_port.get(endpoint.port) is endpoint:
                target = self._target(endpoint)
                if isinstance(target, HostPort):
                    wanted[endpoint.fast_port] = target
        return wanted

    def _begin_lines_period(self) -> None:
        """After LINES_PERIOD_S, log how many changes had no line of their own, and begin anew."""
        if self._clock() - self._lines_since < LINES_PERIOD_S:
            return
        if self._unnamed:
            text = "%d more forwards of %s have changed; the log names %d in %d s"
            log.info(text, self._unnamed, self.traffic, MOST_LINES, LINES_PERIOD_S)
        self._lines = self._unnamed = 0
        self._lines_since = self._clock()

    def _log(self, change: Changes) -> None:
        self._begin_lines_period()
        changed = [*{**change.removed, **change.added}]
        logged = changed[: MOST_LINES - self._lines]
        self._lines += len(logged)
        self._unnamed += len(changed) - len(logged)
        for port in logged:
            endpoint = self._accounts.owners.get(port)
            target = change.added.get(port)
            name = endpoint.label if endpoint else "a node that has ended"
            if target:
                log.info("%s: the kernel forwards port %d to %s", name, port, target)
            else:
                why = self.reason(endpoint) if endpoint else "the endpoint has ended"
                log.info("%s: the kernel no longer forwards port %d: %s", name, port, why)
