"""Asking a node who it is: does it answer, as which process, with which topics, on which port?

There are four questions. `NodeClient.probe` is the cheap one (``getPid``), asked over and over; of
nodes that are well by `rosproxy.ros1.clients.kept_connections`.
`NodeClient.inspect` has the node describe itself; whoever is about to believe what somebody else
said of a node (the master after a restart, an operator, the node's former process) inspects it
first. `NodeClient.name` asks what it is called, before it is registered for somebody who calls from
another address, and `NodeClient.provider` whether it has a service. All only ask: what follows for
the endpoint is decided in `upkeep`.
"""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Mapping

import msgspec

from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master_client import (
    CALLER_ID,
    MasterClient,
    MasterError,
    Unreachable,
    parse_value,
)
from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header, encode_header, header_length
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.limits import PID_REPLY
from rosproxy.ros1.registry.graph import ROSOUT, NodeInfo, read_types
from rosproxy.ros1.registry.node_health import ProbeResult

log = logging.getLogger(__name__)

GET_PID = "getPid"
TOPICS_ASKED = 3
"""How many of its topics a node is asked for at most until it has answered for enough."""
ENOUGH_PORTS = 2
"""How many of their TCPROS ports are asked for: a node has one for all topics, or one for each."""

_PID_CALL = xmlrpc.dump_call(GET_PID, CALLER_ID)


class ProbeAnswer(msgspec.Struct, frozen=True):
    """How a probe ended; ``pid`` if the node answered, ``reason`` if it didn't."""

    probe: ProbeResult
    pid: int | None = None
    reason: str = ""


class NodeClient:
    """Questions to nodes; ``within`` is the time-out of each in seconds."""

    def __init__(self, upstream: MasterClient, within: float) -> None:
        self._upstream = upstream
        self._within = within

    async def probe(self, slave: HostPort, within: float | None = None) -> ProbeAnswer:
        """Call ``getPid``. Whatever answers in HTTP lives, even if it does not know that call."""
        try:
            body = await self._upstream.post_to_node(slave, _PID_CALL, within or self._within)
            return ProbeAnswer(ProbeResult.ANSWERED, self.read_pid(body))
        except Unreachable as error:
            return ProbeAnswer(error.probe, reason=str(error))

    def connect(self, slave: HostPort) -> socket.socket:
        """A connection to the slave API at an address that is about to be made. Raises OSError."""
        return sockets.begin_to_dial(self._upstream.reach(slave))

    def close_after_answer(self, sock: socket.socket) -> None:
        """Close such a connection once the answer that is due on it has come."""
        self._upstream.close_after_answer(sock)

    def pid_question(self, slave: HostPort) -> bytes:
        """The HTTP request by which the node at an address is asked for its pid."""
        return self._upstream.node_request(slave, _PID_CALL)

    def read_pid(self, body: bytes) -> int | None:
        """The pid that a reply's body gives, whatever its status; None if it gives none.

        Raises Unreachable if it is no XML-RPC.
        """
        match parse_value(body, PID_REPLY):
            case [_, _, int(pid)]:
                return pid
        return None

    async def inspect(self, slave: HostPort) -> NodeInfo | None:
        """What the node at an address says of itself; None if nothing answers there."""
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
        """What the node at an address is called, as it says itself; None if it doesn't.

        rospy has ``getName`` for that. roscpp has nothing like it in its slave API, but gives its
        name in the header with which it answers a TCPROS connection (roscpp's
        transport_subscriber_link.cpp and service_client_link.cpp, handleHeader): for a topic that
        it publishes, or for a ``service``, given with its port. It has one of them when it
        registers for the first time: it notes a publisher (/rosout is the first of all) and a
        service before it registers them. Its subscriptions are not asked for: it keeps them locked
        while it registers one (topic_manager.cpp, subscribe).
        """
        try:
            name = await self._upstream.call_node(slave, self._within, "getName")
            if isinstance(name, str):
                return name
        except Unreachable as error:
            if error.probe is not ProbeResult.ANSWERED:
                return None
        except MasterError as error:
            log.debug("node at %s gives no name: %s", slave, error)
        return await self._name_by_tcpros(slave, service)

    async def provider(self, server: HostPort, service: str) -> str | None:
        """The name of the node with a TCPROS server, if it has a service; None if it has not."""
        return await self._server_name(server, {"service": service})

    async def publisher(self, server: HostPort, topic: str) -> str | None:
        """The name of the node with a TCPROS server, if it publishes a topic; None if it doesn't.

        None, too, of a library that does not answer somebody who takes any type.
        """
        return await self._server_name(server, {"topic": topic, "type": "*"})

    async def _name_by_tcpros(self, slave: HostPort, service: tuple[str, int] | None) -> str | None:
        published = await self._topics(slave, "getPublications") or {ROSOUT: ""}
        topics = sorted(published, key=lambda topic: topic != ROSOUT)[:TOPICS_ASKED]
        for topic in topics:
            port = await self._topic_port_or_none(slave, topic)
            name = await self.publisher(HostPort(slave.host, port), topic) if port else None
            if name:
                return name
        if service is None:
            return None
        return await self._server_name(HostPort(slave.host, service[1]), {"service": service[0]})

    async def _server_name(self, server: HostPort, fields: dict[str, str]) -> str | None:
        """The name in the header with which a TCPROS server answers; None if it gives none."""
        try:
            async with asyncio.timeout(self._within):
                with await sockets.dial(server) as conn:
                    return (await _greet(conn, fields)).get("callerid")
        except (OSError, EOFError, HeaderError) as error:
            log.debug("TCPROS server at %s does not answer a connection header: %s", server, error)
            return None

    async def take_leave(self, conn: socket.socket, topic: str) -> None:
        """Close a connection to a publisher that has got no header yet, after one of the proxy's.

        rospy's one thread that accepts connections warns of each that ends before its header. Where
        that is its first warning, it asks its master for a parameter, over a connection that it
        keeps; if the network to there has just gone, nobody else is accepted for a quarter of an
        hour (rospy: tcpros_base.py, _tcp_server_callback; rosout.py, _rosout).
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
        """The TCPROS port that a node names for a topic. Raises Unreachable, MasterError."""
        answer = await self._upstream.call_node(
            slave, self._within, "requestTopic", topic, [["TCPROS"]]
        )
        match answer:
            case [_, _, int(port)] if 0 < port < 65536:
                return port
        return None

    async def _topic_ports(self, slave: HostPort, topics: list[str]) -> dict[str, int]:
        """The TCPROS ports of two topics, which show whether all of the node's are the same."""
        ports: dict[str, int] = {}
        for topic in topics[:TOPICS_ASKED]:
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
    # "*" is the md5sum of any type. A service of rospy that is probed closes the connection after
    # its header, and waits for no request (tcpros_service.py, handle).
    header = encode_header({"callerid": CALLER_ID, "md5sum": "*", "probe": "1", **fields})
    await asyncio.get_running_loop().sock_sendall(conn, header)
    size = header_length(await sockets.read_exactly(conn, 4))
    return decode_header(await sockets.read_exactly(conn, size))
