"""XML-RPC calls to the master and to nodes.

- ``post_to_…`` sends a document unchanged, and returns the bytes of the reply. The proxy forwards
  calls of nodes in this way.
- ``pass_to_…`` does the same for documents that the proxy does not read. A long reply arrives piece
  by piece, and the document may be sent piece by piece.
- ``call_…`` makes a call of the proxy itself, and returns the value of the ROS triple ``[1,
  message, value]`` in the reply. ``multicall`` makes many calls to the master at once.
- ``read_graph`` and ``look_up`` ask the master for the ROS graph.
"""

import asyncio
import os
import socket
import time
from collections.abc import Iterable, Sequence
from hashlib import blake2b
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import msgspec

from rosproxy.net.http_client import (
    LONG_BODY_BYTES,
    MOST_BODY_BYTES,
    CallFailed,
    HttpClient,
    LongBody,
    LongReply,
)
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.limits import OWN_REPLY, REPLY, Limits
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import Graph, read_state
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.shared.addresses import HostPort, is_address
from rosproxy.shared.http.bodies import BadResponse
from rosproxy.shared.machine.resolver import NODES, resolve
from rosproxy.shared.output.problems import LONGEST_TEXT
from rosproxy.shared.output.text import brief
from rosproxy.telemetry.metrics import Metrics

CALLER_ID = "/rosproxy"
"""The node name of the proxy in its own calls."""
LOOP_HEADER = "X-Rosproxy"
"""Has the id of the proxy, so that the proxy notices when its own call comes back."""
MULTICALL_CALLS = 100
"""Most calls in a ``system.multicall`` of the proxy."""
MOST_MASTER_CONNECTIONS = 64
MOST_NODE_CONNECTIONS = 10_000
MASTER_TIMEOUT_S = 30.0
MASTER_KEEPALIVE_S = 8.0
"""Seconds to keep an unused connection to the master; rosmaster spends a thread on each."""
NODE_KEEPALIVE_S = 2.0
"""Seconds to keep an unused connection to a node; rospy spends a thread on each."""
NODE_TIMEOUT_S = 15.0


class Unreachable(CallFailed):
    """A call without an XML-RPC reply.

    ``probe`` says what the failure means for the health of the called node. REFUSED: the connection
    was refused. ANSWERED: the HTTP answer is no XML-RPC reply; libraries answer so to methods that
    they do not implement. SILENT: any other failure, such as no answer in time.
    """

    def __init__(self, message: str, probe: ProbeResult = ProbeResult.SILENT) -> None:
        super().__init__(message)
        self.probe = probe

    @property
    def refused(self) -> bool:
        """Whether the connection was refused."""
        return self.probe is ProbeResult.REFUSED


class MasterError(CallFailed):
    """The master or a node answered with a fault, without a ROS triple, or not with status 1."""


