"""Ports that stand in for those of nodes on the master's host, for inside nodes only.

Where the master's name leads to the proxy (see `policy`), a port is opened right before an inside
node is given a URI that needs it (`Alias.listen_for`), and closed when the node behind it refuses,
since a dead node must look dead. Only URIs that the master names open one: they come with its
replies, or it is asked (`Alias.listen_for_announced`). Slave API calls are forwarded to the node,
TCPROS connections of services relayed as they are; topics flow directly, to the address in the
node's own reply. Nothing is relayed that does not begin with a TCPROS header.

All of this is done only while the master's address is given (``--master-address``), which is what
says that its name may lead to the proxy.
"""

import asyncio
import logging
import socket
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

from rosproxy.forwarding.relay import Relay
from rosproxy.forwarding.relay_set import OpenRelays
from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort
from rosproxy.net.interfaces import address_towards
from rosproxy.net.sockets import Acceptor
from rosproxy.ros1.alias import policy
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header
from rosproxy.ros1.protocol.uris import parse_service_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.registry.graph import Graph
from rosproxy.ros1.registry.selection import Standing
from rosproxy.ros1.servers.callers import Callers
from rosproxy.ros1.servers.tcpros import hand_on, read_header
from rosproxy.ros1.servers.xmlrpc_server import IncomingCall, XmlRpcServer, counted

log = logging.getLogger(__name__)

PORTS_PER_TURN = 50
"""How many are opened before all connections are looked at again."""
MOST_PORTS = 1024
"""How many ports stand in for nodes at most."""
CONNECT_TIMEOUT = 2.0
TIDY_INTERVAL = 30.0
SERVICE_PROBLEM = 600.0
"""Seconds for which a problem with a service is kept: it is looked up anew for each call."""
LOOK_TIMEOUT = 1.0
"""Seconds for which a node waits at most for the URI of another one that was gone."""


