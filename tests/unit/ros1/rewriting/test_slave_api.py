"""The slave API, row by row: exact bytes to the node and back, in both dialects."""

import base64
from typing import Any

import pytest

from rosproxy.ros1.protocol.master_methods import MASTER_ONLY, Kind
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import XmlRpcError, dump_fault
from rosproxy.ros1.rewriting import slave_api
from rosproxy.ros1.rewriting.slave_api import CallView
from rosproxy.shared.addresses import HostPort
from tests.unit.builders import (
    DIALECTS,
    PROXY,
    add_node,
    add_registration,
    make_addressing,
    make_caller,
    py_call,
    py_reply,
    python_values,
)

OWN = "http://10.0.0.5:40001/"
OUT = "http://robot-host:45000/"
OTHER = "http://10.0.0.6:40001/"
OTHER_OUT = "http://robot-host:45001/"
FAR_OUT = "http://robot-host:45002/"
FAR_RELAYED = f"http://{PROXY}:45002/"
LAPTOP = "http://laptop:33445/"
MASTER = "http://robot:11311/"
OUTSIDE = HostPort("robot-host", 45000)
MASTER_ID = "/master"


def world() -> CallView:
    addressing = make_addressing()
    node = add_node(addressing, OWN)
    add_node(addressing, OTHER)
    add_node(addressing, "http://172.20.0.7:40001/")
    return slave_api.from_outside(make_caller("10.0.0.5", endpoint=node), MASTER, addressing)


def inward(body: bytes) -> bytes:
    return slave_api.rewrite_call(body, xmlrpc.parse_call(body), world())


def outward(method: str, reply: bytes, reached: HostPort = OUTSIDE) -> bytes:
    call = xmlrpc.parse_call(py_call(method, "/tool", "/chatter"))
    return slave_api.rewrite_reply(call, reply, reached, world())


UPDATES = [
    # publishers from the master, publishers to the node
    ([], []),
    ([LAPTOP], [LAPTOP]),
    ([OUT], [OWN]),
    ([LAPTOP, FAR_OUT, OTHER_OUT, OUT], [LAPTOP, FAR_RELAYED, OTHER, OWN]),
    ([OUT, OTHER_OUT, LAPTOP], [OWN, OTHER, LAPTOP]),
    ([LAPTOP, LAPTOP], [LAPTOP]),
    ([OTHER_OUT, LAPTOP, OTHER_OUT, OTHER_OUT], [OTHER, LAPTOP]),
    ([OTHER, OTHER_OUT], [OTHER]),  # two forms of the same
    (["http://robot-host:45009/gone:1/"], ["http://robot-host:45009/gone:1/"]),
    (["", "x"], ["", "x"]),
    ([LAPTOP, 5, LAPTOP], [LAPTOP, 5]),
]


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(("given", "expected"), UPDATES)
def test_publishers_are_imported_in_order_and_once(
    dialect: str, given: list[Any], expected: list[Any]
) -> None:
    call, _ = DIALECTS[dialect]
    sent = inward(call("publisherUpdate", MASTER_ID, "/chatter", given))
    assert python_values(sent) == [MASTER_ID, "/chatter", expected]
    if len(given) == len(expected):
        assert sent == call("publisherUpdate", MASTER_ID, "/chatter", expected)


UNTOUCHED_CALLS: list[tuple[str, list[Any]]] = [
    ("publisherUpdate", []),
    ("publisherUpdate", [MASTER_ID, OUT]),
    ("publisherUpdate", [MASTER_ID, OUT, OUT]),
    ("publisherUpdate", [MASTER_ID, OUT, {"a": OUT, "b": OUT}]),
    ("publisherUpdate", [MASTER_ID, OUT, 5]),
    ("paramUpdate", [MASTER_ID, "/key", [OUT, OUT, {"a": [True, 1.5, ""]}]]),
    ("requestTopic", ["/tool", "/chatter", [["TCPROS"]]]),
    ("requestTopic", ["/tool", OUT, [["UDPROS", OUT, "10.0.0.9", 5, 1500], ["TCPROS"]]]),
    ("shutdown", [MASTER_ID, OUT]),
    ("getBusInfo", [OUT]),
    ("getPid", [OUT, [OUT]]),
    ("constructor", [OUT]),
]


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(("method", "params"), UNTOUCHED_CALLS)
def test_other_calls_reach_the_node_byte_for_byte(
    dialect: str, method: str, params: list[Any]
) -> None:
    body = DIALECTS[dialect][0](method, *params)
    assert inward(body) == body


