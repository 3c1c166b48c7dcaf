"""The slave API of inside nodes, which outside and the master reach through leases.

Each endpoint has a port, and a call that arrives at the port is for this endpoint. The proxy
imports the addresses in the call, forwards the call to the endpoint, and exports the addresses in
the reply (`rosproxy.ros1.rewriting.slave_api`). The proxy also records the TCPROS port that a node
names in a reply, and whether the node answers.
"""

import asyncio
import logging
import socket
from collections.abc import Awaitable
from functools import partial
from typing import TypeVar

from rosproxy.net.http_client import LongReply
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.context import MANY_VALUES, Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.protocol.master_methods import MASTER_ONLY
from rosproxy.ros1.protocol.name_lengths import too_long_to_ask
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import multicall, passing
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.rewriting import slave_api
from rosproxy.ros1.servers.long_calls import LongCall
from rosproxy.ros1.servers.tcpros_server import InsideNodes, TcprosServer
from rosproxy.ros1.servers.xmlrpc_server import IncomingCall, XmlRpcServer, count_reply
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.adopter import Adopter
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_inside_path

log = logging.getLogger(__name__)

_Answer = TypeVar("_Answer")
NO_CALLER_ID = (
    "the proxy can't read the caller_id of this call, and needs the caller_id to apply the policy. "
    "Send the caller_id as the first parameter, a string"
)
NOT_THE_MASTER = "only the master's host may call this method (--slave-control master)"


