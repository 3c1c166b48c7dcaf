"""Nodes that registered at the real master directly: identity, location, reason for shutdown."""

from collections.abc import Mapping, Sequence

import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import Graph, NodeInfo
from rosproxy.ros1.upkeep.decisions import adoption as policy
from rosproxy.ros1.upkeep.decisions.adoption import DirectNode
from rosproxy.ros1.upkeep.decisions.recovery_claims import confirmed_by
from rosproxy.ros1.upkeep.decisions.registration import is_known_as
from rosproxy.shared.addresses import HostPort
from tests.unit.builders import add_node, make_addressing

PUB = Kind.PUBLISHER
SUB = Kind.SUBSCRIBER
SRV = Kind.SERVICE
C1 = ("10.0.0.5", {"c1", "3f2a91c0b7de"})
C2 = ("10.0.0.6", {"c2", "twin"})
C3 = ("10.0.0.7", {"c3", "twin"})


def make_registration(
    name: str, caller_id: str = "/n", kind: Kind = PUB, since: float = 0.0
) -> Registration:
    return Registration(kind, name, caller_id, since=since)


def places(*addresses: str) -> tuple[HostPort, ...]:
    return tuple(HostPort(host, int(port)) for host, port in (f.split(":") for f in addresses))


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
    graph = Graph({"/n": [make_registration("/a")]}, {"/n": uri})
    nodes = policy.find_direct(graph, [C1, C2, C3], make_addressing())
    assert nodes == (
        [DirectNode("/n", uri, expected, (make_registration("/a"),))] if expected else []
    )


def test_a_container_named_as_the_advertised_host_is_no_way_to_the_proxys_own_nodes() -> None:
    uris = {"/ours": "http://robot-host:45003/10.0.0.5:40001/", "/its": "http://robot-host:50000/"}
    graph = Graph({name: [make_registration("/a", name)] for name in uris}, uris)
    nodes = policy.find_direct(graph, [("10.0.0.5", {"robot-host"})], make_addressing())
    assert [node.caller_id for node in nodes] == ["/its"]


def test_a_container_on_two_networks_is_looked_for_on_both() -> None:
    graph = Graph({"/n": [make_registration("/a")]}, {"/n": "http://c1:40001/"})
    both = [C1, ("10.1.0.5", C1[1]), C1]
    (node,) = policy.find_direct(graph, both, make_addressing())
    assert node.slaves == places("10.0.0.5:40001", "10.1.0.5:40001")


def direct(caller_id: str, topics: Sequence[str], *addresses: str, kind: Kind = PUB) -> DirectNode:
    registrations = tuple(make_registration(topic, caller_id, kind) for topic in topics)
    return DirectNode(caller_id, "http://twin:40001/", places(*addresses), registrations)


SIX = "10.0.0.6:40001"
SEVEN = "10.0.0.7:40001"
LOCATED = [
    # topics at the master, topics of the node at each place, location
    (["/a"], {SIX: ["/a"]}, SIX),
    (["/a", "/rosout"], {SIX: ["/a", "/rosout"]}, SIX),
    (["/rosout"], {SIX: ["/rosout"]}, SIX),
    (["/a", "/rosout"], {SIX: ["/rosout"]}, None),  # another node
    (["/a"], {SIX: []}, None),
    ([], {SIX: ["/a"]}, None),  # no confirmation
    (["/a"], {}, None),  # no answer
    (["/a"], {SIX: ["/b"], SEVEN: ["/a"]}, SEVEN),
    (["/a", "/b"], {SIX: ["/a"], SEVEN: ["/a", "/b"]}, SEVEN),
    (["/a", "/b"], {SIX: ["/a", "/b", "/c"], SEVEN: ["/a"]}, SIX),
    (["/a"], {SIX: ["/a"], SEVEN: ["/a"]}, None),  # either
    (["/rosout"], {SIX: ["/rosout"], SEVEN: ["/rosout"]}, None),
]


Located = tuple[dict[HostPort, list[DirectNode]], dict[str, str]]


def locate(nodes: Sequence[DirectNode], said: Mapping[str, Sequence[str]]) -> Located:
    """The locations of nodes, if the nodes at these places publish these topics."""
    infos = {
        places(address)[0]: NodeInfo(7, dict.fromkeys(topics, "t"), {})
        for address, topics in said.items()
    }
    sure = {
        (node.caller_id, place)
        for node in nodes
        for place in infos
        if confirmed_by(node.registrations, infos[place])
    }
    return policy.locate(nodes, infos, sure)


