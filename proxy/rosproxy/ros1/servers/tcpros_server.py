"""TCPROS through a lease: read the connection header, find the node's port, relay.

A client sends a connection header that names a topic or a service. The node behind the lease has a
separate TCPROS port. The node has named this port in a reply to ``requestTopic`` or in a service
URI, or the proxy asks for the port now. The proxy sends the header to this port, and then relays
the bytes.
"""

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from rosproxy.forwarding.relay import Relay
from rosproxy.forwarding.relay_set import OpenRelays
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.policy.denial import Denial
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.name_lengths import too_long_to_connect
from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header, encode_header, header_length
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.graph import ROSOUT
from rosproxy.shared.addresses import HostPort, is_loopback
from rosproxy.shared.connections import sockets
from rosproxy.shared.connections.budget import Charge, OverBudget
from rosproxy.telemetry.metrics import Traffic

log = logging.getLogger(__name__)

RATE_INTERVAL_S = 2.0
"""Seconds between two calls of `TcprosServer.sample_rates`."""
UNREGISTERED = "unregistered"
"""The name of a relay whose topic or service is not registered."""
NO_PORT = 0
"""In place of a TCPROS port: the node says that it does not have the topic or service."""


class NotOffered(Exception):
    """A node says that it does not have the topic or service that a client asks for.

    ``is_final``: the client may give up. A subscriber must not give up on a node that still starts
    at the URI of a former node: roscpp takes the master's update for the connection that it tries
    to open again, and would then have none (Subscription::pubUpdate in subscription.cpp, and
    TransportPublisherLink::onConnectionDropped in transport_publisher_link.cpp).
    """

    def __init__(self, text: str, is_final: bool) -> None:
        super().__init__(text)
        self.is_final = is_final


class TcprosTarget(Protocol):
    """The node that a connection to a port of the proxy leads to."""

    inside: bool
    """Whether the node is inside. Clients are on the other side."""

    @property
    def port(self) -> int:
        """The port of the proxy."""

    def check(self, kind: str, name: str, peer: str, caller_id: str) -> Denial | None:
        """Check whether a client may have a topic or service."""

    async def connect(self, kind: str, name: str) -> socket.socket | None:
        """Connect to the node's TCPROS server; None if there is none. Raises NotOffered."""

    def label(self, kind: str, name: str) -> str:
        """The name of a topic or service in status and metrics.

        Only known names count, because clients may send any name.
        """

    def note_connection(self) -> None:
        """Record that a relay for the node has started."""

    def note_disconnection(self) -> None:
        """Record that a relay for the node has ended."""

    def note_failure(self, name: str) -> None:
        """Record that there was no connection for a topic or service."""


class TcprosServer:
    """Relays TCPROS connections to nodes."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._may_splice = context.settings.data_plane != "copy"
        self.relays = OpenRelays()
        self._ended = Traffic()

    def topic_connections(self) -> set[tuple[int, str, str]]:
        """The open connections of topics: port, topic and the subscriber's name."""
        return {(r.port, r.name, r.caller_id) for r in self.relays if r.kind == "topic"}

    def traffic(self) -> Traffic:
        """Bytes by topic and service, of ended and open connections."""
        total = Traffic()
        total.sent = dict(self._ended.sent)
        total.received = dict(self._ended.received)
        for relay in self.relays:
            total.add(relay.kind, relay.name, relay.sent, relay.received)
        return total

    async def sample_rates(self) -> None:
        """Compute the rates of all connections since the last call."""
        now = self._context.now()
        for relay in self.relays:
            relay.sample(now)

    async def serve(self, target: TcprosTarget, peer: str, conn: socket.socket) -> None:
        """Relay a connection whose first bytes are a TCPROS header. Close it on failure.

        Raises EOFError, TimeoutError, OSError; the caller then closes the connection.
        """
        try:
            header = await read_header(self._context, peer, conn)
            kind, name, caller_id = _requested(decode_header(header[4:]))
        except HeaderError as error:
            await self._refuse(conn, str(error), "bad header")
            return
        version = self._context.policy.rules.version
        if denial := target.check(kind, name, peer, caller_id):
            await self._refuse(conn, denial.reason, "denied")
            return
        node = await self._connect(target, kind, name, conn)
        if node is None:
            return
        if not await hand_on(header, node):
            self._fail(target, conn, name)
            return
        # The policy may have changed during the calls to the node. After a reset the client
        # connects again, and then gets the reason.
        changed = self._context.policy.rules.version != version
        if changed and target.check(kind, name, peer, caller_id):
            node.close()
            self._fail(target, conn, name)
            return
        outside, inside = (conn, node) if target.inside else (node, conn)
        relay = Relay(
            target.port, kind, target.label(kind, name), caller_id, peer, outside, inside,
            splice=self._may_splice, inside_asks=not target.inside,
            client_is_silent=kind == "topic",
        )  # fmt: skip
        target.note_connection()
        self._context.gate.enter(peer, target.port)  # the acceptor counts until `serve` ends
        self.relays.start(relay, lambda ended: self._finished(target, ended))

    async def _connect(
        self, target: TcprosTarget, kind: str, name: str, conn: socket.socket
    ) -> socket.socket | None:
        """Connect to the target; None after the client was refused, reset or gone."""
        # A subscriber that hears of a publisher twice keeps the later connection. A publisher of
        # rospy keeps the connection with the later header. So a header on an ended connection
        # would leave no connection at all.
        if kind == "topic" and sockets.has_ended(conn):
            conn.close()
            return None
        try:
            node = await target.connect(kind, name)
        except NotOffered as error:  # roscpp gives up; after a reset it does not
            if error.is_final:
                await self._refuse(conn, str(error), "not offered")
            else:
                self._reset(conn, "not offered")
            return None
        if node is None:
            self._fail(target, conn, name)
        elif kind == "topic" and sockets.has_ended(conn):
            conn.close()
            await self._context.nodes.close_after_header(node, name)
            return None
        return node

    def cut(self, port: int) -> None:
        """End the connections through a port."""
        for relay in self.relays:
            if relay.port == port:
                relay.end()

    async def _refuse(self, conn: socket.socket, text: str, reason: str) -> None:
        """Send the reason in a header, as the servers of ROS do, and close."""
        reply = encode_header({"error": f"rosproxy: {text}"})
        await asyncio.get_running_loop().sock_sendall(conn, reply)
        conn.close()
        self._context.metrics.relay_errors.labels(reason).inc()

    def _finished(self, target: TcprosTarget, relay: Relay) -> None:
        target.note_disconnection()
        self._context.gate.leave(relay.peer, relay.port)
        self._ended.add(relay.kind, relay.name, relay.sent, relay.received)

    def _fail(self, target: TcprosTarget, conn: socket.socket, name: str) -> None:
        self._reset(conn, "node unreachable")
        target.note_failure(name)

    def _reset(self, conn: socket.socket, reason: str) -> None:
        """Reset the connection, like a node that is gone: roscpp and rospy then try again."""
        self._context.metrics.relay_errors.labels(reason).inc()
        sockets.reset_on_close(conn)
        conn.close()


