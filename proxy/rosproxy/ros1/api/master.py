"""The master port, which nodes inside call as their master.

A request that registers or names an address takes these steps (`MasterApi`):

1. Read: parse the calls (`rosproxy.ros1.rewriting.master_calls`).
2. Check: ask the policy. The proxy answers calls that a rule denies, and look-ups of hidden names.
3. Admit: give the node an endpoint, and ask the policy about the registration.
4. Export the addresses (`rosproxy.ros1.rewriting.master_api`).
5. Call the master.
6. Record in the registry what the master has accepted, and tell subscribers of hidden publishers.
7. Filter the reply by the policy, and import the addresses.

A ``system.multicall`` takes the same steps for each call. All other requests pass unchanged. The
proxy does not read long requests of this kind, which usually set parameters.
"""

import asyncio
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from rosproxy.net.http_client import LongReply
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import MASTER_METHODS
from rosproxy.ros1.protocol.name_lengths import LONGEST_NAME, too_long_to_register
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import fast, passing
from rosproxy.ros1.protocol.xmlrpc.limits import Limits
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting import master_api, master_calls
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.rewriting.master_calls import (
    CallOutcome,
    ExportedRequest,
    LocalAnswer,
    MasterCall,
    MasterReply,
    Passing,
    RegistryChange,
    Request,
    refusal,
)
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.servers.long_calls import LongCall
from rosproxy.ros1.servers.xmlrpc_server import IncomingCall, count_reply
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.adopter import Adopter
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.ros1.upkeep.publisher_updates import PublisherUpdates
from rosproxy.ros1.upkeep.recovery import Recovery

PendingRegistration = tuple[Endpoint, Registration | None]
"""The endpoint of a call that registers, and the registration; None if the call names nothing."""


