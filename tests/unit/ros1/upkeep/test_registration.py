"""Calls to the master on behalf of nodes: the reverse of what the nodes' own calls were."""

from collections.abc import Iterable

import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import MOST_CALLERS, Registration
from rosproxy.ros1.registry.graph import NodeInfo
from rosproxy.ros1.upkeep.decisions import registration as decisions
from tests.unit.builders import (
    add_node,
    add_registration,
    exchange,
    make_addressing,
    make_caller,
    py_call,
    py_reply,
)

PUB = Kind.PUBLISHER
SUB = Kind.SUBSCRIBER
SRV = Kind.SERVICE
PARAM = Kind.PARAM


def make_registration(
    name: str, caller_id: str = "/n", kind: Kind = PUB, since: float = 0.0
) -> Registration:
    return Registration(kind, name, caller_id, since=since)


def said(published: Iterable[str] | None, subscribed: Iterable[str] | None = ()) -> NodeInfo:
    """A node's answers, None for no answer. The type of /a is t/a."""
    types = [
        None if names is None else {name: f"t{name}" for name in names}
        for names in (published, subscribed)
    ]
    return NodeInfo(7, types[0], types[1])


OWN = "http://10.0.0.5:40001/"
SERVICE = "rosrpc://10.0.0.5:50001"
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
    addressing = make_addressing()
    node = make_caller("10.0.0.5")
    done = exchange(addressing, node, register, py_reply([1, "", []]))
    endpoint = addressing.registry.by_port[45000]
    (registration,) = endpoint.registrations.values()
    uris = addressing.advertised_uri(endpoint), addressing.advertised_service(endpoint)
    method, params = decisions.register_call(registration, *uris)
    assert py_call(method, *params) == done.sent
    method, params = decisions.unregister_call(registration, *uris)
    assert py_call(method, *params) == exchange(addressing, node, unregister, py_reply([])).sent


HELD = [(PUB, "/a"), (SUB, "/b"), (SRV, "/s"), (PARAM, "/p")]


@pytest.mark.parametrize(
    ("published", "subscribed", "same_process", "kept"),
    [
        ({"/a"}, {"/b"}, True, HELD),
        ({"/a"}, {"/b"}, False, HELD[:2]),  # another process: only topics that this process names
        ({"/a"}, set(), True, [HELD[0], *HELD[2:]]),
        ({"/b"}, {"/a"}, True, []),  # the kinds are not the same
        (set(), set(), True, []),
        ({"/rosout"}, set(), True, []),
        # no answer: keep all
        (None, None, True, HELD),
        (None, None, False, HELD[:2]),
        (set(), None, True, HELD[1:]),
        (None, set(), True, [HELD[0], *HELD[2:]]),
    ],
)
def test_what_still_holds_of_a_node_that_is_back(
    published: set[str] | None,
    subscribed: set[str] | None,
    same_process: bool,
    kept: list[tuple[Kind, str]],
) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    for kind, name in HELD:
        add_registration(addressing, endpoint, kind, name)
    valid = decisions.valid_registrations(endpoint, said(published, subscribed), same_process)
    assert [(registration.kind, registration.name) for registration in valid] == kept


def test_a_service_alone_holds_if_the_process_is_the_same() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    service = add_registration(addressing, endpoint, SRV, "/s")
    assert decisions.valid_registrations(endpoint, said({"/rosout"}), same_process=True) == [
        service
    ]
    assert decisions.valid_registrations(endpoint, said({"/rosout"}), same_process=False) == []


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
    ([*OLD, (SRV, "/late", "/old", 12.0), (SUB, "/b", "/new", 20.0)], {"/rosout"}, set(), OLD),
    # no answer about the old node's publications
    ([*OLD, *NEW], None, {"/b"}, []),
    ([*OLD, *NEW], {"/rosout"}, None, OLD),
    ([*OLD, *NEW], None, None, []),
]


