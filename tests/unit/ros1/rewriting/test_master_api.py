"""The master API, row by row: exact bytes to the master and back, in both dialects."""

from typing import Any

import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc.document import XmlRpcError, dump_fault
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.rewriting import master_api, master_calls
from rosproxy.ros1.rewriting.addressing import Addressing
from tests.unit.builders import (
    DIALECTS,
    MASTER,
    PROXY,
    add_node,
    add_registration,
    exchange,
    make_addressing,
    make_caller,
    py_call,
    py_reply,
    raw_call,
)

ID = "/ns/talker"
TOPIC = "/chatter"
TYPE = "std_msgs/String"
OWN = "http://10.0.0.5:40001/"
OUT = "http://robot-host:45000/"
SERVICE = "rosrpc://10.0.0.5:50001"
OUT_SERVICE = "rosrpc://robot-host:45000"
LAPTOP = "http://laptop:33445/"
OTHER = "http://10.0.0.6:40001/"
OTHER_OUT = "http://robot-host:45001/"
FAR = "http://172.20.0.7:40001/"
FAR_OUT = "http://robot-host:45002/"
FAR_RELAYED = f"http://{PROXY}:45002/"
NODE = make_caller("10.0.0.5", master=MASTER)


def world() -> Addressing:
    """The node itself, a neighbour, and a node that the neighbours cannot reach. All publish and
    serve.
    """
    addressing = make_addressing()
    for uri, name in ((OWN, ID), (OTHER, "/other"), (FAR, "/far")):
        endpoint = add_node(addressing, uri)
        for kind in Kind:
            add_registration(addressing, endpoint, kind, f"{name}/held", name)
    return addressing


EXPORTED = [
    # method, parameters from the node, parameters to the master
    ("registerPublisher", [ID, TOPIC, TYPE, OWN], [ID, TOPIC, TYPE, OUT]),
    ("registerSubscriber", [ID, TOPIC, TYPE, OWN], [ID, TOPIC, TYPE, OUT]),
    ("registerService", [ID, "/s", SERVICE, OWN], [ID, "/s", OUT_SERVICE, OUT]),
    ("subscribeParam", [ID, OWN, "/key"], [ID, OUT, "/key"]),
    ("unregisterPublisher", [ID, TOPIC, OWN], [ID, TOPIC, OUT]),
    ("unregisterSubscriber", [ID, TOPIC, OWN], [ID, TOPIC, OUT]),
    ("unsubscribeParam", [ID, OWN, "/key"], [ID, OUT, "/key"]),
    (
        "unregisterService",
        [ID, f"{ID}/held", SERVICE],
        [ID, f"{ID}/held", OUT_SERVICE],
    ),
    ("unregisterService", [ID, "talker/held", SERVICE], [ID, "talker/held", OUT_SERVICE]),
    ("unregisterService", [ID, "~held", SERVICE], [ID, "~held", OUT_SERVICE]),
    # rosnode cleanup: another node, by the URI that the proxy gave
    ("unregisterPublisher", ["/other", TOPIC, OTHER], ["/other", TOPIC, OTHER_OUT]),
    ("unregisterPublisher", ["/far", TOPIC, FAR_RELAYED], ["/far", TOPIC, FAR_OUT]),
    ("unregisterSubscriber", ["/laptop", TOPIC, LAPTOP], ["/laptop", TOPIC, LAPTOP]),
    (
        "unregisterService",
        ["/far", "/far/held", f"rosrpc://{PROXY}:45002"],
        ["/far", "/far/held", "rosrpc://robot-host:45002"],
    ),
    (
        "unregisterService",
        ["/laptop", "/s", "rosrpc://laptop:5"],
        ["/laptop", "/s", "rosrpc://laptop:5"],
    ),
    # what is no address is left to the master to complain about
    ("registerService", [ID, "/s", "nonsense", OWN], [ID, "/s", "nonsense", OUT]),
    ("registerPublisher", [ID, TOPIC, TYPE, "nonsense"], [ID, TOPIC, TYPE, "nonsense"]),
    ("registerPublisher", [ID, TOPIC, TYPE, ""], [ID, TOPIC, TYPE, ""]),
    ("registerPublisher", [ID, TOPIC, TYPE, 5], [ID, TOPIC, TYPE, 5]),
    ("registerPublisher", [ID, TOPIC, TYPE, [OWN]], [ID, TOPIC, TYPE, [OWN]]),
    ("registerPublisher", [ID, TOPIC, TYPE], [ID, TOPIC, TYPE]),
    ("registerPublisher", [], []),
    ("registerPublisher", [{"caller_id": OWN}], [{"caller_id": OWN}]),
    ("registerPublisher", [5, 5, 5, OWN], [5, 5, 5, OUT]),
    ("unregisterService", [ID, "/s"], [ID, "/s"]),
    ("unregisterService", [ID, 5, SERVICE], [ID, 5, SERVICE]),
    ("subscribeParam", [ID], [ID]),
    ("lookupNode", [], []),
    ("getUri", [], []),
]


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(("method", "given", "expected"), EXPORTED)
def test_what_the_master_gets(
    dialect: str, method: str, given: list[Any], expected: list[Any]
) -> None:
    call, reply = DIALECTS[dialect]
    done = exchange(world(), NODE, call(method, *given), reply([1, "", 0]))
    assert done.sent == call(method, *expected)
    assert done.received == reply([1, "", 0])


