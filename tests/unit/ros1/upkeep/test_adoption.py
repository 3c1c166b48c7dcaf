"""Nodes that registered around the proxy: who they are, where, and what is taken back."""

from collections.abc import Mapping, Sequence

import pytest

from rosproxy.admin.requests import Arrival
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import Graph
from rosproxy.ros1.upkeep.adoption import policy
from rosproxy.ros1.upkeep.adoption.policy import Stray
from tests.unit.builders import add_node, make_addressing

PUB, SUB, SRV, PARAM = Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE, Kind.PARAM
C1 = Arrival("10.0.0.5", frozenset({"c1", "3f2a91c0b7de"}))
C2 = Arrival("10.0.0.6", frozenset({"c2", "twin"}))
C3 = Arrival("10.0.0.7", frozenset({"c3", "twin"}))


def held(name: str, caller_id: str = "/n", kind: Kind = PUB, since: float = 0.0) -> Registration:
    return Registration(kind, name, caller_id, since=since)


def places(*found: str) -> tuple[HostPort, ...]:
    return tuple(HostPort(host, int(port)) for host, port in (f.split(":") for f in found))


FOUND = [
    # the URI at the master, where the node may be
    ("http://10.0.0.5:40001/", places("10.0.0.5:40001")),
    ("http://c1:40001/", places("10.0.0.5:40001")),
    ("http://C1:40001", places("10.0.0.5:40001")),
    ("http://3f2a91c0b7de:40001/", places("10.0.0.5:40001")),
    ("http://twin:40001/", places("10.0.0.6:40001", "10.0.0.7:40001")),
    ("http://robot:40001/", ()),
    ("http://localhost:40001/", ()),
    ("http://10.0.0.99:40001/", ()),
    ("http://c1.local:40001/", ()),
    ("http://robot-host:45003/10.0.0.5:40001/", ()),  # the proxy's own
    ("http://robot-host:45003/", ()),
    ("nonsense", ()),
    ("", ()),
]


@pytest.mark.parametrize(("uri", "expected"), FOUND)
def test_whose_uri_may_mean_a_container(uri: str, expected: tuple[HostPort, ...]) -> None:
    graph = Graph({"/n": [held("/a")]}, {"/n": uri})
    found = policy.find(graph, [C1, C2, C3], make_addressing())
    assert found == ([Stray("/n", uri, expected, (held("/a"),))] if expected else [])


def test_a_container_named_as_the_advertised_host_is_no_way_to_the_proxys_own_nodes() -> None:
    uris = {"/ours": "http://robot-host:45003/10.0.0.5:40001/", "/its": "http://robot-host:50000/"}
    graph = Graph({name: [held("/a", name)] for name in uris}, uris)
    arrival = Arrival("10.0.0.5", frozenset({"robot-host"}))
    found = policy.find(graph, [arrival], make_addressing())
    assert [stray.caller_id for stray in found] == ["/its"]


def test_a_container_on_two_networks_is_looked_for_on_both() -> None:
    graph = Graph({"/n": [held("/a")]}, {"/n": "http://c1:40001/"})
    both = [C1, Arrival("10.1.0.5", C1.names), C1]
    (stray,) = policy.find(graph, both, make_addressing())
    assert stray.places == places("10.0.0.5:40001", "10.1.0.5:40001")


def stray(caller_id: str, topics: Sequence[str], *where: str, kind: Kind = PUB) -> Stray:
    registrations = tuple(held(topic, caller_id, kind) for topic in topics)
    return Stray(caller_id, "http://twin:40001/", places(*where), registrations)


SIX, SEVEN = "10.0.0.6:40001", "10.0.0.7:40001"
SETTLED = [
    # what a node has at the master, what the nodes at its places say, where it is
    (["/a"], {SIX: ["/a"]}, SIX),
    (["/a", "/rosout"], {SIX: ["/a", "/rosout"]}, SIX),
    (["/rosout"], {SIX: ["/rosout"]}, SIX),
    (["/a", "/rosout"], {SIX: ["/rosout"]}, None),  # another node
    (["/a"], {SIX: []}, None),
    ([], {SIX: ["/a"]}, None),  # nothing bears it out
    (["/a"], {}, None),  # nobody answers
    (["/a"], {SIX: ["/b"], SEVEN: ["/a"]}, SEVEN),
    (["/a", "/b"], {SIX: ["/a"], SEVEN: ["/a", "/b"]}, SEVEN),
    (["/a", "/b"], {SIX: ["/a", "/b", "/c"], SEVEN: ["/a"]}, SIX),
    (["/a"], {SIX: ["/a"], SEVEN: ["/a"]}, None),  # either
    (["/rosout"], {SIX: ["/rosout"], SEVEN: ["/rosout"]}, None),
]


