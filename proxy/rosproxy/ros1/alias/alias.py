"""Ports that stand in for nodes on the master's host, for inside only (see `core.mirror`).

They are there only while the master's address is given (``--master-address``), which is what says
that its name may lead to the proxy.
"""

import asyncio
import logging
import socket
import time
from collections import Counter, OrderedDict
from collections.abc import Iterable
from functools import partial
from typing import Any

from rosproxy.forwarding.relay import Relay
from rosproxy.forwarding.relay_set import OpenRelays
from rosproxy.net import sockets
from rosproxy.net.acceptor import Acceptor
from rosproxy.net.addresses import HostPort, is_inside
from rosproxy.net.interfaces import address_towards
from rosproxy.ros1.alias import policy as core
from rosproxy.ros1.clients.master import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.servers.dispatch import dispatch
from rosproxy.ros1.servers.xmlrpc_server import IncomingCall, XmlRpcServer
from rosproxy.telemetry.problems import Problem

log = logging.getLogger(__name__)

MOST_PORTS = 1024
CONNECT_TIMEOUT = 2.0
TIDY_INTERVAL = 30.0
SERVICE_PROBLEM = 600.0
"""Seconds for which a problem with a service is kept: it is looked up anew for each call."""
LOOK_TIMEOUT = 1.0
"""Seconds for which a node waits at most for the URI of another one that was gone."""