def test_who_tells_no_topics_is_where_it_has_answered_for_them() -> None:
    node = direct("/n", ["/a"], SIX, SEVEN)
    six, seven = places(SIX, SEVEN)
    silent = {place: NodeInfo(7, None, None) for place in (six, seven)}
    assert policy.locate([node], silent, {("/n", seven)}) == ({seven: [node]}, {})
    assert list(policy.locate([node], silent)[1]) == ["/n"]


@pytest.mark.parametrize(("topics", "said", "expected"), LOCATED)
def test_where_a_node_is(
    topics: list[str], said: Mapping[str, list[str]], expected: str | None
) -> None:
    node = direct("/n", topics, SIX, SEVEN)
    located, doubts = locate([node], said)
    if expected is None:
        assert located == {}
        assert list(doubts) == ["/n"]
        assert "http://twin:40001/" in doubts["/n"]
    else:
        assert (located, doubts) == ({places(expected)[0]: [node]}, {})


def test_a_service_is_no_topic() -> None:
    node = direct("/n", ["/add"], SIX, kind=SRV)
    assert locate([node], {SIX: ["/add"]})[0] == {}


def test_doubts_tell_what_was_found() -> None:
    node = direct("/n", ["/a"], SIX, SEVEN)
    assert "no node answers at 10.0.0.6:40001, 10.0.0.7:40001" in locate([node], {})[1]["/n"]
    assert "does not show that it made" in locate([node], {SIX: ["/b"]})[1]["/n"]
    either = locate([node], {SIX: ["/a"], SEVEN: ["/a"]})[1]["/n"]
    assert "not adopted: the node may be at 10.0.0.6:40001 or 10.0.0.7:40001" in either


def test_two_containers_with_the_same_names_and_ports() -> None:
    first = direct("/n1", ["/a"], SIX, SEVEN)
    second = direct("/n2", ["/b"], SIX, SEVEN)
    six, seven = places(SIX, SEVEN)
    located, doubts = locate([first, second], {SIX: ["/b", "/rosout"], SEVEN: ["/a"]})
    assert located == {seven: [first], six: [second]}
    assert not doubts


def test_two_names_of_one_process() -> None:
    both = [direct("/manager", ["/a"], SIX), direct("/nodelet", ["/b"], SIX)]
    (six,) = places(SIX)
    assert locate(both, {SIX: ["/a", "/b"]}) == ({six: both}, {})


def test_by_what_uris_an_endpoint_may_be_known() -> None:
    endpoint = add_node(make_addressing(), "http://c1:40001/", "10.0.0.5", True)
    endpoint.former_uris.add("http://robot-host:45000/c1:40001/10.0.0.4/")
    assert is_known_as(endpoint, "http://c1:40001/")
    assert is_known_as(endpoint, "http://robot-host:45000/c1:40001/10.0.0.4/")
    assert not is_known_as(endpoint, "http://robot-host:45000/c1:40001/10.0.0.5/")
    assert not is_known_as(endpoint, "http://c1:40002/")


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_loopback_address_is_everybodys_own(host: str) -> None:
    endpoint = add_node(make_addressing(), f"http://{host}:40001/", "10.0.0.5", False)
    assert not is_known_as(endpoint, endpoint.uri)


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
    assert policy.name_registered_again(caller_id, reason) == name


LITERAL = "http://c1:40001/"
ADVERTISED = "http://robot-host:45000/"
NAMES = [
    # adopted before? URI at the master, whether the name is unique
    (False, ADVERTISED, True),
    (True, ADVERTISED, True),
    (False, LITERAL, True),
    (True, LITERAL, True),
    (False, None, False),
    (True, None, True),
    (False, "http://laptop:1/", False),
    (True, "http://laptop:1/", False),
    (True, "http://robot-host:45001/c2:40001/10.0.0.6/", False),
]


@pytest.mark.parametrize(("direct", "uri", "its_own"), NAMES)
def test_who_is_to_be_shut_down(direct: bool, uri: str | None, its_own: bool) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing, LITERAL, "10.0.0.5", True)
    assert addressing.advertised_uri(endpoint) == ADVERTISED
    if direct:
        endpoint.former_uris.add(LITERAL)
    assert endpoint.has_registered_directly is direct
    assert policy.has_name_still(endpoint, uri, ADVERTISED) is its_own
