"""The master API as inside nodes call it: calls rewritten on the way out, replies on the way in.

A request is one call or a ``system.multicall`` of several; each follows its own row of
``rosproxy.ros1.protocol.master_methods``. Rows and traps: http://wiki.ros.org/ROS/Master_API and
ros_comm/tools/rosmaster/src/rosmaster/master_api.py.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

from rosproxy.ros1.protocol.master_methods import Reply, Row, resolve_name, row
from rosproxy.ros1.protocol.uris import parse_service_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call, Edit, Value
from rosproxy.ros1.protocol.xmlrpc.multicall import (
    MULTICALL,
    inner_calls,
    inner_items,
    insert_items,
)
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.addressing import Addressing, Asker


@dataclass(frozen=True, slots=True)
class Refusal:
    """A call that the proxy answers itself: with ROS status -1 and a reason."""

    reason: str

    def triple(self) -> list[object]:
        """The ROS status triple (http://wiki.ros.org/ROS/Master_Slave_APIs)."""
        return [-1, self.reason, 0]


Admission = Endpoint | Refusal | None
"""What became of a call that registers or unregisters: its endpoint, or why it has none."""


@dataclass(slots=True)
class Request:
    """A request of an inside node and what is known of it.

    ``calls`` holds None for an element of a multicall that is no call; ``items`` are those
    elements, and ``admissions`` has one for each call.
    """

    body: bytes
    calls: list[Call | None]
    multicall: bool
    asker: Asker
    items: list[Value] = field(default_factory=list)
    admissions: list[Admission] = field(default_factory=list)

    @property
    def method(self) -> str:
        """The outer method's name."""
        if self.multicall:
            return MULTICALL
        return self.calls[0].method if self.calls and self.calls[0] else ""

    @property
    def plain(self) -> bool:
        """Whether request and reply pass untouched."""
        return all(call is None or row(call.method) == Row() for call in self.calls)

    def forwarded(self) -> list[int]:
        """Which calls the master gets to see."""
        return [i for i, a in enumerate(self.admissions) if not isinstance(a, Refusal)]


@dataclass(frozen=True, slots=True)
class Result:
    """A call that the master has answered, its ROS triple, and the endpoint it registers."""

    call: Call
    triple: Value
    endpoint: Endpoint | None

    @property
    def accepted(self) -> bool:
        """Whether the master answered with ROS status 1."""
        return self.triple.items[0].integer() == 1


@dataclass(frozen=True, slots=True)
class Answer:
    """The master's reply to a request; ``results`` leaves out faults and malformed triples."""

    body: bytes
    value: Value | None
    results: list[Result]


@dataclass(frozen=True, slots=True)
class Noted:
    """A fact from an accepted call, for the registry.

    ``endpoint`` is where the registration was made, None if it has ended.
    """

    registration: Registration
    endpoint: Endpoint | None


def read_request(body: bytes, asker: Asker) -> Request:
    """Parse a request. Raises XmlRpcError if it is none."""
    call = xmlrpc.parse_call(body)
    if call.method != MULTICALL:
        return Request(body, [call], False, _named(asker, _caller_id(call)))
    calls = inner_calls(call)
    caller_id = next((_caller_id(inner) for inner in calls if inner), "")
    items = inner_items(call)
    return Request(body, calls, True, _named(asker, caller_id), items)


def registering_uri(call: Call | None) -> str | None:
    """The slave URI that a call registers, if it is a complete registration."""
    found = row(call.method) if call else Row()
    if call is None or found.registers is None or found.caller_api is None:
        return None
    return call.string(found.caller_api)


def export_request(request: Request, addressing: Addressing) -> bytes:
    """The request for the master: URIs exported, refused calls left out.

    A call that unregisters gets the endpoint of its registration as its admission.
    """
    edits: list[Edit] = []
    for index, call in enumerate(request.calls):
        if call and row(call.method).unregisters:
            request.admissions[index] = _holder(call, request.asker, addressing)
    for call, admission in zip(request.calls, request.admissions, strict=True):
        if call and not isinstance(admission, Refusal):
            edits += _export_call(call, admission, request.asker, addressing)
    return xmlrpc.apply(request.body, edits + _without_refused(request))


def local_reply(request: Request) -> bytes | None:
    """The whole reply if no call of the request is to be forwarded, else None."""
    if request.forwarded() or not request.calls:
        return None
    triples = [a.triple() for a in request.admissions if isinstance(a, Refusal)]
    return xmlrpc.dump_reply([[t] for t in triples] if request.multicall else triples[0])


def read_answer(request: Request, reply: bytes) -> Answer:
    """Match a reply with its request. Raises XmlRpcError if it is no XML-RPC response."""
    value = xmlrpc.parse_reply(reply)
    return Answer(reply, value, list(_results(request, value)) if value else [])


def import_answer(request: Request, answer: Answer, addressing: Addressing) -> bytes:
    """The reply for the inside node: URIs imported, refused calls answered."""
    edits: list[Edit] = []
    for result in answer.results:
        if row(result.call.method).reply is not Reply.OTHER:
            asker = request.asker
            if result.endpoint and result.endpoint is not asker.endpoint:
                asker = replace(asker, endpoint=result.endpoint)
            edits += _import_result(result, asker, addressing)
    if request.multicall and answer.value and answer.value.items:
        edits += insert_items(answer.value, _refused_results(request))
    return xmlrpc.apply(answer.body, edits)


def rename_master(answer: Answer, master: str) -> bytes:
    """The reply with the master's own URI, where getUri asked for it, as ``master`` is reached."""
    edits: list[Edit] = []
    for result in answer.results:
        text = result.triple.items[2].string()
        if row(result.call.method).reply is Reply.MASTER_URI and text:
            edits += _import_one(result.triple, text, f"http://{master}/")
    return xmlrpc.apply(answer.body, edits)


def noted(answer: Answer, now: float) -> list[Noted]:
    """What the registry has to learn from the calls that the master accepted.

    The master also accepts what changes nothing: a node that makes room for another of its name
    unregisters with its own URI, and the other's registrations stay.
    """
    facts = []
    for result in answer.results:
        held = _registration(result.call, now)
        if held and result.accepted and result.endpoint:
            made = row(result.call.method).registers is not None
            facts.append(Noted(held, result.endpoint if made else None))
    return facts


def _named(asker: Asker, caller_id: str) -> Asker:
    return Asker(asker.address, asker.proxy, caller_id, asker.master, asker.endpoint)


def _caller_id(call: Call) -> str:
    return call.string(0) or ""


def _name(call: Call) -> str:
    """The topic, service or node that a call's second parameter names."""
    return resolve_name(call.string(1) or "", _caller_id(call))


def _holder(call: Call, asker: Asker, addressing: Addressing) -> Endpoint | None:
    """The endpoint of the registration that a call ends, if it gives that endpoint's URI."""
    found, holder = row(call.method), addressing.registry.by_caller(_caller_id(call))
    if holder is None:
        return None
    if found.caller_api is not None:
        uri = addressing.export_slave(call.string(found.caller_api) or "", asker)
        return holder if uri == addressing.advertised_uri(holder) else None
    uri = addressing.export_service(call.string(2) or "", _name(call), asker)
    return holder if uri == addressing.advertised_service(holder) else None


def _export_call(
    call: Call, admission: Admission, asker: Asker, addressing: Addressing
) -> list[Edit]:
    found, edits = row(call.method), []
    caller_api = _string_at(call, found.caller_api)
    service_api = _string_at(call, found.service_api)
    if caller_api and isinstance(admission, Endpoint):
        edits.append(xmlrpc.replace(caller_api, addressing.advertised_uri(admission)))
    elif caller_api:
        edits.append(xmlrpc.replace(caller_api, addressing.export_slave(caller_api.text, asker)))
    if service_api and isinstance(admission, Endpoint):
        edits += _export_service_api(service_api, admission, addressing)
    elif service_api:
        text = addressing.export_service(service_api.text, _name(call), asker)
        edits.append(xmlrpc.replace(service_api, text))
    return edits


def _export_service_api(value: Value, endpoint: Endpoint, addressing: Addressing) -> list[Edit]:
    if parse_service_uri(value.text) is None:
        return []
    return [xmlrpc.replace(value, addressing.advertised_service(endpoint))]


def _string_at(call: Call, index: int | None) -> Value | None:
    if index is None or call.string(index) is None:
        return None
    return call.params[index]


def _without_refused(request: Request) -> list[Edit]:
    refused = zip(request.items, request.admissions, strict=False)
    return [xmlrpc.remove(item) for item, a in refused if isinstance(a, Refusal)]


def _refused_results(request: Request) -> list[tuple[int, bytes]]:
    return [
        (i, xmlrpc.dump_value([admission.triple()]))
        for i, admission in enumerate(request.admissions)
        if isinstance(admission, Refusal)
    ]


def _results(request: Request, value: Value) -> Iterator[Result]:
    """The calls that went to the master with their ROS triples; faults are left out."""
    triples: Sequence[Value | None] = [value]
    if request.multicall:
        triples = [item.items[0] if item.items else None for item in value.items]
    for index, triple in zip(request.forwarded(), triples, strict=False):
        call, admission = request.calls[index], request.admissions[index]
        if call and triple and triple.kind == "array" and len(triple.items) == 3:
            yield Result(call, triple, admission if isinstance(admission, Endpoint) else None)


def _import_result(result: Result, asker: Asker, addressing: Addressing) -> list[Edit]:
    triple, kind = result.triple, row(result.call.method).reply
    text = triple.items[2].string()
    if not result.accepted:
        return []
    if kind is Reply.SLAVE_URIS:
        return _import_each(triple.items[2], asker, addressing)
    if text is None or kind is Reply.OTHER:
        return []
    return _import_one(triple, text, _imported(result.call, text, asker, addressing))


def _imported(call: Call, text: str, asker: Asker, addressing: Addressing) -> str:
    kind = row(call.method).reply
    if kind is Reply.SLAVE_URI:
        return addressing.import_slave(text, asker)
    if kind is Reply.SERVICE_URI:
        return addressing.import_service(text, _name(call), asker)
    return f"http://{asker.master}/" if asker.master else text


def _import_each(held: Value, asker: Asker, addressing: Addressing) -> list[Edit]:
    return [
        xmlrpc.replace(item, addressing.import_slave(item.text, asker))
        for item in held.items
        if item.kind == "string"
    ]


def _import_one(triple: Value, before: str, after: str) -> list[Edit]:
    """Replace the value, and the same text where the status message quotes it (lookupService)."""
    edits = [xmlrpc.replace(triple.items[2], after)]
    message = triple.items[1].string()
    if message and before and before in message:
        edits.append(xmlrpc.replace(triple.items[1], message.replace(before, after)))
    return edits


def _registration(call: Call, now: float) -> Registration | None:
    found, caller_id = row(call.method), _caller_id(call)
    kind = found.registers or found.unregisters
    name = call.string(found.name) if found.name is not None else None
    if kind is None or not name:
        return None
    type_ = (call.string(found.type) if found.type is not None else None) or "*"
    service_api = call.string(found.service_api) if found.service_api is not None else None
    return Registration(kind, resolve_name(name, caller_id), caller_id, type_, service_api, now)