IMPORTED = [
    # method, parameters, the master's triple, the node's
    (
        "registerSubscriber",
        [ID, TOPIC, TYPE, OWN],
        [1, "Subscribed", [LAPTOP, OUT, OTHER_OUT, FAR_OUT, LAPTOP]],
        [1, "Subscribed", [LAPTOP, OWN, OTHER, FAR_RELAYED, LAPTOP]],
    ),
    (
        "registerPublisher",
        [ID, TOPIC, TYPE, OWN],
        [1, "Registered", [FAR_OUT, OUT]],
        [1, "Registered", [FAR_RELAYED, OWN]],
    ),
    ("registerPublisher", [ID, TOPIC, TYPE, OWN], [1, "", []], [1, "", []]),
    ("registerPublisher", [ID, TOPIC, TYPE, OWN], [-1, OUT, [OUT]], [-1, OUT, [OUT]]),
    ("registerPublisher", [ID, TOPIC, TYPE, OWN], [1, "", [5, [OUT]]], [1, "", [5, [OUT]]]),
    ("lookupNode", [ID, "/far"], [1, "node api", FAR_OUT], [1, "node api", FAR_RELAYED]),
    ("lookupNode", [ID, "/other"], [1, "node api", OTHER_OUT], [1, "node api", OTHER]),
    ("lookupNode", [ID, ID], [1, "node api", OUT], [1, "node api", OWN]),
    ("lookupNode", [ID, "/laptop"], [1, "node api", LAPTOP], [1, "node api", LAPTOP]),
    ("lookupNode", [ID, "/x"], [-1, "unknown node [/x]", ""], [-1, "unknown node [/x]", ""]),
    (
        "lookupService",
        [ID, "/far/held"],
        [1, "rosrpc URI: [rosrpc://robot-host:45002]", "rosrpc://robot-host:45002"],
        [1, f"rosrpc URI: [rosrpc://{PROXY}:45002]", f"rosrpc://{PROXY}:45002"],
    ),
    (
        "lookupService",
        ["/other/x", "held"],
        [1, "rosrpc URI: [rosrpc://robot-host:45001]", "rosrpc://robot-host:45001"],
        [1, "rosrpc URI: [rosrpc://10.0.0.6:50001]", "rosrpc://10.0.0.6:50001"],
    ),
    (
        "lookupService",
        [ID, "/s"],
        [1, "rosrpc URI: [rosrpc://laptop:5]", "rosrpc://laptop:5"],
        [1, "rosrpc URI: [rosrpc://laptop:5]", "rosrpc://laptop:5"],
    ),
    ("lookupService", [ID, "/s"], [-1, "no provider", ""], [-1, "no provider", ""]),
    ("getUri", [ID], [1, "", "http://robot:11311/"], [1, "", f"http://{MASTER}/"]),
    ("getUri", [], [-1, "missing required caller_id", ""], [-1, "missing required caller_id", ""]),
    ("subscribeParam", [ID, OWN, "/key"], [1, "", OUT], [1, "", OUT]),  # a parameter's value
    ("unregisterPublisher", [ID, TOPIC, OWN], [1, "", 1], [1, "", 1]),
    ("getParam", [ID, "/key"], [1, "", [OUT, {"a": OUT}]], [1, "", [OUT, {"a": OUT}]]),
    ("getSystemState", [ID], [1, "", [[[OUT, [OUT]]], [], []]], [1, "", [[[OUT, [OUT]]], [], []]]),
]


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(("method", "params", "given", "expected"), IMPORTED)
def test_what_the_node_gets(
    dialect: str, method: str, params: list[Any], given: list[Any], expected: list[Any]
) -> None:
    call, reply = DIALECTS[dialect]
    assert exchange(world(), NODE, call(method, *params), reply(given)).received == reply(expected)


