"""Zenoh peers of a router outside that do not reach each other."""

from rosproxy.zenoh.peers_apart import MOST_PEERS_APART, PeersApart, peers_apart
from rosproxy.zenoh.protocol.report import RouterReport, RouterSession, SessionConnection

HUB = "03"
ROBOT = "192.0.2.7"
HOST = "192.0.2.10"
LAPTOP = "192.0.2.20"


def session(zid: str, mode: str, remote: str, local: str = ROBOT) -> RouterSession:
    ends = SessionConnection(f"tcp/{local}:7447", f"tcp/{remote}:50000")
    return RouterSession(zid, mode, (ends,))


ON_ROBOT = session("a1", "peer", "127.0.0.1", "127.0.0.1")
ON_ROBOT_BY_LAN = session("a2", "peer", ROBOT)
THE_HUB = session(HUB, "router", HOST)
IN_CONTAINER = session("b1", "peer", HOST)
ON_LAPTOP = session("c1", "peer", LAPTOP)


def apart(
    *sessions: RouterSession, peers: tuple[RouterReport, ...] | None = None
) -> tuple[PeersApart, ...]:
    """The peers apart. ``peers`` are the answers of peers; None: each answers without a session."""
    if peers is None:
        peers = tuple(RouterReport(s.peer) for s in sessions if s.whatami == "peer")
    return peers_apart(["04"], HUB, (RouterReport("04", sessions), *peers))


def test_a_peer_beside_those_on_the_machine_of_the_router_is_apart() -> None:
    found = apart(ON_ROBOT, ON_ROBOT_BY_LAN, THE_HUB, IN_CONTAINER)
    assert found == (PeersApart("04", HOST, ("b1",), is_own_address=True),)


def test_peers_at_two_other_addresses_are_apart() -> None:
    found = apart(THE_HUB, IN_CONTAINER, ON_LAPTOP)
    assert [(peers.address, peers.is_own_address) for peers in found] == [
        (HOST, True),
        (LAPTOP, False),
    ]


def test_peers_at_one_address_are_not_apart() -> None:
    assert not apart(ON_ROBOT, ON_ROBOT_BY_LAN, THE_HUB)
    assert not apart(THE_HUB, IN_CONTAINER, session("b2", "peer", HOST))


def test_a_client_is_not_apart() -> None:
    assert not apart(ON_ROBOT, THE_HUB, session("b1", "client", HOST))


def test_peers_with_a_session_with_all_others_are_not_apart() -> None:
    linked = RouterReport("c1", (session("a1", "peer", ROBOT, LAPTOP),))
    assert not apart(ON_ROBOT, ON_LAPTOP, peers=(linked,))
    (found,) = apart(ON_ROBOT, ON_ROBOT_BY_LAN, ON_LAPTOP, peers=(linked,))
    assert found.address == LAPTOP


def test_peers_without_an_answer_are_not_known_to_be_apart() -> None:
    """A program without an admin space, or a peer beyond the bound of asked peers."""
    assert not apart(ON_ROBOT, THE_HUB, IN_CONTAINER, ON_LAPTOP, peers=())
    answer = RouterReport("c1", (session("b1", "peer", HOST, LAPTOP),))
    (found,) = apart(ON_ROBOT, THE_HUB, IN_CONTAINER, ON_LAPTOP, peers=(answer,))
    assert found.address == LAPTOP
    silent = RouterReport("c1")
    assert [p.address for p in apart(IN_CONTAINER, ON_LAPTOP, peers=(silent,))] == [HOST, LAPTOP]


def test_a_node_that_finds_its_own_robot_by_name_is_on_the_machine_of_the_router() -> None:
    """Debian gives the own host name the address 127.0.1.1."""
    by_name = session("a3", "peer", "127.0.0.1", "127.0.1.1")
    assert not apart(ON_ROBOT, by_name, ON_ROBOT_BY_LAN, THE_HUB)


def test_a_router_without_an_answer_tells_nothing() -> None:
    assert peers_apart(["05"], HUB, (RouterReport("04", (ON_ROBOT, ON_LAPTOP)),)) == ()


def test_the_number_of_addresses_is_bounded() -> None:
    crowd = [session(f"d{number}", "peer", f"10.0.{number}.1") for number in range(200)]
    assert len(apart(*crowd)) == MOST_PEERS_APART