class MasterClient:
    """HTTP sessions to the master and to the nodes.

    The client keeps connections alive: to the master between any two calls, to a node between calls
    in quick succession, for example when a machine subscribes to several of its topics.

    ``master_address`` is the IP address at which the proxy reaches the host of ``master_uri``; it
    may change at any time. None: the address follows from the host name. In a container network
    this name may lead to the proxy itself. The address also holds for nodes on the master's host.
    ``longest`` is the highest number of bytes of a reply that passes unread.
    """

    def __init__(
        self,
        master_uri: str,
        instance: str,
        metrics: Metrics,
        master_address: str | None = None,
        longest: int = MOST_BODY_BYTES,
    ) -> None:
        self.master_uri = master_uri
        self.master_address = master_address
        self._metrics = metrics
        self._reading = asyncio.Lock()
        uri = urlsplit(master_uri)
        self._master_path = uri.path or "/"
        self._netloc = uri.netloc
        self._master_host_port = HostPort(uri.hostname or "", uri.port or 80)
        # If a call comes back to the proxy, the header tells which address has led it here:
        # --master-uri, or the address of a node (`MasterApi`).
        master_headers = {LOOP_HEADER: instance}
        node_headers = {LOOP_HEADER: f"{instance} node"}
        self._master = HttpClient(
            master_headers, MASTER_KEEPALIVE_S, MOST_MASTER_CONNECTIONS, longest
        )
        self._nodes = HttpClient(
            node_headers, NODE_KEEPALIVE_S, MOST_NODE_CONNECTIONS, longest, NODES
        )

    async def close(self) -> None:
        """Close all connections."""
        await asyncio.gather(self._master.close(), self._nodes.close())

    @property
    def reached_at(self) -> str | None:
        """The address where the proxy looks for the master; None before its name was resolved."""
        host = self._master_host_port.host
        return self.master_address or (host if is_address(host) else self._master.last_address)

    async def master_addresses(self) -> list[str]:
        """The addresses of the master's host; empty if the name cannot be resolved."""
        if self.master_address:
            return [self.master_address]
        return await resolve(self._master_host_port.host)

    def reach(self, host_port: HostPort) -> HostPort:
        """The address to connect to for the host and port of the master or a node.

        Only the host of the master has a different address, and only if ``master_address`` is set.
        """
        if self.master_address and host_port.host.lower() == self._master_host_port.host:
            return HostPort(self.master_address, host_port.port)
        return host_port

    async def post_to_master(self, body: bytes, limits: Limits = REPLY) -> bytes:
        """The master's reply to a call, within ``limits``. Raises Unreachable.

        Kept connections belong to an address, so a new address means new connections.
        """
        target = self.reach(self._master_host_port)
        path = self._master_path
        name = self._netloc
        try:
            return await self._master.post(target, path, name, body, MASTER_TIMEOUT_S, limits.size)
        except _FAILURES as error:
            raise _unreachable(f"master {self.master_uri}", error) from error

    async def pass_to_master(self, body: bytes | LongBody) -> bytes | LongReply:
        """The master's reply to a call; the proxy reads neither the call nor the reply.

        Raises Unreachable, and XmlRpcError if a long body raises that.
        """
        target = self.reach(self._master_host_port)
        path = self._master_path
        name = self._netloc
        try:
            return await self._master.pass_on(target, path, name, body, MASTER_TIMEOUT_S)
        except xmlrpc.XmlRpcError:
            raise
        except _FAILURES as error:
            raise _unreachable(f"master {self.master_uri}", error) from error

    async def call_master(self, method: str, *params: Any, limits: Limits = OWN_REPLY) -> Any:
        """Call the master and return the value. Raises Unreachable, MasterError.

        Unreachable with ANSWERED includes a reply that exceeds ``limits``.
        """
        started = time.monotonic()
        call = xmlrpc.dump_call(method, CALLER_ID, *params)
        reply = await self.post_to_master(call, limits)
        self._metrics.master_round_trip.observe(time.monotonic() - started)
        return read_value(method, reply, limits)

    async def multicall(self, calls: Sequence[tuple[str, list[Any]]]) -> list[Any]:
        """Make many calls ``(method, params)`` by ``system.multicall``; return the values.

        ``params`` include the caller_id. The value of a failed call is None. Raises Unreachable.
        """
        values: list[Any] = []
        for start in range(0, len(calls), MULTICALL_CALLS):
            batch = calls[start : start + MULTICALL_CALLS]
            body = [{"methodName": method, "params": params} for method, params in batch]
            call = xmlrpc.dump_call("system.multicall", body)
            results = parse_value(await self.post_to_master(call, OWN_REPLY))
            if not isinstance(results, list) or len(results) != len(batch):
                raise Unreachable(f"master {self.master_uri}: unusable reply to system.multicall")
            values += [_result_of(result) for result in results]
        return values

    async def read_changes(self, last: bytes) -> tuple[bytes, dict[str, list[Registration]] | None]:
        """A digest of the master's state, and the registrations of each node, without types.

        ``last``: the digest of the previous call. If the digest is the same, the registrations are
        None. To parse the names of ten thousand topics takes half a second, to compare the digest a
        hundredth. Raises Unreachable, MasterError.
        """
        reply = await self.post_to_master(xmlrpc.dump_call("getSystemState", CALLER_ID), OWN_REPLY)
        digest = blake2b(reply).digest()
        if digest == last:
            return digest, None
        return digest, _read_state(read_value("getSystemState", reply, OWN_REPLY), [])

    async def read_registrations(self) -> dict[str, list[Registration]]:
        """The registrations of each node. Raises Unreachable, MasterError."""
        state, types = await asyncio.gather(self.call_master("getSystemState"), self._read_types())
        return _read_state(state, types)

    async def _read_types(self) -> Any:
        """The types of all topics; none if there are too many to read.

        rosmaster keeps the types of topics that no node has any more (master_api.py, topics_types).
        So a node that registers ever new topics makes the reply longer and longer.
        """
        try:
            return await self.call_master("getTopicTypes")
        except Unreachable as error:
            if error.probe is not ProbeResult.ANSWERED:
                raise
            return []

    async def read_graph(self) -> Graph:
        """The registrations and URI of each node. Raises Unreachable, MasterError."""
        registrations = await self.read_registrations()
        return Graph(registrations, await self.look_up("lookupNode", registrations))

    async def look_up(self, method: str, names: Iterable[str]) -> dict[str, str]:
        """The URIs of the known nodes (``lookupNode``) or services (``lookupService``), by name.

        Raises Unreachable.
        """
        wanted = sorted(names)
        uris = await self.multicall([(method, [CALLER_ID, name]) for name in wanted])
        pairs = zip(wanted, uris, strict=True)
        return {name: uri for name, uri in pairs if isinstance(uri, str)}

    async def post_to_node(
        self,
        slave: HostPort,
        body: bytes,
        within: float = NODE_TIMEOUT_S,
        path: str = "/",
        name: str = "",
        limits: Limits = REPLY,
    ) -> bytes:
        """A node's reply to a call, within ``limits``. Raises Unreachable.

        ``within`` is in seconds. ``name`` is the host and port for the HTTP header and for errors,
        if they differ from the address.
        """
        called = name or str(slave)
        target = self.reach(slave)
        try:
            return await self._nodes.post(target, path, called, body, within, limits.size)
        except _FAILURES as error:
            raise _unreachable(f"node at {called}", error) from error

    async def pass_to_node(self, slave: HostPort, body: bytes | LongBody) -> bytes | LongReply:
        """A node's reply to a call; the proxy reads neither the call nor the reply.

        Raises Unreachable, and XmlRpcError if a long body raises that.
        """
        target = self.reach(slave)
        name = str(slave)
        try:
            return await self._nodes.pass_on(target, "/", name, body, NODE_TIMEOUT_S)
        except xmlrpc.XmlRpcError:
            raise
        except _FAILURES as error:
            raise _unreachable(f"node at {name}", error) from error

    async def call_node(
        self, slave: HostPort, within: float, method: str, *params: Any, limits: Limits = REPLY
    ) -> Any:
        """Call a node in ``within`` seconds; return the value. Raises Unreachable, MasterError.

        Long replies of nodes, which may come at once, are read one after the other. Between these,
        the proxy serves others for as long as it has read.
        """
        body = xmlrpc.dump_call(method, CALLER_ID, *params)
        reply = await self.post_to_node(slave, body, within, limits=limits)
        if len(reply) <= LONG_BODY_BYTES:
            return read_value(method, reply, limits)
        async with self._reading:
            began = time.monotonic()
            try:
                return read_value(method, reply, limits)
            finally:
                await asyncio.sleep(time.monotonic() - began)

    def close_after_answer(self, sock: socket.socket, received: bytes) -> None:
        """Close a connection to a node once the answer that is due has arrived.

        ``received``: the part of the answer that the caller has read.
        """
        self._nodes.close_after_answer(sock, received)

    def node_request(self, slave: HostPort, body: bytes) -> bytes:
        """A call to a node as an HTTP request, for callers with a connection of their own."""
        return self._nodes.encoded_request("/", str(slave), body)