@pytest.mark.parametrize(("registered", "published", "subscribed", "left"), LEFT_OVER)
def test_what_a_process_that_is_gone_has_left_behind(
    registered: list[tuple[Kind, str, str, float]],
    published: set[str] | None,
    subscribed: set[str] | None,
    left: list[tuple[Kind, str, str, float]],
) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    for kind, name, caller_id, since in registered:
        addressing.registry.register(endpoint, Registration(kind, name, caller_id, since=since))
    left_over = decisions.left_over_registrations(
        endpoint, said(published, subscribed), before=10.0
    )
    assert [registration.key for registration in left_over] == [row[:3] for row in left]


def test_a_node_with_another_name_after_each_start_keeps_room_for_the_next() -> None:
    """An anonymous node at a fixed port that was killed 64 times could register no more."""
    addressing = make_addressing()
    endpoint = add_node(addressing)
    names = [f"/n_{number}" for number in range(MOST_CALLERS)]
    registry = addressing.registry
    for number, name in enumerate(names):
        registration = Registration(PUB, "/t", name, since=float(number))
        assert registry.reason_full(endpoint, registration) is None
        registry.register(endpoint, registration)
    following = Registration(PUB, "/t", "/next")
    assert registry.reason_full(endpoint, following)
    before = float(MOST_CALLERS)
    left_over = decisions.left_over_registrations(endpoint, said({"/t"}), before)
    assert [r.caller_id for r in left_over] == names[:1]
    registry.unregister(PUB, "/t", names[0])
    assert registry.reason_full(endpoint, following) is None
    assert decisions.left_over_registrations(endpoint, said({"/t"}), before) == []


def test_topics_that_a_node_has_and_the_master_does_not_know_of() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    assert decisions.unregistered_topics(endpoint, said({"/a"})) == []  # no known node name
    add_registration(addressing, endpoint, PUB, "/a", "/n")
    topics = decisions.unregistered_topics(endpoint, said({"/a", "/b"}, {"/a"}))
    assert topics == [Registration(PUB, "/b", "/n", "t/b"), Registration(SUB, "/a", "/n", "t/a")]
    add_registration(addressing, endpoint, SUB, "/c", "/m")
    assert decisions.unregistered_topics(endpoint, said({"/b"})) == []


def test_what_is_taken_back_and_put_back_and_in_which_order() -> None:
    uris = {"/n": "http://c1:40001/", "/m": "http://c1:40001"}
    services = {"/add": "rosrpc://c1:50001"}
    mine = [
        make_registration("/a"),
        make_registration("/add", kind=SRV),
        make_registration("/b", kind=SUB),
        make_registration("/c", "/m", SUB),
    ]
    mine.append(make_registration("/lost", kind=SRV))
    assert decisions.free_calls(mine, uris, services) == [
        ("unregisterSubscriber", ["/n", "/b", "http://c1:40001/"]),
        ("unregisterSubscriber", ["/m", "/c", "http://c1:40001"]),
        ("unregisterPublisher", ["/n", "/a", "http://c1:40001/"]),
        ("unregisterService", ["/n", "/add", "rosrpc://c1:50001"]),
    ]
    assert decisions.restore_calls(mine, uris, services) == [
        ("registerPublisher", ["/n", "/a", "*", "http://c1:40001/"]),
        ("registerService", ["/n", "/add", "rosrpc://c1:50001", "http://c1:40001/"]),
        ("registerSubscriber", ["/n", "/b", "*", "http://c1:40001/"]),
        ("registerSubscriber", ["/m", "/c", "*", "http://c1:40001"]),
    ]


