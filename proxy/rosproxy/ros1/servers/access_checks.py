"""What the policy says to calls at the master port, and to what outside asks of a node inside.

One object that `rosproxy.ros1.api` and the TCPROS server ask, each at one step. What is denied at
the master port comes back as the reply to give instead; what is denied to outside, as the reason.
Somebody who has the address of a node inside is no outsider: nodes in several inside networks
reach each other through the proxy's ports.
"""

import asyncio
from dataclasses import dataclass, replace

from rosproxy.access.access_policy import OUTWARDS, PARAMETERS, AccessPolicy
from rosproxy.access.layers import Verdict, strictest
from rosproxy.access.rules import RuleKind
from rosproxy.forwarding.relay import Relay
from rosproxy.ros1.clients.master_client import MasterClient, MasterError, Unreachable
from rosproxy.ros1.protocol.master_methods import Kind, method_spec, prefix
from rosproxy.ros1.protocol.uris import parse_service_uri
from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.rewriting import policing
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.ros1.rewriting.master_calls import (
    NO_REPLY_CHANGES,
    CallOutcome,
    LocalAnswer,
    LocalReply,
    MasterReply,
    Refusal,
    ReplyChanges,
    Request,
    registration_of,
    second_parameter_name,
)
from rosproxy.ros1.rewriting.policing import ParamUse
from rosproxy.ros1.rewriting.slave_api import MASTER_ONLY

MASTER = "/master"
"""The caller_id of the master's calls to nodes (rosmaster/registrations.py)."""


