"""Questions to a node: does it answer, as which process, with which name, topics and ports?

- `NodeClient.probe` is the cheap question (``getPid``), which the proxy asks again and again.
  `rosproxy.ros1.clients.kept_connections` asks healthy nodes the same.
- `NodeClient.inspect` makes the node describe itself. The proxy inspects a node before the proxy
  trusts a claim about the node: from the master after a restart, from an operator, or from the
  former process of the node.
- `NodeClient.name` asks for the name, before a node is registered by a caller at another address.
- `NodeClient.provider` asks whether the node has a service.

The client only asks. The modules in `upkeep` decide what follows for the endpoint.
"""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Mapping

import msgspec

from rosproxy.ros1.clients.master_client import (
    CALLER_ID,
    MasterClient,
    MasterError,
    Unreachable,
    parse_value,
)
from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header, encode_header, header_length
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.limits import SHORT_REPLY
from rosproxy.ros1.registry.graph import ROSOUT, NodeInfo, read_types
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.connections import sockets

log = logging.getLogger(__name__)

GET_PID = "getPid"
MOST_TOPICS_ASKED = 3
"""Most topics of a node for whose TCPROS port the proxy asks."""
ENOUGH_PORTS = 2
"""TCPROS ports that are enough: a node has one port for all topics, or one for each topic."""

_PID_CALL = xmlrpc.dump_call(GET_PID, CALLER_ID)


class ProbeAnswer(msgspec.Struct, frozen=True):
    """The result of a probe; ``pid`` if the node answered, ``reason`` if not."""

    probe: ProbeResult
    pid: int | None = None
    reason: str = ""