class Alias:
    """Listens on the ports of nodes on the master's host and passes on what arrives there."""

    def __init__(self, context: Context, callers: Callers) -> None:
        self._context, self._callers = context, callers
        self._name = policy.aliased_host(context.settings.master_uri) or ""
        self._acceptors: dict[int, Acceptor] = {}
        """By port, the one that was of no use for longest first."""
        self._refused: set[int] = set()
        self._relays = OpenRelays()
        greeting = "rosproxy: a ROS node on the master's host\n"
        self._server = XmlRpcServer(context, self._forward, greeting, context.master_call)
        self._closed = False
        self._asking = asyncio.Lock()
        self._asked: set[str] = set()
        """Topics whose publishers somebody waits to be told of."""
        self._publishers: dict[str, set[str]] = {}
        """The master's last answer to that: slave URIs by topic."""

    async def listen_for(self, uris: Iterable[str]) -> None:
        """Have the ports listen that these URIs lead to, before an inside node is given them.

        The URIs are the master's own word.
        """
        if self._address is None or self._closed:
            return
        wanted = policy.ports_needed(uris, self._name, self._context.addressing)
        again = self._refused & wanted.keys()
        still = await asyncio.gather(*map(self._refuses, again))
        self._refused -= {port for port, gone in zip(again, still, strict=True) if not gone}
        for number, (port, uri) in enumerate(wanted.items(), start=1):
            if number % PORTS_PER_TURN == 0:
                await asyncio.sleep(0)
            if port not in self._refused and not self._closed:
                self._listen(port, uri)

    async def listen_for_announced(self, topic: str, uris: Sequence[str]) -> None:
        """The same for the publishers that a ``publisherUpdate`` names, as far as they are some.

        Anybody may call that at a lease, and name any port. Its source proves nothing: every
        program on the master's host has that address, and NAT gives it to others. So where a
        port would have to be opened the master is asked whether it has that publisher.
        """
        if self._address is None or self._closed:
            return
        wanted = policy.ports_needed(uris, self._name, self._context.addressing)
        known = {uri for port, uri in wanted.items() if port in self._acceptors}
        if len(known) < len(wanted):
            known |= await self._publishers_of(topic)
        await self.listen_for(uri for uri in wanted.values() if uri in known)

    def import_call(self, body: bytes, call: xmlrpc.Call) -> bytes:
        """A call from outside, parsed as ``call``, in a form that an inside node can use."""
        address = self._address
        return policy.direct_call(call, body, self._name, address) if address else body

    async def tidy(self) -> None:
        """Forget the problems of nodes that have ended, and of services not looked up any more.

        rospy complains of connections to a service's port that say nothing: none is made.
        """
        if self._address is None:
            return
        for problem in self._context.problems.all():
            uri = problem.subject
            for port in policy.ports_needed([uri], self._name, self._context.addressing):
                if parse_service_uri(uri):
                    ended = time.time() - problem.when > SERVICE_PROBLEM
                else:
                    ended = await self._refuses(port)
                if ended:
                    self._context.problems.solved(uri)

    def status(self) -> list[dict[str, Any]]:
        """The ports with their open connections, for ``/status``."""
        counts = self._connections()
        return [{"port": port, "connections": counts[port]} for port in sorted(self._acceptors)]

    def close(self) -> None:
        """Stop listening, for good."""
        self._closed = True
        for port in list(self._acceptors):
            self._close(port)

    async def stop(self) -> None:
        """End all connections."""
        await asyncio.gather(self._relays.stop(), self._server.close())

    @property
    def _address(self) -> str | None:
        """The address of the master's host; None if its name can't lead to the proxy."""
        return self._context.upstream.master_address if self._name else None

    async def _publishers_of(self, topic: str) -> set[str]:
        """The slave URIs of a topic's publishers as the master has them now; none if it is away.

        There is one question at a time, for all topics that have come up meanwhile.
        """
        self._asked.add(topic)
        async with self._asking:
            if topic in self._asked:  # nobody has asked since
                topics, self._asked = self._asked, set()
                self._publishers = await self._ask_publishers(topics)
            return self._publishers.get(topic, set())

    async def _ask_publishers(self, topics: set[str]) -> dict[str, set[str]]:
        upstream = self._context.upstream
        try:
            state = await upstream.read_registrations()
            names = [
                name
                for name, held in state.items()
                if any(one.kind is Kind.PUBLISHER and one.name in topics for one in held)
            ]
            graph = Graph(state, await upstream.look_up("lookupNode", names))
        except (Unreachable, MasterError) as error:
            log.debug("the master can't be asked who publishes: %s", error)
            return {}
        publishers = graph.by_topic(Kind.PUBLISHER)
        return {topic: set(publishers.get(topic, ())) for topic in topics}

    def _listen(self, port: int, uri: str) -> None:
        """Let a port listen that a URI needs, or report why it can't."""
        problems = self._context.problems
        if port in self._acceptors:
            self._note_used(port)
            return
        why = policy.obstacle(port, self._context.settings) or self._open(port)
        if why is None:
            problems.solved(uri)
            return
        text = policy.advice(port, why, self._address or "")
        if (uri, text) not in ((p.subject, p.text) for p in problems.all()):
            log.warning("%s: %s", uri, text)
        problems.add(uri, text)

    def _open(self, port: int) -> str | None:
        """Open a port; the reason if that can't be done."""
        if len(self._acceptors) >= MOST_PORTS:
            counts = self._connections()
            unused = next((port for port in self._acceptors if not counts[port]), None)
            if unused is None:
                return f"is one too many: {MOST_PORTS} others stand in for nodes and are in use"
            self._close(unused)
        try:
            sock = sockets.listen(self._context.settings.bind, port)
        except OSError as error:
            return f"can't be opened here ({error.strerror})"
        serve, gate = partial(self._serve, port), self._context.gate
        self._acceptors[port] = Acceptor(self._context.tasks, sock, serve, gate)
        log.debug("port %d stands in for that of %s", port, self._name)
        return None

    def _close(self, port: int) -> None:
        """Let a port refuse; relays that are open stay."""
        acceptor = self._acceptors.pop(port, None)
        if acceptor is not None:
            acceptor.close()
            self._server.close_port(port)

    def _note_used(self, port: int) -> None:
        if port in self._acceptors:
            self._acceptors[port] = self._acceptors.pop(port)

    def _note_end(self, relay: Relay) -> None:
        self._context.gate.leave(relay.peer, relay.port)
        self._note_used(relay.port)

    def _note_refused(self, port: int) -> None:
        """A node that refuses has ended: its port refuses as well, until it is found again."""
        log.debug("port %d of %s refuses; it does so here", port, self._name)
        self._close(port)
        self._refused.add(port)

    async def _refuses(self, port: int) -> bool:
        """Whether nobody listens at a port of the master's host."""
        try:
            (await self._dial(port, LOOK_TIMEOUT)).close()
        except ConnectionRefusedError:
            return True
        except OSError as error:
            log.debug("port %d of %s: %s", port, self._name, error)
        return False

    async def _dial(self, port: int, within: float) -> socket.socket:
        """Connect to a port of the master's host; refused if that is here. Raises OSError."""
        address = self._address
        if address is None or address_towards(address) == address:
            raise ConnectionRefusedError(f"--master-address {address} is the proxy's own")
        return await sockets.dial(HostPort(address, port), within)

    def _connections(self) -> Counter[int]:
        counts = Counter(relay.port for relay in self._relays)
        counts.update({port: self._server.count(port) for port in self._acceptors})
        return counts

    async def _serve(self, port: int, conn: socket.socket, peer: str) -> None:
        """Serve a connection from inside: XML-RPC or TCPROS, by its first bytes."""
        await self._callers.begin()
        self._context.refresh_networks()
        if self._context.standing(peer) is not Standing.ADMITTED:
            log.debug("%s may not use the proxy: refused at port %d", peer, port)
            conn.close()
            return
        self._note_used(port)
        await self._server.dispatch(conn, peer, partial(self._relay, port, peer))

    async def _relay(self, port: int, peer: str, conn: socket.socket) -> None:
        """Relay TCPROS as it is, once it is known to be that."""
        try:
            header = await read_header(self._context, peer, conn)
            decode_header(header[4:])
        except HeaderError as error:
            log.debug("%s at port %d: %s", peer, port, error)
            conn.close()
            return
        try:
            node = await self._dial(port, CONNECT_TIMEOUT)
        except OSError as error:
            log.debug("port %d of %s: %s", port, self._name, error)
            sockets.reset_on_close(conn)
            conn.close()
            if isinstance(error, ConnectionRefusedError):
                self._note_refused(port)
            return
        if not await hand_on(header, node):
            sockets.reset_on_close(conn)
            conn.close()
            return
        splice = self._context.settings.data_plane != "copy"
        relay = Relay(port, "service", f"at port {port}", "", peer, node, conn, splice=splice)
        self._context.gate.enter(peer, port)
        self._relays.start(relay, self._note_end)

    async def _forward(self, call: IncomingCall) -> bytes:
        """A node's reply to a call. Raises XmlRpcError, Unreachable."""
        if call.comes_from(self._context.instance):
            raise Unreachable(f"the address of {self._name} leads back to the proxy itself")
        parsed = xmlrpc.parse_call(call.body, self._context.master_call)
        port, upstream = call.local.port, self._context.upstream
        answer = upstream.post_to_node(HostPort(self._name, port), call.body, path=call.path)
        try:
            reply = await counted(self._context.metrics, "alias", parsed.method, answer)
        except Unreachable as error:
            if error.refused:
                self._note_refused(port)
            raise
        return policy.direct_reply(parsed, reply, self._name, self._address or self._name)
