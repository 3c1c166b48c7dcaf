"""The master port: inside nodes call it as their master.

A call that registers or names an address goes one way: its node is admitted (`admission`), its
addresses are exported, the master is called, what it accepted is noted in the registry, and the
addresses in the reply are imported (`rosproxy.ros1.rewriting.master_api`). All other calls pass as
they are; long ones, parameters above all, unread.

The policy is asked (`AccessChecks`) when it is settled what becomes of each call, and what it
changes in the reply. What it denies the master does not get; the nodes inside that have to know are
told (`PublisherUpdates`).
"""

import asyncio
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace

from rosproxy.net.http_client import LongReply
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import NO_SPEC, method_spec
from rosproxy.ros1.protocol.name_lengths import LONGEST_NAME, too_long_to_register
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.protocol.xmlrpc.limits import Limits
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting import master_api, master_calls
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.rewriting.master_calls import (
    CallOutcome,
    LocalReply,
    Refusal,
    RegistryChange,
    Request,
    caller_id_of,
)
from rosproxy.ros1.servers.access_checks import AccessChecks
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.servers.long_calls import LongCall
from rosproxy.ros1.servers.xmlrpc_server import IncomingCall, count_reply
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.adopter import Adopter
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.ros1.upkeep.policy_enforcer import PolicyEnforcer
from rosproxy.ros1.upkeep.publisher_updates import PublisherUpdates
from rosproxy.ros1.upkeep.recovery import Recovery
from rosproxy.ros1.upkeep.service_finder import ServiceFinder


