"""The master's host name as an alias of the proxy: which ports it needs, and what is rewritten.

In a container network the master's host name may lead to the proxy, so that ``ROS_MASTER_URI``
need not change. Nodes outside that run on the master's host give that very name in their own
URIs; inside, those lead to the proxy as well. So the proxy listens on the same port numbers and
passes on what arrives there. The URIs stay as they are, and nothing has to be mapped back.
"""

from collections.abc import Iterable

from rosproxy.net.addresses import HostPort, is_address, is_loopback
from rosproxy.ros1.protocol.uris import parse_service_uri, parse_slave_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call
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


def obstacle(port: int, settings: Settings) -> str | None:
    """What the proxy itself needs a port for, so that it can't stand in; None if nothing."""
    if port in settings.ports.listen:
        return f"lies in --port-range {settings.ports.listen}"
    own = {
        settings.master_port: "--master-port",
        settings.publish_master: "--publish-master",
        settings.admin.port: "--admin-bind",
    }
    return f"is that of {own[port]}" if port in own else None


def advice(port: int, why: str, address: str) -> str:
    """What is wrong where a port can't stand in, and the cure; ``address`` is the master's."""
    return (
        f"inside nodes can't reach it: port {port} {why}. Start that node with ROS_IP={address}, "
        "so that it gives its address instead of its host name"
    )


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
    triple = ros_triple(xmlrpc.parse_reply(reply)) if call.method == "requestTopic" else None
    said = tcpros_address(triple) if triple else None
    if triple is None or said is None or said.host.lower() != host:
        return reply
    return xmlrpc.apply(reply, send_to(triple, HostPort(address, said.port)))
