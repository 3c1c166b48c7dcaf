"""The master API for nodes inside: export URIs in calls, import URIs in replies.

A request passes four steps. Each step makes a new value and changes no earlier value.

1. `master_calls.read_request` parses the request.
2. `export_request` exports the URIs, when the outcome of each call is known.
3. `master_calls.read_reply` parses the reply, and says what the registry has to record.
4. `import_reply` imports the URIs.

Methods and pitfalls: http://wiki.ros.org/ROS/Master_API and
ros_comm/tools/rosmaster/src/rosmaster/master_api.py.
"""

from collections.abc import Callable, Iterator, Sequence

from msgspec.structs import replace

from rosproxy.ros1.protocol.master_methods import Reply
from rosproxy.ros1.protocol.status_triples import replace_value
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.multicall import insert_items
from rosproxy.ros1.protocol.xmlrpc.values import Edit, Value
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.ros1.rewriting.master_calls import (
    CallOutcome,
    CallResult,
    ExportedRequest,
    LocalAnswer,
    MasterCall,
    MasterReply,
    Passing,
    Request,
    read_reply,
)
from rosproxy.shared.uris import parse_service_uri, with_caller_address

ResultFilter = Callable[[CallResult, Caller], Sequence[Edit]]
"""The edits of a result that hide or add parts for a caller; empty if there are none.

The texts of these edits have imported URIs, so a filtered result is not imported again."""


def export_request(
    request: Request, outcomes: Sequence[CallOutcome], addressing: Addressing
) -> ExportedRequest:
    """The request for the master, with exported URIs, without calls that the proxy answers.

    ``outcomes`` has an element for each call.
    """
    edits: list[Edit] = []
    for call, outcome in zip(request.calls, outcomes, strict=True):
        if call and not isinstance(outcome, LocalAnswer):
            edits += _export_call(call, outcome, request.caller, addressing)
    local = [isinstance(outcome, LocalAnswer) for outcome in outcomes]
    if local and all(local):
        return ExportedRequest(request, tuple(outcomes), None)
    edits += [item.removed() for item, out in zip(request.items, local, strict=False) if out]
    return ExportedRequest(request, tuple(outcomes), xmlrpc.apply(request.body, edits))


def import_reply(reply: MasterReply, addressing: Addressing, filter_result: ResultFilter) -> bytes:
    """The reply for the node inside: filtered, with imported URIs and the proxy's own answers."""
    edits: list[Edit] = []
    request = reply.exported.request
    for result in reply.results:
        caller = request.caller
        if result.endpoint:
            caller = replace(caller, endpoint=result.endpoint)
        edits += filter_result(result, caller) or _import_result(result, caller, addressing)
    if request.multicall and reply.value and reply.value.items:
        outcomes = enumerate(reply.exported.outcomes)
        local = [(i, o.triple()) for i, o in outcomes if isinstance(o, LocalAnswer)]
        results = [(i, xmlrpc.dump_value([triple])) for i, triple in local]
        edits += insert_items(reply.value, results)
    return xmlrpc.apply(reply.body, edits)


def rename_master(request: Request, reply: bytes, master: str) -> bytes:
    """A reply with ``http://MASTER/`` in place of the master's own URI in results of getUri.

    The rest of the reply stays the same. Raises XmlRpcError.
    """
    if not any(call and call.method == "getUri" for call in request.calls):
        return reply
    edits: list[Edit] = []
    for result in read_reply(
        ExportedRequest(request, (Passing.NO_REGISTRATION,) * len(request.calls), None), reply
    ).results:
        if not (result.triple and result.value):
            continue
        text = result.value.string()
        if result.call.spec.reply is Reply.MASTER_URI and text:
            edits += replace_value(result.triple, f"http://{master}/")
    return xmlrpc.apply(reply, edits)


def unregistering_endpoint(
    call: MasterCall, caller: Caller, addressing: Addressing
) -> Endpoint | Passing:
    """The endpoint of the registration that a call ends.

    FOREIGN_URI if the call does not have the URI of this endpoint.
    """
    spec = call.spec
    endpoint = addressing.registry.by_caller.get(call.caller_id)
    if endpoint is None:
        return Passing.FOREIGN_URI
    if spec.caller_api is None:
        uri = addressing.export_service(
            call.string(spec.service_api) or "", call.second_name, caller
        )
        is_own = uri == addressing.advertised_service(endpoint)
        return endpoint if is_own else Passing.FOREIGN_URI
    uri = addressing.export_slave(call.string(spec.caller_api) or "", caller)
    return endpoint if uri == addressing.advertised_uri(endpoint) else Passing.FOREIGN_URI


def _export_call(
    call: MasterCall, outcome: CallOutcome, caller: Caller, addressing: Addressing
) -> Iterator[Edit]:
    caller_api = call.string_value(call.spec.caller_api)
    service_api = call.string_value(call.spec.service_api)
    if isinstance(outcome, Endpoint):
        if caller_api:
            yield caller_api.with_text(addressing.advertised_uri(outcome))
        if service_api and parse_service_uri(with_caller_address(service_api.text, caller.address)):
            yield service_api.with_text(addressing.advertised_service(outcome))
        return
    if caller_api:
        yield caller_api.with_text(addressing.export_slave(caller_api.text, caller))
    if service_api:
        text = addressing.export_service(service_api.text, call.second_name, caller)
        yield service_api.with_text(text)


def _import_result(result: CallResult, caller: Caller, addressing: Addressing) -> list[Edit]:
    triple = result.triple
    if triple is None or not result.accepted:
        return []
    if result.call.spec.reply is Reply.SLAVE_URIS:
        return [
            item.with_text(addressing.import_slave(item.text, caller))
            for item in triple.items[2].items
            if item.kind == "string"
        ]
    return _import_uri(result.call, triple, caller, addressing)


def _import_uri(
    call: MasterCall, triple: Value, caller: Caller, addressing: Addressing
) -> list[Edit]:
    text = triple.items[2].string()
    kind = call.spec.reply
    if text and kind is Reply.SLAVE_URI:
        return replace_value(triple, addressing.import_slave(text, caller))
    if text and kind is Reply.SERVICE_URI:
        uri = addressing.import_service(text, call.second_name, caller)
        return replace_value(triple, uri)
    if text and kind is Reply.MASTER_URI and caller.master:
        return replace_value(triple, f"http://{caller.master}/")
    return []