@pytest.mark.parametrize(("topics", "said", "expected"), SETTLED)
def test_where_a_stray_is(
    topics: list[str], said: Mapping[str, list[str]], expected: str | None
) -> None:
    one = stray("/n", topics, SIX, SEVEN)
    answers = {places(where)[0]: topics for where, topics in said.items()}
    found, doubts = policy.settle([one], answers)
    if expected is None:
        assert found == {}
        assert list(doubts) == ["/n"]
        assert "http://twin:40001/" in doubts["/n"]
    else:
        assert (found, doubts) == ({places(expected)[0]: [one]}, {})


def test_a_service_is_no_topic() -> None:
    one = stray("/n", ["/add"], SIX, kind=SRV)
    assert policy.settle([one], {places(SIX)[0]: ["/add"]})[0] == {}


def test_doubts_tell_what_was_found() -> None:
    one = stray("/n", ["/a"], SIX, SEVEN)
    six, seven = places(SIX, SEVEN)
    assert "no node answers at 10.0.0.6:40001, 10.0.0.7:40001" in policy.settle([one], {})[1]["/n"]
    assert "is another" in policy.settle([one], {six: ["/b"]})[1]["/n"]
    either = policy.settle([one], {six: ["/a"], seven: ["/a"]})[1]["/n"]
    assert "could be at 10.0.0.6:40001 and 10.0.0.7:40001; left alone" in either


def test_two_containers_with_the_same_names_and_ports() -> None:
    first, second = stray("/n1", ["/a"], SIX, SEVEN), stray("/n2", ["/b"], SIX, SEVEN)
    six, seven = places(SIX, SEVEN)
    found, doubts = policy.settle([first, second], {six: ["/b", "/rosout"], seven: ["/a"]})
    assert found == {seven: [first], six: [second]}
    assert not doubts


def test_two_names_of_one_process() -> None:
    both = [stray("/manager", ["/a"], SIX), stray("/nodelet", ["/b"], SIX)]
    (six,) = places(SIX)
    assert policy.settle(both, {six: ["/a", "/b"]}) == ({six: both}, {})


def test_by_what_uris_an_endpoint_may_be_known() -> None:
    endpoint = add_node(make_addressing(), "http://c1:40001/", "10.0.0.5", True)
    endpoint.former_uris.add("http://robot-host:45000/c1:40001/10.0.0.4/")
    assert policy.known_as(endpoint, "http://c1:40001/")
    assert policy.known_as(endpoint, "http://robot-host:45000/c1:40001/10.0.0.4/")
    assert not policy.known_as(endpoint, "http://robot-host:45000/c1:40001/10.0.0.5/")
    assert not policy.known_as(endpoint, "http://c1:40002/")


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_loopback_address_is_everybodys_own(host: str) -> None:
    endpoint = add_node(make_addressing(), f"http://{host}:40001/", "10.0.0.5", False)
    assert not policy.known_as(endpoint, endpoint.uri)


PARAMETERS = ["/n/rate", "/n/gain/p", "/robot/name", "/nn/x", "/use_sim_time"]


def test_the_parameters_that_a_node_is_most_likely_subscribed_to() -> None:
    assert policy.own_keys("/n", PARAMETERS) == [
        "/rosout_disable_topics_generation",
        "/n/diagnostic_period",
        "/n/rate",
        "/n",
        "/n/gain/p",
        "/n/gain",
    ]


def test_all_other_parameters_and_namespaces() -> None:
    others = policy.other_keys("/n", PARAMETERS)
    assert set(others) == {"/", "/robot/name", "/robot", "/nn/x", "/nn", "/use_sim_time"}
    assert len(others) == 6


