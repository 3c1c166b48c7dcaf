"""Recovery from the master's registrations: claims, confirmation, lost registrations."""

from collections.abc import Collection, Sequence
from ipaddress import ip_network

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry import remembered_leases
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import Graph, NodeInfo
from rosproxy.ros1.upkeep.decisions import recovery_claims
from rosproxy.ros1.upkeep.decisions.recovery_claims import Claim
from rosproxy.shared.addresses import HostPort, is_inside
from tests.unit.builders import add_node, add_registration, make_addressing

PUB = Kind.PUBLISHER
SRV = Kind.SERVICE


def make_registration(name: str, caller_id: str = "/n") -> Registration:
    return Registration(PUB, name, caller_id)


def graph(uris: dict[str, str]) -> Graph:
    return Graph({node: [make_registration("/a", node)] for node in uris}, uris)


MEMORY = remembered_leases.read_leases(
    "45003 /10.0.0.5:40001/\n"
    "45004 /c5:40001/10.0.0.5/ 41234 41235\n"
    "45005 /127.0.0.1:40001/10.0.0.5/\n"
    "45009 /[fd00::5]:40001/\n",
    make_addressing().ports,
)
URIS = [
    # URI at the master, the claim: port, own host and port of the node, address to ask
    ("http://robot-host:45003/", (45003, "10.0.0.5:40001", "10.0.0.5")),
    ("http://robot-host:45003", (45003, "10.0.0.5:40001", "10.0.0.5")),
    ("http://robot-host:45003/RPC2", (45003, "10.0.0.5:40001", "10.0.0.5")),
    ("http://robot-host:45004/", (45004, "c5:40001", "10.0.0.5")),
    ("http://robot-host:45005/", (45005, "127.0.0.1:40001", "10.0.0.5")),
    ("http://robot-host:45009/", (45009, "[fd00::5]:40001", "fd00::5")),
    # of a former version
    ("http://robot-host:45003/10.0.0.7:40001/", (45003, "10.0.0.7:40001", "10.0.0.7")),
    ("http://robot-host:45001/c5:40001/10.0.0.5/", (45001, "c5:40001", "10.0.0.5")),
    ("http://robot-host:45003/c5:40001/", (45003, "c5:40001", "c5")),  # refused by address
    ("http://robot-host:45010/10.0.0.5:40001/", None),
    ("http://robot-host:44999/10.0.0.5:40001/", None),
    ("http://another-host:45003/", None),
    ("http://laptop:33445/", None),
    ("rosrpc://robot-host:45003", None),
    ("nonsense", None),
    ("", None),
]


@pytest.mark.parametrize(("uri", "expected"), URIS)
def test_claims_are_read_from_advertised_uris_and_what_is_remembered(
    uri: str, expected: tuple[int, str, str] | None
) -> None:
    found_claims, forgotten = recovery_claims.find_claims(
        graph({"/n": uri}), make_addressing(), MEMORY
    )
    claims = [(claim.port, claim.uri, str(claim.slave), claim.topics) for claim in found_claims]
    assert forgotten == {}
    if expected is None:
        assert claims == []
    else:
        port, node, address = expected
        assert claims == [(port, f"http://{node}/", str(HostPort(address, 40001)), {"/a"})]


def test_the_ports_of_services_are_remembered() -> None:
    uris = {"/n": "http://robot-host:45004/", "/m": "http://robot-host:45003/"}
    claims, _ = recovery_claims.find_claims(graph(uris), make_addressing(), MEMORY)
    assert [claim.service_ports for claim in claims] == [(41234, 41235), ()]


def test_of_some_nothing_is_remembered() -> None:
    uri = "http://robot-host:45008/"
    claims, forgotten = recovery_claims.find_claims(
        graph({"/n": uri, "/m": uri}), make_addressing(), MEMORY
    )
    assert claims == []
    assert {registration.caller_id for registration in forgotten[uri]} == {"/n", "/m"}