@dataclass(slots=True, eq=False)
class MasterApi:
    """Forwards master API calls, rewritten, and keeps the registry in step with the master."""

    _context: Context
    _admission: NodeAdmission
    _adopter: Adopter
    _recovery: Recovery
    _stand_ins: StandInPorts
    _publisher_updates: PublisherUpdates
    _memory: LeaseMemory

    async def __call__(self, call: IncomingCall) -> bytes | LongReply:
        """The reply to a call. Raises XmlRpcError, Unreachable."""
        self._refuse_loop(call)
        metrics = self._context.metrics
        upstream = self._context.upstream
        # rospy and roscpp use only scalars in calls for parameters, except to set a list or struct.
        method = fast.method_of_scalars(call.body) if self._context.policy.idle else None
        if method and _passes(method):
            return await count_reply(metrics, "master", method, upstream.pass_to_master(call.body))
        # The reply to getUri has the address by which the node calls the proxy.
        caller = Caller(call.source, call.local.host, master=call.host_header or str(call.local))
        # roslaunch sets all parameters by a single multicall (launch.py, _load_parameters).
        if len(call.body) > passing.SHORT_BYTES:
            reads_params = self._context.policy.reads_parameters(call.source)
            if not reads_params and await _is_multicall_that_passes(call.body):
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
        """The watch for a long call that may pass unread; None if the proxy must read the call."""
        # To check a call for a single parameter, `pass_on` needs only the head of the call. A
        # multicall may name many parameters, and the proxy must filter a reply to getParamNames.
        is_checked = method in (MULTICALL, "getParamNames")
        if is_checked and self._context.policy.reads_parameters(None):
            return None
        return _watch(method, size, self._context.master_call)

    async def pass_on(self, call: IncomingCall, long_call: LongCall) -> bytes | LongReply:
        """The reply to a long call, which passes unread. Raises XmlRpcError, Unreachable."""
        self._refuse_loop(call)
        metrics = self._context.metrics
        denial = self._context.policy.check_unread(long_call.method, call.body, call.source)
        if denial is not None:
            metrics.count("master", long_call.method, "refused")
            return xmlrpc.dump_reply(denial.answer.triple())
        reply = self._context.upstream.pass_to_master(long_call)
        return await count_reply(metrics, "master", long_call.method, reply)

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

    async def _answer(self, request: Request, incoming: IncomingCall) -> bytes | LongReply:
        """The reply to a parsed request. A request without changes passes as the original bytes."""
        policy = self._context.policy
        if not request.is_address_free:
            # Without the recovery, a node of a former process of the proxy would get another port.
            # rosmaster would shut the node down for the new URI (registrations.py,
            # _register_node_api).
            await self._recovery.ensure()
        version = policy.rules.version
        answers = await policy.check_request(request)
        if request.is_address_free and not any(answers) and not policy.reads_reply(request):
            return await self._context.upstream.pass_to_master(request.body)
        pending = list[PendingRegistration]()
        try:
            outcomes = await self._outcomes(request, answers, incoming, pending)
            return await self._forward(request, outcomes, version)
        finally:
            for endpoint, registration in pending:
                endpoint.pending -= 1
                if registration is not None:
                    self._context.registry.end_promise(endpoint, registration)

    async def _forward(
        self, request: Request, outcomes: Sequence[CallOutcome], version: int
    ) -> bytes:
        """The reply to a request whose calls have these outcomes. Raises XmlRpcError, Unreachable.

        ``version``: the version of the policy that has checked the request.
        """
        context = self._context
        policy = context.policy
        exported = master_api.export_request(request, outcomes, context.addressing)
        self._record(exported.registry_changes(), request.caller)
        if exported.body is None:
            return exported.local_reply()
        reply = await self._call_master(exported, exported.body)
        self._record(reply.registry_changes(context.now()), request.caller)
        await self._memory.write()  # `_record` has just learnt a service's port
        await self._stand_ins.listen_for(reply.uris(), request.caller)
        if policy.rules.version != version:  # new rules may deny the request
            policy.must_enforce = True
        return master_api.import_reply(reply, context.addressing, policy.filter_result)

    async def _outcomes(
        self,
        request: Request,
        answers: Sequence[LocalAnswer | None],
        incoming: IncomingCall,
        pending: list[PendingRegistration],
    ) -> Sequence[CallOutcome]:
        """The outcomes of a request's calls, in order. ``answers``: the answers of the policy.

        The endpoints that the calls register become *pending*, so their leases do not end, and the
        method adds them to ``pending``. Raises Unreachable if the caller closes the connection
        before the call of the master.
        """
        outcomes = list[CallOutcome]()
        # In order, because two calls may register the same new node.
        for call, answer in zip(request.calls, answers, strict=True):
            if outcomes:
                await asyncio.sleep(0)  # with many rules, a call may take milliseconds
            if incoming.gone:
                raise Unreachable("the caller has closed the connection")
            outcome: CallOutcome = answer or Passing.NO_REGISTRATION
            if call and answer is None:
                outcome = await self._outcome(call, request, pending)
            outcomes.append(outcome)
        return outcomes

    async def _outcome(
        self, call: MasterCall, request: Request, pending: list[PendingRegistration]
    ) -> CallOutcome:
        """The outcome of a call. Makes the endpoint that the call registers pending."""
        caller = request.caller
        policy = self._context.policy
        if call.spec.unregisters:
            ended = master_api.unregistering_endpoint(call, caller, self._context.addressing)
            return policy.answer_unregistration(call, ended) or ended
        admission = await self._admit(call, request)
        if isinstance(admission, LocalAnswer) or admission is Passing.NO_REGISTRATION:
            return admission
        if isinstance(admission, Endpoint):
            # Pending before the first await. Otherwise the lease could end meanwhile.
            admission.pending += 1
            if call.registration is not None:
                self._context.registry.promise(admission, call.registration)
            pending.append((admission, call.registration))
            await self._adopter.take_over(admission, call.caller_id)
        denial = policy.check_registration(call, admission, caller, self._context.now())
        return denial.answer if denial else admission

    async def _admit(self, call: MasterCall, request: Request) -> CallOutcome:
        """Admit a call, or refuse a name that is too long or exceeds the bound of an endpoint."""
        caller = request.caller
        may_be_long = len(request.body) > LONGEST_NAME
        if may_be_long and (text := too_long_to_register(call)):
            return self._refuse("long_name", call, caller, text)
        admission = await self._admission.admit(call, caller)
        if not isinstance(admission, Endpoint):
            return admission
        registration = call.registration
        if registration and (text := self._context.registry.reason_full(admission, registration)):
            return self._refuse("too_many_names", call, caller, text)
        return admission

    def _refuse(self, reason: str, call: MasterCall, caller: Caller, text: str) -> LocalAnswer:
        """Report a call over a bound, and return the refusal."""
        description = f"{call.method} of {caller.caller_id}: {text}"
        self._context.refusals.note(reason, caller.address, description)
        return refusal(f"rosproxy: {text}")

    async def _call_master(self, exported: ExportedRequest, body: bytes) -> MasterReply:
        """The master's reply to a request. Raises XmlRpcError, Unreachable."""
        # Written before the call: if the proxy is killed after the call, the next process finds a
        # registration with this lease, and needs the address of the node.
        await self._memory.write()
        limits = exported.request.reply_limits
        answer = await self._context.upstream.post_to_master(body, limits)
        return master_calls.read_reply(exported, answer)

    def _record(self, changes: Iterable[RegistryChange], caller: Caller) -> None:
        """Record what the master has accepted, and what the policy hides from the master.

        The registry takes the port of a service only from a caller at the address of the node. Any
        node may register a service by the name of another node, and outside would reach the port.
        """
        registry = self._context.registry
        for change in changes:
            registration = change.registration
            endpoint = change.endpoint
            if endpoint is None:
                registry.unregister(registration.kind, registration.name, registration.caller_id)
            elif registry.by_port.get(endpoint.port) is endpoint:  # not removed since
                registration = self._context.policy.settle(endpoint, registration)
                if caller.address == endpoint.location.address:
                    registry.register(endpoint, registration)
                else:
                    registry.register(endpoint, replace(registration, service_api=None))
            self._publisher_updates.note_registration(registration)


