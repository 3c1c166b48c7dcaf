"""The slave API as outside and the master call it: what is rewritten on the way in and back.

Rows: http://wiki.ros.org/ROS/Slave_API; the replies' shapes: ros_comm's
clients/rospy/src/rospy/impl/masterslave.py and clients/roscpp/src/libros/topic_manager.cpp.
"""

import msgspec

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call, Edit, Value
from rosproxy.ros1.rewriting.addressing import Addressing, Asker

MASTER_ONLY = frozenset({"shutdown", "publisherUpdate", "paramUpdate"})
"""What the master calls at nodes; a policy can refuse it from anybody else."""

LONG = frozenset({"paramUpdate"})
"""What may be long and holds no address. All else that outside calls is short."""

_URI_REPLIES = frozenset({"getUri", "getMasterUri"})
_REWRITTEN = _URI_REPLIES | {"publisherUpdate", "requestTopic", "getBusInfo"}


class Visit(msgspec.Struct, frozen=True):
    """A call at an endpoint.

    ``node`` is the endpoint's node as an asker of imported addresses, ``reached`` the address and
    port at which the caller is to find its topics, ``master_uri`` the master's URI outside.
    """

    node: Asker
    reached: HostPort
    master_uri: str


def rewritten(call: Call) -> bool:
    """Whether anything in a call or its reply is rewritten."""
    return call.method in _REWRITTEN


def import_call(body: bytes, call: Call, node: Asker, addressing: Addressing) -> bytes:
    """The call for the inside node: the publishers of a ``publisherUpdate`` imported.

    Their order is kept; a publisher that is named twice is left out the second time.
    """
    edits, seen = [], set()
    for item in _publishers(call):
        uri = addressing.import_slave(item.text, node)
        edits.append(xmlrpc.remove(item) if uri in seen else xmlrpc.replace(item, uri))
        seen.add(uri)
    return xmlrpc.apply(body, edits)


def export_reply(call: Call, reply: bytes, visit: Visit, addressing: Addressing) -> bytes:
    """The reply for outside: addresses exported."""
    triple = ros_triple(xmlrpc.parse_reply(reply))
    if triple is None:
        return reply
    edits: list[Edit] = []
    if call.method == "requestTopic" and _is_tcpros(triple):
        edits = send_to(triple, visit.reached)
    elif call.method == "getBusInfo":
        edits = _export_bus_info(triple, visit, addressing)
    elif call.method in _URI_REPLIES:
        edits = _export_uri(call.method, triple, visit, addressing)
    return xmlrpc.apply(reply, edits)


def announced_publishers(call: Call) -> list[str]:
    """The publishers that a ``publisherUpdate`` names; nothing for other calls."""
    return [item.text for item in _publishers(call)]


def is_outdated(call: Call, addressing: Addressing, now: float) -> bool:
    """Whether a ``publisherUpdate`` lacks a publisher that is being registered anew.

    A newer one follows; a subscriber inside need not drop its connection in between.
    """
    topic, listed = call.string(1) or "", set(announced_publishers(call))
    return any(
        endpoint.settles_at > now
        and topic in endpoint.shown(Kind.PUBLISHER)
        and addressing.advertised_uri(endpoint) not in listed
        for endpoint in addressing.registry
    )


def topic_port(call: Call, reply: bytes) -> int | None:
    """The port that a reply to ``requestTopic`` names for a topic, if it is one for TCPROS."""
    triple = ros_triple(xmlrpc.parse_reply(reply))
    said = tcpros_address(triple) if triple else None
    return said.port if said and call.string(1) else None


def ros_triple(value: Value | None) -> Value | None:
    """The value of a reply if it is a ROS status triple, else None."""
    return value if value and value.kind == "array" and len(value.items) == 3 else None


def tcpros_address(triple: Value) -> HostPort | None:
    """Where a reply to ``requestTopic`` sends the subscriber, if that is for TCPROS."""
    if not _is_tcpros(triple):
        return None
    _, host, port = triple.items[2].items
    number = port.integer()
    return HostPort(host.text, number) if number and 0 < number < 65536 else None


def send_to(triple: Value, where: HostPort) -> list[Edit]:
    """Edits by which such a reply sends the subscriber elsewhere."""
    _, host, port = triple.items[2].items
    edits = [xmlrpc.replace(host, where.host), xmlrpc.replace(port, str(where.port))]
    return edits + _in_message(triple, f"{host.text}:{port.text}", str(where))


def replace_held(triple: Value, after: str) -> list[Edit]:
    """Edits by which a reply gives another text, also where its status message quotes it."""
    held = triple.items[2]
    return [xmlrpc.replace(held, after), *_in_message(triple, held.text, after)]


def _in_message(triple: Value, before: str, after: str) -> list[Edit]:
    """The edit of a status message that quotes a text; none if it does not."""
    text = triple.items[1].string() or ""
    return [xmlrpc.replace(triple.items[1], text.replace(before, after))] if before in text else []


def _publishers(call: Call) -> list[Value]:
    if call.method != "publisherUpdate" or len(call.params) < 3 or call.params[2].kind != "array":
        return []
    return [item for item in call.params[2].items if item.kind == "string"]


def _is_tcpros(triple: Value) -> bool:
    protocol = triple.items[2].items
    return len(protocol) == 3 and protocol[0].string() == "TCPROS"


def _export_bus_info(triple: Value, visit: Visit, addressing: Addressing) -> list[Edit]:
    peers = [row.items[1] for row in triple.items[2].items if len(row.items) > 1]
    return [
        xmlrpc.replace(peer, addressing.export_slave(peer.text, visit.node))
        for peer in peers
        if parse_slave_uri(peer.string() or "")
    ]


def _export_uri(method: str, triple: Value, visit: Visit, addressing: Addressing) -> list[Edit]:
    held = triple.items[2].string()
    if not held:
        return []
    if method == "getMasterUri":
        return replace_held(triple, visit.master_uri)
    return replace_held(triple, addressing.export_slave(held, visit.node))
