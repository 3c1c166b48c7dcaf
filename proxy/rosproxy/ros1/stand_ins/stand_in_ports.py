"""Listens on the ports of stand-ins, and passes on what arrives there.

The proxy opens a port right before a node inside gets a URI that needs this port (`listen_for`).
The proxy closes the port when the node behind it refuses connections, since a dead node must look
dead. Only URIs from the master open a port. These URIs come with a reply of the master, or the
proxy asks the master (`listen_for_announced`).

The proxy forwards slave API calls to the node, and relays TCPROS connections. If URIs are kept
because the master's name leads to the proxy (`registry.stand_ins`), topics flow without the proxy:
the reply to ``requestTopic`` has the address of the node. The proxy relays only connections that
begin with a TCPROS header.

The stand-in of a slave URI also has a fast port, if the kernel forwards and no rule of the policy
could be bypassed by the fast port. The fast port listens as long as the stand-in. The proxy relays
connections that the kernel does not forward.
"""

import asyncio
import contextlib
import logging
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.registry import stand_ins
from rosproxy.ros1.registry.client_kinds import ClientKind
from rosproxy.ros1.registry.stand_ins import StandIn
from rosproxy.ros1.rewriting import slave_api
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.servers.callers import Callers
from rosproxy.ros1.servers.tcpros_server import TcprosServer
from rosproxy.ros1.servers.xmlrpc_server import IncomingCall, XmlRpcServer, count_reply
from rosproxy.ros1.stand_ins.outside_nodes import RETRY_TIMEOUT_S, Outside, OutsideNode
from rosproxy.ros1.stand_ins.publisher_lookup import PublisherLookup
from rosproxy.ros1.stand_ins.udpros_relays import UdprosRelays
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.connections import sockets
from rosproxy.shared.connections.sockets import Acceptor
from rosproxy.shared.uris import parse_service_uri, slave_uri

log = logging.getLogger(__name__)

MOST_RETRIES = 32
"""Nodes that have refused and that the proxy tries again at the same time."""
PORTS_PER_TURN = 10
"""Ports that the proxy opens before the event loop does other work."""
URIS_PER_TURN = 200
"""URIs that the proxy reads before the event loop does other work. A master may name thousands."""
TIDY_INTERVAL_S = 30.0
SERVICE_PROBLEM_KEPT_S = 600.0
"""Seconds to keep a problem with a service: each call of a client looks the service up anew."""
LONGEST_SHOWN_URI = 200
"""Characters of a URI in the status."""


