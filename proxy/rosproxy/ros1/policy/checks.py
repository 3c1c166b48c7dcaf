"""Checks calls by the policy before the master or a node gets them, and filters the replies.

Each ``check_…`` returns a `Denial`, or None if allowed, and reports the denial. Only
`check_request` returns answers. A source with the address of a node inside is not outside: nodes in
several inside networks reach each other through the ports of the proxy.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

from rosproxy.access.access_policy import OFFER_KINDS, PARAMETER_KINDS, AccessPolicy
from rosproxy.access.rule_index import MOST_CALLER_COMPARISONS
from rosproxy.forwarding.relay import Relay
from rosproxy.ros1.clients.master_client import MasterClient, MasterError, Unreachable
from rosproxy.ros1.policy.denial import Denial, denied, no_provider, no_publisher, with_fix
from rosproxy.ros1.policy.hidden import HiddenAnswers
from rosproxy.ros1.policy.parameters import ParamUse, param_use, param_use_of, sets_namespace
from rosproxy.ros1.policy.service_finder import ServiceFinder
from rosproxy.ros1.protocol.master_methods import (
    GRAPH_METHODS,
    MASTER_ONLY,
    Kind,
    prefix,
    resolve_name,
)
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.document import Call, Value
from rosproxy.ros1.protocol.xmlrpc.values import Edit
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.ros1.rewriting.master_calls import (
    CallResult,
    LocalAnswer,
    MasterCall,
    Passing,
    Request,
)
from rosproxy.shared.policy.layers import Verdict, strictest
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.uris import parse_service_uri

MASTER = "/master"
"""The caller_id of the master's calls to nodes (rosmaster/registrations.py)."""
RULE_KINDS = {
    Kind.PUBLISHER: RuleKind.PUBLISH,
    Kind.SUBSCRIBER: RuleKind.SUBSCRIBE,
    Kind.SERVICE: RuleKind.SERVE,
    Kind.PARAM: RuleKind.GET_PARAM,
}
"""The kind of rules for each kind of registration."""
_OFFERED = {"topic": Kind.PUBLISHER, "service": Kind.SERVICE}
"""The registration of a node inside, if outside asks for a topic or service of the node."""
_USED = {"topic": RuleKind.SUBSCRIBE, "service": RuleKind.CALL}
"""The kind of rules for a topic or service of outside."""