@dataclass(slots=True, eq=False)
class PublishedMaster:
    """Forwards calls of outside to a master that runs inside (``--publish-master``).

    The registrations at the master already have outside addresses. The proxy replaces only the URI
    of the master by ``address``, the published address.
    """

    _context: Context
    _address: str

    async def __call__(self, call: IncomingCall) -> bytes | LongReply:
        """The reply to a call. Raises XmlRpcError, Unreachable."""
        upstream = self._context.upstream
        if len(call.body) > passing.SHORT_BYTES and await _is_multicall_that_passes(call.body):
            return await upstream.pass_to_master(call.body)
        caller = Caller(call.source, call.local.host, master=self._address)
        request = master_calls.read_request(call.body, caller, self._context.master_call)
        if request.is_address_free:
            return await upstream.pass_to_master(call.body)
        reply = await upstream.post_to_master(call.body)
        return master_api.rename_master(request, reply, self._address)

    def watch(self, method: str, size: int) -> passing.CallWatch | None:
        """The watch for a long call that may pass unread; None if the proxy must read the call."""
        return _watch(method, size, self._context.master_call)

    async def pass_on(self, call: IncomingCall, long_call: LongCall) -> bytes | LongReply:
        """The reply to a long call, which passes unread. Raises XmlRpcError, Unreachable."""
        return await self._context.upstream.pass_to_master(long_call)


def _passes(method: str) -> bool:
    return method not in MASTER_METHODS


def _watch(method: str, size: int, limits: Limits) -> passing.CallWatch | None:
    if method == MULTICALL:  # the proxy reads a shorter multicall, which may have addresses
        return passing.MulticallWatch(_passes) if size > limits.size else None
    return passing.CallWatch() if _passes(method) else None


async def _is_multicall_that_passes(body: bytes) -> bool:
    """Whether a long body is a multicall that the proxy need not read."""
    if passing.method_of(body) != MULTICALL:
        return False
    watch = passing.MulticallWatch(_passes)
    if watch.passes(body):
        return True
    try:
        for piece in passing.cut(body):
            watch.see(piece)
            await asyncio.sleep(0)
        watch.end()
    except xmlrpc.XmlRpcError:  # the proxy then reads the call and reports the error
        return False
    return True