class StandInPorts:
    """Opens, closes and serves the ports of stand-ins."""

    def __init__(
        self,
        context: Context,
        callers: Callers,
        tcpros: TcprosServer,
        plane: KernelPlane,
    ) -> None:
        self._context = context
        self._callers = callers
        self._stand_ins = context.stand_ins
        self._tcpros = tcpros
        self._plane = plane
        self._acceptors: dict[HostPort, Acceptor] = {}
        self._refused: dict[str, None] = {}
        """URIs of nodes that refused at the last attempt, oldest first; the number is bounded."""
        self._retry_slots = asyncio.Semaphore(MOST_RETRIES)
        greeting = "rosproxy: a ROS node outside\n"
        self.server = XmlRpcServer(context, self._forward, greeting, context.master_call)
        self._outside = Outside(context, self._note_refused)
        self.udpros = UdprosRelays(context, self._outside)
        self._closed = False
        self._lookup = PublisherLookup(context.upstream)

    async def listen_for(self, uris: Iterable[str], caller: Caller) -> None:
        """Open a port for each URI that needs one, before inside gets the URI.

        The URIs must come from the master.
        """
        targets = await self._targets(uris)
        if not targets:
            return
        await self._retry({uri: targets[uri] for uri in self._refused.keys() & targets.keys()})
        address = self._stand_ins.address(caller.proxy)
        # The URIs with a port come first: of a list that is too long, the same URIs stay.
        in_order = sorted(targets, key=lambda uri: not self._stand_ins.find(address, uri))
        for number, uri in enumerate(in_order, start=1):
            if number % PORTS_PER_TURN == 0:
                await asyncio.sleep(0)
            if uri in self._refused or self._closed:
                continue
            if not self._listen(uri, targets[uri], address, targets):
                break

    async def listen_for_announced(self, topic: str, uris: Sequence[str], caller: Caller) -> None:
        """Open ports for the URIs that are publishers at the master, if another program names them.

        Any program may call ``publisherUpdate`` at a lease, and name any port. The source of the
        call proves nothing: every program on the master's host has that address, and NAT gives the
        address to other hosts. A node outside may put any URI into its bus info. So before the
        proxy opens a port, it asks the master whether the URI is a publisher of the topic.
        """
        targets = await self._targets(uris)
        address = self._stand_ins.address(caller.proxy)
        known_uris = {uri for uri in targets if self._stand_ins.find(address, uri)}
        if len(known_uris) < len(targets):
            known_uris |= await self._lookup.publishers_of(topic)
        await self.listen_for((uri for uri in targets if uri in known_uris), caller)

    def with_address(self, body: bytes, call: xmlrpc.Call) -> bytes:
        """A call from outside, parsed as ``call``, with UDPROS offers that nodes inside can reach.

        The master's address replaces the master's host name, if this name leads to the proxy.
        """
        address = self._context.upstream.master_address
        if not address or not self._stand_ins.aliased:
            return body
        return slave_api.with_address(body, call, self._stand_ins.aliased, address)

    async def tidy(self) -> None:
        """Remove problems of nodes that have ended, and of services that have not failed lately.

        Also end UDPROS relays whose node inside is no longer registered.

        The proxy does not try the port of a service: rospy logs a warning for a connection without
        a header.
        """
        self.udpros.sweep()
        for problem in self._context.problems.all():
            uri = problem.subject
            for target in (await self._targets([uri])).values():
                if parse_service_uri(uri):
                    ended = time.time() - problem.when > SERVICE_PROBLEM_KEPT_S
                else:
                    ended = await self._outside.refuses(uri, target)
                if ended:
                    self._context.problems.solved(uri)

    def status(self) -> list[dict[str, Any]]:
        """The ports with their nodes and open connections, for ``/status``."""
        counts = self._connections()
        ports = []
        sent: defaultdict[int, float] = defaultdict(float)
        received: defaultdict[int, float] = defaultdict(float)
        for relay in self._tcpros.relays:
            sent[relay.port] += relay.sent_rate
            received[relay.port] += relay.received_rate
        for stand_in in sorted(
            self._stand_ins.by_local.values(), key=lambda s: (s.local.port, s.uri)
        ):
            plane = self._plane.status_of(stand_in) if stand_in.fast_candidate else None
            ports.append(
                {
                    "port": stand_in.local.port,
                    "uri": stand_in.uri[:LONGEST_SHOWN_URI],
                    "connections": counts[stand_in.local.port],
                    "sent_rate": sent[stand_in.local.port] + (plane["sent_rate"] if plane else 0.0),
                    "received_rate": received[stand_in.local.port]
                    + (plane["received_rate"] if plane else 0),
                    "data_plane": plane,
                }
            )
        return ports

    def close_fast_ports(self) -> int:
        """Close all fast ports, where no header is checked.

        Returns the number of cut connections.
        """
        count = 0
        for stand_in in self._stand_ins.by_local.values():
            if stand_in.fast_port is not None:
                count += stand_in.fast_connections
                self._plane.cut(stand_in)
                self._close_fast_port(stand_in)
        return count

    def close(self) -> None:
        """Stop listening for good."""
        self._closed = True
        self.udpros.close()
        for stand_in in list(self._stand_ins.by_local.values()):
            self._close(stand_in)

    async def _targets(self, uris: Iterable[str]) -> dict[str, HostPort]:
        """The URIs that need a stand-in, each with the host and port of the target."""
        targets = dict[str, HostPort]()
        has_alias = self._context.upstream.master_address is not None
        if self._closed or not (self._stand_ins.is_bidirectional or has_alias):
            return targets
        for number, uri in enumerate(uris, start=1):
            if number % URIS_PER_TURN == 0:
                await asyncio.sleep(0)
            if target := self._context.addressing.stand_in_target(uri):
                targets[uri] = target
        return targets

    def _listen(self, uri: str, target: HostPort, address: str, kept: Container[str]) -> bool:
        """Open the port for a URI, or report why that fails. Return False if there is no room.

        ``kept``: the URIs whose ports the proxy does not close to make room.
        """
        if stand_in := self._stand_ins.find(address, uri):
            self._stand_ins.note_used(stand_in)
            self._open_fast_port(stand_in)
            return True
        lack = reason = self._make_room(kept)
        if lack is None:
            for candidate in self._stand_ins.candidates(uri, target, address):
                reason = self._open(candidate)
                if reason is None:
                    self._context.problems.solved(uri)
                    return True
        self._report_unreachable(uri, target, reason or "")
        return lack is None

    def _report_unreachable(self, uri: str, target: HostPort, reason: str) -> None:
        """Report why no port stands in for a URI; log the same report once."""
        problems = self._context.problems
        master_address = self._context.upstream.master_address or ""
        text = self._stand_ins.advice(target, reason, master_address)
        if (uri, text) not in ((p.subject, p.text) for p in problems.all()):
            log.warning("%s: %s", uri, text)
        problems.add(uri, text)

    def _make_room(self, kept: Container[str]) -> str | None:
        """Close the port unused for longest if there are too many, but no port of ``kept`` URIs.

        Returns None if there is room now, otherwise the reason.
        """
        if len(self._stand_ins.by_local) < stand_ins.MOST_STAND_INS:
            return None
        counts = self._connections()
        # `by_local` begins with the stand-in that has been unused longest.
        for stand_in in self._stand_ins.by_local.values():
            if stand_in.uri not in kept and not counts[stand_in.local.port]:
                self._close(stand_in)
                return None
        return f"can't be opened: all {stand_ins.MOST_STAND_INS} stand-in ports are in use"

    def _open(self, stand_in: StandIn) -> str | None:
        """Open a port; return the reason if that fails."""
        local = stand_in.local
        if reason := stand_ins.obstacle(local.port, self._context.settings):
            return reason
        if local in self._stand_ins.by_local:
            return "already stands in for another node"
        try:
            sock = sockets.listen(local.host, local.port)
        except OSError as error:
            return f"can't be opened by the proxy ({error.strerror})"
        serve = partial(self._serve, stand_in)
        gate = self._context.gate
        self._acceptors[local] = Acceptor(self._context.tasks, sock, serve, gate)
        self._stand_ins.add(stand_in)
        self._open_fast_port(stand_in)
        log.debug("%s stands in for %s", local, stand_in.uri)
        return None

    def _open_fast_port(self, stand_in: StandIn) -> None:
        """Open the fast port of a stand-in if it is useful and possible."""
        usable = self._plane.syncer.usable
        candidate = self._stand_ins.choose_fast_candidate(stand_in) if usable else None
        if candidate is None:
            return
        if not self._context.policy.inside_may_bypass() or stand_ins.obstacle(
            candidate.port, self._context.settings
        ):
            return
        try:
            sock = sockets.listen(candidate.host, candidate.port)
        except OSError as error:
            log.debug("fast port %s can't be opened: %s", candidate, error)
            return
        serve = partial(self._serve, stand_in)
        gate = self._context.gate
        self._acceptors[candidate] = Acceptor(self._context.tasks, sock, serve, gate)
        self._stand_ins.note_fast_port(stand_in, candidate.port)

    def _close_fast_port(self, stand_in: StandIn) -> None:
        if stand_in.fast_port is not None:
            self._acceptors.pop(HostPort(stand_in.local.host, stand_in.fast_port)).close()
            self._stand_ins.note_fast_port(stand_in, None)
            self._plane.syncer.note_change(stand_in)

    async def _topic_listener(self, stand_in: StandIn, tcpros_port: int) -> HostPort:
        """The proxy's port for a node's topics: the fast port if the kernel forwards it."""
        syncer = self._plane.syncer
        fast_port = stand_in.fast_port
        if fast_port is None:
            return stand_in.local
        try:
            stand_in.address = (await self._outside.reach(stand_in.target)).host
        except OSError as error:
            log.debug("%s: %s", stand_in.target, error)
            return stand_in.local
        if syncer.may_forward(stand_in) and await syncer.forwards(stand_in, tcpros_port):
            return HostPort(stand_in.local.host, fast_port)
        syncer.log_reason(stand_in)
        return stand_in.local

    def _close(self, stand_in: StandIn) -> None:
        """Make a port refuse connections; open relays stay."""
        acceptor = self._acceptors.pop(stand_in.local, None)
        if acceptor is not None:
            acceptor.close()
            self._close_fast_port(stand_in)
            self._stand_ins.remove(stand_in)
            self.server.close_port(stand_in.local.port)

    def _note_refused(self, stand_in: StandIn) -> None:
        """Close the port of a node that refuses connections, because such a node has ended.

        `listen_for` opens the port again if the node no longer refuses.
        """
        log.debug(
            "%s refuses connections: the proxy closes the stand-in %s", stand_in.uri, stand_in.local
        )
        self._close(stand_in)
        self._refused[stand_in.uri] = None
        if len(self._refused) > stand_ins.MOST_STAND_INS:
            del self._refused[next(iter(self._refused))]

    async def _retry(self, targets: Mapping[str, HostPort]) -> None:
        """Try nodes that have refused before. Nodes that refuse again stay refused.

        A node inside waits for this, at most RETRY_TIMEOUT_S.
        """
        refusing = set[str]()

        async def try_node(uri: str, target: HostPort) -> None:
            async with self._retry_slots:
                if await self._outside.refuses(uri, target):
                    refusing.add(uri)

        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(RETRY_TIMEOUT_S), asyncio.TaskGroup() as tries:
                for uri, target in targets.items():
                    tries.create_task(try_node(uri, target))
        for uri in targets.keys() - refusing:
            self._refused.pop(uri, None)

    def _connections(self) -> Counter[int]:
        counts = Counter(relay.port for relay in self._tcpros.relays if relay.inside_asks)
        for stand_in in self._stand_ins.by_local.values():
            counts[stand_in.local.port] += (
                self.server.count(stand_in.local.port) + stand_in.fast_connections
            )
        return counts

    async def _serve(self, stand_in: StandIn, conn: socket.socket, peer: str) -> None:
        """Serve a connection from inside: XML-RPC or TCPROS, by its first bytes."""
        await self._callers.wait_until_begun()
        self._context.refresh_networks()
        if self._context.client_kind(peer) is not ClientKind.ADMITTED:
            log.debug("%s may not use the proxy: refused at %s", peer, stand_in.local)
            conn.close()
            return
        self._stand_ins.note_used(stand_in)
        target = OutsideNode(self._outside, self._context, stand_in)
        await self.server.dispatch(conn, peer, partial(self._tcpros.serve, target, peer))

    async def _forward(self, call: IncomingCall) -> bytes:
        """The node's reply to a call. Raises XmlRpcError, Unreachable."""
        if call.comes_from(self._context.instance):
            raise Unreachable("the address of a node outside leads back to the proxy itself")
        stand_in = self._stand_ins.at(call.local)
        if stand_in is None:
            raise Unreachable(f"{call.local} is not a stand-in any more")
        parsed = xmlrpc.parse_call(call.body, self._context.master_call)
        answer = self._answer(stand_in, parsed, call)
        return await count_reply(self._context.metrics, "stand_in", parsed.method, answer)

    async def _answer(self, stand_in: StandIn, parsed: xmlrpc.Call, call: IncomingCall) -> bytes:
        denial = self._context.policy.check_inside_request(parsed, call.source)
        if denial is not None:
            return xmlrpc.dump_reply(denial.answer.triple())
        caller = Caller(call.source, call.local.host)
        master = slave_uri(HostPort(caller.proxy, self._context.settings.master_port))
        view = slave_api.from_inside(caller, master, self._context.addressing)
        body = slave_api.rewrite_call(call.body, parsed, view)
        if not stand_in.is_uri_kept:
            body = await self.udpros.redirect_offers_to_outside(stand_in, parsed, body, call.source)
        reply = await self._outside.ask(stand_in, body, call.path)
        if not slave_api.is_rewritten(parsed.method):
            return reply
        if stand_in.is_uri_kept:
            address = self._context.upstream.master_address or stand_in.target.host
            return slave_api.with_address_in_reply(
                parsed, reply, stand_in.target.host.lower(), address
            )
        listener = stand_in.local
        tcpros_port = slave_api.topic_port(parsed, reply)
        if tcpros_port is not None:
            stand_in.note_topic_port(parsed.string(1) or "", tcpros_port)
            listener = await self._topic_listener(stand_in, tcpros_port)
        for topic, uris in slave_api.named_publishers(parsed, reply).items():
            await self.listen_for_announced(topic, uris, caller)
        return slave_api.rewrite_reply(parsed, reply, listener, view)
