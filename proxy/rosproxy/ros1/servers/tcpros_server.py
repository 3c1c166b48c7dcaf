"""TCPROS through a lease: read the connection header, find the node's port, relay.

A client sends a connection header that names a topic or a service. The node behind the lease has a
TCPROS port of its own, which it has named itself (in a reply to ``requestTopic``, in a service URI)
or is asked for now. The header is sent on to that port, and the bytes are relayed from then on.
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
from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort, is_loopback
from rosproxy.net.budget import Charge, OverBudget
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.policy.denial import Denial
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.name_lengths import too_long_to_connect
from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header, encode_header, header_length
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.graph import ROSOUT
from rosproxy.telemetry.metrics import Traffic

log = logging.getLogger(__name__)

RATE_INTERVAL = 2.0
UNREGISTERED = "unregistered"
"""What a relay's topic or service is called that its node has not registered."""
NO_PORT = 0
"""In place of a TCPROS port: the node says that it does not have the topic or service."""


class NotOffered(Exception):
    """A node says that it does not have the topic or service that somebody connects for."""


class TcprosTarget(Protocol):
    """The node that a connection to one of the proxy's ports leads to."""

    inside: bool
    """Whether it is inside; who connects is then outside, and the other way round."""

    @property
    def port(self) -> int:
        """The proxy's port."""

    def check(self, kind: str, name: str, peer: str, caller_id: str) -> Denial | None:
        """Check whether a client may have a topic or service."""

    async def connect(self, kind: str, name: str) -> socket.socket | None:
        """A connection to the node's TCPROS server; None if there is none. Raises NotOffered."""

    def label(self, kind: str, name: str) -> str:
        """What a topic or service is called in status and metrics: whoever connects names it."""

    def note_connection(self) -> None:
        """Note that a connection is relayed."""

    def note_disconnection(self) -> None:
        """Note that one is relayed no more."""

    def note_failure(self, name: str) -> None:
        """Note that there was no connection for a topic or service."""


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
        """Compute the rates of all connections since the last time."""
        now = self._context.now()
        for relay in self.relays:
            relay.sample(now)

    async def serve(self, target: TcprosTarget, peer: str, conn: socket.socket) -> None:
        """Relay a connection whose first bytes are a TCPROS header. Closes it on failure."""
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
        # While the node was asked and connected to, the policy may have changed. After a reset the
        # client comes again, and is then told why it is refused.
        changed = self._context.policy.rules.version != version
        if changed and target.check(kind, name, peer, caller_id):
            node.close()
            self._fail(target, conn, name)
            return
        outside, inside = (conn, node) if target.inside else (node, conn)
        relay = Relay(
            target.port, kind, target.label(kind, name), caller_id, peer, outside, inside,
            splice=self._may_splice, inside_asks=not target.inside, client_listens=kind == "topic",
        )  # fmt: skip
        target.note_connection()
        self._context.gate.enter(peer, target.port)  # the acceptor counts it until `serve` ends
        self.relays.start(relay, lambda ended: self._finished(target, ended))

    async def _connect(
        self, target: TcprosTarget, kind: str, name: str, conn: socket.socket
    ) -> socket.socket | None:
        """A connection to the target; None if the client gets none, which it has been shown."""
        # A subscriber that is told of a publisher twice keeps the later connection, and rospy's
        # publishers the one whose header comes last: were the former one handed on, none was left.
        if kind == "topic" and sockets.has_ended(conn):
            conn.close()
            return None
        try:
            node = await target.connect(kind, name)
        except NotOffered as error:  # roscpp tries for ever after a reset, and gives up after this
            await self._refuse(conn, str(error), "not offered")
            return None
        if node is None:
            self._fail(target, conn, name)
        elif kind == "topic" and sockets.has_ended(conn):
            conn.close()
            await self._context.nodes.take_leave(node, name)
            return None
        return node

    def cut(self, port: int) -> None:
        """End the connections through a port."""
        for relay in self.relays:
            if relay.port == port:
                relay.end()

    async def _refuse(self, conn: socket.socket, text: str, reason: str) -> None:
        """Say why in a header, as ROS's servers do, and close."""
        reply = encode_header({"error": f"rosproxy: {text}"})
        await asyncio.get_running_loop().sock_sendall(conn, reply)
        conn.close()
        self._context.metrics.relay_errors.labels(reason).inc()

    def _finished(self, target: TcprosTarget, relay: Relay) -> None:
        target.note_disconnection()
        self._context.gate.leave(relay.peer, relay.port)
        self._ended.add(relay.kind, relay.name, relay.sent, relay.received)

    def _fail(self, target: TcprosTarget, conn: socket.socket, name: str) -> None:
        """Reset, as a node that is gone would: roscpp and rospy try again."""
        self._context.metrics.relay_errors.labels("node unreachable").inc()
        sockets.reset_on_close(conn)
        conn.close()
        target.note_failure(name)


