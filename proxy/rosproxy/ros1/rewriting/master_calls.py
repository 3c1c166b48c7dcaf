"""A request to the master and its reply, read: which calls they hold and what follows from them.

A request is one call or a ``system.multicall`` of several; each follows its own row of
``rosproxy.ros1.protocol.master_methods``. What a call registers, which URIs a reply holds and what
the registry has to learn of both is told here; `rosproxy.ros1.rewriting.master_api` rewrites them.
"""

from collections.abc import Iterator, Sequence
from enum import Enum

import msgspec
from msgspec.structs import replace

from rosproxy.ros1.protocol.master_methods import (
    GRAPH_METHODS,
    NO_SPEC,
    Reply,
    method_spec,
    resolve_name,
)
from rosproxy.ros1.protocol.uris import with_caller_address
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.document import Call, Value
from rosproxy.ros1.protocol.xmlrpc.limits import OWN_REPLY, REPLY, Limits
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL, inner_calls, inner_items
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.rewriting.slave_api import ros_triple


class LocalAnswer(msgspec.Struct, frozen=True):
    """The answer to a call that the master does not get; ``change`` follows from the call.

    ``value`` is the third element of the triple, whose status is ``code``.
    """

    code: int
    text: str
    value: object = 0
    change: "RegistryChange | None" = None

    def triple(self) -> list[object]:
        """The ROS status triple (http://wiki.ros.org/ROS/Master_Slave_APIs)."""
        return [self.code, self.text, self.value]


class Passing(Enum):
    """Why a call goes to the master without an endpoint; its URIs are exported all the same."""

    NO_REGISTRATION = "the call neither registers nor unregisters"
    FOREIGN_URI = "the URI is not that of the caller's own endpoint: a node outside, or another"


def refusal(reason: str) -> LocalAnswer:
    """The answer to a call that fails: ROS status -1, and the reason."""
    return LocalAnswer(-1, reason)


_URIS = frozenset({Reply.SLAVE_URI, Reply.SLAVE_URIS, Reply.SERVICE_URI})
CallOutcome = Endpoint | LocalAnswer | Passing
"""What becomes of a call: the endpoint that it registers or unregisters, the proxy's own answer, or
the reason why the call passes to the master without either."""


class Request(msgspec.Struct, frozen=True):
    """A request of an inside node, read: one call, or the calls of a ``system.multicall``.

    ``calls`` holds None for an element of a multicall that is no call; ``items`` are those
    elements as they were sent.
    """

    body: bytes
    calls: tuple[Call | None, ...]
    multicall: bool
    caller: Caller
    items: Sequence[Value] = ()

    @property
    def method(self) -> str:
        """The outer method's name."""
        if self.multicall:
            return MULTICALL
        return self.calls[0].method if self.calls and self.calls[0] else ""

    @property
    def tells_graph(self) -> bool:
        """Whether the reply tells of the graph of all nodes."""
        return any(call and call.method in GRAPH_METHODS for call in self.calls)

    @property
    def reply_limits(self) -> Limits:
        """How large the reply may be."""
        return OWN_REPLY if self.tells_graph or self.reply_passes else REPLY

    @property
    def reply_passes(self) -> bool:
        """Whether nothing in the reply is rewritten."""
        if self.multicall or self.tells_graph or self.method == "getParamNames":
            return False
        return method_spec(self.method).reply is Reply.OTHER

    @property
    def plain(self) -> bool:
        """Whether request and reply pass untouched."""
        return all(call is None or method_spec(call.method) == NO_SPEC for call in self.calls)


class ExportedRequest(msgspec.Struct, frozen=True):
    """A request made ready for the master, and what became of each of its calls.

    ``body`` is what the master gets; None if it gets nothing, since the proxy answers all calls.
    """

    request: Request
    outcomes: tuple[CallOutcome, ...]
    body: bytes | None

    def local_reply(self) -> bytes:
        """The whole reply to a request of which the master gets nothing."""
        triples = [o.triple() for o in self.outcomes if isinstance(o, LocalAnswer)]
        return xmlrpc.dump_reply([[t] for t in triples] if self.request.multicall else triples[0])

    def registry_changes(self) -> "list[RegistryChange]":
        """What the registry has to learn from the calls that the proxy answers."""
        local = (o for o in self.outcomes if isinstance(o, LocalAnswer))
        return [o.change for o in local if o.change]


class CallResult(msgspec.Struct, frozen=True):
    """A call that the master has answered: its ROS status and value, and the endpoint it registers.

    ``triple`` is None where the reply holds nothing that is rewritten, and was not read.
    """

    call: Call
    status: int | None
    triple: Value | None
    endpoint: Endpoint | None

    @property
    def accepted(self) -> bool:
        """Whether the master answered with ROS status 1."""
        return self.status == 1

    @property
    def value(self) -> Value | None:
        """The third element of the triple, if it was read."""
        return self.triple.items[2] if self.triple else None