class InsideNodes:
    """Makes targets of the nodes inside.

    A connection leads to a port on the endpoint's own address, which the node itself has named. The
    proxy never uses the host in a reply or registration. So no reply leads to another host inside.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._port_tasks: dict[tuple[Endpoint, str, str], asyncio.Task[int | None]] = {}

    def target(self, endpoint: Endpoint) -> "InsideNode":
        """The target of connections to an endpoint's ports."""
        return InsideNode(self._context, endpoint, self._learn_port)

    async def _learn_port(self, endpoint: Endpoint, kind: str, name: str) -> int | None:
        """Ask the node for the TCPROS port of a topic or service, once for all waiting callers.

        Returns NO_PORT if the node does not have the topic or service, None without an answer.
        """
        key = endpoint, kind, name
        task = self._port_tasks.get(key)
        if task is None:
            ask = self._ask_service_port if kind == "service" else self._ask_topic_port
            task = self._context.tasks.spawn(ask(endpoint, name), f"TCPROS port of {name}")
            self._port_tasks[key] = task
            task.add_done_callback(lambda _: self._port_tasks.pop(key))
        return await asyncio.shield(task)  # other callers go on waiting if one is cancelled

    async def _ask_topic_port(self, endpoint: Endpoint, topic: str) -> int | None:
        """The port that the node names for a topic, or NO_PORT; None without an answer."""
        port: int | None = None
        try:
            port = await self._context.nodes.topic_port(endpoint.slave, topic) or NO_PORT
        except MasterError as error:
            log.debug("%s does not publish topic %s: %s", endpoint.label, topic, error)
            port = NO_PORT
        except Unreachable as error:
            log.debug("%s gives no TCPROS port for topic %s: %s", endpoint.label, topic, error)
        endpoint.note_topic_port(topic, port or None)
        return port

    async def _ask_service_port(self, endpoint: Endpoint, service: str) -> int | None:
        """The port where the node answers for a service, or NO_PORT; None if no port answers.

        Nodes do not tell the ports of services. In rospy and roscpp topics and services share a
        port.
        """
        ports = [*endpoint.node_ports, *endpoint.service_ports]
        if not ports:
            topic = next(iter(endpoint.names(Kind.PUBLISHER)), ROSOUT)
            port = await self._learn_port(endpoint, "topic", topic)
            ports = [port] if port else []
        for port in dict.fromkeys(ports):
            server = HostPort(endpoint.address, port)
            if await self._context.nodes.provider(server, service) in endpoint.callers:
                self._context.registry.note_service_port(endpoint, service, port)
                return port
        # A registered service may answer next time. The client is reset, and connects again.
        return None if service in endpoint.names(Kind.SERVICE) else NO_PORT


