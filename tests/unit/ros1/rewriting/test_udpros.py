"""The offers of UDPROS: read, led elsewhere, taken out."""

import xmlrpc.client
from typing import Any

import pytest

from rosproxy.ros1.protocol.tcpros import encode_header
from rosproxy.ros1.protocol.xmlrpc import document
from rosproxy.ros1.rewriting.udpros_offers import read_offers, redirect_offer
from rosproxy.shared.addresses import HostPort

HERE = HostPort("10.0.0.1", 25000)


def header(topic: str) -> xmlrpc.client.Binary:
    """A header of roscpp without the total length."""
    return xmlrpc.client.Binary(encode_header({"topic": topic, "callerid": "/n"})[4:])


def offer(topic: str = "/t", host: Any = "laptop", port: Any = 40000) -> list[Any]:
    return ["UDPROS", header(topic), host, port, 1500]


def asked(*offers: list[Any]) -> bytes:
    return xmlrpc.client.dumps(("/n", "/t", list(offers)), "requestTopic").encode()


def redirected(body: bytes, receiver: HostPort | None) -> Any:
    """The offers of a call, each led to somewhere."""
    call = document.parse_call(body)
    edits = [edit for o in read_offers(call) for edit in redirect_offer(o, receiver)]
    return xmlrpc.client.loads(document.apply(body, edits).decode())[0][2]


def test_an_offer_is_read() -> None:
    (parsed_offer,) = read_offers(document.parse_call(asked(["TCPROS"], offer("/other"))))
    assert (parsed_offer.topic, parsed_offer.receiver) == ("/other", HostPort("laptop", 40000))


def test_an_offer_leads_elsewhere_and_all_else_stays() -> None:
    assert redirected(asked(["TCPROS"], offer()), HERE) == [
        ["TCPROS"],
        offer(host=HERE.host, port=25000),
    ]


def test_an_offer_is_taken_out() -> None:
    assert redirected(asked(offer(), ["TCPROS"]), None) == [["TCPROS"]]


@pytest.mark.parametrize(
    "odd",
    [
        ["UDPROS"],
        ["UDPROS", "no header", "laptop", 40000, 1500],
        ["UDPROS", xmlrpc.client.Binary(b"\xff\xff"), "laptop", 40000, 1500],
        offer(port=0),
        offer(port=70000),
        offer(port="40000"),
        offer(host=""),
        offer(host=7),
    ],
)
def test_what_can_not_be_read_is_taken_out(odd: list[Any]) -> None:
    (parsed_offer,) = read_offers(document.parse_call(asked(odd)))
    assert parsed_offer.receiver is None or parsed_offer.topic == ""
    if parsed_offer.receiver is None:
        assert redirected(asked(odd, ["TCPROS"]), HERE) == [["TCPROS"]]


def test_other_calls_have_none() -> None:
    body = xmlrpc.client.dumps(("/n", "/t", [offer()]), "publisherUpdate").encode()
    assert read_offers(document.parse_call(body)) == []