REPLIES = [
    # method, the node's reply, what outside gets
    (
        "requestTopic",
        [1, "ready on 10.0.0.5:38117", ["TCPROS", "10.0.0.5", 38117]],
        [1, "ready on robot-host:45000", ["TCPROS", "robot-host", 45000]],
    ),
    (
        "requestTopic",  # roscpp
        [1, "", ["TCPROS", "c5", 38117]],
        [1, "", ["TCPROS", "robot-host", 45000]],
    ),
    (
        "requestTopic",  # a forged reply leads nowhere else
        [1, "ready", ["TCPROS", "10.0.0.66", 22]],
        [1, "ready", ["TCPROS", "robot-host", 45000]],
    ),
    ("requestTopic", [0, "Unknown Error", 0], [0, "Unknown Error", 0]),
    ("requestTopic", [-1, "Not a publisher of [/x]", []], [-1, "Not a publisher of [/x]", []]),
    ("requestTopic", [1, "", ["TCPROS", "c5"]], [1, "", ["TCPROS", "c5"]]),
    ("requestTopic", [1, "", ["UDPROS", "c5", 5]], [1, "", ["UDPROS", "robot-host", 5]]),
    (
        "requestTopic",
        [1, "", ["UDPROS", "10.0.0.5", 40123, 1, 1500, "header"]],
        [1, "", ["UDPROS", "robot-host", 40123, 1, 1500, "header"]],
    ),
    (
        "getBusInfo",
        [1, "bus info", [[1, OTHER, "i", "TCPROS", "/a", True, "from 10.0.0.6"]]],
        [1, "bus info", [[1, OTHER_OUT, "i", "TCPROS", "/a", True, "from 10.0.0.6"]]],
    ),
    (
        "getBusInfo",
        [1, "", [[1, FAR_RELAYED, "i"], [2, LAPTOP, "i"], [3, "/listener", "o"], [4, OWN, "i"]]],
        [1, "", [[1, FAR_OUT, "i"], [2, LAPTOP, "i"], [3, "/listener", "o"], [4, OUT, "i"]]],
    ),
    ("getBusInfo", [1, "", []], [1, "", []]),
    ("getBusInfo", [1, "", 0], [1, "", 0]),
    ("getBusInfo", [1, "", [[], [1], 5, [1, 2], [1, [OTHER]]]], None),
    ("getMasterUri", [1, f"http://{PROXY}:11311", f"http://{PROXY}:11311"], [1, MASTER, MASTER]),
    ("getMasterUri", [1, "", f"http://{PROXY}:11311"], [1, "", MASTER]),
    ("getMasterUri", [0, "master URI not set", ""], None),
    ("getMasterUri", [0, "", 0], None),
    ("getUri", [1, "", OWN], [1, "", OUT]),
    ("getUri", [1, "", "nonsense"], None),
    ("getUri", [1, "", ""], None),
    ("getPid", [1, OWN, OWN], None),
    ("getBusStats", [1, OWN, [[OWN]]], None),
    ("getSubscriptions", [1, "", [[OWN, OTHER]]], None),
    ("getPublications", [1, "", [["TCPROS", "10.0.0.5", 5]]], None),
    ("publisherUpdate", [1, OWN, 0], None),
    ("shutdown", [1, "shutdown", 0], None),
]


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(("method", "given", "expected"), REPLIES)
def test_what_outside_gets(
    dialect: str, method: str, given: list[Any], expected: list[Any] | None
) -> None:
    """None: byte for byte what the node said."""
    _, reply = DIALECTS[dialect]
    assert outward(method, reply(given)) == reply(expected or given)


REACHED = [
    (HostPort("robot-host", 30000), "ready on robot-host:30000"),
    (HostPort(PROXY, 45000), f"ready on {PROXY}:45000"),
    (HostPort("fd00::1", 45000), "ready on [fd00::1]:45000"),
]


@pytest.mark.parametrize(("reached", "message"), REACHED)
def test_a_caller_is_sent_back_to_where_it_reached_the_node(
    reached: HostPort, message: str
) -> None:
    reply = py_reply([1, "ready on 10.0.0.5:38117", ["TCPROS", "10.0.0.5", 38117]])
    expected = py_reply([1, message, ["TCPROS", reached.host, reached.port]])
    assert outward("requestTopic", reply, reached) == expected