class InsideNodes:
    """The nodes inside as targets.

    A connection leads to a port on the endpoint's own address, as that node itself named it; the
    host in a reply or registration is never used, so none can lead to another inside host.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._port_tasks: dict[tuple[Endpoint, str, str], asyncio.Task[int | None]] = {}

    def target(self, endpoint: Endpoint) -> "InsideNode":
        """What connections to an endpoint's ports lead to."""
        return InsideNode(self._context, endpoint, self._learn_port)

    async def _learn_port(self, endpoint: Endpoint, kind: str, name: str) -> int | None:
        """The TCPROS port of a topic or service now; the node is asked once for all who wait."""
        key = endpoint, kind, name
        task = self._port_tasks.get(key)
        if task is None:
            ask = self._ask_service_port if kind == "service" else self._ask_topic_port
            task = self._context.tasks.spawn(ask(endpoint, name), f"TCPROS port of {name}")
            self._port_tasks[key] = task
            task.add_done_callback(lambda _: self._port_tasks.pop(key))
        return await asyncio.shield(task)  # the others wait on if one of the callers goes away

    async def _ask_topic_port(self, endpoint: Endpoint, topic: str) -> int | None:
        """The port that the node names for a topic, or NO_PORT; None if it can't be asked."""
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
        """The port at which the node answers for a service, or NO_PORT; None if none answers.

        No node can be asked where its services are. In rospy and roscpp it is where its topics are.
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
        # A registered service may answer next time: its client is reset, and comes again.
        return None if service in endpoint.names(Kind.SERVICE) else NO_PORT


@dataclass(slots=True)
class InsideNode:
    """A node inside as a target, for those who connect from outside."""

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
        # Without the caller_id: publishers take the topic of a header as it stands (rospy's
        # tcpros_pubsub.py, topic_connection_handler; roscpp's transport_subscriber_link.cpp).
        return self._context.policy.check_outside(kind, name, self._endpoint, peer)

    async def connect(self, kind: str, name: str) -> socket.socket | None:
        """A connection to the node; a port that is not known or refuses is asked for.

        A port of another topic or service is never tried: nodes may have one for each.
        """
        endpoint = self._endpoint
        if kind == "topic":
            port = endpoint.topic_ports.get(name)
        elif endpoint.location.confirmed:
            port = self._context.registry.service_port(endpoint, name)
        else:
            port = None  # it came from an address that hides several: the node has to answer for it
        node = await _dial(endpoint.address, port)
        if node is not None:
            return node
        port = await self._learn_port(endpoint, kind, name)
        if port == NO_PORT:
            raise NotOffered(f"{endpoint.label} has no {kind} {name or '(no name given)'}")
        return await _dial(endpoint.address, port)

    def label(self, kind: str, name: str) -> str:
        """The topic or service if the node has registered it."""
        wanted_kind = Kind.SERVICE if kind == "service" else Kind.PUBLISHER
        return name if name in self._endpoint.names(wanted_kind) else UNREGISTERED

    def note_connection(self) -> None:
        """Note that a connection is relayed."""
        self._endpoint.connections += 1
        self._endpoint.idle_since = None

    def note_disconnection(self) -> None:
        """Note that one is relayed no more."""
        self._endpoint.connections -= 1

    def note_failure(self, name: str) -> None:
        """Tell of a node that is registered, and whose TCPROS server can't be reached."""
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
    """Kind and name of what a header asks for, and who asks. Raises HeaderError."""
    if too_long := too_long_to_connect(fields):
        raise HeaderError(too_long)
    # rospy and roscpp would serve the topic (tcpros_base.py, _tcp_server_callback;
    # connection_manager.cpp, onConnectionHeaderReceived), and the policy be asked for the service.
    if "service" in fields and "topic" in fields:
        raise HeaderError("the connection header names both a topic and a service")
    kind = "service" if "service" in fields else "topic"
    return kind, fields.get(kind, ""), fields.get("callerid", "")


async def read_header(context: Context, peer: str, conn: socket.socket) -> bytes:
    """Take a connection header off the socket: its four bytes of length and its body.

    Raises HeaderError if it is too long, EOFError, TimeoutError, OSError.
    """
    charge = Charge(context.buffered, peer)
    with context.gate.waiting(peer, partial(sockets.hang_up, conn)), charge:
        async with asyncio.timeout(sockets.SILENCE_TIMEOUT):
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


async def hand_on(header: bytes, inside: socket.socket) -> bool:
    """Send a node the header that was read; closes the connection to it if that fails."""
    try:
        async with asyncio.timeout(sockets.CONNECT_TIMEOUT):
            await asyncio.get_running_loop().sock_sendall(inside, header)
    except BaseException as error:
        inside.close()
        if not isinstance(error, OSError):  # a time-out is one, too
            raise
        log.debug("the TCPROS header could not be sent to the node: %s", error)
        return False
    return True