class Ros1Policy:
    """Applies the policy in force, ``rules``, to calls, connections and registrations.

    ``must_enforce``: a former policy has allowed something meanwhile, so `PolicyEnforcer` must
    enforce the policy again.
    """

    def __init__(
        self,
        rules: AccessPolicy,
        registry: Registry,
        addressing: Addressing,
        upstream: MasterClient,
        services: ServiceFinder,
    ) -> None:
        self.rules = rules
        self.must_enforce = False
        self._registry = registry
        self._addressing = addressing
        self._upstream = upstream
        self._services = services
        self._hidden = HiddenAnswers(registry, addressing)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to check: no rule, and no hidden registration."""
        return self.rules.empty and not self._registry.has_hidden

    # Calls at the master port

    def reads_parameters(self, source: str | None) -> bool:
        """Whether the proxy must read calls for parameters from an address (None: any address)."""
        return self.rules.may_deny(PARAMETER_KINDS, (), source)

    def reads_reply(self, request: Request) -> bool:
        """Whether the proxy may have to change the master's reply to a request."""
        if request.tells_graph and self._registry.has_hidden:
            return True
        lists_params = any(call and call.method == "getParamNames" for call in request.calls)
        return lists_params and self._filters_params(request.caller)

    async def check_request(self, request: Request) -> Sequence[LocalAnswer | None]:
        """The proxy's answer to each call of a request; None if the call goes to the master.

        `check_registration` checks registrations later, when the node has an endpoint. Raises
        Unreachable.
        """
        answers: list[LocalAnswer | None] = [None] * len(request.calls)
        if self.idle:
            return answers
        params = _ParamNames(self._upstream)
        for index, call in enumerate(request.calls):
            if call:
                answers[index] = await self._answer(call, request.caller, params)
            await asyncio.sleep(0)  # with many rules, a call may take milliseconds
        return answers

    def check_unread(self, method: str, head: bytes, source: str) -> Denial | None:
        """Check a long call by the head of the call."""
        caller_id, name = passing.first_strings(head, 2)
        use = param_use(method, caller_id or "", name)
        if use is None:
            return None
        verdict = self._verdict_on_use(use, caller_id or "", source)
        return self._denial(verdict, use.kind, f"of {caller_id}", source)

    def check_registration(
        self, call: MasterCall, admission: Endpoint | Passing, caller: Caller, now: float
    ) -> Denial | None:
        """Check a call that registers, after admission.

        A denied registration becomes hidden. At the URI of another node, the registration fails.
        """
        affected = call.registration
        if self.rules.empty or affected is None:
            return None
        if affected.kind is Kind.PARAM:  # already checked
            return None
        endpoint = admission if isinstance(admission, Endpoint) else None
        address = endpoint.address if endpoint else caller.address
        kind = RULE_KINDS[affected.kind]
        verdict = self.rules.ask(kind, affected.name, [affected.caller_id], address)
        if verdict.allowed:
            return None
        if endpoint is None:  # the URI of another node, which the proxy can't hide
            return denied(verdict.reason)
        hidden = replace(affected, since=now, hidden=True)
        answer = self._hidden.answer_registration(hidden, endpoint, caller)
        return Denial(verdict.reason, answer)

    def answer_unregistration(
        self, call: MasterCall, ended_at: Endpoint | Passing
    ) -> LocalAnswer | None:
        """The answer to a call that ends a hidden registration; None for any other call."""
        ended = call.registration
        if ended is None or not isinstance(ended_at, Endpoint):
            return None
        current = ended_at.registrations.get(ended.key)
        return self._hidden.answer_unregistration(current) if current and current.hidden else None

    def settle(self, endpoint: Endpoint, registration: Registration) -> Registration:
        """The registration for the registry.

        If the policy has just changed, the master may still have a denied registration. Then
        the registration stays shown until the enforcer takes it back from the master. The enforcer
        also takes the fast port of a node with hidden registrations.
        """
        if not registration.hidden:
            return registration
        previous = endpoint.registrations.get(registration.key)
        is_shown = previous is not None and not previous.hidden
        if is_shown or endpoint.fast_port is not None:
            self.must_enforce = True
        return replace(registration, hidden=not is_shown)

    def filter_result(self, result: CallResult, caller: Caller) -> Sequence[Edit]:
        """The edits that remove denied names from a result and add hidden names."""
        value = result.value
        if value is None or not result.accepted:
            return ()
        call = result.call
        if call.method == "getParamNames":
            return self._without_denied_params(value, caller)
        if not self._registry.has_hidden:
            return ()
        if call.method in GRAPH_METHODS:
            graph = self._hidden.complete_graph(call, xmlrpc.python_value(value))
            return [value.replaced_by(xmlrpc.dump_value(graph))]
        if call.spec.registers is Kind.SUBSCRIBER and result.endpoint:
            extra = self.publishers_for(result.endpoint, call.second_name, [])
            uris = [*(item.text for item in value.items), *extra]
            imported = dict.fromkeys(self._addressing.import_slave(uri, caller) for uri in uris)
            return [value.replaced_by(xmlrpc.dump_value([*imported]))] if extra else ()
        return ()

    def publishers_for(self, endpoint: Endpoint, topic: str, at_master: Sequence[str]) -> list[str]:
        """The publishers of a topic for a node inside, by the URIs that the master has.

        ``at_master`` are the publishers that the master tells this node.
        """
        if not self._registry.has_hidden:
            return [*dict.fromkeys(at_master)]
        return self._hidden.publishers_for(endpoint, topic, at_master)

    # What is registered

    def verdict(self, endpoint: Endpoint, registration: Registration) -> Verdict:
        """Whether the master may have a registration. Reports no denial."""
        kind = RULE_KINDS[registration.kind]
        name = registration.name
        verdict = self.rules.judge(kind, name, [registration.caller_id], endpoint.address)
        if registration.kind is Kind.PARAM and verdict.allowed:
            caller_id = registration.caller_id
            return self.rules.judge_below(kind, prefix(name), caller_id, endpoint.address)
        return verdict

    def report_registration(self, endpoint: Endpoint, registration: Registration) -> Verdict:
        """The same as `verdict`; reports a denial."""
        verdict = self.verdict(endpoint, registration)
        subject = f"{registration.name} of {registration.caller_id}"
        return self.rules.report(verdict, RULE_KINDS[registration.kind], subject, endpoint.address)

    # What outside asks of a node inside

    def check_outside(
        self, kind: str, name: str, endpoint: Endpoint, source: str, caller_id: str = ""
    ) -> Denial | None:
        """Check whether outside may have something of a node: a "topic" or a "service"."""
        if self.rules.empty:
            return None
        callers = endpoint.callers_of(_OFFERED[kind], name)
        rule_kind = RULE_KINDS[_OFFERED[kind]]
        for resolved in topic_names(name, caller_id):
            verdict = self.rules.judge(rule_kind, resolved, callers, endpoint.address)
            if verdict.rule is not None and not self._is_inside(source):
                subject = f"{resolved} of {endpoint.label}"
                if denial := self._denial(verdict, rule_kind, subject, source):
                    return denial
        return None

    def check_outside_request(self, call: Call, endpoint: Endpoint, source: str) -> Denial | None:
        """Check a requestTopic from outside.

        An offer of UDPROS has a separate header, and roscpp serves the topic of this header
        (topic_manager.cpp, requestTopic). So the proxy denies UDPROS if a rule may deny a topic of
        the node.
        """
        topic = call.string(1) or ""
        caller_id = call.string(0) or ""
        denial = self.check_outside("topic", topic, endpoint, source, caller_id)
        if denial:
            return no_publisher(topic, with_fix(denial.reason))
        if _offers_tcpros_alone(call) or self.may_bypass(endpoint) or self._is_inside(source):
            return None
        text = "a policy may deny topics of this node, so only TCPROS passes. Offer TCPROS"
        return no_publisher(topic, text)

    async def check_slave_call(
        self, method: str, endpoint: Endpoint, source: str, caller_id: str
    ) -> Denial | None:
        """Check a call from outside at a node.

        The master may make MASTER_ONLY calls: with the caller_id MASTER, from the master's host.
        """
        kind = RuleKind.SLAVE
        verdict = self.rules.judge(kind, method, [caller_id], endpoint.address)
        if verdict.rule is None or self._is_inside(source):
            return None
        is_from_master = method in MASTER_ONLY and caller_id == MASTER
        if is_from_master and source in await self._upstream.master_addresses():
            return None
        return self._denial(verdict, kind, f"{method} at {endpoint.label}", source)

    def may_bypass(self, endpoint: Endpoint) -> bool:
        """Whether the kernel may forward a node's topics, so that the proxy reads no header."""
        return not self.rules.may_deny(OFFER_KINDS, endpoint.caller_ids, endpoint.address)

    # What a node inside asks of outside

    def check_inside(self, kind: str, name: str, source: str, caller_id: str) -> Denial | None:
        """Check whether a node inside may have a "topic" or "service" of outside.

        A client may give any name. If the proxy knows no node of this name at the address, the
        rules for all nodes at the address apply, too.
        """
        if self.rules.empty:
            return None
        callers = [caller_id]
        owner = self._registry.by_caller.get(caller_id)
        if owner is None or owner.address != source:
            at_source = (n for e in self._registry if e.address == source for n in e.callers)
            # More names than the policy compares with rules change no verdict.
            callers += islice(at_source, MOST_CALLER_COMPARISONS)
        for resolved in topic_names(name, caller_id):
            verdict = self.rules.ask(_USED[kind], resolved, callers, source)
            if not verdict.allowed:
                return denied(verdict.reason)
        return None

    def check_inside_request(self, call: Call, source: str) -> Denial | None:
        """Check a call of a node inside at a node outside, if it is a requestTopic."""
        if call.method != "requestTopic":
            return None
        topic = call.string(1) or ""
        denial = self.check_inside("topic", topic, source, call.string(0) or "")
        return no_publisher(topic, with_fix(denial.reason)) if denial else None

    def inside_may_bypass(self) -> bool:
        """Whether nodes inside may get topics of outside without the proxy reading a header."""
        return not self.rules.may_deny((RuleKind.SUBSCRIBE,), (), None)

    def inside_may_keep(self, relay: Relay) -> bool:
        """Whether a node inside may keep a relayed connection to outside.

        Of a connection to a service the proxy knows only the address, not the service. If a rule
        may deny a service to the caller, the connection ends, too.
        """
        if parse_service_uri(relay.name):
            return not self.rules.may_deny({RuleKind.CALL}, [relay.caller_id], relay.peer)
        return self.check_inside("topic", relay.name, relay.peer, relay.caller_id) is None

    async def _answer(
        self, call: MasterCall, caller: Caller, params: "_ParamNames"
    ) -> LocalAnswer | None:
        if call.method == "lookupNode":
            return self._hidden.find_node(call.second_name, caller)
        if call.method == "lookupService":
            return await self._answer_lookup(call, caller)
        denial = await self._check_parameters(call, caller, params)
        return denial.answer if denial else None

    async def _answer_lookup(self, call: MasterCall, caller: Caller) -> LocalAnswer | None:
        name = call.second_name
        await self._services.find(name)
        provider = self._registry.services.get(name)
        # Rules for `call` concern services of outside (docs/reference/policy.md). After the proxy
        # has unregistered a dead node, another node may have the service.
        if provider and not provider[0].health.cleaned:
            is_hidden = provider[1].hidden
            return self._hidden.find_service(name, provider[0], caller) if is_hidden else None
        callers = [call.caller_id]
        verdict = self.rules.ask(RuleKind.CALL, name, callers, caller.address)
        return None if verdict.allowed else no_provider(verdict.reason).answer

    async def _check_parameters(
        self, call: MasterCall, caller: Caller, params: "_ParamNames"
    ) -> Denial | None:
        """Check how a call uses parameters. Raises Unreachable."""
        use = param_use_of(call)
        if use is None:
            return None
        caller_id = call.caller_id
        verdict = self._verdict_on_use(use, caller_id, caller.address)
        # The rules for existing names decide about a namespace, except in two cases. rosmaster also
        # sends a subscriber parameters that are set below the namespace later (paramserver.py,
        # compute_param_updates). And a setParam of a whole namespace may make new names.
        may_settle = use.below and call.method != "subscribeParam" and not sets_namespace(call)
        exact = self._verdict_on_names(use.kind, use.names, caller_id, caller.address)
        if may_settle and exact.allowed and not verdict.allowed:
            starts = tuple(map(prefix, use.names))
            below = [name for name in await params.read() if name.startswith(starts)]
            names = (*use.names, *below)
            verdict = self._verdict_on_names(use.kind, names, caller_id, caller.address)
        return self._denial(verdict, use.kind, f"{use.names[0]} of {caller_id}", caller.address)

    def _verdict_on_use(self, use: ParamUse, caller_id: str, source: str) -> Verdict:
        """The strictest verdict on all names that a call may mean, and on names below them."""
        verdict = self._verdict_on_names(use.kind, use.names, caller_id, source)
        if not use.below:
            return verdict
        judge = self.rules.judge_below
        below = [judge(use.kind, prefix(name), caller_id, source) for name in use.names]
        return strictest([verdict, *below])

    def _verdict_on_names(
        self, kind: RuleKind, names: Sequence[str], caller_id: str, source: str
    ) -> Verdict:
        judge = self.rules.judge
        return strictest([judge(kind, name, [caller_id], source) for name in names])

    def _filters_params(self, caller: Caller) -> bool:
        """Whether a rule may deny a parameter to a caller."""
        return self.rules.may_deny({RuleKind.GET_PARAM}, [caller.caller_id], caller.address)

    def _without_denied_params(self, names: Value, caller: Caller) -> list[Edit]:
        """The edits that remove from a list all parameters that a caller may not read."""
        if not self._filters_params(caller):
            return []
        kind = RuleKind.GET_PARAM
        return [
            item.removed()
            for item in names.items
            if not self._verdict_on_names(
                kind, [item.text], caller.caller_id, caller.address
            ).allowed
        ]

    def _denial(self, verdict: Verdict, kind: RuleKind, subject: str, source: str) -> Denial | None:
        """Report a verdict; return the denial, or None if allowed."""
        is_allowed = self.rules.report(verdict, kind, subject, source).allowed
        return None if is_allowed else denied(verdict.reason)

    def _is_inside(self, source: str) -> bool:
        """Whether an address belongs to a node inside that has answered."""
        return any(e.address == source and e.trusted for e in self._registry)


class _ParamNames:
    """The names of all parameters for a request. Asks the master once, only if needed."""

    def __init__(self, upstream: MasterClient) -> None:
        self._upstream = upstream
        self._names: list[str] | None = None

    async def read(self) -> list[str]:
        """Return the names. Raises Unreachable."""
        if self._names is None:
            try:
                listing = await self._upstream.call_master("getParamNames")
            except MasterError as error:
                raise Unreachable(str(error)) from None
            names = listing if isinstance(listing, list) else []
            self._names = [name for name in names if isinstance(name, str)]
        return self._names


def topic_names(topic: str, caller_id: str) -> tuple[str, ...]:
    """The names to which a node may resolve a topic name of a client."""
    return tuple(dict.fromkeys((topic, resolve_name(topic, ""), resolve_name(topic, caller_id))))


def _offers_tcpros_alone(call: Call) -> bool:
    """Whether a requestTopic offers only TCPROS."""
    offers = call.params[2].items if len(call.params) > 2 else []
    return all(offer.items and offer.items[0].string() == "TCPROS" for offer in offers)
