"""The alias: bound ports, released ports, and rewritten replies."""

from typing import Any

import pytest

from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import XmlRpcError, dump_fault
from rosproxy.ros1.registry import stand_ins as book
from rosproxy.ros1.rewriting import master_api, master_calls, slave_api
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy.shared.settings import Settings
from tests.unit.builders import (
    DIALECTS,
    make_addressing,
    make_caller,
    make_stand_ins,
    py_call,
    py_reply,
)

ROBOT = "robot"
ADDRESS = "192.0.2.7"
URI = "http://robot:40001/"
SERVICE = "rosrpc://robot:40003"
LAPTOP = "http://laptop:33445/"


def settings(**options: Any) -> Settings:
    listen = PortRange(45000, 45009)
    return Settings(
        master_uri="http://robot:11311", advertise_host="host", port_range=listen, **options
    )


@pytest.mark.parametrize(
    ("master_uri", "host"),
    [
        ("http://robot:11311", "robot"),
        ("http://Robot.LAN:11311/", "robot.lan"),
        ("http://192.0.2.7:11311", None),
        ("http://[2001:db8::7]:11311", None),
        ("http://localhost:11311", None),
        ("robot:11311", None),
    ],
)
def test_only_a_host_name_can_lead_to_the_proxy(master_uri: str, host: str | None) -> None:
    assert book.aliased_host(master_uri) == host


def handed(calls: list[tuple[str, list[Any]]], reply: bytes, multicall: bool = False) -> list[str]:
    """The URIs that a reply to calls hands over."""
    body = [{"methodName": method, "params": params} for method, params in calls]
    method, params = calls[0]
    text = py_call("system.multicall", body) if multicall else py_call(method, *params)
    request = master_calls.read_request(text, make_caller("10.0.0.5"))
    exported = master_api.export_request(
        request, [master_calls.Passing.NO_REGISTRATION] * len(request.calls), make_addressing()
    )
    return list(master_calls.read_reply(exported, reply).uris())


NAMED = [
    ("lookupNode", ["/n", "/far"], [1, "node api", URI], [URI]),
    ("lookupService", ["/n", "/add"], [1, f"rosrpc URI: [{SERVICE}]", SERVICE], [SERVICE]),
    ("registerSubscriber", ["/n", "/t", "*", LAPTOP], [1, "", [URI, LAPTOP]], [URI, LAPTOP]),
    ("registerPublisher", ["/n", "/t", "x/Y", LAPTOP], [1, "", [URI]], [URI]),
    ("registerSubscriber", ["/n", "/t", "*", LAPTOP], [1, "", []], []),
    ("registerSubscriber", ["/n", "/t", "*", LAPTOP], [1, "", [5, "", URI]], [URI]),
    ("lookupNode", ["/n", "/far"], [-1, "unknown node", ""], []),
    ("lookupNode", ["/n", "/far"], [-1, "unknown node", URI], []),
    ("lookupNode", ["/n", "/far"], [1, "odd", 7], []),
    ("getUri", ["/n"], [1, "", URI], []),
    ("getParam", ["/n", "/p"], [1, "", URI], []),
    ("getPid", ["/n"], [1, "", 5], []),
]


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(("method", "params", "triple", "expected"), NAMED)
def test_uris_that_a_reply_hands_over(
    dialect: str, method: str, params: list[str], triple: list[Any], expected: list[str]
) -> None:
    assert handed([(method, params)], DIALECTS[dialect][1](triple)) == expected


def test_uris_of_a_multicall_and_of_a_fault() -> None:
    calls = [(method, params) for method, params, _, _ in NAMED]
    reply = py_reply([[triple] for _, _, triple, _ in NAMED])
    assert handed(calls, reply, multicall=True) == [uri for *_, uris in NAMED for uri in uris]
    assert handed(calls, dump_fault(1, "no")) == []


@pytest.mark.parametrize(
    ("method", "params", "expected"),
    [
        ("publisherUpdate", ["/master", "/t", [URI, 5, LAPTOP]], [URI, LAPTOP]),
        ("publisherUpdate", ["/master", "/t", []], []),
        ("publisherUpdate", ["/master", "/t", URI], []),
        ("publisherUpdate", ["/master", "/t"], []),
        ("paramUpdate", ["/master", "/t", [URI]], []),
    ],
)
def test_uris_that_a_publisher_update_names(
    method: str, params: list[Any], expected: list[str]
) -> None:
    call = xmlrpc.parse_call(py_call(method, *params))
    assert list(slave_api.announced_publishers(call)) == expected


def test_only_ports_of_the_masters_host_need_a_port() -> None:
    uris = [
        URI,
        SERVICE,
        LAPTOP,
        "http://ROBOT:40004/",
        "http://robot:45003/10.0.0.5:40001/",
        "http://robot.lan:40005/",
        "http://192.0.2.7:40006/",
        "http://robot:0/",
        "http://robot:70000/",
        "http://robot/",
        "",
    ]
    addressing = make_addressing("robot")
    needed = {uri for uri in uris if addressing.stand_in_target(uri)}
    assert needed == {URI, SERVICE, "http://ROBOT:40004/"}