def test_what_is_taken_back_and_in_which_order() -> None:
    uris = {"/n": "http://c1:40001/", "/m": "http://c1:40001"}
    known = {
        "/n": [held("/a"), held("/add", kind=SRV), held("/b", kind=SUB)],
        "/m": [held("/c", "/m", SUB), held("/lost", "/m", SRV)],
        "/other": [held("/a", "/other")],
    }
    services = {"/add": "rosrpc://c1:50001", "/lost": None}
    assert policy.take_back(uris, known, services) == [
        ("unregisterSubscriber", ["/n", "/b", "http://c1:40001/"]),
        ("unregisterSubscriber", ["/m", "/c", "http://c1:40001"]),
        ("unregisterPublisher", ["/n", "/a", "http://c1:40001/"]),
        ("unregisterService", ["/n", "/add", "rosrpc://c1:50001"]),
    ]


def test_what_is_put_back() -> None:
    known = [Registration(PUB, "/a", "/n", "std_msgs/String"), held("/add", kind=SRV)]
    services = {"/add": "rosrpc://c1:50001", "/lost": None}
    assert policy.put_back("http://c1:40001/", [*known, held("/lost", kind=SRV)], services) == [
        ("registerPublisher", ["/n", "/a", "std_msgs/String", "http://c1:40001/"]),
        ("registerService", ["/n", "/add", "rosrpc://c1:50001", "http://c1:40001/"]),
    ]


def test_parameters_are_released_one_after_the_other() -> None:
    ask = ("lookupNode", ["/rosproxy", "/n"])
    assert policy.release("/n", "http://c1:1/", ["/x", "/y"], "/rosproxy") == [
        ask,
        ("unsubscribeParam", ["/n", "http://c1:1/", "/x"]),
        ask,
        ("unsubscribeParam", ["/n", "http://c1:1/", "/y"]),
        ask,
    ]


RELEASED = [
    # the answers to lookupNode, the parameters that were subscribed to at most
    ([None, None, None], []),
    (["U", None, None], ["/x"]),
    (["U", "U", None], ["/x", "/y"]),
    (["U", "U", "U"], None),
    (["other", "other", "other"], None),  # somebody else has the name by now
]


@pytest.mark.parametrize(("answers", "expected"), RELEASED)
def test_what_a_node_was_subscribed_to(
    answers: list[str | None], expected: list[str] | None
) -> None:
    values = [answers[0], 1, answers[1], 1, answers[2]]
    assert policy.released(["/x", "/y"], values) == expected


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
        addressing.registry.register(endpoint, held(name, kind=kind, since=since))
    gone = policy.vanished(endpoint, ["/kept"], {"/kept": "type"}, before=5.0)
    assert [(one.kind, one.name) for one in gone] == [(PUB, "/dropped"), (SUB, "/dropped")]


REASONS = [
    ("/master", "[/n] Reason: new node registered with same name", "/n"),
    ("/master", "[/ns/n] Reason: new node registered with same name", "/ns/n"),
    ("/rosnode", "[/n] Reason: new node registered with same name", None),
    ("/rosnode", "user request", None),
    ("/master", "user request", None),
    ("/master", "[n] Reason: new node registered with same name", None),
    ("/master", "[/n] Reason: something else", None),
    ("/master", "", None),
]


@pytest.mark.parametrize(("caller_id", "reason", "name"), REASONS)
def test_whose_uri_has_changed(caller_id: str, reason: str, name: str | None) -> None:
    assert policy.accused(caller_id, reason) == name


LITERAL, ADVERTISED = "http://c1:40001/", "http://robot-host:45000/c1:40001/10.0.0.5/"
JUDGED = [
    # registered around the proxy before? what the master has, the verdict
    (False, ADVERTISED, policy.Verdict.SETTLED),
    (True, ADVERTISED, policy.Verdict.SETTLED),
    (False, LITERAL, policy.Verdict.ASTRAY),
    (True, LITERAL, policy.Verdict.ASTRAY),
    (False, None, policy.Verdict.GUILTY),
    (True, None, policy.Verdict.ASTRAY),
    (False, "http://laptop:1/", policy.Verdict.GUILTY),
    (True, "http://laptop:1/", policy.Verdict.GUILTY),
    (True, "http://robot-host:45001/c2:40001/10.0.0.6/", policy.Verdict.GUILTY),
]


@pytest.mark.parametrize(("direct", "uri", "verdict"), JUDGED)
def test_who_is_to_be_shut_down(direct: bool, uri: str | None, verdict: policy.Verdict) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing, LITERAL, "10.0.0.5", True)
    assert addressing.advertised_uri(endpoint) == ADVERTISED
    if direct:
        endpoint.former_uris.add(LITERAL)
    assert endpoint.direct is direct
    assert policy.judge(endpoint, uri, ADVERTISED) is verdict