@dataclass(slots=True)
class InsideNode:
    """A node inside as the target of clients outside."""

    _context: Context
    _endpoint: Endpoint
    _learn_port: Callable[[Endpoint, str, str], Awaitable[int | None]]
    inside: bool = True

    @property
    def port(self) -> int:
        """The lease."""
        return self._endpoint.port

    def check(self, kind: str, name: str, peer: str, caller_id: str) -> Denial | None:
        """Check whether outside may have a topic or service."""
        # Without the caller_id: publishers use the topic of a header unchanged (rospy's
        # tcpros_pubsub.py, topic_connection_handler; roscpp's transport_subscriber_link.cpp).
        return self._context.policy.check_outside(kind, name, self._endpoint, peer)

    async def connect(self, kind: str, name: str) -> socket.socket | None:
        """Connect to the node; ask the node for an unknown port, or if the known port refuses.

        The method never tries a port of another topic or service: a node may have one port for
        each.
        """
        endpoint = self._endpoint
        if kind == "topic":
            port = endpoint.topic_ports.get(name)
        elif endpoint.location.confirmed:
            port = self._context.registry.service_port(endpoint, name)
        else:
            port = None  # the source hides several nodes: the node itself has to name the port
        node = await _dial(endpoint.address, port)
        if node is not None:
            return node
        port = await self._learn_port(endpoint, kind, name)
        if port == NO_PORT:
            text = f"{endpoint.label} has no {kind} {name or '(no name given)'}"
            is_starting = endpoint.is_starting(self._context.now())
            raise NotOffered(text, is_final=kind != "topic" or not is_starting)
        return await _dial(endpoint.address, port)

    def label(self, kind: str, name: str) -> str:
        """The topic or service if the node has registered it."""
        wanted_kind = Kind.SERVICE if kind == "service" else Kind.PUBLISHER
        return name if name in self._endpoint.names(wanted_kind) else UNREGISTERED

    def note_connection(self) -> None:
        """Record that a relay for the node has started."""
        self._endpoint.connections += 1
        self._endpoint.idle_since = None

    def note_disconnection(self) -> None:
        """Record that a relay for the node has ended."""
        self._endpoint.connections -= 1

    def note_failure(self, name: str) -> None:
        """Report a registered node whose TCPROS server is unreachable."""
        endpoint = self._endpoint
        if not endpoint.registrations or endpoint.health.has_ended:
            return
        text = f"no TCPROS connection to the node for {name or '?'}"
        if is_loopback(endpoint.node.host):
            text += (
                f". The node listens on loopback only ({endpoint.uri}). Unset ROS_IP and "
                f"ROS_HOSTNAME where the node runs, or set ROS_IP={endpoint.location.address}"
            )
        log.warning("%s: %s", endpoint.label, text)
        self._context.problems.add(endpoint.label, text, endpoint.port)


def _requested(fields: Mapping[str, str]) -> tuple[str, str, str]:
    """The kind and name that a header asks for, and the caller_id. Raises HeaderError."""
    if too_long := too_long_to_connect(fields):
        raise HeaderError(too_long)
    # rospy and roscpp would serve the topic (tcpros_base.py, _tcp_server_callback;
    # connection_manager.cpp, onConnectionHeaderReceived), but the policy would check the service.
    if "service" in fields and "topic" in fields:
        raise HeaderError("the connection header names both a topic and a service")
    kind = "service" if "service" in fields else "topic"
    return kind, fields.get(kind, ""), fields.get("callerid", "")


async def read_header(context: Context, peer: str, conn: socket.socket) -> bytes:
    """Read a connection header from a socket: four bytes of length, and the body.

    Raises HeaderError if the header is too long, EOFError, TimeoutError, OSError.
    """
    charge = Charge(context.buffered, peer)
    with context.gate.waiting(peer, partial(sockets.hang_up, conn)), charge:
        async with asyncio.timeout(sockets.SILENCE_TIMEOUT_S):
            first = await sockets.read_exactly(conn, 4)
            size = header_length(first)
            try:
                charge.add(size)
            except OverBudget as error:
                context.refusals.note("over_budget", peer, str(error))
                raise HeaderError(str(error)) from None
            return first + await sockets.read_exactly(conn, size)


async def _dial(address: str, port: int | None) -> socket.socket | None:
    try:
        return await sockets.dial(HostPort(address, port)) if port else None
    except (OSError, TimeoutError) as error:
        log.debug("no connection to %s:%s: %s", address, port, error)
        return None


async def hand_on(header: bytes, node: socket.socket) -> bool:
    """Send a node the header of a client; return whether that worked.

    If that fails, the connection to the node is closed.
    """
    try:
        async with asyncio.timeout(sockets.CONNECT_TIMEOUT_S):
            await asyncio.get_running_loop().sock_sendall(node, header)
    except BaseException as error:
        node.close()
        if not isinstance(error, OSError):  # a TimeoutError is an OSError
            raise
        log.debug("the TCPROS header could not be sent to the node: %s", error)
        return False
    return True
