"""The slave API: what the proxy rewrites in a call that passes, and in the reply.

The functions are the same for both directions. A `CallView` says how addresses change:
`from_outside` if outside or the master calls a node inside, `from_inside` if a node inside calls a
node outside.

Methods: http://wiki.ros.org/ROS/Slave_API. Forms of the replies: ros_comm's
clients/rospy/src/rospy/impl/masterslave.py and clients/roscpp/src/libros/topic_manager.cpp.
"""

from collections.abc import Callable
from functools import partial

import msgspec

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.status_triples import replace_in_message, replace_value, ros_triple
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL
from rosproxy.ros1.protocol.xmlrpc.values import Edit, Value
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_slave_uri

_URI_REPLIES = frozenset({"getUri", "getMasterUri"})
_REWRITTEN = _URI_REPLIES | {"publisherUpdate", "requestTopic", "getBusInfo"}


class CallView(msgspec.Struct, frozen=True):
    """How both ends of a call see the nodes that the call names.

    ``rewrite_in_call`` turns a slave URI in the call into the URI for the node,
    ``rewrite_in_reply`` a URI in the reply into the URI for the caller. ``master_uri`` is the
    caller's URI for the master.
    """

    rewrite_in_call: Callable[[str], str]
    rewrite_in_reply: Callable[[str], str]
    master_uri: str


def from_outside(node: Caller, master_uri: str, addressing: Addressing) -> CallView:
    """The view of a call from outside to a node inside."""
    imported = partial(addressing.import_slave, caller=node)
    return CallView(imported, partial(addressing.export_slave, caller=node), master_uri)


def from_inside(caller: Caller, master_uri: str, addressing: Addressing) -> CallView:
    """The view of a call from a node inside to a node outside."""
    exported = partial(addressing.export_slave, caller=caller)
    return CallView(exported, partial(addressing.import_slave, caller=caller), master_uri)


def is_rewritten(method: str) -> bool:
    """Whether the proxy rewrites a call or its reply."""
    return method in _REWRITTEN


def passes_unread(method: str) -> bool:
    """Whether a call may pass unread, because it has no address and needs no check.

    The proxy takes a multicall apart, and may keep a ``shutdown`` from the node.
    """
    return not (is_rewritten(method) or method in ("shutdown", MULTICALL))


def rewrite_call(body: bytes, call: Call, view: CallView) -> bytes:
    """The call for the node, with the publishers of a ``publisherUpdate`` rewritten.

    The order stays the same. A repeated publisher is left out.
    """
    edits = []
    listed = set()
    for item in _publishers(call):
        uri = view.rewrite_in_call(item.text)
        # roscpp would connect twice to a repeated publisher (subscription.cpp, pubUpdate).
        edits.append(item.removed() if uri in listed else item.with_text(uri))
        listed.add(uri)
    return xmlrpc.apply(body, edits)


def rewrite_reply(call: Call, reply: bytes, reached: HostPort, view: CallView) -> bytes:
    """The reply for the caller, with addresses that the caller can use.

    ``reached`` is the address and port at which the caller finds the node's topics, and the address
    from which the caller gets datagrams.
    """
    triple = ros_triple(xmlrpc.parse_reply(reply))
    if triple is None:
        return reply
    edits: list[Edit] = []
    if call.method == "requestTopic" and _is_tcpros(triple):
        edits = replace_topic_address(triple, reached)
    elif call.method == "requestTopic" and _is_udpros(triple):
        # A relay or NAT sends the datagrams from there; some libraries drop all other datagrams.
        edits = [triple.items[2].items[1].with_text(reached.host)]
    elif call.method == "getBusInfo":
        edits = [peer.with_text(view.rewrite_in_reply(peer.text)) for peer in _peers(triple)]
    elif call.method in _URI_REPLIES:
        edits = _rewrite_uri(call.method, triple, view)
    return xmlrpc.apply(reply, edits)


def with_address_in_reply(call: Call, reply: bytes, host: str, address: str) -> bytes:
    """A node's reply, with ``address`` in place of the host name ``host`` (in lower case).

    Only the TCPROS address in a reply to ``requestTopic`` changes. So topics flow without the
    proxy. Raises XmlRpcError.
    """
    triple = ros_triple(xmlrpc.parse_reply(reply)) if call.method == "requestTopic" else None
    server = tcpros_address(triple) if triple else None
    if triple is None or server is None or server.host.lower() != host:
        return reply
    return xmlrpc.apply(reply, replace_topic_address(triple, HostPort(address, server.port)))


