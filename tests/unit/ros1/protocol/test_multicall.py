"""system.multicall: the proxy treats each call and each result like a single call."""

from typing import Any

import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc.document import INVALID_PARAMS, XmlRpcError, dump_fault
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL
from rosproxy.ros1.rewriting import master_calls
from rosproxy.ros1.rewriting.addressing import Addressing
from tests.unit.builders import (
    DIALECTS,
    MASTER,
    add_node,
    add_registration,
    cpp_call,
    cpp_reply,
    exchange,
    make_addressing,
    make_caller,
    py_call,
    py_reply,
    python_values,
)

OWN = "http://10.0.0.5:40001/"
OUT = "http://robot-host:45000/"
SERVICE = "rosrpc://10.0.0.5:50001"
OUT_SERVICE = "rosrpc://robot-host:45000"
FULL = "http://full:40001/"
NODE = make_caller("10.0.0.5", master=MASTER)
FAULT = {"faultCode": 1, "faultString": "method is not supported"}
REFUSED = [[-1, "rosproxy: no port is left", 0]]


def world() -> Addressing:
    addressing = make_addressing()
    endpoint = add_node(addressing, OWN)
    for kind in Kind:
        add_registration(addressing, endpoint, kind, "/held", "/n")
    return addressing


def element(method: str, *params: Any) -> dict[str, Any]:
    return {"methodName": method, "params": list(params)}


def refuse(uri: str) -> bool:
    return uri == FULL


SHUTDOWN = [
    # rospy's calls on shutdown (rospy/impl/registration.py)
    element("unregisterSubscriber", "/n", "/held", OWN),
    element("unregisterPublisher", "/n", "/held", OWN),
    element("unregisterService", "/n", "/held", SERVICE),
]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_end_of_a_rospy_node(dialect: str) -> None:
    call, reply = DIALECTS[dialect]
    addressing = world()
    results = [[[1, "Unregistered", 1]]] * 3
    done = exchange(addressing, NODE, call("system.multicall", SHUTDOWN), reply(results))
    assert done.sent == call(
        "system.multicall",
        [
            element("unregisterSubscriber", "/n", "/held", OUT),
            element("unregisterPublisher", "/n", "/held", OUT),
            element("unregisterService", "/n", "/held", OUT_SERVICE),
        ],
    )
    assert done.received == reply(results)
    assert [fact.registration.kind for fact in done.facts] == [
        Kind.SUBSCRIBER,
        Kind.PUBLISHER,
        Kind.SERVICE,
    ]
    assert [registration.kind for _, registration in addressing.registry.registrations()] == [
        Kind.PARAM
    ]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_each_result_is_imported_by_the_row_of_its_call(dialect: str) -> None:
    call, reply = DIALECTS[dialect]
    calls = [
        element("lookupNode", "/n", "/n"),
        element("getParam", "/n", "/key"),
        element("nonsense", "/n"),
        element("registerSubscriber", "/n", "/t", "*", OWN),
        element("lookupService", "/n", "/held"),
        element("getUri", "/n"),
    ]
    results: list[Any] = [
        [[1, "node api", OUT]],
        [[1, "", OUT]],
        FAULT,
        [[1, "", [OUT, "http://laptop:5/"]]],
        [[1, f"rosrpc URI: [{OUT_SERVICE}]", OUT_SERVICE]],
        [[1, "", "http://robot:11311/"]],
    ]
    done = exchange(world(), NODE, call("system.multicall", calls), reply(results))
    assert done.received == reply(
        [
            [[1, "node api", OWN]],
            [[1, "", OUT]],
            FAULT,
            [[1, "", [OWN, "http://laptop:5/"]]],
            [[1, f"rosrpc URI: [{SERVICE}]", SERVICE]],
            [[1, "", f"http://{MASTER}/"]],
        ]
    )


GOOD = element("registerPublisher", "/n", "/a", "*", OWN)
BAD = element("registerPublisher", "/n", "/b", "*", FULL)
PATTERNS = ["gb", "bg", "gbg", "bgb", "bbg", "gbb", "gbbg", "bgbgb", "gg", "bxg", "xbx", "gxb"]


@pytest.mark.parametrize("dialect", [(py_call, py_reply), (cpp_call, cpp_reply)])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_refused_calls_among_others(pattern: str, dialect: Any) -> None:
    """g is granted, b is refused for want of a port, x is no call."""
    call, reply = dialect
    given = [{"g": GOOD, "b": BAD, "x": 5}[letter] for letter in pattern]
    results = [[[1, f"{i}", [OUT]]] if letter == "g" else FAULT for i, letter in enumerate(pattern)]
    from_master = [r for r, letter in zip(results, pattern, strict=True) if letter != "b"]
    done = exchange(world(), NODE, call("system.multicall", given), reply(from_master), refuse)
    exported = {"g": element("registerPublisher", "/n", "/a", "*", OUT), "x": 5}
    sent = [exported[letter] for letter in pattern if letter != "b"]
    assert python_values(done.sent) == [sent]
    answers = {"b": REFUSED, "x": FAULT}
    assert python_values(done.received) == [
        [answers.get(letter, [[1, f"{i}", [OWN]]]) for i, letter in enumerate(pattern)]
    ]
    assert len(done.facts) == pattern.count("g")