def test_the_parameter_that_every_node_is_subscribed_to_is_released() -> None:
    ask = [("lookupNode", ["/rosproxy", name]) for name in ("/n", "/m")]
    parameter = "/rosout_disable_topics_generation"
    assert decisions.release_calls({"/n": "http://c1:1/", "/m": "http://c1:2/"}, "/rosproxy") == [
        *ask,
        ("unsubscribeParam", ["/n", "http://c1:1/", parameter]),
        ("unsubscribeParam", ["/m", "http://c1:2/", parameter]),
        *ask,
    ]


def test_who_was_subscribed_to_it_and_who_is_known_still() -> None:
    uris = dict.fromkeys(("/unknown", "/common", "/another", "/taken"), "U")
    before = [None, "U", "U", "other"]
    after = [None, None, "U", "other"]
    ended, remaining = decisions.read_release(uris, [*before, 1, 1, 1, 1, *after])
    assert ended == [Registration(PARAM, decisions.COMMON_PARAMETER, "/common")]
    assert remaining == {"/another": "U", "/taken": "other"}


def test_what_has_not_ended_meanwhile_is_registered_subscribers_last() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    kinds = (SUB, PUB, PARAM, SRV)
    wanted = [(endpoint, add_registration(addressing, endpoint, kind, "/a")) for kind in kinds]
    ended = endpoint, make_registration("/gone")
    replaced = endpoint, make_registration("/a", "/talker")
    registrations = decisions.to_register([ended, replaced, *wanted])
    assert registrations == [*wanted[1:], wanted[0]]


def test_topics_that_a_node_no_longer_has() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    for kind, name, since in [
        (PUB, "/kept", 1.0),
        (PUB, "/dropped", 1.0),
        (PUB, "/new", 9.0),
        (SUB, "/kept", 1.0),
        (SUB, "/dropped", 1.0),
        (SRV, "/add", 1.0),
        (PARAM, "/rate", 1.0),
    ]:
        addressing.registry.register(endpoint, make_registration(name, kind=kind, since=since))
    gone = decisions.vanished_topics(endpoint, said(["/kept"], ["/kept"]), before=5.0)
    assert [(r.kind, r.name) for r in gone] == [(PUB, "/dropped"), (SUB, "/dropped")]


LOST = [
    # ours, the master's, what is lost
    ([], [], []),
    ([make_registration("/a")], [make_registration("/a")], []),
    ([make_registration("/a")], [], [make_registration("/a")]),
    ([make_registration("/a")], [make_registration("/a", "/other")], [make_registration("/a")]),
    ([make_registration("/a")], [make_registration("/a", kind=SUB)], [make_registration("/a")]),
    (
        [make_registration("/a"), make_registration("/b")],
        [make_registration("/a")],
        [make_registration("/b")],
    ),
    ([make_registration("/a", since=9.9)], [], [make_registration("/a", since=9.9)]),
    ([make_registration("/a", since=10.0)], [], []),  # made while the master was being asked
    ([make_registration("/a", since=11.0)], [], []),
    # getSystemState has no parameters: lost if the node is lost
    ([make_registration("/p", kind=PARAM)], [], []),
    ([make_registration("/a"), make_registration("/p", kind=PARAM)], [make_registration("/a")], []),
    (
        [make_registration("/a"), make_registration("/p", kind=PARAM)],
        [],
        [make_registration("/a"), make_registration("/p", kind=PARAM)],
    ),
    (
        [make_registration("/a"), make_registration("/b"), make_registration("/p", kind=PARAM)],
        [make_registration("/b")],
        [make_registration("/a")],
    ),
    (
        [make_registration("/a"), make_registration("/p", "/m", PARAM)],
        [],
        [make_registration("/a")],
    ),
]


@pytest.mark.parametrize(("ours", "masters", "lost"), LOST)
def test_what_the_master_has_lost(
    ours: list[Registration], masters: list[Registration], lost: list[Registration]
) -> None:
    state: dict[str, list[Registration]] = {}
    for registration in masters:
        state.setdefault(registration.caller_id, []).append(registration)
    assert decisions.lost_registrations(ours, state, before=10.0) == lost