class SlaveApi:
    """Serves the ports of nodes inside: XML-RPC here, topics and services by ``tcpros``."""

    def __init__(
        self,
        context: Context,
        leases: Leases,
        stand_ins: StandInPorts,
        adopter: Adopter,
        tcpros: TcprosServer,
    ) -> None:
        self._context = context
        self._leases = leases
        self._stand_ins = stand_ins
        self._adopter = adopter
        self._tcpros = tcpros
        self._policy = context.policy
        self._nodes = InsideNodes(context)
        greeting = "rosproxy: slave API of a ROS node behind the proxy\n"
        self.server = XmlRpcServer(context, self, greeting, context.lease_call, self)

    async def serve(self, endpoint: Endpoint, conn: socket.socket, peer: str) -> None:
        """Serve a connection to a port of an endpoint. Raises TimeoutError, OSError."""
        target = self._nodes.target(endpoint)
        await self.server.dispatch(conn, peer, partial(self._tcpros.serve, target, peer))

    def end_calls(self, port: int) -> None:
        """End the XML-RPC connections of a closed port, busy connections after the current call."""
        self.server.close_port(port)

    async def __call__(self, call: IncomingCall) -> bytes | LongReply:
        """The node's reply to a call, rewritten. Raises XmlRpcError, Unreachable."""
        endpoint = self._endpoint(call)
        method = passing.method_of(call.body)
        if method is not None and not await self._may_call(method, call.source):
            return self._refuse(method, NOT_THE_MASTER)  # before parsing, which takes time
        try:
            parsed = xmlrpc.parse_call(call.body, self._context.lease_call)
        except xmlrpc.XmlRpcError:
            self._context.metrics.count("slave", "other", "malformed")
            raise
        if parsed.method != multicall.MULTICALL:
            return await self._reply_to_call(endpoint, parsed, call.body, call)
        results = []
        for inner in multicall.inner_calls(parsed):
            if call.gone:
                raise Unreachable("the caller has closed the connection")
            results.append(await self._multicall_result(endpoint, inner, call))
            call.charge(len(results[-1]))
            # A refused or absorbed call waits for no node. So let other tasks run here.
            await asyncio.sleep(0)
        return multicall.results_reply(results)

    def watch(self, method: str, size: int) -> passing.CallWatch | None:
        """The watch for a long call that may pass unread; None if the proxy must read the call."""
        return passing.CallWatch() if slave_api.passes_unread(method) else None

    async def pass_on(self, call: IncomingCall, long_call: LongCall) -> bytes | LongReply:
        """The node's reply to a long call, which passes unread. Raises XmlRpcError, Unreachable."""
        endpoint = self._endpoint(call)
        method = long_call.method
        caller_id, parameter = passing.first_strings(call.body, 2)
        reason = await self._reason_against_call(endpoint, method, caller_id or "", call.source)
        if reason is None and caller_id is None and not self._policy.idle:
            reason = NO_CALLER_ID
        if reason is None and method == "paramUpdate":
            reason = await self._reason_against_update(endpoint, parameter)
        if reason is not None:
            return self._refuse(method, reason)
        reply = self._forward_unchanged(endpoint, long_call)
        return await count_reply(self._context.metrics, "slave", method, reply)

    def _endpoint(self, call: IncomingCall) -> Endpoint:
        """The endpoint that a call is for.

        Raises Unreachable if the call comes from this proxy, or if the node has gone.
        """
        endpoint = self._context.registry.by_port.get(call.local.port)
        if call.comes_from(self._context.instance):
            raise Unreachable("the address of a node leads back to the proxy itself")
        if endpoint is None or not self._matches_path(endpoint, call.path):
            raise Unreachable(f"port {call.local.port} has no node at {call.path} any more")
        return endpoint

    def _matches_path(self, endpoint: Endpoint, path: str) -> bool:
        """Whether the path of a request names this endpoint.

        Also true if the path names no node: roscpp drops the path of a URI (subscription.cpp,
        negotiateConnection). The port may serve another node by now. A ``shutdown`` that the master
        sends to the former node must not end the present node.
        """
        inside_path = parse_inside_path(path)
        return inside_path is None or inside_path.slave == endpoint.slave

    async def _multicall_result(
        self, endpoint: Endpoint, inner: xmlrpc.Call | None, call: IncomingCall
    ) -> bytes:
        """The result of one call in a multicall. The node gets only single calls.

        Several client libraries lack system.multicall (docs/architecture.md, Client libraries).
        """
        if inner is None:
            text = f"an element of {multicall.MULTICALL} is not a method call"
            return multicall.fault_value(xmlrpc.INVALID_REQUEST, f"rosproxy: {text}")
        body = multicall.single_call(inner)
        reply = await self._reply_to_call(
            endpoint, xmlrpc.parse_call(body, self._context.lease_call), body, call
        )
        if isinstance(reply, LongReply):
            reply.close()
            text = f"a reply of {reply.size} bytes is too long for a {multicall.MULTICALL}"
            return multicall.fault_value(xmlrpc.SYSTEM_ERROR, f"rosproxy: {text}")
        return multicall.result_value(reply)

    async def _reply_to_call(
        self, endpoint: Endpoint, parsed: xmlrpc.Call, body: bytes, call: IncomingCall
    ) -> bytes | LongReply:
        """The reply to a single call.

        ``body`` is the document of the single call. ``call`` is the call that has arrived: the
        single call, or a multicall around the single call.
        """
        caller_id = parsed.string(0) or ""
        reason = await self._reason_against_call(endpoint, parsed.method, caller_id, call.source)
        if reason is None and parsed.method == "paramUpdate":
            reason = await self._reason_against_update(endpoint, parsed.string(1))
        if reason is not None:
            return self._refuse(parsed.method, reason)
        if too_long := too_long_to_ask(parsed):
            self._context.metrics.count("slave", parsed.method, "refused")
            return xmlrpc.dump_reply([-1, f"rosproxy: {too_long}", 0])
        if parsed.method == "requestTopic":
            denial = self._policy.check_outside_request(parsed, endpoint, call.source)
            if denial is not None:
                self._context.metrics.count("slave", parsed.method, "refused")
                return xmlrpc.dump_reply(denial.answer.triple())
        reply = self._forward_allowed(endpoint, parsed, body, call)
        return await count_reply(self._context.metrics, "slave", parsed.method, reply)

    def _refuse(self, method: str, reason: str) -> bytes:
        """Count a refused call; return the reply with the reason."""
        self._context.metrics.count("slave", method, "refused")
        return xmlrpc.dump_reply([-1, f"rosproxy: {reason}", 0])

    async def _forward_allowed(
        self, endpoint: Endpoint, parsed: xmlrpc.Call, body: bytes, call: IncomingCall
    ) -> bytes | LongReply:
        """The node's reply to an allowed call, or the proxy's reply to a call that `_absorb` takes.

        Imports the addresses in the call, and exports the addresses in the reply. Before a
        ``publisherUpdate``, opens stand-ins for the publishers and adds hidden publishers.
        """
        if await self._absorb(endpoint, parsed):
            return xmlrpc.dump_reply([1, "", 0])
        if not slave_api.is_rewritten(parsed.method):
            return await self._forward_unchanged(endpoint, body)
        if parsed.method == "publisherUpdate":
            await self._context.wait_for_registration(endpoint)
            topic = parsed.string(1) or ""
            announced = slave_api.announced_publishers(parsed)
            node = self._context.caller_at(endpoint)
            await self._stand_ins.listen_for_announced(topic, announced, node)
            if len(announced) > MANY_VALUES:
                await self._context.yield_to_others()
            body, parsed = self._with_publishers_for_node(endpoint, parsed, body)
        self._context.refresh_networks()
        addressing = self._context.addressing
        is_local = call.reached_locally
        node = self._context.caller_at(endpoint)
        view = slave_api.from_outside(node, self._context.settings.master_uri, addressing)
        if self._context.stand_ins.is_bidirectional:
            body = await self._stand_ins.udpros.redirect_offers_to_inside(
                endpoint, parsed, body, call.source
            )
        else:
            body = self._stand_ins.with_address(body, parsed)
        reply = await self._forward_rewritten(endpoint, slave_api.rewrite_call(body, parsed, view))
        # Only this reply names the TCPROS port of the node. The relay and the kernel plane lead the
        # next connections to the port that the proxy records here.
        port = endpoint.port
        topic_port = slave_api.topic_port(parsed, reply)
        if topic_port is not None:
            endpoint.note_topic_port(parsed.string(1) or "", topic_port)
            if self._policy.may_bypass(endpoint):
                port = await self._leases.obtain_fast_port(endpoint, topic_port) or port
        reached = HostPort(call.local.host, port) if is_local else addressing.outside(port)
        return slave_api.rewrite_reply(parsed, reply, reached, view)

    def _with_publishers_for_node(
        self, endpoint: Endpoint, parsed: xmlrpc.Call, body: bytes
    ) -> tuple[bytes, xmlrpc.Call]:
        """The body and the parsed call of a publisherUpdate with the publishers for the node.

        `publishers_for` adds the publishers that the master does not have. If the subscriber itself
        is hidden from the master, only publishers inside remain. Unchanged if the publishers are
        the same.
        """
        topic = parsed.string(1) or ""
        announced = slave_api.announced_publishers(parsed)
        publishers = self._policy.publishers_for(endpoint, topic, announced)
        if publishers == [*dict.fromkeys(announced)]:
            return body, parsed
        body = xmlrpc.dump_call(parsed.method, parsed.string(0) or "", topic, publishers)
        return body, xmlrpc.parse_call(body)

    async def _absorb(self, endpoint: Endpoint, parsed: xmlrpc.Call) -> bool:
        """Keep a needless ``shutdown`` or an outdated ``publisherUpdate`` from the node.

        Return True if the call is kept from the node. `Adopter.absorb_shutdown` may also register
        the node again.
        """
        if parsed.method == "shutdown":
            caller_id = parsed.string(0) or ""
            reason = parsed.string(1) or ""
            return await self._adopter.absorb_shutdown(endpoint, caller_id, reason)
        if parsed.method != "publisherUpdate":
            return False
        return slave_api.is_outdated(parsed, self._context.addressing, self._context.now())

    async def _forward_rewritten(self, endpoint: Endpoint, body: bytes) -> bytes:
        return await self._await_and_note_health(
            endpoint, self._context.upstream.post_to_node(endpoint.slave, body)
        )

    async def _forward_unchanged(
        self, endpoint: Endpoint, body: bytes | LongCall
    ) -> bytes | LongReply:
        return await self._await_and_note_health(
            endpoint, self._context.upstream.pass_to_node(endpoint.slave, body)
        )

    async def _await_and_note_health(
        self, endpoint: Endpoint, answer: Awaitable[_Answer]
    ) -> _Answer:
        """Await the answer of a node, and record whether the node answers. Raises Unreachable."""
        health = endpoint.health
        try:
            reply = await answer
        except Unreachable as error:
            if error.probe is ProbeResult.ANSWERED:  # with an HTTP answer that is no reply
                health.note(error.probe, self._context.now())
            if error.refused and health.note(error.probe, self._context.now()):
                # With this refusal the node counts as ended. So the proxy closes the node's port
                # now, and the port refuses the next caller.
                log.info("%s has ended: %s", endpoint.label, error)
                self._leases.close(endpoint)
            raise
        health.note(ProbeResult.ANSWERED, self._context.now())
        return reply

    async def _reason_against_call(
        self, endpoint: Endpoint, method: str, caller_id: str, source: str
    ) -> str | None:
        """The reason why a caller may not call a method of a node; None if allowed."""
        if not await self._may_call(method, source):
            return NOT_THE_MASTER
        denial = await self._policy.check_slave_call(method, endpoint, source, caller_id)
        return denial.reason if denial else None

    async def _reason_against_update(self, endpoint: Endpoint, parameter: str | None) -> str | None:
        """The reason to refuse a ``paramUpdate``; None if the node may have subscribed.

        rosmaster keeps parameter subscriptions of nodes that have ended. Some libraries do not
        unsubscribe (rosrust subscribes to every parameter). The port may now belong to another
        node, which gets the updates for the former node. A node of rosnodejs never answers a
        ``paramUpdate``. While rosmaster waits for the answer, rosmaster sends this node no
        ``publisherUpdate``.
        """
        await self._context.wait_for_registration(endpoint)
        if parameter is None or endpoint.may_hear_of(parameter):
            return None
        return f"{endpoint.label} has not subscribed to parameter {parameter}"

    async def _may_call(self, method: str, source: str) -> bool:
        """Whether ``--slave-control`` allows a source to call a method."""
        all_may_call = self._context.settings.slave_control == "any"
        if all_may_call or method not in MASTER_ONLY:
            return True
        return source in await self._context.upstream.master_addresses()