def test_a_udpros_reply_keeps_its_binary_header() -> None:
    header = base64.b64encode(bytes(range(64))).decode()
    reply = (
        b'<?xml version="1.0"?>\r\n<methodResponse><params><param>\r\n\t<value><array><data><value>'
        b"<i4>1</i4></value><value></value><value><array><data><value>UDPROS</value><value>c5"
        b"</value><value><i4>40123</i4></value><value><i4>1</i4></value><value><i4>1500</i4></value>"
        b"<value><base64>" + header.encode() + b"\n</base64></value></data></array></value></data>"
        b"</array></value>\r\n</param></params></methodResponse>\r\n"
    )
    expected = reply.replace(b"<value>c5</value>", b"<value>robot-host</value>")
    assert outward("requestTopic", reply) == expected


PORTS = [
    # the node's reply, the port learned
    ([1, "", ["TCPROS", "10.0.0.5", 38117]], 38117),
    ([1, "", ["TCPROS", "10.0.0.66", 65535]], 65535),  # the host counts for nothing
    ([1, "", ["TCPROS", "10.0.0.5", 0]], None),
    ([1, "", ["TCPROS", "10.0.0.5", -1]], None),
    ([1, "", ["TCPROS", "10.0.0.5", 65536]], None),
    ([1, "", ["TCPROS", "10.0.0.5", "38117"]], None),
    ([1, "", ["TCPROS", "10.0.0.5"]], None),
    ([1, "", ["UDPROS", "10.0.0.5", 38117]], None),
    ([1, "", ["UDPROS", "10.0.0.5", 38117, 1, 1500, ""]], None),
    ([1, "", [["TCPROS"], "10.0.0.5", 38117]], None),
    ([0, "Unknown Error", 0], None),
    ([-1, "Not a publisher", []], None),
    ([1, ""], None),
    ("TCPROS", None),
]


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(("reply", "port"), PORTS)
def test_the_tcpros_port_that_a_node_names(dialect: str, reply: Any, port: int | None) -> None:
    call, encode = DIALECTS[dialect]
    asked = xmlrpc.parse_call(call("requestTopic", "/tool", "/chatter", [["TCPROS"]]))
    assert slave_api.topic_port(asked, encode(reply)) == port


@pytest.mark.parametrize("params", [[], ["/tool"], ["/tool", 5], ["/tool", ""]])
def test_no_port_is_learned_for_no_topic(params: list[Any]) -> None:
    asked = xmlrpc.parse_call(py_call("requestTopic", *params))
    assert slave_api.topic_port(asked, py_reply([1, "", ["TCPROS", "c5", 5]])) is None


@pytest.mark.parametrize(
    "method", ["publisherUpdate", "requestTopic", "getBusInfo", "getUri", "getMasterUri"]
)
def test_methods_that_are_rewritten_and_their_faults(method: str) -> None:
    assert slave_api.is_rewritten(method)
    assert not slave_api.passes_unread(method)
    fault = dump_fault(1, OWN)
    assert outward(method, fault) == fault
    for reply in (py_reply(OWN), py_reply([OWN]), py_reply([1, OWN, OWN, 1])):
        assert outward(method, reply) == reply
    with pytest.raises(XmlRpcError):
        outward(method, b"<html>")


@pytest.mark.parametrize("method", ["getPid", "shutdown", "paramUpdate", "getPublications", "x"])
def test_methods_that_are_not_rewritten(method: str) -> None:
    assert not slave_api.is_rewritten(method)
    assert slave_api.passes_unread(method) is (method not in ("shutdown", "system.multicall"))


def test_what_only_the_master_calls() -> None:
    assert {"shutdown", "publisherUpdate", "paramUpdate"} == MASTER_ONLY


def test_an_update_from_before_a_publisher_was_registered_anew() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    add_registration(addressing, endpoint, Kind.PUBLISHER, "/a")
    ours = addressing.advertised_uri(endpoint)
    other = "http://laptop:1/"
    endpoint.settles_at = 5.0

    def outdated(topic: str, publishers: list[str], now: float) -> bool:
        call = xmlrpc.parse_call(py_call("publisherUpdate", "/master", topic, publishers))
        return slave_api.is_outdated(call, addressing, now)

    assert outdated("/a", [other], now=4.0)
    assert outdated("/a", [], now=4.0)
    assert not outdated("/a", [other, ours], now=4.0)
    assert not outdated("/a", [other], now=5.0)
    assert not outdated("/b", [other], now=4.0)
    addressing.registry.unregister(Kind.PUBLISHER, "/a", "/talker")
    assert not outdated("/a", [other], now=4.0)