def with_address(body: bytes, call: Call, host: str, address: str) -> bytes:
    """A ``requestTopic`` from outside, with ``address`` in place of ``host`` in UDPROS offers.

    The subscriber receives datagrams at ``host``, a name in lower case. No stand-in is possible for
    such an address. Other calls stay the same.
    """
    if call.method != "requestTopic" or len(call.params) < 3:
        return body
    offers = [offer.items for offer in call.params[2].items if len(offer.items) > 2]
    hosts = [items[2] for items in offers if items[0].string() == "UDPROS"]
    return xmlrpc.apply(
        body, [h.with_text(address) for h in hosts if (h.string() or "").lower() == host]
    )


def named_publishers(call: Call, reply: bytes) -> dict[str, list[str]]:
    """The slave URIs of publishers in a reply to ``getBusInfo``, by topic."""
    triple = ros_triple(xmlrpc.parse_reply(reply)) if call.method == "getBusInfo" else None
    publishers: dict[str, list[str]] = {}
    for row in triple.items[2].items if triple else ():
        uri, topic = (row.items[i].string() if len(row.items) > i else None for i in (1, 4))
        if topic and parse_slave_uri(uri or ""):
            publishers.setdefault(topic, []).append(uri or "")
    return publishers


def announced_publishers(call: Call) -> list[str]:
    """The publishers in a ``publisherUpdate``; empty for other calls."""
    return [item.text for item in _publishers(call)]


def is_outdated(call: Call, addressing: Addressing, now: float) -> bool:
    """Whether a ``publisherUpdate`` lacks a publisher that is being registered anew.

    A newer update follows, so a subscriber inside need not drop its connection meanwhile.
    """
    topic = call.string(1) or ""
    listed = set(announced_publishers(call))
    return any(
        endpoint.settles_at > now
        and topic in endpoint.names_at_master(Kind.PUBLISHER)
        and addressing.advertised_uri(endpoint) not in listed
        for endpoint in addressing.registry
    )


def topic_port(call: Call, reply: bytes) -> int | None:
    """The TCPROS port in a reply to ``requestTopic``; None if the reply or the call names none."""
    triple = ros_triple(xmlrpc.parse_reply(reply))
    server = tcpros_address(triple) if triple else None
    return server.port if server and call.string(1) else None


def tcpros_address(triple: Value) -> HostPort | None:
    """The TCPROS address in a reply to ``requestTopic``; None if there is none."""
    if not _is_tcpros(triple):
        return None
    _, host, port = triple.items[2].items
    number = port.integer()
    return HostPort(host.text, number) if number and 0 < number < 65536 else None


def replace_topic_address(triple: Value, target: HostPort) -> list[Edit]:
    """Edits that change the address in a reply to ``requestTopic`` to ``target``."""
    _, host, port = triple.items[2].items
    edits = [host.with_text(target.host), port.with_text(str(target.port))]
    # rospy's message is "ready on HOST:PORT" (tcpros_pubsub.py, init_publisher).
    return edits + replace_in_message(triple, f"{host.text}:{port.text}", str(target))


def _publishers(call: Call) -> list[Value]:
    if call.method != "publisherUpdate" or len(call.params) < 3 or call.params[2].kind != "array":
        return []
    return [item for item in call.params[2].items if item.kind == "string"]


def _is_tcpros(triple: Value) -> bool:
    protocol = triple.items[2].items
    return len(protocol) == 3 and protocol[0].string() == "TCPROS"


def _is_udpros(triple: Value) -> bool:
    protocol = triple.items[2].items
    return len(protocol) > 2 and protocol[0].string() == "UDPROS"


def _peers(triple: Value) -> list[Value]:
    """The nodes in the rows of ``getBusInfo`` that have a slave URI."""
    named = [row.items[1] for row in triple.items[2].items if len(row.items) > 1]
    return [peer for peer in named if parse_slave_uri(peer.string() or "")]


def _rewrite_uri(method: str, triple: Value, view: CallView) -> list[Edit]:
    text = triple.items[2].string()
    if not text:
        return []
    uri = view.master_uri if method == "getMasterUri" else view.rewrite_in_reply(text)
    return replace_value(triple, uri)
