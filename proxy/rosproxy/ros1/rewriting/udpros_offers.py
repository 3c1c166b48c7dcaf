"""The offers of UDPROS in a ``requestTopic``: read, redirect, or remove offers.

An offer is ``["UDPROS", header, host, port, datagram size]`` with a connection header in base64
(``Subscription::negotiateConnection`` in clients/roscpp/src/libros/subscription.cpp).
"""

import base64
import binascii

import msgspec

from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.protocol.xmlrpc.values import Edit, Value
from rosproxy.shared.addresses import HostPort

PROTOCOL = "UDPROS"


class UdprosOffer(msgspec.Struct, frozen=True):
    """Where a subscriber wants to receive datagrams, and the topic in the connection header.

    ``topic`` is empty without a readable header, ``receiver`` None without a valid address.
    """

    value: Value
    topic: str
    receiver: HostPort | None


def read_offers(call: Call) -> list[UdprosOffer]:
    """The offers in a call."""
    if call.method != "requestTopic" or len(call.params) < 3:
        return []
    return [
        UdprosOffer(offer, _topic(offer.items), _receiver(offer.items))
        for offer in call.params[2].items
        if offer.items and offer.items[0].string() == PROTOCOL
    ]


def redirect_offer(offer: UdprosOffer, target: HostPort | None) -> list[Edit]:
    """The edits that redirect an offer to ``target``; None removes the offer from the call."""
    if target is None or offer.receiver is None:
        return [offer.value.removed()]
    _, _, host, port, *_ = offer.value.items
    return [host.with_text(target.host), port.with_text(str(target.port))]


def _topic(items: list[Value]) -> str:
    try:
        return decode_header(base64.b64decode(items[1].text)).get("topic", "")
    except (IndexError, binascii.Error, HeaderError, ValueError):
        return ""


def _receiver(items: list[Value]) -> HostPort | None:
    if len(items) < 4:
        return None
    host = items[2].string()
    port = items[3].integer()
    return HostPort(host, port) if host and port and 0 < port < 65536 else None
