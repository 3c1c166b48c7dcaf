"""The master's host name as an alias of the proxy: which ports it needs, and what is rewritten.

In a container network the master's host name may lead to the proxy, so that ``ROS_MASTER_URI``
need not change. Nodes outside that run on the master's host give that very name in their own
URIs; inside, those lead to the proxy as well. So the proxy listens on the same port numbers and
passes on what arrives there. The URIs stay as they are, and nothing has to be mapped back.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping

from rosproxy.net.addresses import HostPort, is_address, is_loopback
from rosproxy.ros1.protocol.uris import parse_service_uri, parse_slave_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call, Edit, Value
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL, inner_calls
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.ros1.rewriting.slave_api import ros_triple, send_to, tcpros_address
from rosproxy.settings import Settings


def aliased_host(master_uri: str) -> str | None:
    """The master's host if it is a name that can lead to the proxy, in lower case."""
    where = parse_slave_uri(master_uri)
    if where is None or is_address(where.host) or is_loopback(where.host):
        return None
    return where.host.lower()


def ports_needed(uris: Iterable[str], host: str, addressing: Addressing) -> dict[int, str]:
    """The ports that have to stand in for those of ``host``, each with a URI that names it.

    An address of the proxy's own is none, even where the proxy is advertised by the same name.
    """
    found: dict[int, str] = {}
    for uri in uris:
        where = parse_slave_uri(uri) or parse_service_uri(uri)
        if where and where.host.lower() == host and not addressing.advertises(where):
            found[where.port] = uri
    return found


def is_service(uri: str) -> bool:
    """Whether a URI is that of a service, not of a slave API."""
    return parse_service_uri(uri) is not None


def obstacle(port: int, settings: Settings) -> str | None:
    """What the proxy itself needs a port for, so that it can't stand in; None if nothing."""
    if port in settings.ports.listen:
        return f"lies in --port-range {settings.ports.listen}"
    for option, own in (
        ("--master-port", settings.master_port),
        ("--publish-master", settings.publish_master),
        ("--admin-bind", settings.admin.port),
    ):
        if port == own:
            return f"is that of {option}"
    return None


def advice(port: int, why: str, address: str) -> str:
    """What is wrong where a port can't stand in, and the cure; ``address`` is the master's."""
    return (
        f"inside nodes can't reach it: port {port} {why}. Start that node with ROS_IP={address}, "
        "so that it gives its address instead of its host name"
    )


def least_used(used: Mapping[int, float], busy: Collection[int]) -> int | None:
    """The port to give up first: the one unused for the longest time and not ``busy``.

    ``used`` tells when, in seconds, each was last of use.
    """
    return min((port for port in used if port not in busy), key=used.__getitem__, default=None)


def direct_call(call: Call, body: bytes, host: str, address: str) -> bytes:
    """A ``requestTopic`` from outside, with the address where it names the host for UDPROS.

    A subscriber tells there where it wants its datagrams; no port could stand in for that.
    """
    if call.method != "requestTopic" or len(call.params) < 3:
        return body
    offers = [offer.items for offer in call.params[2].items if len(offer.items) > 2]
    hosts = [items[2] for items in offers if items[0].string() == "UDPROS"]
    return xmlrpc.apply(
        body, [xmlrpc.replace(h, address) for h in hosts if (h.string() or "").lower() == host]
    )


def direct_reply(call: Call, reply: bytes, host: str, address: str) -> bytes:
    """A node's reply, with the address in place of the host's name where a topic is to be had.

    So topics flow without the proxy. Everything else stays as it is. Raises XmlRpcError.
    """
    if call.method not in ("requestTopic", MULTICALL):
        return reply
    edits: list[Edit] = []
    for triple in _topic_replies(call, xmlrpc.parse_reply(reply)):
        said = tcpros_address(triple)
        if said and said.host.lower() == host:
            edits += send_to(triple, HostPort(address, said.port))
    return xmlrpc.apply(reply, edits)


def _topic_replies(call: Call, value: Value | None) -> Iterator[Value]:
    """The ROS triples with which a reply answers to ``requestTopic``."""
    if value and call.method == MULTICALL:
        pairs = zip(inner_calls(call), value.items, strict=False)
        values = [v for inner, v in pairs if inner and inner.method == "requestTopic"]
        triples = [ros_triple(v.items[0]) for v in values if v.items]
    else:
        triples = [ros_triple(value)]
    yield from (triple for triple in triples if triple)