@dataclass(slots=True, eq=False)
class MasterApi:
    """Forwards master API calls, rewritten, and keeps the registry in step with the master."""

    _context: Context
    _admission: NodeAdmission
    _stand_ins: StandInPorts
    _recovery: Recovery
    _adopter: Adopter
    _access: AccessChecks
    _publisher_updates: PublisherUpdates
    _enforcer: PolicyEnforcer
    _services: ServiceFinder
    _memory: LeaseMemory

    async def __call__(self, call: IncomingCall) -> bytes | LongReply:
        """The reply to a call. Raises XmlRpcError, Unreachable."""
        self._refuse_loop(call)
        # getUri is answered with the address by which the node itself calls the proxy.
        caller = Caller(call.source, call.local.host, master=call.host_header or str(call.local))
        metrics = self._context.metrics
        upstream = self._context.upstream
        judges_params = self._access.judges_parameters(call.source)
        # roslaunch sets all its parameters by one multicall (launch.py, _load_parameters).
        if not judges_params and await _is_long_and_passes(call.body):
            return await count_reply(
                metrics, "master", MULTICALL, upstream.pass_to_master(call.body)
            )
        try:
            request = master_calls.read_request(call.body, caller, self._context.master_call)
        except xmlrpc.XmlRpcError:
            metrics.count("master", "other", "malformed")
            raise
        return await count_reply(metrics, "master", request.method, self._answer(request, call))

    def watch(self, method: str, size: int) -> passing.CallWatch | None:
        """How to watch a long call while it passes; None if it has to be read."""
        # A call for one parameter is judged by its head (`pass_on`). A multicall holds many, and of
        # getParamNames the reply has to be filtered.
        if method in (MULTICALL, "getParamNames") and self._access.judges_parameters(None):
            return None
        return _watch(method, size, self._context.master_call)

    async def pass_on(self, call: IncomingCall, long_call: LongCall) -> bytes | LongReply:
        """The reply to a long call, which passes unread. Raises XmlRpcError, Unreachable."""
        self._refuse_loop(call)
        local_reply = self._access.judge_long(long_call.method, call.body, call.source)
        if local_reply is not None:
            self._context.metrics.count("master", long_call.method, "refused")
            return xmlrpc.dump_reply(local_reply.triple())
        reply = self._context.upstream.pass_to_master(long_call)
        return await count_reply(self._context.metrics, "master", long_call.method, reply)

    def _refuse_loop(self, call: IncomingCall) -> None:
        """Refuse a call that the proxy itself has made. Raises XmlRpcError."""
        if call.comes_from(self._context.instance):
            text = "the address of a node leads back to the proxy itself"
            if call.loop_id == self._context.instance:
                uri = self._context.settings.master_uri
                text = (
                    f"master {uri} leads back to the proxy itself. Set the URI of the real master"
                )
            raise xmlrpc.XmlRpcError(xmlrpc.SYSTEM_ERROR, text)

    async def _answer(self, request: Request, call: IncomingCall) -> bytes | LongReply:
        """The reply to a request that was read; what needs no change passes untouched."""
        if not request.plain:
            # A node that a former process of the proxy knew would get another port before that, and
            # rosmaster would shut it down for its new URI (registrations.py, _register_node_api).
            await self._recovery.ensure()
            await self._services.find_for(request)
        elif self._access.idle:
            return await self._context.upstream.pass_to_master(request.body)
        replies = await self._access.judge_request(request)
        if request.plain and not any(replies) and not self._access.has_to_read_reply(request):
            return await self._context.upstream.pass_to_master(request.body)
        return await self._rewrite(request, replies, call)

    async def _rewrite(
        self, request: Request, replies: Sequence[LocalReply | None], call: IncomingCall
    ) -> bytes:
        """Admit nodes, export URIs, call the master, note what it accepted, import its URIs."""
        addressing = self._context.addressing
        version = self._context.policy.version
        async with self._outcomes(request, replies, call) as outcomes:
            exported = master_api.export_request(request, outcomes, addressing)
            self._note(exported.registry_changes(), request.caller.address)
            if exported.body is None:
                return exported.local_reply()
            # Before the master knows the node: were the proxy killed in between, the next process
            # would find a registration with this lease, and not know where its node is.
            await self._memory.write()
            limits = request.reply_limits
            answer = await self._context.upstream.post_to_master(exported.body, limits)
            reply = master_calls.read_reply(exported, answer)
            self._note(reply.registry_changes(self._context.now()), request.caller.address)
            await self._memory.write()  # the registry learns a service's port only now
            await self._stand_ins.listen_for(reply.uris(), request.caller)
            if self._context.policy.version != version:  # what was judged may be denied by now
                self._enforcer.look_again()
            return master_api.import_reply(reply, addressing, self._access.reply_changes(reply))

    @asynccontextmanager
    async def _outcomes(
        self, request: Request, replies: Sequence[LocalReply | None], incoming: IncomingCall
    ) -> AsyncIterator[Sequence[CallOutcome]]:
        """What becomes of each call of a request; some have a reply already. Raises Unreachable.

        Within the context the endpoints that they register are *pending*: their leases do not end
        while the calls are on their way. If the caller goes away meanwhile, the master is told
        nothing.
        """
        self._context.refresh_networks()
        outcomes = list[CallOutcome]()
        pending = list[Endpoint]()
        try:
            # One after the other: they may register the same new node.
            for call, reply in zip(request.calls, replies, strict=True):
                if incoming.gone:
                    raise Unreachable("the caller has closed the connection")
                outcome: CallOutcome = reply
                if call and reply is None:
                    outcome = await self._outcome(call, request, pending)
                outcomes.append(outcome)
                await asyncio.sleep(0)  # with many rules one call may take milliseconds
            yield outcomes
        finally:
            for endpoint in pending:
                endpoint.release()

    async def _outcome(self, call: Call, request: Request, pending: list[Endpoint]) -> CallOutcome:
        """What becomes of a call; the endpoint that it registers is pending from now on."""
        caller = request.caller
        if method_spec(call.method).unregisters:
            endpoint = master_api.unregistering_endpoint(call, caller, self._context.addressing)
            return self._access.judge_unregistration(call, endpoint, caller) or endpoint
        admission = await self._admit(call, request)
        if isinstance(admission, Endpoint):
            # Held before anything is awaited: nothing else keeps the lease from ending meanwhile.
            admission.hold()
            pending.append(admission)
            await self._adopter.take_over(admission, caller_id_of(call))
        return self._access.judge_registration(call, admission, caller, self._context.now())

    async def _admit(self, call: Call, request: Request) -> CallOutcome:
        """What becomes of one call; what is too long, or one too many, is refused."""
        caller = request.caller
        may_be_long = len(request.body) > LONGEST_NAME
        if may_be_long and (text := too_long_to_register(call)):
            return self._refuse("long_name", call, caller, text)
        admission = await self._admission.admit(call, caller)
        if isinstance(admission, Endpoint) and (text := admission.reason_full):
            return self._refuse("too_many_names", call, caller, text)
        return admission

    def _refuse(self, reason: str, call: Call, caller: Caller, text: str) -> Refusal:
        """Refuse a call that is over a bound, and tell of it."""
        description = f"{call.method} of {caller.caller_id}: {text}"
        self._context.refusals.note(reason, caller.address, description)
        return Refusal(f"rosproxy: {text}")

    def _note(self, facts: Iterable[RegistryChange], source: str) -> None:
        """Note what the master has accepted, and what the policy keeps from it.

        A service's port is believed only from the node's own address: anybody may register a
        service in another node's name, and its port would be opened to outside.
        """
        registry = self._context.registry
        for fact in facts:
            registration = fact.registration
            if fact.endpoint is None:
                registry.unregister(registration.kind, registration.name, registration.caller_id)
            elif registry.by_port.get(fact.endpoint.port) is fact.endpoint:  # not forgotten since
                own = source == fact.endpoint.location.address
                registration = self._keep_shown(fact.endpoint, registration)
                registry.register(
                    fact.endpoint, registration if own else replace(registration, service_api=None)
                )
            self._publisher_updates.note_registration(registration)

    def _keep_shown(self, endpoint: Endpoint, registration: Registration) -> Registration:
        """A registration to note: one that the master has stays shown until it is taken back.

        A policy that hides it now has just changed, and no topic of a node that hides anything may
        bypass the proxy: in both cases the enforcer looks again.
        """
        previous = endpoint.registrations.get(registration.key)
        was_shown = previous is not None and not previous.hidden
        if registration.hidden and (was_shown or endpoint.fast_port is not None):
            self._enforcer.look_again()
        hide = registration.hidden and not was_shown
        return registration if registration.hidden is hide else replace(registration, hidden=hide)


