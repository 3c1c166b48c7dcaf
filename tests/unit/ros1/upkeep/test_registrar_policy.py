"""Calls to the master on behalf of nodes: the reverse of what the nodes' own calls were."""

import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.upkeep import policy
from tests.unit.builders import (
    add_node,
    add_registration,
    exchange,
    make_addressing,
    make_asker,
    py_call,
    py_reply,
)

PUB, SUB, SRV, PARAM = Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE, Kind.PARAM
OWN, SERVICE = "http://10.0.0.5:40001/", "rosrpc://10.0.0.5:50001"
BY_NODE = [
    # how the node registers and unregisters
    (
        py_call("registerPublisher", "/n", "/a", "std_msgs/String", OWN),
        py_call("unregisterPublisher", "/n", "/a", OWN),
    ),
    (
        py_call("registerSubscriber", "/n", "/a", "*", OWN),
        py_call("unregisterSubscriber", "/n", "/a", OWN),
    ),
    (
        py_call("registerService", "/n", "/s", SERVICE, OWN),
        py_call("unregisterService", "/n", "/s", SERVICE),
    ),
    (py_call("subscribeParam", "/n", OWN, "/k"), py_call("unsubscribeParam", "/n", OWN, "/k")),
]


@pytest.mark.parametrize(("register", "unregister"), BY_NODE)
def test_the_proxy_calls_the_master_exactly_as_the_node_did(
    register: bytes, unregister: bytes
) -> None:
    addressing, node = make_addressing(), make_asker("10.0.0.5")
    done = exchange(addressing, node, register, py_reply([1, "", []]))
    endpoint = addressing.registry.by_port[45000]
    (held,) = endpoint.registrations.values()
    method, params = policy.register_call(endpoint, held, addressing)
    assert py_call(method, *params) == done.sent
    method, params = policy.unregister_call(endpoint, held, addressing)
    assert py_call(method, *params) == exchange(addressing, node, unregister, py_reply([])).sent


HELD = [(PUB, "/a"), (SUB, "/b"), (SRV, "/s"), (PARAM, "/p")]


@pytest.mark.parametrize(
    ("published", "subscribed", "same_process", "kept"),
    [
        ({"/a"}, {"/b"}, True, HELD),
        ({"/a"}, {"/b"}, False, HELD[:2]),  # another process: only what it names itself
        ({"/a"}, set(), True, [HELD[0], *HELD[2:]]),
        ({"/b"}, {"/a"}, True, []),  # the kinds are not the same
        (set(), set(), True, []),
        ({"/rosout"}, set(), True, []),
    ],
)
def test_what_still_holds_of_a_node_that_is_back(
    published: set[str], subscribed: set[str], same_process: bool, kept: list[tuple[Kind, str]]
) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    for kind, name in HELD:
        add_registration(addressing, endpoint, kind, name)
    found = policy.still_held(endpoint, published, subscribed, same_process)
    assert [(held.kind, held.name) for held in found] == kept


OLD = [(PUB, "/rosout", "/old", 1.0), (PUB, "/a", "/old", 1.0), (SRV, "/s", "/old", 1.0)]
NEW = [(PUB, "/rosout", "/new", 5.0), (SUB, "/b", "/new", 5.0)]
LEFT_OVER = [
    # registered, published, subscribed, left over
    ([], {"/x"}, {"/y"}, []),
    (OLD, {"/rosout", "/a"}, set(), []),
    (OLD, {"/rosout"}, set(), [OLD[1]]),  # the topic has gone, the node has not
    ([*OLD, *NEW], {"/rosout"}, {"/b"}, OLD),  # another node on the same port
    ([*OLD, *NEW], {"/rosout", "/a"}, {"/b"}, []),  # two names in one process
    ([*OLD, (SUB, "/b", "/new", 20.0)], {"/rosout"}, set(), OLD),  # is being made right now
]


@pytest.mark.parametrize(("registered", "published", "subscribed", "left"), LEFT_OVER)
def test_what_a_process_that_is_gone_has_left_behind(
    registered: list[tuple[Kind, str, str, float]],
    published: set[str],
    subscribed: set[str],
    left: list[tuple[Kind, str, str, float]],
) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    for kind, name, caller_id, since in registered:
        addressing.registry.register(endpoint, Registration(kind, name, caller_id, since=since))
    found = policy.left_over(endpoint, published, subscribed, before=10.0)
    assert [held.key for held in found] == [row[:3] for row in left]


def test_topics_that_a_node_has_and_the_master_does_not_know_of() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    assert policy.unregistered(endpoint, {"/a": "t/A"}, {}) == []  # whose would they be?
    add_registration(addressing, endpoint, PUB, "/a", "/n")
    found = policy.unregistered(endpoint, {"/a": "t/A", "/b": "t/B"}, {"/a": "t/A"})
    assert found == [Registration(PUB, "/b", "/n", "t/B"), Registration(SUB, "/a", "/n", "t/A")]
    add_registration(addressing, endpoint, SUB, "/c", "/m")
    assert policy.unregistered(endpoint, {"/b": "t/B"}, {}) == []