class RegistryChange(msgspec.Struct, frozen=True):
    """A fact from an accepted call, for the registry.

    ``endpoint`` is where the registration was made, None if it has ended.
    """

    registration: Registration
    endpoint: Endpoint | None


class MasterReply(msgspec.Struct, frozen=True):
    """The master's reply, matched with its request.

    ``results`` leaves out faults and malformed triples.
    """

    exported: ExportedRequest
    body: bytes
    value: Value | None
    results: tuple[CallResult, ...]

    def registry_changes(self, now: float) -> list[RegistryChange]:
        """What the registry has to learn from the calls that the master accepted.

        The master also accepts what changes nothing: a node that makes room for another of its
        name unregisters with its own URI, and the other's registrations stay.
        """
        changes = []
        for result in self.results:
            affected = registration_of(result.call, now, self.exported.request.caller.address)
            if affected and result.accepted and result.endpoint:
                registers = method_spec(result.call.method).registers is not None
                changes.append(RegistryChange(affected, result.endpoint if registers else None))
        return changes

    def uris(self) -> Iterator[str]:
        """The URIs that it hands to an inside node, as the master holds them."""
        for result in self.results:
            value = result.value
            if value and result.accepted and method_spec(result.call.method).reply in _URIS:
                texts = (item.string() for item in (value.items or [value]))
                yield from (text for text in texts if text)


def read_request(body: bytes, caller: Caller, limits: Limits = OWN_REPLY) -> Request:
    """Parse a request within limits. Raises XmlRpcError if it is none, or is beyond them."""
    call = xmlrpc.parse_call(body, limits)
    if call.method != MULTICALL:
        return Request(body, (call,), False, replace(caller, caller_id=caller_id_of(call)))
    calls = tuple(inner_calls(call))
    caller_id = next((caller_id_of(inner) for inner in calls if inner), "")
    return Request(body, calls, True, replace(caller, caller_id=caller_id), inner_items(call))


def read_reply(exported: ExportedRequest, reply: bytes) -> MasterReply:
    """Match a reply with its request. Raises XmlRpcError if it is no XML-RPC response.

    Of one that holds no address only the status is read: the value of a parameter that a node
    subscribes to may be anything.
    """
    if exported.request.reply_passes and (status := passing.status_of(reply)) is not None:
        call = exported.request.calls[0]
        outcome = exported.outcomes[0]
        if call and not isinstance(outcome, LocalAnswer):
            result = CallResult(call, status, None, _endpoint_of(outcome))
            return MasterReply(exported, reply, None, (result,))
    value = xmlrpc.parse_reply(reply, exported.request.reply_limits)
    return MasterReply(exported, reply, value, tuple(_results(exported, value)) if value else ())


def registering_uri(call: Call | None) -> str | None:
    """The slave URI that a call registers, if it is a complete registration."""
    if call is None or method_spec(call.method).registers is None:
        return None
    return call.string(method_spec(call.method).caller_api)


def registration_of(call: Call, now: float, source: str) -> Registration | None:
    """What a call from an address registers or unregisters; None for any other call."""
    spec = method_spec(call.method)
    caller_id = caller_id_of(call)
    kind = spec.registers or spec.unregisters
    name = call.string(spec.name)
    if kind is None or not name:
        return None
    name = resolve_name(name, caller_id)
    type_ = call.string(spec.type) or "*"
    service_api = call.string(spec.service_api)
    if service_api is not None:
        service_api = with_caller_address(service_api, source)
    return Registration(kind, name, caller_id, type_, service_api, now)


def second_parameter_name(call: Call) -> str:
    """The topic, service or node that a call's second parameter names."""
    return resolve_name(call.string(1) or "", caller_id_of(call))


def caller_id_of(call: Call) -> str:
    """The name of the node that makes a call; "" if it gives none."""
    return call.string(0) or ""


def _results(exported: ExportedRequest, value: Value) -> Iterator[CallResult]:
    """The calls that went to the master with their ROS triples; faults are left out."""
    triples: Sequence[Value | None] = [value]
    if exported.request.multicall:
        triples = [item.items[0] if item.items else None for item in value.items]
    pairs = zip(exported.request.calls, exported.outcomes, strict=True)
    sent = [(call, outcome) for call, outcome in pairs if not isinstance(outcome, LocalAnswer)]
    # A reply may hold fewer results than there were calls; what has none is passed on as it is.
    for (call, outcome), triple in zip(sent, triples, strict=False):
        if call and triple and ros_triple(triple):
            yield CallResult(call, triple.items[0].integer(), triple, _endpoint_of(outcome))


def _endpoint_of(outcome: CallOutcome) -> Endpoint | None:
    return outcome if isinstance(outcome, Endpoint) else None