@dataclass(slots=True, eq=False)
class AccessChecks:
    """Applies the policy to calls and connections."""

    _policy: AccessPolicy
    _registry: Registry
    _addressing: Addressing
    _upstream: MasterClient

    @property
    def idle(self) -> bool:
        """Whether there is nothing to judge: no rule, and nothing that a former one has hidden."""
        return self._policy.empty and not self._registry.hidden

    # Calls at the master port

    def judges_parameters(self, source: str | None) -> bool:
        """Whether calls for parameters from an address have to be read; None: from any."""
        return self._policy.may_deny(PARAMETERS, (), source)

    def has_to_read_reply(self, request: Request) -> bool:
        """Whether the reply to a request has to say otherwise than the master does."""
        hides = request.tells_graph and bool(self._registry.hidden)
        return hides or self.filters_names(request)

    def filters_names(self, request: Request) -> bool:
        """Whether the reply to a request lists parameters that its node may not see."""
        listing = any(call and call.method == "getParamNames" for call in request.calls)
        caller = request.caller
        callers = [caller.caller_id]
        return listing and self._policy.may_deny({RuleKind.GET_PARAM}, callers, caller.address)

    async def judge_request(self, request: Request) -> list[LocalReply | None]:
        """The replies to those calls of a request that the master does not get.

        Those that register are judged once they have an endpoint (`judge_registration`).
        Raises Unreachable.
        """
        caller = request.caller
        params = _KnownParams(self._upstream)
        if self.idle:
            return [None] * len(request.calls)
        replies = list[LocalReply | None]()
        for call in request.calls:
            replies.append(await self._judge_call(call, caller, params) if call else None)
            await asyncio.sleep(0)  # with many rules one call may take milliseconds
        return replies

    def judge_long(self, method: str, head: bytes, source: str) -> LocalReply | None:
        """The reply to a long call of which only the head was read; None if it passes."""
        caller_id, name = passing.first_strings(head, 2)
        use = policing.param_use(method, caller_id or "", name)
        if use is None:
            return None
        verdict = self._judge_use(use, caller_id or "", source)
        return _refusal(self._policy.report(verdict, use.kind, f"of {caller_id}", source))

    def judge_registration(
        self, call: Call, admission: CallOutcome, caller: Caller, now: float
    ) -> CallOutcome:
        """What becomes of a call that registers, once its node is admitted."""
        if self.idle or isinstance(admission, LocalReply):
            return admission
        affected = registration_of(call, now, caller.address)
        if affected is None or affected.kind is Kind.PARAM:  # parameters were judged before
            return admission
        address = admission.address if isinstance(admission, Endpoint) else caller.address
        kind = policing.KINDS[affected.kind]
        callers = [affected.caller_id]
        verdict = self._policy.ask(kind, affected.name, callers, address)
        if verdict.allowed:
            return admission
        if not isinstance(admission, Endpoint):
            return _refusal(verdict)  # a URI of somebody else, whom the proxy could not hide
        concealed = replace(affected, hidden=True)
        return policing.hidden_registration(concealed, admission, caller, self._addressing)

    def judge_unregistration(
        self, call: Call, endpoint: Endpoint | None, caller: Caller
    ) -> LocalAnswer | None:
        """The answer to a call that ends a registration of which the master does not know."""
        ended = registration_of(call, 0.0, caller.address)
        if self.idle or endpoint is None or ended is None or ended.kind is Kind.PARAM:
            return None
        current = endpoint.registrations.get(ended.key)
        return policing.hidden_unregistration(current) if current and current.hidden else None

    def reply_changes(self, reply: MasterReply) -> ReplyChanges:
        """What the policy changes in the master's reply."""
        if self.idle:
            return NO_REPLY_CHANGES
        publishers = dict[str, list[str]]()
        caller = reply.exported.request.caller
        for result in reply.results:
            if method_spec(result.call.method).registers is Kind.SUBSCRIBER and result.endpoint:
                topic = second_parameter_name(result.call)
                publishers[topic] = policing.publishers_for(
                    result.endpoint, topic, [], self._addressing
                )
        params: frozenset[str] = frozenset()
        if self.filters_names(reply.exported.request):
            kind = RuleKind.GET_PARAM
            callers = [caller.caller_id]
            params = frozenset(
                name
                for name in reply.param_names()
                if not self._policy.judge(kind, name, callers, caller.address).allowed
            )
        return ReplyChanges(publishers, params, bool(self._registry.hidden))

    # What outside asks of a node inside

    def outside_may_not(
        self, kind: RuleKind, name: str, endpoint: Endpoint, source: str, caller_id: str = ""
    ) -> str | None:
        """Why somebody outside may not have a topic or service of a node; None if he may."""
        wanted_kind = Kind.SERVICE if kind is RuleKind.SERVE else Kind.PUBLISHER
        callers = endpoint.callers_of(wanted_kind, name)
        for resolved in policing.topic_names(name, caller_id):
            verdict = self._policy.judge(kind, resolved, callers, endpoint.address)
            if verdict.rule is not None and not self._is_inside(source):
                self._policy.report(verdict, kind, f"{resolved} of {endpoint.label}", source)
                if not verdict.allowed:
                    return verdict.reason
        return None

    def outside_may_not_ask(
        self, call: Call, endpoint: Endpoint, source: str
    ) -> list[object] | None:
        """The ROS triple of requestTopic for what outside may not have; None if it may.

        An offer of UDPROS holds a header of its own, whose topic roscpp serves (topic_manager.cpp,
        requestTopic): it is refused where anything of the node may be denied.
        """
        topic = call.string(1) or ""
        caller_id = call.string(0) or ""
        reason = self.outside_may_not(RuleKind.PUBLISH, topic, endpoint, source, caller_id)
        if reason is None and not policing.offers_tcpros_alone(call):
            if self.may_bypass(endpoint) or self._is_inside(source):
                return None
            text = "a policy may deny topics of this node, so only TCPROS passes. Offer TCPROS"
            return policing.no_publisher(topic, text)
        return None if reason is None else policing.no_publisher(topic, policing.denial(reason))

    # What a node inside asks of outside

    def inside_may_not(self, kind: RuleKind, name: str, source: str, caller_id: str) -> str | None:
        """Why a node inside may not have a topic or service of outside; None if it may.

        Whoever connects gives any name: unless a node of that name is known at its address, what
        one of the nodes there may not have is denied.
        """
        names_at_source = [n for e in self._registry if e.address == source for n in e.caller_ids]
        callers = [caller_id] if caller_id in names_at_source else [caller_id, *names_at_source]
        for resolved in policing.topic_names(name, caller_id):
            verdict = self._policy.ask(kind, resolved, callers, source)
            if not verdict.allowed:
                return verdict.reason
        return None

    def inside_may_bypass(self) -> bool:
        """Whether nodes inside may have topics of outside where no header is read."""
        return not self._policy.may_deny((RuleKind.SUBSCRIBE,), (), None)

    def inside_may_not_keep(self, relay: Relay) -> bool:
        """Whether a node inside may not have any more what it has of a node outside.

        Of a service's connection only the address is known: it may be denied as well.
        """
        if parse_service_uri(relay.name):
            kinds = {RuleKind.CALL}
            return self._policy.may_deny(kinds, [relay.caller_id], relay.peer)
        kind = RuleKind.SUBSCRIBE
        return bool(self.inside_may_not(kind, relay.name, relay.peer, relay.caller_id))

    def inside_may_not_ask(self, call: Call, source: str) -> list[object] | None:
        """The ROS triple of requestTopic for what a node inside may not have; None if it may."""
        if call.method != "requestTopic":
            return None
        topic = call.string(1) or ""
        caller_id = call.string(0) or ""
        reason = self.inside_may_not(RuleKind.SUBSCRIBE, topic, source, caller_id)
        return None if reason is None else policing.no_publisher(topic, policing.denial(reason))

    # What outside calls at a node inside

    async def outside_may_not_call(
        self, method: str, endpoint: Endpoint, source: str, caller_id: str
    ) -> str | None:
        """Why somebody outside may not call a method of a node; None if he may.

        What only the master calls, in its name and from its address, is not asked about.
        """
        kind = RuleKind.SLAVE
        verdict = self._policy.judge(kind, method, [caller_id], endpoint.address)
        if verdict.rule is None or self._is_inside(source):
            return None
        is_from_master = method in MASTER_ONLY and caller_id == MASTER
        if is_from_master and source in await self._upstream.master_addresses():
            return None
        subject = f"{method} at {endpoint.label}"
        return (
            None if self._policy.report(verdict, kind, subject, source).allowed else verdict.reason
        )

    def may_bypass(self, endpoint: Endpoint) -> bool:
        """Whether a node's topics may go where no header is read: forwarded by the kernel."""
        return not self._policy.may_deny(OUTWARDS, endpoint.caller_ids, endpoint.address)

    def _is_inside(self, source: str) -> bool:
        """Whether a node lives at an address that has been heard itself."""
        return any(e.address == source and e.trusted for e in self._registry)

    async def _judge_call(
        self, call: Call, caller: Caller, params: "_KnownParams"
    ) -> LocalReply | None:
        caller_id = call.string(0) or ""
        if call.method == "lookupNode":
            return policing.hidden_node(call, caller, self._addressing)
        if call.method == "lookupService":
            return self._judge_lookup(call, caller, caller_id)
        use = policing.param_use_of(call)
        if use is None:
            return None
        verdict = self._judge_use(use, caller_id, caller.address)
        # A subscriber of a namespace is also sent what is set below it later (rosmaster's
        # paramserver.py, compute_param_updates), so the names that exist now don't settle it.
        if not verdict.allowed and use.below and call.method != "subscribeParam":
            verdict = await self._judge_names(use, call, caller.address, params)
        subject = f"{use.names[0]} of {caller_id}"
        return _refusal(self._policy.report(verdict, use.kind, subject, caller.address))

    def _judge_lookup(self, call: Call, caller: Caller, caller_id: str) -> LocalReply | None:
        name = second_parameter_name(call)
        provider = self._registry.services.get(name)
        # Rules for `call` are about services of outside (docs/reference/policy.md). Once a node's
        # registrations are taken back, the master may have the service of another.
        if provider and not provider[0].health.cleaned:
            return policing.hidden_service(call, caller, self._addressing)
        verdict = self._policy.ask(RuleKind.CALL, name, [caller_id], caller.address)
        return None if verdict.allowed else policing.no_provider(verdict.reason)

    def _judge_use(self, use: ParamUse, caller_id: str, source: str) -> Verdict:
        """The strictest verdict on all names that a call may mean, and on those below them."""
        verdicts = [self._policy.judge(use.kind, name, [caller_id], source) for name in use.names]
        if use.below:
            verdicts += [
                self._policy.judge_below(use.kind, prefix(name), caller_id, source)
                for name in use.names
            ]
        return strictest(verdicts)

    async def _judge_names(
        self, use: ParamUse, call: Call, source: str, params: "_KnownParams"
    ) -> Verdict:
        """The verdict on a call denied for what may be below its names: by the names that exist.

        Whoever sets a whole namespace stays denied. Raises Unreachable.
        """
        caller_id = call.string(0) or ""
        exact = [self._policy.judge(use.kind, name, [caller_id], source) for name in use.names]
        sets_namespace = call.method == "setParam" and (
            len(call.params) < 3 or call.params[2].kind == "struct"
        )
        if sets_namespace or not all(v.allowed for v in exact):
            return self._judge_use(use, caller_id, source)
        starts = tuple(map(prefix, use.names))
        below = [name for name in await params.names() if name.startswith(starts)]
        verdicts = [self._policy.judge(use.kind, name, [caller_id], source) for name in below]
        return strictest([*exact, *verdicts])


class _KnownParams:
    """The names of all parameters, for one request: the master is asked once if at all."""

    def __init__(self, upstream: MasterClient) -> None:
        self._upstream = upstream
        self._names: list[str] | None = None

    async def names(self) -> list[str]:
        """The names. Raises Unreachable."""
        if self._names is None:
            try:
                listing = await self._upstream.call_master("getParamNames")
            except MasterError as error:
                raise Unreachable(str(error)) from None
            names = listing if isinstance(listing, list) else []
            self._names = [name for name in names if isinstance(name, str)]
        return self._names


def _refusal(verdict: Verdict) -> LocalReply | None:
    return None if verdict.allowed else Refusal(f"rosproxy: {verdict.reason}")