def test_white_space_comments_and_declarations_stay() -> None:
    body = (
        b'<?xml version="1.0"?>\r\n<!-- c -->\r\n<methodCall>\n <methodName> registerPublisher '
        b"</methodName>\n <params>\n  <param> <value>/n</value> </param>\n"
        b"  <param>\t<value><string>/t</string></value></param><param><value>*</value></param>"
        b"<param><value>\n<string>%s</string> </value></param>\n </params>\n</methodCall>\r\n\r\n"
    )
    done = exchange(world(), NODE, body % OWN.encode(), py_reply([1, "", []]))
    assert done.sent == body % OUT.encode()


@pytest.mark.parametrize(
    "written",
    [
        "http://10.0.0.5&#58;40001/",
        "<![CDATA[http://10.0.0.5:40001/]]>",
        "http://<!-- c -->10.0.0.5:40001/",
    ],
)
def test_an_address_is_found_however_it_is_written(written: str) -> None:
    given = [f"<value>{text}</value>" for text in (ID, TOPIC, "*", written)]
    expected = [f"<value>{text}</value>" for text in (ID, TOPIC, "*", OUT)]
    body = raw_call(*given, method="registerPublisher")
    sent = exchange(world(), NODE, body, py_reply([1, "", []])).sent
    assert sent == raw_call(*expected, method="registerPublisher")


OTHER_METHODS = ["getParam", "setParam", "getSystemState", "system.listMethods", "constructor"]


@pytest.mark.parametrize("method", OTHER_METHODS)
def test_other_methods_are_plain(method: str) -> None:
    request = master_calls.read_request(py_call(method, ID, OWN, OUT), NODE)
    assert request.is_address_free
    assert request.method == method


@pytest.mark.parametrize("method", ["registerPublisher", "lookupNode", "getUri"])
def test_methods_of_the_table_are_not_plain(method: str) -> None:
    assert not master_calls.read_request(py_call(method), NODE).is_address_free


def test_the_caller_is_known_by_its_name() -> None:
    assert master_calls.read_request(py_call("getUri", ID), NODE).caller.caller_id == ID
    assert master_calls.read_request(py_call("getUri", 5), NODE).caller.caller_id == ""


@pytest.mark.parametrize(
    ("method", "params", "uri"),
    [
        ("registerPublisher", [ID, TOPIC, TYPE, OWN], OWN),
        ("registerSubscriber", [ID, TOPIC, TYPE, OWN], OWN),
        ("registerService", [ID, "/s", SERVICE, OWN], OWN),
        ("subscribeParam", [ID, OWN, "/key"], OWN),
        ("registerPublisher", [ID, TOPIC, TYPE], None),
        ("registerPublisher", [ID, TOPIC, TYPE, 5], None),
        ("unregisterPublisher", [ID, TOPIC, OWN], None),
        ("unregisterService", [ID, "/s", SERVICE], None),
        ("lookupNode", [ID, ID], None),
        ("getParam", [ID, OWN, OWN, OWN], None),
    ],
)
def test_which_calls_need_a_lease(method: str, params: list[Any], uri: str | None) -> None:
    [call] = master_calls.read_request(py_call(method, *params), NODE).calls
    assert call
    assert call.registering_uri == uri


NOTED = [
    # method, parameters, what is noted
    ("registerPublisher", [ID, "chatter", TYPE, OWN], (Kind.PUBLISHER, "/ns/chatter", TYPE, None)),
    ("registerSubscriber", [ID, TOPIC, "*", OWN], (Kind.SUBSCRIBER, TOPIC, "*", None)),
    ("registerService", [ID, "~s", SERVICE, OWN], (Kind.SERVICE, f"{ID}/s", "*", SERVICE)),
    ("subscribeParam", [ID, OWN, "/key"], (Kind.PARAM, "/key", "*", None)),
]


@pytest.mark.parametrize(("method", "params", "expected"), NOTED)
@pytest.mark.parametrize(("status", "accepted"), [(1, True), (0, False), (-1, False)])
def test_registrations_are_noted_if_the_master_accepts_them(
    method: str, params: list[Any], expected: tuple[Any, ...], status: int, accepted: bool
) -> None:
    addressing = world()
    facts = exchange(addressing, NODE, py_call(method, *params), py_reply([status, "", []])).facts
    assert len(facts) == accepted
    for fact in facts:
        registration = fact.registration
        assert (
            registration.kind,
            registration.name,
            registration.type,
            registration.service_api,
        ) == expected
        assert (registration.caller_id, registration.since) == (ID, 7.0)
        assert fact.endpoint is addressing.registry.by_port[45000]


def registered_kinds(addressing: Addressing, name: str) -> list[Kind]:
    endpoint: Endpoint | None = addressing.registry.by_caller.get(name)
    return [r.kind for r in endpoint.registrations.values()] if endpoint else []