_FAILURES = (aiohttp.ClientError, OSError, TimeoutError, ValueError)


def _unreachable(peer: str, error: Exception) -> Unreachable:
    """A failure of the call of a peer."""
    probe = ProbeResult.SILENT
    if isinstance(error, ConnectionRefusedError):
        probe = ProbeResult.REFUSED
    elif isinstance(error, BadResponse):
        probe = ProbeResult.ANSWERED
    if isinstance(error, TimeoutError):
        reason = "no answer in time"
    elif isinstance(error, OSError) and (error.errno or 0) > 0:
        # The text of asyncio is "Connect call failed ('192.0.2.7', 11311)".
        reason = os.strerror(error.errno or 0).lower()
    elif isinstance(error, OSError) and error.strerror:
        reason = error.strerror.lower()
    else:
        reason = brief(error, LONGEST_TEXT) or type(error).__name__
    return Unreachable(f"{peer}: {reason}", probe)


def parse_value(reply: bytes, limits: Limits = OWN_REPLY) -> Any:
    """The value of a reply, or of a fault. Raises Unreachable."""
    try:
        return xmlrpc.read_response(reply, limits)
    except xmlrpc.XmlRpcError as error:
        raise Unreachable(f"the reply is not XML-RPC: {error}", ProbeResult.ANSWERED) from None


def read_value(method: str, reply: bytes, limits: Limits = REPLY) -> Any:
    """The value in a reply of the master or a node. Raises Unreachable, MasterError."""
    match parse_value(reply, limits):
        case [list(), list()] as value if method == "getBusStats":
            return value  # roscpp gives the value alone (TopicManager::getBusStatsCallback)
        case [1, _, value]:
            return value
        case [_, str(message), _] | {"faultString": str(message)}:
            raise MasterError(f"{method}: {brief(message, LONGEST_TEXT)}")
    raise MasterError(f"{method}: the reply is not a ROS status triple")


def _read_state(state: Any, types: Any) -> dict[str, list[Registration]]:
    try:
        return read_state(state, types)
    except msgspec.ValidationError as error:
        raise MasterError(f"getSystemState: {error}") from None


def _result_of(result: Any) -> Any:
    match result:
        case [[1, _, value]]:
            return value
    return None