@pytest.mark.parametrize("count", [1, 2, 5])
def test_if_all_calls_are_refused_the_master_is_not_asked(count: int) -> None:
    done = exchange(world(), NODE, py_call("system.multicall", [BAD] * count), b"", refuse)
    assert done.sent == b""
    assert done.received == py_reply([REFUSED] * count)


def test_a_fault_for_the_whole_is_passed_on() -> None:
    fault = dump_fault(1, "KeyError")
    done = exchange(world(), NODE, py_call("system.multicall", [GOOD, BAD]), fault, refuse)
    assert done.received == fault
    assert not done.facts


@pytest.mark.parametrize(
    "results",
    [[], [[]], [FAULT], [[[1, ""]]], 5, "x", {}, [5, 6, 7], [[5]], [[[]]], [[1, "", 1]]],
)
def test_results_of_another_shape_are_passed_on(results: Any) -> None:
    done = exchange(world(), NODE, py_call("system.multicall", [GOOD]), py_reply(results))
    assert done.received == py_reply(results)
    assert not done.facts


def test_fewer_results_than_calls() -> None:
    body = py_call("system.multicall", [GOOD, GOOD])
    done = exchange(world(), NODE, body, py_reply([[[1, "", [OUT]]]]))
    assert done.received == py_reply([[[1, "", [OWN]]]])
    assert len(done.facts) == 1


NO_CALLS: list[tuple[Any, ...]] = [
    (),
    ([],),
    (5,),
    ("x",),
    ({},),
    ({"a": GOOD},),
    ([5],),
    (["x"],),
    ([[]],),
    ([[GOOD]],),
    ([{}],),
    ([{"methodName": "registerPublisher"}],),
    ([{"params": ["/n", "/a", "*", OWN]}],),
    ([{"methodName": 5, "params": []}],),
    ([{"methodName": "", "params": []}],),
    ([{"methodName": "registerPublisher", "params": OWN}],),
    ([{"methodName": "registerPublisher", "params": {"caller_api": OWN}}],),
    ([{"__proto__": "registerPublisher", "constructor": []}],),
    ([GOOD], [GOOD]),
]


@pytest.mark.parametrize("params", NO_CALLS)
def test_what_holds_no_call_goes_to_the_master_as_it_is(params: tuple[Any, ...]) -> None:
    body = py_call("system.multicall", *params)
    reply = dump_fault(1, "no")
    done = exchange(world(), NODE, body, reply)
    assert done.sent == body
    assert done.received == reply
    assert master_calls.read_request(body, NODE).is_address_free


def test_a_multicall_in_a_multicall_is_refused() -> None:
    """rosmaster accepts a nested multicall, and would get the addresses unchanged."""
    inner = element("system.multicall", [GOOD])
    with pytest.raises(XmlRpcError) as caught:
        exchange(world(), NODE, py_call("system.multicall", [GOOD, inner]), b"")
    assert caught.value.code == INVALID_PARAMS


def test_names_are_resolved_for_the_caller_of_each_call() -> None:
    """Not for the caller of the first call."""
    addressing = world()
    calls = [
        element("getPid", "/elsewhere/x"),
        element("unregisterService", "/n", "held", SERVICE),
        element("lookupService", "/n", "held"),
    ]
    results = [[[1, "", 5]], [[1, "", 1]], [[1, "", OUT_SERVICE]]]
    done = exchange(addressing, NODE, py_call("system.multicall", calls), py_reply(results))
    assert python_values(done.sent)[0][1]["params"] == ["/n", "held", OUT_SERVICE]
    assert [fact.registration.name for fact in done.facts] == ["/held"]


def test_empty_and_self_closing_results_keep_their_places() -> None:
    body = py_call("system.multicall", [BAD, GOOD, BAD, GOOD, BAD])
    reply = (
        b"<methodResponse><params><param><value><array><data>\n <value/>\n <value>"
        b"<array><data/></array></value> </data></array></value></param></params></methodResponse>"
    )
    done = exchange(world(), NODE, body, reply, refuse)
    assert python_values(done.received) == [[REFUSED, "", REFUSED, [], REFUSED]]


@pytest.mark.parametrize("calls", [[], [element("getParam", "/n", "/a")], [element("x"), 5]])
def test_a_multicall_without_addresses_is_plain(calls: list[Any]) -> None:
    request = master_calls.read_request(py_call("system.multicall", calls), NODE)
    assert request.is_address_free
    assert request.method == MULTICALL