class NodeClient:
    """Asks nodes; ``within`` is the time-out of each question in seconds."""

    def __init__(self, upstream: MasterClient, within: float) -> None:
        self._upstream = upstream
        self._within = within

    async def probe(self, slave: HostPort, within: float | None = None) -> ProbeAnswer:
        """Call ``getPid``, for ``within`` seconds or the usual time-out.

        Any HTTP answer shows that the node lives, even an error because the method is unknown.
        """
        try:
            body = await self._upstream.post_to_node(
                slave, _PID_CALL, within or self._within, limits=SHORT_REPLY
            )
            return ProbeAnswer(ProbeResult.ANSWERED, self.read_pid(body))
        except Unreachable as error:
            return ProbeAnswer(error.probe, reason=str(error))

    def connect(self, slave: HostPort) -> socket.socket:
        """Begin a connection to the slave API at an address. Raises OSError."""
        return sockets.begin_to_dial(self._upstream.reach(slave))

    def close_after_answer(self, sock: socket.socket, received: bytes) -> None:
        """Close a connection from `connect` once the answer that is due has arrived.

        ``received``: the part of the answer that the caller has read.
        """
        self._upstream.close_after_answer(sock, received)

    def pid_question(self, slave: HostPort) -> bytes:
        """The HTTP request that asks the node at an address for its pid."""
        return self._upstream.node_request(slave, _PID_CALL)

    def read_pid(self, body: bytes) -> int | None:
        """The pid in the body of a reply, with any status; None if there is none.

        Raises Unreachable if the body is not XML-RPC.
        """
        match parse_value(body, SHORT_REPLY):
            case [_, _, int(pid)]:
                return pid
        return None

    async def inspect(self, slave: HostPort) -> NodeInfo | None:
        """What the node at an address says about itself; None if no node answers there."""
        answer, published, subscribed = await asyncio.gather(
            self.probe(slave),
            self._topics(slave, "getPublications"),
            self._topics(slave, "getSubscriptions"),
        )
        if answer.probe is not ProbeResult.ANSWERED:
            log.debug("node at %s does not answer: %s", slave, answer.reason)
            return None
        ports = await self._topic_ports(slave, sorted(published or {}))
        return NodeInfo(answer.pid, published, subscribed, ports)

    async def name(self, slave: HostPort, service: tuple[str, int] | None = None) -> str | None:
        """The name that the node at an address gives; None if it gives none.

        rospy has ``getName`` for this. roscpp has no such method in its slave API. But roscpp gives
        its name in the header with which it answers a TCPROS connection for a topic or a service
        (transport_subscriber_link.cpp and service_client_link.cpp, handleHeader). roscpp has a
        topic or a service when it registers for the first time, because it records a publisher or
        service before it registers. /rosout is the first publisher of all. ``service``: the name
        and TCPROS port of the service, if the registration is for a service.

        The proxy does not ask for subscriptions, because roscpp keeps them locked during a
        registration (topic_manager.cpp, subscribe).
        """
        try:
            name = await self._upstream.call_node(
                slave, self._within, "getName", limits=SHORT_REPLY
            )
            if isinstance(name, str):
                return name
        except Unreachable as error:
            if error.probe is not ProbeResult.ANSWERED:
                return None
        except MasterError as error:
            log.debug("node at %s gives no name: %s", slave, error)
        return await self._name_by_tcpros(slave, service)

    async def provider(self, server: HostPort, service: str) -> str | None:
        """The name of the node with a TCPROS server, if the node has a service; None if not."""
        return await self._server_name(server, {"service": service})

    async def publisher(self, server: HostPort, topic: str) -> str | None:
        """The name of the node with a TCPROS server, if the node publishes a topic; None if not.

        None as well if the library does not answer a subscriber that accepts any type.
        """
        return await self._server_name(server, {"topic": topic, "type": "*"})

    async def _name_by_tcpros(self, slave: HostPort, service: tuple[str, int] | None) -> str | None:
        published = await self._topics(slave, "getPublications") or {ROSOUT: ""}
        topics = sorted(published, key=lambda topic: topic != ROSOUT)[:MOST_TOPICS_ASKED]
        for topic in topics:
            port = await self._topic_port_or_none(slave, topic)
            name = await self.publisher(HostPort(slave.host, port), topic) if port else None
            if name:
                return name
        if service is None:
            return None
        return await self._server_name(HostPort(slave.host, service[1]), {"service": service[0]})

    async def _server_name(self, server: HostPort, fields: dict[str, str]) -> str | None:
        """The name in the header with which a TCPROS server answers; None if there is none."""
        try:
            async with asyncio.timeout(self._within):
                with await sockets.dial(server) as conn:
                    return (await _greet(conn, fields)).get("callerid")
        except (OSError, EOFError, HeaderError) as error:
            log.debug("TCPROS server at %s does not answer a connection header: %s", server, error)
            return None

    async def close_after_header(self, conn: socket.socket, topic: str) -> None:
        """Send the first header on a connection to a publisher, then close the connection.

        rospy accepts connections in a single thread, which logs a warning for each connection that
        ends before its header. With its first warning, the thread asks the master for a parameter,
        over a kept connection. If the network to the master has just failed, the thread accepts no
        connection for a quarter of an hour (rospy: tcpros_base.py, _tcp_server_callback; rosout.py,
        _rosout).
        """
        with conn, contextlib.suppress(OSError, EOFError, HeaderError):
            async with asyncio.timeout(self._within):
                await _greet(conn, {"topic": topic, "type": "*"})

    async def _topics(self, slave: HostPort, method: str) -> dict[str, str] | None:
        try:
            return read_types(await self._upstream.call_node(slave, self._within, method))
        except (Unreachable, MasterError) as error:
            log.debug("node at %s gives no list of topics: %s", slave, error)
            return None

    async def topic_port(self, slave: HostPort, topic: str) -> int | None:
        """The TCPROS port that a node names for a topic; None if the node names no port.

        Raises Unreachable, MasterError.
        """
        answer = await self._upstream.call_node(
            slave, self._within, "requestTopic", topic, [["TCPROS"]], limits=SHORT_REPLY
        )
        match answer:
            case [_, _, int(port)] if 0 < port < 65536:
                return port
        return None

    async def _topic_ports(self, slave: HostPort, topics: list[str]) -> dict[str, int]:
        """The TCPROS ports of up to two topics: they show whether all topics have the same port."""
        ports: dict[str, int] = {}
        for topic in topics[:MOST_TOPICS_ASKED]:
            port = await self._topic_port_or_none(slave, topic)
            if port is not None:
                ports[topic] = port
            if len(ports) == ENOUGH_PORTS:
                break
        return ports

    async def _topic_port_or_none(self, slave: HostPort, topic: str) -> int | None:
        try:
            return await self.topic_port(slave, topic)
        except (Unreachable, MasterError) as error:
            log.debug("node at %s gives no TCPROS port for topic %s: %s", slave, topic, error)
            return None


async def _greet(conn: socket.socket, fields: Mapping[str, str]) -> dict[str, str]:
    """Exchange TCPROS headers with a node. Raises OSError, EOFError, HeaderError."""
    # "*" is the md5sum of any type. After the header of a probe, a service of rospy closes the
    # connection, and waits for no request (tcpros_service.py, handle).
    header = encode_header({"callerid": CALLER_ID, "md5sum": "*", "probe": "1", **fields})
    await asyncio.get_running_loop().sock_sendall(conn, header)
    size = header_length(await sockets.read_exactly(conn, 4))
    return decode_header(await sockets.read_exactly(conn, size))