def test_claims_in_an_advertised_range_with_an_offset_are_for_the_port_that_listens() -> None:
    addressing = make_addressing(advertise=(30000, 30009))
    uris = {"/n": "http://robot-host:30003/", "/m": "http://robot-host:45003/"}
    kept = remembered_leases.read_leases("30003 /10.0.0.5:1/\n", addressing.ports)
    assert [
        claim.port for claim in recovery_claims.find_claims(graph(uris), addressing, kept)[0]
    ] == [45003]


def test_names_that_share_a_uri_are_one_claim() -> None:
    uri = "http://robot-host:45003/"
    (claim,), _ = recovery_claims.find_claims(
        graph({"/n": uri, "/m": uri}), make_addressing(), MEMORY
    )
    assert {registration.caller_id for registration in claim.registrations} == {"/n", "/m"}


def test_a_node_without_registrations_or_without_a_uri() -> None:
    addressing = make_addressing()
    uri = "http://robot-host:45003/"
    (claim,), _ = recovery_claims.find_claims(Graph({}, {"/n": uri}), addressing, MEMORY)
    assert claim.registrations == []
    assert recovery_claims.find_claims(
        Graph({"/n": [make_registration("/a")]}, {}), addressing, MEMORY
    ) == (
        [],
        {},
    )


def claim(
    port: int,
    address: str,
    topics: Sequence[str] = (),
    said: Collection[str] | None = None,
    slave: int = 40001,
) -> Claim:
    named = None if said is None else NodeInfo(7, dict.fromkeys(said, "t"), {})
    node = HostPort(address, slave)
    return Claim(port, node, node, list(map(make_registration, topics)), named)


A = "10.0.0.5"
B = "10.0.0.6"
SETTLED = [
    # claims: port, address, topics at the master, topics from the node; kept claims
    ([], []),
    ([claim(1, A, ["/a"]), claim(2, B, ["/a"])], [(1, A), (2, B)]),
    # one port, two nodes: a left-over, or a forgery of many topics that no node confirms
    ([claim(1, A, ["/a"], ["/a"]), claim(1, B, ["/a", "/b"])], [(1, A)]),
    ([claim(1, A, ["/a", "/b", "/c"]), claim(1, B, ["/b"], ["/b"])], [(1, B)]),
    ([claim(1, A, ["/a"], ["/x"]), claim(1, B, ["/b"], ["/b"])], [(1, B)]),
    # a forgery that leads to a real node, but claims too many topics
    ([claim(1, A, ["/a"], ["/a"]), claim(1, B, ["/c", "/x", "/y"], ["/c"])], [(1, A)]),
    # a node with two ports: no more topics than the node has
    ([claim(1, A, ["/a"], ["/a", "/b"]), claim(2, A, ["/a", "/b"], ["/a", "/b"])], [(2, A)]),
    # no answer: the claim with more registrations
    ([claim(1, A, ["/a"]), claim(1, B, ["/a", "/b"])], [(1, B)]),
    # an answer that bears out nothing is still better than none
    ([claim(1, A, ["/a"], []), claim(1, B, ["/a", "/b"])], [(1, A)]),
]


@pytest.mark.parametrize(("claims", "kept"), SETTLED)
def test_one_claim_is_kept_for_each_port_and_each_node(
    claims: list[Claim], kept: list[tuple[int, str]]
) -> None:
    assert (
        sorted((claim.port, claim.slave.host) for claim in recovery_claims.choose_claims(claims))
        == kept
    )


@pytest.mark.parametrize(
    ("claims", "ports"),
    [
        ([], []),
        ([claim(1, A), claim(2, B)], []),
        ([claim(1, A), claim(2, A, slave=40002)], []),
        ([claim(1, A), claim(1, B), claim(2, A, slave=40002)], [1, 1]),
        ([claim(1, A), claim(2, A), claim(3, B)], [1, 2]),
    ],
)
def test_claims_to_the_same_port_or_node_are_contested(
    claims: list[Claim], ports: list[int]
) -> None:
    assert [claim.port for claim in recovery_claims.contested_claims(claims)] == ports


TOPICS = st.lists(st.sampled_from(["/a", "/b", "/c"]), unique=True)
ADDRESSES = st.sampled_from(["10.0.0.5", "10.0.0.6", "10.0.0.7"])
CLAIMS = st.builds(claim, st.integers(1, 4), ADDRESSES, TOPICS, st.none() | TOPICS)