class Alias:
    """Listens on the ports of nodes on the master's host and passes on what arrives there."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._host = core.mirrored_host(context.settings.master_uri)
        self._acceptors: dict[int, Acceptor] = {}
        self._used: dict[int, float] = {}
        self._gone: OrderedDict[int, None] = OrderedDict()
        self._relays = OpenRelays()
        self._server = XmlRpcServer(self._call, "rosproxy: a ROS node on the master's host\n")
        self._closed = False

    async def listen_for(self, uris: Iterable[str]) -> None:
        """Have the ports listen that these URIs lead to, before an inside node is given them."""
        address = self._context.upstream.master_address
        if self._host is None or address is None or self._closed:
            return
        wanted = core.to_mirror(uris, self._host, self._context.addressing)
        await asyncio.gather(*(self._look_again(port) for port in wanted if port in self._gone))
        for port, uri in wanted.items():
            if port not in self._gone:
                self._stand_in(port, uri, address)

    def import_call(self, body: bytes, call: xmlrpc.Call) -> bytes:
        """A call from outside, parsed as ``call``, in a form that an inside node can use."""
        address = self._context.upstream.master_address
        if self._host is None or address is None:
            return body
        return core.direct_call(call, body, self._host, address)

    async def tidy(self) -> None:
        """Forget the problems of nodes that have ended, and of services not looked up any more."""
        if self._host is None or self._context.upstream.master_address is None:
            return
        for problem in self._context.problems.all():
            ports = core.to_mirror([problem.subject], self._host, self._context.addressing)
            if ports and await self._is_over(problem, *ports):
                self._context.problems.solved(problem.subject)

    def status(self) -> list[dict[str, Any]]:
        """The mirrored ports with their open connections, for ``/status``."""
        counts = self._connections()
        return [{"port": port, "connections": counts[port]} for port in sorted(self._acceptors)]

    def __len__(self) -> int:
        """How many ports are mirrored."""
        return len(self._acceptors)

    def close(self) -> None:
        """Stop listening, for good."""
        self._closed = True
        for port in list(self._acceptors):
            self._close(port)

    async def stop(self) -> None:
        """End all connections."""
        await asyncio.gather(self._relays.stop(), self._server.close())

    def _stand_in(self, port: int, uri: str, address: str) -> None:
        if port not in self._acceptors:
            why = core.obstacle(port, self._context.settings) or self._open(port)
            if why is not None:
                self._report(uri, core.advice(port, why, address))
                return
            self._context.problems.solved(uri)
        self._used[port] = self._context.now()

    def _open(self, port: int) -> str | None:
        """Let a port listen; the reason if it can't."""
        if not self._make_room():
            return f"is one too many: {MOST_PORTS} others stand in for nodes and are in use"
        try:
            sock = sockets.listen(self._context.settings.bind, port)
        except OSError as error:
            return f"can't be opened here ({error.strerror})"
        self._acceptors[port] = Acceptor(
            self._context.tasks, sock, lambda conn, peer: self._connection(port, conn, peer)
        )
        log.debug("port %d stands in for that of %s", port, self._host)
        return None

    def _make_room(self) -> bool:
        if len(self._acceptors) < MOST_PORTS:
            return True
        oldest = core.least_used(self._used, +self._connections())
        if oldest is not None:
            self._close(oldest)
        return oldest is not None

    def _close(self, port: int) -> None:
        """Let a port refuse; relays that are open stay."""
        acceptor = self._acceptors.pop(port, None)
        if acceptor is not None:
            del self._used[port]
            acceptor.stop()
            acceptor.sock.close()
            self._server.close_port(port)

    def _leave(self, port: int) -> None:
        """A node that refuses has ended: its port refuses as well, until it is found again."""
        log.debug("port %d of %s refuses; it does so here", port, self._host)
        self._close(port)
        self._gone[port] = None
        if len(self._gone) > MOST_PORTS:
            self._gone.popitem(last=False)

    async def _look_again(self, port: int) -> None:
        if not await self._refuses(port):
            self._gone.pop(port, None)

    async def _refuses(self, port: int) -> bool:
        """Whether nobody listens at a port of the master's host."""
        try:
            (await sockets.dial(self._target(port), LOOK_TIMEOUT)).close()
        except ConnectionRefusedError:
            return True
        except OSError as error:
            log.debug("port %d of %s: %s", port, self._host, error)
        return False

    async def _is_over(self, problem: Problem, port: int) -> bool:
        """Whether a port that could not be mirrored does not matter any more.

        rospy complains of connections to a service's port that say nothing: none is made.
        """
        if core.is_service(problem.subject):
            return time.time() - problem.when > SERVICE_PROBLEM
        return await self._refuses(port)

    def _target(self, port: int) -> HostPort:
        """Where a port of the master's host is. Raises ConnectionRefusedError if that is here."""
        address = self._context.upstream.master_address
        if address is None or address_towards(address) == address:
            raise ConnectionRefusedError(f"--master-address {address} is the proxy's own")
        return HostPort(address, port)

    def _connections(self) -> Counter[int]:
        counts = Counter(relay.port for relay in self._relays)
        for port in self._acceptors:
            counts[port] += self._server.connections(port)
        return counts

    def _report(self, uri: str, text: str) -> None:
        problems = self._context.problems
        if (uri, text) not in ((p.subject, p.text) for p in problems.all()):
            log.warning("%s: %s", uri, text)
        problems.add(uri, text)

    async def _connection(self, port: int, conn: socket.socket, peer: str) -> None:
        """Serve a connection from inside: XML-RPC or TCPROS, by its first bytes."""
        self._context.refresh_networks()
        if not is_inside(peer, self._context.addressing.networks):
            log.debug("%s is not inside: refused at port %d", peer, port)
            conn.close()
            return
        if port in self._used:
            self._used[port] = self._context.now()
        await dispatch(conn, self._server, partial(self._relay, port, peer))

    async def _relay(self, port: int, peer: str, conn: socket.socket) -> None:
        """Relay TCPROS as it is."""
        try:
            node = await sockets.dial(self._target(port), CONNECT_TIMEOUT)
        except OSError as error:
            log.debug("port %d of %s: %s", port, self._host, error)
            sockets.reset_on_close(conn)
            conn.close()
            if isinstance(error, ConnectionRefusedError):
                self._leave(port)
            return
        relay = Relay(port, "service", f"at port {port}", "", peer, outside=node, inside=conn)
        relay.splice = self._context.settings.data_plane != "copy"
        self._relays.start(relay, self._ended)

    def _ended(self, relay: Relay) -> None:
        if relay.port in self._used:
            self._used[relay.port] = self._context.now()

    async def _call(self, call: IncomingCall) -> bytes:
        """A node's reply to a call. Raises XmlRpcError, Unreachable."""
        if call.comes_from(self._context.instance):
            raise Unreachable(f"the address of {self._host} leads back to the proxy itself")
        parsed = xmlrpc.parse_call(call.body)
        port, host, upstream = call.local.port, self._host or "", self._context.upstream
        try:
            reply = await upstream.node(HostPort(host, port), call.body, path=call.path)
        except Unreachable as error:
            self._context.metrics.count("mirror", parsed.method, "unreachable")
            if error.refused:
                self._leave(port)
            raise
        self._context.metrics.count("mirror", parsed.method, "answered")
        return core.direct_reply(parsed, reply, host, upstream.master_address or host)