UNREGISTERING = [
    ("unregisterPublisher", [ID, f"{ID}/held", OWN], Kind.PUBLISHER),
    ("unregisterSubscriber", [ID, f"{ID}/held", OWN], Kind.SUBSCRIBER),
    ("unregisterService", [ID, f"{ID}/held", SERVICE], Kind.SERVICE),
    ("unsubscribeParam", [ID, OWN, f"{ID}/held"], Kind.PARAM),
]


@pytest.mark.parametrize("removed", [1, 0])
@pytest.mark.parametrize(("method", "params", "kind"), UNREGISTERING)
def test_a_registration_ends_whether_or_not_the_master_still_had_it(
    method: str, params: list[Any], kind: Kind, removed: int
) -> None:
    addressing = world()
    exchange(addressing, NODE, py_call(method, *params), py_reply([1, "", removed]))
    assert set(registered_kinds(addressing, ID)) == set(Kind) - {kind}
    assert len(registered_kinds(addressing, "/other")) == 4


def test_a_tool_inside_ends_the_registration_of_another_node() -> None:
    addressing = world()
    body = py_call("unregisterPublisher", "/far", "/far/held", FAR_RELAYED)
    exchange(addressing, NODE, body, py_reply([1, "", 1]))
    assert Kind.PUBLISHER not in registered_kinds(addressing, "/far")


@pytest.mark.parametrize(
    ("method", "params"),
    [
        ("unregisterPublisher", [ID, f"{ID}/held", "http://10.0.0.5:40009/"]),
        ("unregisterService", [ID, f"{ID}/held", "rosrpc://10.0.0.9:50009"]),
        ("unsubscribeParam", [ID, "http://10.0.0.5:40009/", f"{ID}/held"]),
        ("unregisterPublisher", [ID, f"{ID}/held"]),
        ("unregisterPublisher", [ID]),
        ("unregisterPublisher", []),
        ("unregisterService", [ID, f"{ID}/held", 5]),
    ],
)
def test_a_node_that_makes_room_for_its_successor_ends_none_of_its_registrations(
    method: str, params: list[Any]
) -> None:
    """The master shuts down the older node of a name.

    This node unregisters with its own URI, and the master answers 1. That answer must not end the
    newer node's lease.
    """
    addressing = world()
    done = exchange(addressing, NODE, py_call(method, *params), py_reply([1, "not known", 0]))
    assert not done.facts
    assert len(registered_kinds(addressing, ID)) == 4


def test_a_registration_with_a_uri_that_the_proxy_handed_out_ends_none() -> None:
    """A registration in the name of another node has no endpoint, but is no unregistration
    either.
    """
    addressing = world()
    request = master_calls.read_request(
        py_call("registerPublisher", "/far", "/far/held", TYPE, FAR_RELAYED), NODE
    )
    exported = master_api.export_request(request, [master_calls.Passing.FOREIGN_URI], addressing)
    assert exported.body == py_call("registerPublisher", "/far", "/far/held", TYPE, FAR_OUT)
    assert master_calls.read_reply(exported, py_reply([1, "", []])).registry_changes(7.0) == []


def test_a_fault_is_passed_on_and_nothing_is_noted() -> None:
    fault = dump_fault(1, OUT)
    done = exchange(world(), NODE, py_call("registerPublisher", ID, TOPIC, TYPE, OWN), fault)
    assert done.received == fault
    assert not done.facts


@pytest.mark.parametrize("value", [1, "x", [], [1], [1, ""], [1, "", 0, 0], {"a": 1}, ["1", "", 0]])
def test_a_reply_that_is_no_status_triple_is_passed_on(value: Any) -> None:
    done = exchange(
        world(), NODE, py_call("registerPublisher", ID, TOPIC, TYPE, OWN), py_reply(value)
    )
    assert done.received == py_reply(value)
    assert not done.facts


def test_a_reply_that_is_no_xmlrpc_is_an_error() -> None:
    with pytest.raises(XmlRpcError):
        exchange(world(), NODE, py_call("getUri", ID), b"<html/>")


def test_a_refused_registration_is_answered_with_a_ros_status() -> None:
    body = py_call("registerPublisher", ID, TOPIC, TYPE, OWN)
    done = exchange(world(), NODE, body, b"", refuse=lambda uri: True)
    assert done.sent == b""
    assert done.received == py_reply([-1, "rosproxy: no port is left", 0])


def test_the_published_master_renames_itself_only() -> None:
    caller = make_caller("192.168.1.77")
    for body, reply, expected in (
        (py_call("getUri", ID), [1, "", "http://inside:11311/"], [1, "", "http://robot-host:1/"]),
        (py_call("lookupNode", ID, ID), [1, "", OUT], [1, "", OUT]),
    ):
        request = master_calls.read_request(body, caller)
        renamed = master_api.rename_master(request, py_reply(reply), "robot-host:1")
        assert renamed == py_reply(expected)