def test_ports_that_the_proxy_needs_itself_do_not_stand_in() -> None:
    own = settings(publish_master=11411, admin=HostPort("0.0.0.0", 11312))
    assert {port: book.obstacle(port, own) for port in (45000, 45009, 11311, 11411, 11312)} == {
        45000: "lies in the range 45000-45009 of the proxy",
        45009: "lies in the range 45000-45009 of the proxy",
        11311: "is taken by the proxy's master API",
        11411: "is taken by the published master",
        11312: "is taken by the admin endpoint",
    }
    assert book.obstacle(45010, own) is None
    assert book.obstacle(40001, settings()) is None


def test_advice_says_what_to_do() -> None:
    address = HostPort(ROBOT, 45000)
    reason = "lies in the range 45000-45009 of the proxy"
    text = make_stand_ins().advice(address, reason, ADDRESS)
    assert "port 45000 lies in the range 45000-45009 of the proxy" in text
    assert "ROS_IP=192.0.2.7" in text


@pytest.mark.parametrize("dialect", DIALECTS)
def test_datagrams_are_sent_to_the_address(dialect: str) -> None:
    def body(host: str, method: str = "requestTopic") -> bytes:
        odd = [[], ["UDPROS"], ["UDPROS", "x", 5], ["other", "x", "robot"], "UDPROS"]
        offers = [["UDPROS", "head", host, 40009, 1500], ["TCPROS"], *odd]
        return DIALECTS[dialect][0](method, "/listener", "/chatter", offers)

    def sent(given: bytes) -> bytes:
        return slave_api.with_address(given, xmlrpc.parse_call(given), ROBOT, ADDRESS)

    for named in ("robot", "Robot"):
        assert sent(body(named)) == body(ADDRESS)
    for other in (body("laptop"), body(ROBOT, "other"), py_call("requestTopic", "/n", "/t")):
        assert sent(other) == other


def direct(reply: bytes, method: str = "requestTopic", address: str = ADDRESS) -> bytes:
    call = xmlrpc.parse_call(py_call(method, "/n", "/chatter", [["TCPROS"]]))
    return slave_api.with_address_in_reply(call, reply, ROBOT, address)


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("named", ["robot", "Robot"])
def test_a_topic_is_to_be_had_at_the_address(dialect: str, named: str) -> None:
    reply = DIALECTS[dialect][1]
    given = reply([1, f"ready on {named}:40002", ["TCPROS", named, 40002]])
    assert direct(given) == reply([1, f"ready on {ADDRESS}:40002", ["TCPROS", ADDRESS, 40002]])


def test_an_ipv6_address_stands_bare_in_the_reply_and_in_brackets_in_its_text() -> None:
    given = py_reply([1, "ready on robot:40002", ["TCPROS", "robot", 40002]])
    expected = py_reply([1, "ready on [2001:db8::7]:40002", ["TCPROS", "2001:db8::7", 40002]])
    assert direct(given, address="2001:db8::7") == expected


@pytest.mark.parametrize(
    "triple",
    [
        [1, "ready on 192.0.2.9:40002", ["TCPROS", "192.0.2.9", 40002]],
        [1, "ready on robot.lan:40002", ["TCPROS", "robot.lan", 40002]],
        [1, "", ["UDPROS", "robot", 40002, 3, 1500, b"x"]],
        [1, "", ["TCPROS", "robot"]],
        [1, "", ["TCPROS", "robot", "40002"]],
        [1, "", []],
        [0, "no supported protocol", 0],
        [-1, "Not a publisher of [/robot]", []],
        ["robot"],
        "robot",
    ],
)
def test_other_replies_pass_untouched(triple: Any) -> None:
    assert direct(py_reply(triple)) == py_reply(triple)


def test_other_methods_pass_unparsed() -> None:
    for method in ("getPid", "getBusInfo", "publisherUpdate", "shutdown"):
        assert direct(b"whatever", method) == b"whatever"
    assert direct(dump_fault(1, "robot")) == dump_fault(1, "robot")
    with pytest.raises(XmlRpcError):
        direct(b"whatever")


def test_of_many_topics_the_latest_are_remembered() -> None:
    address = HostPort("robot", 40001)
    stand_in = book.StandIn(
        HostPort("172.30.0.2", 20001), f"http://{address}/", address, is_uri_kept=False
    )
    for number in range(book.MOST_TOPICS + 10):
        stand_in.note_topic_port(f"/topic{number}", 40000 + number % 7)
        stand_in.note_topic_port("/asked_often", 40002)
    assert len(stand_in.topic_ports) == book.MOST_TOPICS
    assert stand_in.topic_ports["/asked_often"] == 40002
    assert "/topic0" not in stand_in.topic_ports
