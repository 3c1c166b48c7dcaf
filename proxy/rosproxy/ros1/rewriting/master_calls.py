"""Read requests to the master and the replies: calls, URIs, and changes of the registry.

A request is a single call, or a ``system.multicall`` of several calls. Each call follows its row in
``rosproxy.ros1.protocol.master_methods``. This module says what a call registers, which URIs a
reply contains, and what the registry has to record. `rosproxy.ros1.rewriting.master_api` rewrites
the URIs.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from enum import Enum

import msgspec
from msgspec.structs import replace

from rosproxy.ros1.protocol.master_methods import (
    GRAPH_METHODS,
    MASTER_METHODS,
    MethodSpec,
    Reply,
    method_spec,
    resolve_name,
)
from rosproxy.ros1.protocol.status_triples import ros_triple
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.document import Call, Value
from rosproxy.ros1.protocol.xmlrpc.limits import OWN_REPLY, REPLY, Limits
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL, inner_calls, inner_items
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.shared.uris import with_caller_address


class LocalAnswer(msgspec.Struct, frozen=True):
    """The proxy's own answer to a call that does not reach the master.

    ``value`` is the third element of the triple, ``code`` its status. ``change`` is what the
    registry has to record.
    """

    code: int
    text: str
    value: object = 0
    change: "RegistryChange | None" = None

    def triple(self) -> list[object]:
        """The ROS status triple (http://wiki.ros.org/ROS/Master_Slave_APIs)."""
        return [self.code, self.text, self.value]


class Passing(Enum):
    """Why a call passes to the master without an endpoint. Its URIs are exported nevertheless."""

    NO_REGISTRATION = "the call neither registers nor unregisters"
    FOREIGN_URI = "the URI is not that of the caller's own endpoint, but of another node"


def refusal(reason: str) -> LocalAnswer:
    """The answer to a refused call: ROS status -1, and the reason."""
    return LocalAnswer(-1, reason)


_URI_REPLIES = frozenset({Reply.SLAVE_URI, Reply.SLAVE_URIS, Reply.SERVICE_URI})
CallOutcome = Endpoint | LocalAnswer | Passing
"""The outcome of a call: the endpoint that the call registers or unregisters, the proxy's own
answer, or the reason why the call passes without an endpoint."""


class MasterCall(Call, frozen=True):
    """A call of the master API, with what the proxy reads from its parameters.

    ``spec`` is the row of the method. ``caller_id`` is the name of the node that makes the call; ""
    without a name. ``registration`` is what the call registers or ends; None for any other call.
    """

    spec: MethodSpec
    caller_id: str
    registration: Registration | None

    @property
    def second_name(self) -> str:
        """The topic, service or node in the second parameter, as a global name."""
        return resolve_name(self.string(1) or "", self.caller_id)

    @property
    def registering_uri(self) -> str | None:
        """The slave URI, if the call registers; None for any other call, or without a URI."""
        return self.string(self.spec.caller_api) if self.spec.registers else None


class Request(msgspec.Struct, frozen=True):
    """A parsed request of a node inside: a single call, or the calls of a ``system.multicall``.

    - ``method``: the name of the outer method.
    - ``calls``: None stands for an element of a multicall that is no call.
    - ``items``: the elements of a multicall as sent.
    - ``is_address_free``: neither the request nor the reply has an address or a registration. A
      policy may refuse such a request all the same, or filter the reply.
    - ``tells_graph``: the reply has the graph of all nodes.
    - ``reply_passes``: the proxy changes nothing in the reply.
    """

    body: bytes
    method: str
    multicall: bool
    calls: tuple[MasterCall | None, ...]
    caller: Caller
    items: Sequence[Value]
    is_address_free: bool
    tells_graph: bool
    reply_passes: bool

    @property
    def reply_limits(self) -> Limits:
        """The limits of the reply."""
        return OWN_REPLY if self.tells_graph or self.reply_passes else REPLY


class ExportedRequest(msgspec.Struct, frozen=True):
    """A request for the master, and the outcome of each call.

    ``body`` is the document for the master; None if the proxy answers all calls itself.
    """

    request: Request
    outcomes: tuple[CallOutcome, ...]
    body: bytes | None

    def local_reply(self) -> bytes:
        """The whole reply to a request that the proxy answers itself."""
        triples = [o.triple() for o in self.outcomes if isinstance(o, LocalAnswer)]
        return xmlrpc.dump_reply([[t] for t in triples] if self.request.multicall else triples[0])

    def registry_changes(self) -> "list[RegistryChange]":
        """What the registry has to record for the calls that the proxy answers."""
        return [o.change for o in self.outcomes if isinstance(o, LocalAnswer) and o.change]


class CallResult(msgspec.Struct, frozen=True):
    """The result of a call to the master: ROS status, value, and the registered endpoint.

    ``triple`` is None if the reply has nothing to rewrite, and was not parsed.
    """

    call: MasterCall
    status: int | None
    triple: Value | None
    endpoint: Endpoint | None

    @property
    def accepted(self) -> bool:
        """Whether the master answered with ROS status 1."""
        return self.status == 1

    @property
    def value(self) -> Value | None:
        """The third element of the triple, if the reply was parsed."""
        return self.triple.items[2] if self.triple else None


class RegistryChange(msgspec.Struct, frozen=True):
    """A fact from an accepted call, for the registry.

    ``endpoint`` is the endpoint of a new registration; None if the registration has ended.
    """

    registration: Registration
    endpoint: Endpoint | None


class MasterReply(msgspec.Struct, frozen=True):
    """The reply of the master, matched with its request.

    ``results`` has no faults and no malformed triples.
    """

    exported: ExportedRequest
    body: bytes
    value: Value | None
    results: tuple[CallResult, ...]

    def registry_changes(self, now: float) -> list[RegistryChange]:
        """What the registry has to record for the calls that the master has accepted.

        The master also accepts a call without effect. When a second node has taken a name, the
        first node unregisters with its own URI, and the registrations of the second node stay.
        """
        changes = []
        for result in self.results:
            affected = result.call.registration
            if affected and result.accepted and result.endpoint:
                endpoint = result.endpoint if result.call.spec.registers else None
                changes.append(RegistryChange(dataclasses.replace(affected, since=now), endpoint))
        return changes

    def uris(self) -> Iterator[str]:
        """The URIs in the reply for a node inside, in the form that the master has."""
        for result in self.results:
            value = result.value
            if value and result.accepted and result.call.spec.reply in _URI_REPLIES:
                texts = (item.string() for item in (value.items or [value]))
                yield from (text for text in texts if text)


def read_request(body: bytes, caller: Caller, limits: Limits = OWN_REPLY) -> Request:
    """Parse a request within limits. Raises XmlRpcError if it is malformed or too large."""
    outer = xmlrpc.parse_call(body, limits)
    method = outer.method
    multicall = method == MULTICALL
    parsed = inner_calls(outer) if multicall else [outer]
    calls = [_read_call(call, caller.address) if call else None for call in parsed]
    caller_ids = [call.caller_id for call in calls if call]
    methods = {call.method for call in calls if call}
    tells_graph = not GRAPH_METHODS.isdisjoint(methods)
    changes_reply = multicall or tells_graph or method == "getParamNames"
    return Request(
        body,
        method,
        multicall,
        tuple(calls),
        replace(caller, caller_id=caller_ids[0] if caller_ids else ""),
        inner_items(outer) if multicall else (),
        is_address_free=methods.isdisjoint(MASTER_METHODS),
        tells_graph=tells_graph,
        reply_passes=not changes_reply and method_spec(method).reply is Reply.OTHER,
    )


def read_reply(exported: ExportedRequest, reply: bytes) -> MasterReply:
    """Match a reply with its request. Raises XmlRpcError if the reply is no XML-RPC response.

    If the reply has no addresses, the function only reads the status: the value of a subscribed
    parameter may be anything.
    """
    if exported.request.reply_passes and (status := passing.status_of(reply)) is not None:
        call = exported.request.calls[0]
        outcome = exported.outcomes[0]
        if call and not isinstance(outcome, LocalAnswer):
            result = CallResult(call, status, None, _endpoint_of(outcome))
            return MasterReply(exported, reply, None, (result,))
    value = xmlrpc.parse_reply(reply, exported.request.reply_limits)
    return MasterReply(exported, reply, value, tuple(_results(exported, value)) if value else ())


def _read_call(call: Call, source: str) -> MasterCall:
    """A call from an address, with what the proxy reads from its parameters."""
    spec = method_spec(call.method)
    caller_id = call.string(0) or ""
    kind = spec.registers or spec.unregisters
    name = call.string(spec.name)
    registration = None
    if kind is not None and name:
        type_ = call.string(spec.type) or "*"
        service_api = call.string(spec.service_api)
        if service_api is not None:
            service_api = with_caller_address(service_api, source)
        name = resolve_name(name, caller_id)
        registration = Registration(kind, name, caller_id, type_, service_api)
    return MasterCall(call.method, call.params, spec, caller_id, registration)


def _results(exported: ExportedRequest, value: Value) -> Iterator[CallResult]:
    """The calls that went to the master with their ROS triples; faults are left out."""
    triples: Sequence[Value | None] = [value]
    if exported.request.multicall:
        triples = [item.items[0] if item.items else None for item in value.items]
    pairs = zip(exported.request.calls, exported.outcomes, strict=True)
    sent = [(call, outcome) for call, outcome in pairs if not isinstance(outcome, LocalAnswer)]
    # A reply may have fewer results than calls. A call without a result is left out.
    for (call, outcome), triple in zip(sent, triples, strict=False):
        if call and triple and ros_triple(triple):
            yield CallResult(call, triple.items[0].integer(), triple, _endpoint_of(outcome))


def _endpoint_of(outcome: CallOutcome) -> Endpoint | None:
    return outcome if isinstance(outcome, Endpoint) else None
