"""TCPROS through a lease: read the connection header, find the node's port, relay."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable

from rosproxy.acceptor import read_header
from rosproxy.context import Context
from rosproxy.core.methods import Kind
from rosproxy.core.registry import Endpoint
from rosproxy.core.tcpros import HeaderError, decode_header, encode_header
from rosproxy.core.uris import is_loopback
from rosproxy.metrics import Traffic
from rosproxy.node_client import NodeClient
from rosproxy.relay import Relay, reset_on_close

log = logging.getLogger(__name__)

CONNECT_TIMEOUT = 5.0
RATE_INTERVAL = 2.0
STOP_TIMEOUT = 1.0


class TcprosService:
    """Relays TCPROS connections to inside nodes.

    The target is a port on the endpoint's own address, as that node itself named it; the host in
    a reply or registration is never used, so none can lead to another inside host.
    """

    def __init__(self, context: Context, nodes: NodeClient) -> None:
        self._context, self._nodes = context, nodes
        self._relays: set[Relay] = set()
        self._none_open = asyncio.Event()
        self._none_open.set()
        self._ended = Traffic()
        self._asking: dict[Endpoint, asyncio.Task[int | None]] = {}

    @property
    def relays(self) -> list[Relay]:
        """The open connections."""
        return list(self._relays)

    def traffic(self) -> Traffic:
        """Bytes by topic and service, of ended and open connections."""
        total = Traffic()
        total.sent, total.received = dict(self._ended.sent), dict(self._ended.received)
        for relay in self._relays:
            total.add(relay.kind, relay.name, relay.sent, relay.received)
        return total

    async def sample_rates(self) -> None:
        """Compute the rates of all connections since the last time."""
        now = self._context.now()
        for relay in self._relays:
            relay.sample(now)

    async def serve(self, endpoint: Endpoint, conn: socket.socket, peer: str) -> None:
        """Relay a connection whose first bytes are a TCPROS header. Closes it on failure."""
        try:
            header = await read_header(conn)
            fields = decode_header(header[4:])
        except HeaderError as error:
            await self._answer_error(conn, f"rosproxy: {error}")
            self._context.metrics.relay_errors.labels("bad header").inc()
            return
        inside = await self._connect(endpoint, fields)
        if inside is None or not await _hand_on(header, inside):
            self._fail(endpoint, conn, fields)
            return
        self._start(endpoint, fields, conn, inside, peer)

    async def stop(self) -> None:
        """End all connections."""
        for relay in self.relays:
            relay.end()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STOP_TIMEOUT):
                await self._none_open.wait()

    async def _connect(self, endpoint: Endpoint, fields: dict[str, str]) -> socket.socket | None:
        """A connection to the node; its port is asked for anew if the known one refuses."""
        port = self._known_port(endpoint, fields)
        inside = await _dial(endpoint.place.address, port) if port else None
        if inside is not None:
            return inside
        learned = await self._learn_port(endpoint)
        return await _dial(endpoint.place.address, learned) if learned else None

    async def _learn_port(self, endpoint: Endpoint) -> int | None:
        """The TCPROS port that the node names now; it is asked once for all who wait."""
        asking = self._asking.get(endpoint)
        if asking is None:
            asking = self._context.tasks.spawn(
                self._nodes.learn_tcpros_port(endpoint), f"TCPROS port of {endpoint.uri}"
            )
            self._asking[endpoint] = asking
            asking.add_done_callback(lambda _: self._asking.pop(endpoint))
        return await asyncio.shield(asking)

    def _known_port(self, endpoint: Endpoint, fields: dict[str, str]) -> int | None:
        service = fields.get("service")
        if service is None:
            return endpoint.topic_ports.get(fields.get("topic", ""), endpoint.tcpros_port)
        return self._context.registry.service_port(endpoint, service) or endpoint.tcpros_port

    def _start(
        self,
        endpoint: Endpoint,
        fields: dict[str, str],
        conn: socket.socket,
        inside: socket.socket,
        peer: str,
    ) -> None:
        kind = "service" if "service" in fields else "topic"
        name = self._registered_name(endpoint, kind, fields.get(kind, ""))
        relay = Relay(endpoint.port, kind, name, fields.get("callerid", ""), peer, conn, inside)
        self._relays.add(relay)
        self._none_open.clear()
        endpoint.connections += 1
        endpoint.idle_since = None
        loop = asyncio.get_running_loop()
        relay.start(lambda ended: _call_in(loop, lambda: self._finished(endpoint, ended)))

    def _registered_name(self, endpoint: Endpoint, kind: str, name: str) -> str:
        """The name if the node has registered it: a label that outsiders can't multiply."""
        wanted = Kind.SERVICE if kind == "service" else Kind.PUBLISHER
        return name if name in endpoint.names(wanted) else "unregistered"

    def _finished(self, endpoint: Endpoint, relay: Relay) -> None:
        self._relays.discard(relay)
        if not self._relays:
            self._none_open.set()
        endpoint.connections -= 1
        self._ended.add(relay.kind, relay.name, relay.sent, relay.received)

    def _fail(self, endpoint: Endpoint, conn: socket.socket, fields: dict[str, str]) -> None:
        """Reset, as a node that is gone would: roscpp and rospy try again."""
        self._context.metrics.relay_errors.labels("node unreachable").inc()
        reset_on_close(conn)
        conn.close()
        if endpoint.registrations:
            self._report(endpoint, fields)

    def _report(self, endpoint: Endpoint, fields: dict[str, str]) -> None:
        what = fields.get("service") or fields.get("topic") or "?"
        text = f"no TCPROS connection to it for {what}"
        if is_loopback(endpoint.node.host):
            text += (
                f": it listens on loopback only ({endpoint.uri}). Unset ROS_IP and ROS_HOSTNAME "
                f"where it runs, or set ROS_IP={endpoint.place.address}"
            )
        log.warning("%s: %s", endpoint.label, text)
        self._context.problems.add(endpoint.label, text, endpoint.port)

    async def _answer_error(self, conn: socket.socket, message: str) -> None:
        try:
            reply = encode_header({"error": message})
            await asyncio.get_running_loop().sock_sendall(conn, reply)
        finally:
            conn.close()


async def _dial(address: str, port: int) -> socket.socket | None:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    sock.setblocking(False)
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT):
            await asyncio.get_running_loop().sock_connect(sock, (address, port))
    except (OSError, TimeoutError) as error:
        log.debug("connecting to %s:%d: %s", address, port, error)
        sock.close()
        return None
    except BaseException:
        sock.close()
        raise
    return sock


async def _hand_on(header: bytes, inside: socket.socket) -> bool:
    """Send a node the header that was read; closes the connection to it if that fails."""
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT):
            await asyncio.get_running_loop().sock_sendall(inside, header)
    except (OSError, TimeoutError) as error:
        log.debug("handing a header on: %s", error)
        inside.close()
        return False
    except BaseException:
        inside.close()
        raise
    return True


def _call_in(loop: asyncio.AbstractEventLoop, function: Callable[[], None]) -> None:
    """Run a function in the loop from a thread; not at all if the loop has ended."""
    try:
        loop.call_soon_threadsafe(function)
    except RuntimeError:
        log.debug("the event loop has ended before a relay")