@given(st.lists(CLAIMS, max_size=6))
def test_settling_leaves_no_contest_and_forgets_nobody_without_one(claims: list[Claim]) -> None:
    settled = recovery_claims.choose_claims(claims)
    assert recovery_claims.contested_claims(settled) == []
    rivals = recovery_claims.contested_claims(claims)
    assert all(claim in settled for claim in claims if claim not in rivals)


@pytest.mark.parametrize(
    ("address", "allowed"),
    [
        ("10.0.0.5", True),
        ("fd00::5", True),
        ("10.0.1.5", False),
        ("127.0.0.1", False),
        ("::1", False),
        ("0.0.0.0", False),
        ("169.254.169.254", False),
        ("8.8.8.8", False),
        ("c5", False),
        ("localhost", False),
        ("", False),
    ],
)
def test_only_addresses_in_an_inside_network_are_recovered(address: str, allowed: bool) -> None:
    networks = [ip_network("10.0.0.0/24"), ip_network("fd00::/64")]
    assert is_inside(address, networks) is allowed
    assert not is_inside(address, [])


@pytest.mark.parametrize(
    ("registered", "published", "subscribed", "confirmed"),
    [
        (["/rosout", "/chatter"], ["/rosout", "/chatter"], [], True),
        (["/rosout", "/chatter", "/gone"], ["/rosout", "/chatter"], [], True),
        (["/rosout", "/chatter"], ["/rosout", "/other"], [], False),  # every node has /rosout
        (["/rosout", "/chatter"], [], [], False),
        (["/rosout", "/chatter"], ["/rosout"], ["/chatter"], True),
        (["/rosout"], ["/rosout", "/other"], [], True),
        (["/rosout"], [], [], False),
        ([], ["/rosout"], [], None),  # only a service: a node cannot be asked for services
        # no answer about subscriptions says nothing
        (["/rosout", "/chatter"], ["/rosout"], None, None),
        (["/rosout", "/chatter"], ["/rosout", "/chatter"], None, True),
        (["/rosout", "/chatter"], None, ["/chatter"], True),
        (["/rosout", "/chatter"], None, None, None),
    ],
)
def test_a_node_bears_out_what_the_master_says_of_it(
    registered: list[str],
    published: list[str] | None,
    subscribed: list[str] | None,
    confirmed: bool | None,
) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    for name in registered:
        add_registration(addressing, endpoint, PUB, name)
    add_registration(addressing, endpoint, SRV, "/chatter")
    told = [
        None if names is None else dict.fromkeys(names, "t") for names in (published, subscribed)
    ]
    said = NodeInfo(7, told[0], told[1])
    assert recovery_claims.confirmed_by(endpoint.registrations.values(), said) is confirmed


def test_names_that_are_not_the_node_s_are_told_apart() -> None:
    own = make_registration("/a", "/own")
    former = make_registration("/b", "/former")
    service = Registration(SRV, "/s", "/former")
    everything = [
        own,
        former,
        service,
        Registration(SRV, "/t", "/untold"),
        make_registration("/c", "/own"),
    ]
    assert recovery_claims.unconfirmed_registrations(everything, NodeInfo(7, {"/a": "t"}, {})) == [
        former,
        service,
    ]
    assert (
        recovery_claims.unconfirmed_registrations(everything, NodeInfo(7, {"/a": "t"}, None)) == []
    )


def test_a_node_is_asked_for_a_few_of_its_topics_and_services() -> None:
    topics = [make_registration(name) for name in ("/rosout", "/d", "/c", "/b", "/a")]
    services = [Registration(SRV, name, "/n") for name in ("/y", "/x")]
    heard = [Registration(Kind.SUBSCRIBER, "/heard", "/n")]
    asked = recovery_claims.topics_and_services_to_ask([*topics, *services, *heard])
    assert asked == (["/a", "/b", "/c"], [*reversed(services)])
    assert recovery_claims.topics_and_services_to_ask(topics[:2])[0] == ["/d", "/rosout"]