@dataclass(slots=True, eq=False)
class PublishedMaster:
    """The master itself for outside (``--publish-master``), where it runs inside.

    What the master holds are outside addresses already; only its own URI is replaced, by the one at
    which it is published: ``address``.
    """

    _context: Context
    _address: str

    async def __call__(self, call: IncomingCall) -> bytes | LongReply:
        """The reply to a call. Raises XmlRpcError, Unreachable."""
        upstream = self._context.upstream
        if await _is_long_and_passes(call.body):
            return await upstream.pass_to_master(call.body)
        caller = Caller(call.source, call.local.host, master=self._address)
        request = master_calls.read_request(call.body, caller, self._context.master_call)
        if request.plain:
            return await upstream.pass_to_master(call.body)
        reply = await upstream.post_to_master(call.body)
        return master_api.rename_master(request, reply, self._address)

    def watch(self, method: str, size: int) -> passing.CallWatch | None:
        """How to watch a long call while it passes; None if it has to be read."""
        return _watch(method, size, self._context.master_call)

    async def pass_on(self, call: IncomingCall, long_call: LongCall) -> bytes | LongReply:
        """The reply to a long call, which passes unread. Raises XmlRpcError, Unreachable."""
        return await self._context.upstream.pass_to_master(long_call)


def _passes(method: str) -> bool:
    return method_spec(method) == NO_SPEC


def _watch(method: str, size: int, limits: Limits) -> passing.CallWatch | None:
    if method == MULTICALL:  # a shorter one may hold calls with addresses, so it is read
        return passing.MulticallWatch(_passes) if size > limits.size else None
    return passing.CallWatch() if _passes(method) else None


async def _is_long_and_passes(body: bytes) -> bool:
    """Whether a body is a long multicall of which nothing has to be read."""
    if len(body) <= passing.SHORT or passing.method_of(body) != MULTICALL:
        return False
    watch = passing.MulticallWatch(_passes)
    try:
        for piece in passing.cut(body):
            watch.see(piece)
            await asyncio.sleep(0)
        watch.end()
    except xmlrpc.XmlRpcError:  # it is read then, which tells the error
        return False
    return True
