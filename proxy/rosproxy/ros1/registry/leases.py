"""Leases: admitting nodes, opening and closing the ports that stand for them."""

import logging
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import replace

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.leases import fast_ports
from rosproxy.net.acceptor import Acceptor
from rosproxy.net.addresses import HostPort, is_loopback
from rosproxy.net.resolver import resolve
from rosproxy.ros1.clients.node import NodeClient
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry.endpoint import Endpoint, Place
from rosproxy.ros1.registry.health import ProbeResult
from rosproxy.ros1.registry.registry import RangeExhausted
from rosproxy.ros1.rewriting.addressing import Asker
from rosproxy.ros1.rewriting.master_api import Admission, Refusal, registering_uri

log = logging.getLogger(__name__)

RETIRED = "rosproxy: this proxy has been retired and registers nothing any more"
Connection = Callable[[Endpoint, socket.socket, str], Awaitable[None]]
"""Serves a connection to an endpoint's port; the last argument is the peer's address."""


class Leases:
    """Which node holds which port, and whether the port listens.

    ``on_close`` is told the ports that refuse from now on, ``on_short`` the endpoints that lost
    their fast port.
    """

    def __init__(
        self,
        context: Context,
        nodes: NodeClient,
        plane: KernelPlane,
        on_connection: Connection,
        on_close: Callable[[int], None],
        on_short: Callable[[Endpoint], None],
    ) -> None:
        self._context, self._nodes, self._plane = context, nodes, plane
        self._on_connection, self._on_close = on_connection, on_close
        self._on_short = on_short
        self._acceptors: dict[int, Acceptor] = {}

    async def admit(self, call: Call, asker: Asker) -> Admission:
        """The endpoint of a call that registers, or why there is none; None for other calls.

        The endpoint is marked as ``pending``, so that its lease does not end while the call is on
        its way; whoever admits takes the mark back.
        """
        admission = await self._admit(call, asker)
        if isinstance(admission, Endpoint):
            admission.pending += 1
        return admission

    async def _admit(self, call: Call, asker: Asker) -> Admission:
        uri = registering_uri(call)
        if uri is None:
            return None
        if self._context.retired:
            return Refusal(RETIRED)
        endpoint = self._context.registry.admitted(uri, asker.address)
        if endpoint is not None:
            self._welcome_back(endpoint, asker)
            return endpoint
        node = parse_slave_uri(uri)
        if node is None:
            return Refusal(
                f"rosproxy: caller_api {uri[:200]!r} is not of the form http://host:port/"
            )
        if self._context.addressing.handed_out(uri, asker):
            return None
        return await self._admit_new(uri, node, asker)

    def open(self, endpoint: Endpoint) -> None:
        """Let an endpoint's ports listen, if it still holds the lease."""
        if self._context.registry.by_port.get(endpoint.port) is not endpoint:
            return
        self._plane.wake(endpoint)
        if error := self._listen(endpoint, endpoint.port):
            text = f"port {endpoint.port} is taken: {error}"
            self._context.problems.add(endpoint.label, text, endpoint.port)
            log.error("port %d of %s can't be opened: %s", endpoint.port, endpoint.label, error)
        elif endpoint.fast_port is not None and self._listen(endpoint, endpoint.fast_port):
            fast_ports.give_back(self._context.registry, endpoint, blocked=True)

    def _listen(self, endpoint: Endpoint, port: int) -> OSError | None:
        """Let a port listen for an endpoint; the error if another program has it."""
        if port in self._acceptors:
            return None
        try:
            sock = self._context.bank.open(port)
        except OSError as error:
            return error
        self._acceptors[port] = Acceptor(
            self._context.tasks, sock, lambda conn, peer: self._on_connection(endpoint, conn, peer)
        )
        return None

    def close(self, endpoint: Endpoint) -> None:
        """Let an endpoint's ports refuse; the lease and open connections stay."""
        self._plane.wake(endpoint)
        for port in (endpoint.port, endpoint.fast_port):
            self._refuse(port)

    def _refuse(self, port: int | None) -> None:
        acceptor = self._acceptors.pop(port, None) if port is not None else None
        if acceptor is not None and port is not None:
            acceptor.stop()
            self._on_close(port)
            self._context.bank.close(port, acceptor.sock)

    async def cleared(self, endpoint: Endpoint) -> None:
        """Wait a moment until the kernel no longer forwards a new lease, which was a fast port."""
        await self._plane.cleared(endpoint.port)

    async def fast_port(self, endpoint: Endpoint, tcpros_port: int) -> int | None:
        """The port that the kernel forwards to a TCPROS port of an endpoint's node; None if none.

        It is handed out when a subscriber first asks for a topic, while the range has ports left.
        """
        if self._plane.may_forward(endpoint):
            if endpoint.fast_port is None and fast_ports.claim(self._context.registry, endpoint):
                self.open(endpoint)
            if endpoint.fast_port and await self._plane.forwards(endpoint, tcpros_port):
                return endpoint.fast_port
        self._plane.tell(endpoint)
        return None

    @asynccontextmanager
    async def lent(self, order: Iterable[int]) -> AsyncIterator[int | None]:
        """A port that no node needs meanwhile; None if there is none.

        It is the first in an order that is free, else a fast port: whose that was gets it again
        when a subscriber next asks.
        """
        pool = self._context.registry.pool
        port = next(filter(pool.claim, order), None) or self._claim_fast_port()
        try:
            if port is not None:
                await self._plane.cleared(port)
            yield port
        finally:
            if port is not None:
                pool.give_back(port)

    def end(self, endpoint: Endpoint) -> None:
        """End a lease: close its port and forget its endpoint."""
        registry = self._context.registry
        if registry.by_port.get(endpoint.port) is endpoint:
            self.close(endpoint)
            self._context.problems.solved_at(endpoint.port)
            fast_ports.give_back(registry, endpoint)
            registry.remove(endpoint)

    async def retry_blocked(self) -> None:
        """Take in ports of the range that other programs have let go."""
        pool = self._context.registry.pool
        before = pool.blocked_ports
        still = self._context.bank.reserve(before)
        for port in set(before) - set(still):
            pool.unblock(port)
            log.info("port %d of the range is free now", port)
        if before and not still:
            self._context.problems.solved("--port-range")

    def is_open(self, endpoint: Endpoint) -> bool:
        """Whether an endpoint's port listens."""
        return endpoint.port in self._acceptors

    async def _admit_new(self, uri: str, node: HostPort, asker: Asker) -> Admission:
        place = await self._place(node, asker.address)
        endpoint = self.take_in(uri, node, place, asker)
        if isinstance(endpoint, Endpoint):
            await self.cleared(endpoint)
            greeting = self._greet(endpoint, asker.caller_id)
            self._context.tasks.spawn(greeting, f"first probe of {uri}")
        return endpoint

    def take_in(self, uri: str, node: HostPort, place: Place, asker: Asker) -> Endpoint | Refusal:
        """The endpoint of a node found at a place, its port open; a refusal if none is left."""
        try:
            return self._lease(uri, node, place, asker.address)
        except RangeExhausted as error:
            self._context.metrics.exhausted.inc()
            self._context.problems.add(asker.caller_id, str(error))
            log.error("%s (%s) gets no port: %s", asker.caller_id, uri, error)
            return Refusal(str(error))

    def _welcome_back(self, endpoint: Endpoint, asker: Asker) -> None:
        """A node that registers is alive, whatever was believed of it."""
        place = endpoint.place
        if not place.confirmed and place.address == asker.address:
            endpoint.place, endpoint.trusted = replace(place, confirmed=True), True
        if endpoint.trusted:
            self.open(endpoint)
        known = endpoint.caller_ids
        if endpoint.health.down or (known and asker.caller_id not in known):
            endpoint.health.suspect()

    def _lease(self, uri: str, node: HostPort, place: Place, source: str) -> Endpoint:
        """A node's endpoint, its port open; ports that turn out to be taken are passed over."""
        registry = self._context.registry
        while True:
            endpoint = self._take(uri, node, place, source)
            self.open(endpoint)
            if self.is_open(endpoint) or endpoint.registrations:
                return endpoint
            registry.remove(endpoint)
            registry.pool.block(endpoint.port)
            self._context.problems.solved_at(endpoint.port)
            self._context.problems.add("--port-range", f"port {endpoint.port} is taken")

    def _take(self, uri: str, node: HostPort, place: Place, source: str) -> Endpoint:
        registry = self._context.registry
        while True:
            try:
                return registry.admit(uri, node, place, source)
            except RangeExhausted:
                if not self._make_room():
                    raise

    def _make_room(self) -> bool:
        """Take a port back that is needed least, if there is one: a fast port, or an idle lease."""
        if self._give_fast_port_back() is not None:
            return True
        oldest = self._context.registry.reclaimable()
        if oldest is not None:
            self.end(oldest)
        return oldest is not None

    def _claim_fast_port(self) -> int | None:
        port = self._give_fast_port_back()
        return port if port is not None and self._context.registry.pool.claim(port) else None

    def _give_fast_port_back(self) -> int | None:
        """Give back the fast port that is needed least, and tell which it was; None: none left."""
        registry = self._context.registry
        holder = fast_ports.to_give_back(registry)
        if holder is None:
            return None
        port = holder.fast_port
        self._refuse(port)
        log.info("%s: port %s is needed otherwise", holder.label, port)
        fast_ports.give_back(registry, holder)
        self._plane.wake(holder)
        self._on_short(holder)
        return port

    async def _place(self, node: HostPort, source: str) -> Place:
        """Where a node is that gives ``node`` as its address and registers from ``source``."""
        addresses = await resolve(self._context.upstream.reach(node).host)
        elsewhere = [address for address in addresses if not is_loopback(address)]
        if source in addresses or not elsewhere:
            return Place(source, named=source in addresses)
        if (await self._nodes.probe(HostPort(source, node.port))).pid is not None:
            return Place(source, named=False)
        for address in elsewhere:
            if (await self._nodes.probe(HostPort(address, node.port))).pid is not None:
                return Place(address, named=True, confirmed=False)
        return Place(source, named=False)

    async def _greet(self, endpoint: Endpoint, caller_id: str) -> None:
        """Look at once whether a new node can be reached, and say so if not."""
        answer = await self._nodes.probe(endpoint.slave)
        endpoint.health.note(answer.probe, self._context.now())
        endpoint.health.pid = answer.pid
        log.info("%s at %s is %s", caller_id, endpoint.uri, self._advertised(endpoint))
        if answer.probe is ProbeResult.ANSWERED and not _on_loopback(endpoint):
            return
        text = _unreachable_text(endpoint, answer.reason)
        self._context.problems.add(caller_id, text, endpoint.port)
        log.warning("%s: %s", caller_id, text)

    def _advertised(self, endpoint: Endpoint) -> str:
        return self._context.addressing.advertised_uri(endpoint)


def _on_loopback(endpoint: Endpoint) -> bool:
    """Whether a node of another machine gives a loopback address.

    Then roscpp, too, accepts TCPROS connections on loopback only, though its slave API answers
    (transport_tcp.cpp, isOnlyLocalhostAllowed).
    """
    return is_loopback(endpoint.node.host) and not is_loopback(endpoint.place.address)


def _unreachable_text(endpoint: Endpoint, reason: str) -> str:
    if _on_loopback(endpoint):
        return (
            f"gives its address as {endpoint.uri}, a loopback address, and listens only there: no "
            "other machine can reach it. Unset ROS_IP and ROS_HOSTNAME where it runs, or set "
            f"ROS_IP={endpoint.place.address}"
        )
    return (
        f"can't be reached by the proxy at {endpoint.slave} ({reason}). Check that it listens on "
        "that address and that no firewall or network policy is in between"
    )
