"""Networks without multicast, and a proxy with another address than its former process."""

import pytest

from rosproxy.ros2.discovery.announcements.to_inside import DISPOSE_MESSAGE_INTERVAL_S
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.discovery.rediscovery import LAN_RELAY_TIMEOUT_S, SEPARATION_S
from rosproxy.ros2.domain_settings import MOST_PER_ADDRESS
from rosproxy.ros2.protocol.rtps import source_prefix
from rosproxy.ros2.rewriting.discovery import read_discovery
from rosproxy.ros2.sources.rates import BURST
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.requests import BodyError, ContainerUpdate, read_body
from rosproxy.shared.ports import PortMap, PortRange
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    LAN_RELAY,
    NEAR,
    NOW,
    OTHER,
    RANGE,
    ROBOT,
    A,
    B,
    carried,
    dispose_message,
    make_domain,
    meet,
    sedp,
    settle,
    spdp,
    to,
)

C = b"\x01\x0f" + bytes(9) + b"\x07"
PORTS = (RANGE.listen.last, RANGE.listen.last - 1)


def by(prefix: bytes, datagrams: list[bytes]) -> list[bytes]:
    return [datagram for datagram in datagrams if source_prefix(datagram) == prefix]


def is_dispose_message(datagram: bytes) -> bool:
    told = read_discovery(datagram).of_participant
    return told is not None and told.ended


def test_those_inside_are_introduced_to_each_other_as_they_are() -> None:
    domain = make_domain()
    meet(domain, A, INSIDE)

    sent = domain.heard_inside(spdp(B, OTHER), OTHER, NOW)

    assert by(B, to(sent, INSIDE)) == [spdp(B, OTHER)]
    again = domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    assert by(A, to(again, OTHER)) == [spdp(A, INSIDE)]


def test_processes_of_one_pod_are_introduced_to_each_other() -> None:
    """Processes of a pod share an address, and Fast DDS with ROS_STATIC_PEERS sends no
    multicast.
    """
    domain = make_domain()
    meet(domain, A, INSIDE)

    announcement = spdp(B, INSIDE, 7412)
    sent = domain.heard_inside(announcement, INSIDE, NOW)

    assert [s.target for s in sent if s.datagram == announcement] == [HostPort(INSIDE, 7410)]
    again = domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    assert [s.target for s in again if s.datagram == spdp(A, INSIDE)] == [HostPort(INSIDE, 7412)]
    domain.inside.note_in_group(announcement, INSIDE)
    heard = domain.heard_inside(announcement, INSIDE, NOW)
    assert by(B, to(heard, INSIDE)) == []


def test_no_participant_gets_its_own_announcement() -> None:
    """Nor the announcement of another participant at the same locator, as in Cyclone DDS."""
    domain = make_domain()
    for prefix in (A, B, A, B):
        assert by(prefix, to(meet(domain, prefix, INSIDE), INSIDE)) == []


@pytest.mark.parametrize("port", [7400, 7410])
def test_announcements_do_not_go_round(port: int) -> None:
    """A participant on the proxy's machine may announce a port of the proxy."""
    domain = make_domain()
    for prefix, own_port in ((A, port), (B, port), (C, 7418), (A, port), (C, 7418)):
        sent = domain.heard_inside(spdp(prefix, NEAR, own_port), NEAR, NOW)
        assert HostPort(NEAR, port) not in {s.target for s in sent if s.datagram[8:20] == prefix}
    assert HostPort(NEAR, 7418) in {
        s.target for s in domain.heard_inside(spdp(A, NEAR, port), NEAR, NOW)
    }


def test_introductions_are_charged_to_who_makes_them() -> None:
    domain = make_domain(ports=PortMap(PortRange(45000, 45199), PortRange(45000, 45199)))
    for number in range(MOST_PER_ADDRESS):
        prefix = A[:2] + number.to_bytes(10, "big")
        domain.heard_inside(spdp(prefix, INSIDE, 7410 + 2 * number), INSIDE, NOW)
    sent = domain.heard_inside(spdp(A[:2] + bytes(10), INSIDE), INSIDE, NOW)
    assert len(by(A[:2] + bytes(10), to(sent, INSIDE))) == MOST_PER_ADDRESS - 1
    heard = sum(1 for _ in range(1000) if domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW))
    assert heard < BURST / (MOST_PER_ADDRESS - 1)


def test_who_is_heard_by_multicast_needs_no_introduction() -> None:
    domain = make_domain()
    meet(domain, A, INSIDE)
    meet(domain, B, OTHER)
    domain.inside.note_in_group(spdp(B, OTHER), OTHER)

    assert by(B, to(domain.heard_inside(spdp(B, OTHER), OTHER, NOW), INSIDE)) == []
    domain.inside.note_in_group(b"no RTPS message", OTHER)


def test_those_on_other_networks_are_not_introduced() -> None:
    domain = make_domain()
    domain.settings.proxy_address_for = lambda address: address
    meet(domain, A, INSIDE)
    assert by(B, to(meet(domain, B, OTHER), INSIDE)) == []


def moved(lan_relay: HostPort | None = None) -> Domain:
    """A domain with the robot, and with a participant that knew the proxy at another address."""
    domain = make_domain(peers=(ROBOT,), lan_relay=lan_relay)
    domain.heard_outside(spdp(C, ROBOT), ROBOT, NOW)
    domain.former_ports.note_recorded({A: PORTS}, domain.inside.by_prefix)
    return domain


def test_ports_are_those_at_the_proxy_before() -> None:
    domain = moved()
    meet(domain)
    assert tuple(domain.inside.by_prefix[A].ports) == PORTS


def test_who_knew_the_proxy_elsewhere_meets_everybody_anew() -> None:
    domain = moved()

    sent = meet(domain)
    assert is_dispose_message(by(domain.proxy_participants.port_store.prefix, to(sent, INSIDE))[0])
    assert by(C, to(sent, INSIDE)) == []
    parting = settle(domain, NOW)
    meeting = settle(domain, NOW + SEPARATION_S)

    for told in (by(C, to(parting, INSIDE)), by(A, to(parting, ROBOT))):
        assert [is_dispose_message(datagram) for datagram in told] == [True]
    for told in (by(C, to(meeting, INSIDE)), by(A, to(meeting, ROBOT))):
        assert [is_dispose_message(datagram) for datagram in told] == [False]
    assert not domain.has_confirmed_ports(domain.inside.by_prefix[A])
    again = domain.heard_outside(spdp(C, ROBOT), ROBOT, NOW)
    assert [is_dispose_message(datagram) for datagram in by(C, to(again, INSIDE))] == [False]


def test_they_meet_anew_once_the_lan_relay_is_heard() -> None:
    """The LAN relay starts after the proxy. Without the relay, no dispose message reaches
    outside.
    """
    domain = moved(LAN_RELAY)
    meet(domain)
    assert settle(domain, NOW) == settle(domain, NOW + 1) == []

    told = carried(ROBOT, spdp(C, ROBOT))
    assert by(C, to(domain.heard_outside(told, LAN_RELAY.host, NOW + 1), INSIDE)) == []

    parting = settle(domain, NOW + 1)
    assert [is_dispose_message(datagram) for datagram in by(A, to(parting, LAN_RELAY.host))] == [
        True
    ]
    assert [is_dispose_message(datagram) for datagram in by(C, to(parting, INSIDE))] == [True]


def test_they_meet_anew_though_nobody_is_on_the_lan_relays_lan() -> None:
    domain = moved(LAN_RELAY)
    meet(domain)
    assert by(A, to(settle(domain, NOW + LAN_RELAY_TIMEOUT_S), ROBOT))


def test_who_comes_later_is_forgotten_before_he_is_met() -> None:
    domain = moved()
    meet(domain)
    settle(domain, NOW)
    settle(domain, NOW + SEPARATION_S)
    later = by(B, to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW + 1), INSIDE))
    assert [is_dispose_message(datagram) for datagram in later] == [True, False]
    domain.heard_outside(dispose_message(B), ROBOT, NOW + 1)
    assert domain.inside.by_prefix[A].dispose_message_times == {C: NOW}


def test_who_does_not_take_it_in_is_told_again() -> None:
    """Datagrams get lost where dozens meet at once."""
    domain = moved()
    meet(domain)
    settle(domain, NOW)
    settle(domain, NOW + SEPARATION_S)

    def told(later: float) -> list[bool]:
        sent = domain.heard_outside(spdp(C, ROBOT), ROBOT, NOW + later)
        return [is_dispose_message(datagram) for datagram in by(C, to(sent, INSIDE))]

    assert told(DISPOSE_MESSAGE_INTERVAL_S - 0.1) == [False]
    assert told(DISPOSE_MESSAGE_INTERVAL_S) == [True, False]
    (stand_in,) = domain.stand_ins.by_port
    domain.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW + DISPOSE_MESSAGE_INTERVAL_S)
    assert told(3 * DISPOSE_MESSAGE_INTERVAL_S) == [False]


def test_ports_of_locators_that_are_told_later_are_those_before() -> None:
    domain = moved()
    port = RANGE.listen.last - 2
    domain.former_ports.note_recorded({A: (*PORTS, port)}, {})
    meet(domain)
    settle(domain, NOW)
    domain.heard_inside(
        sedp(A, INSIDE, 7000, to=domain.proxy_participants.discovery_participant.prefix),
        INSIDE,
        NOW,
    )
    assert tuple(domain.inside.by_prefix[A].ports) == (*PORTS, port)


@pytest.mark.parametrize("ports", [(80,), (RANGE.listen.last + 1,), (*PORTS, 80)])
def test_a_participant_with_ports_of_another_range_gets_others_and_rediscovers_all(
    ports: tuple[int, ...],
) -> None:
    """Outside ignores new locators of a known participant."""
    domain = make_domain(peers=(ROBOT,), lan_relay=None)
    domain.former_ports.note_recorded({A: ports}, domain.inside.by_prefix)
    meet(domain)
    assert not set(domain.inside.by_prefix[A].ports) & set(ports)
    parting = settle(domain, NOW)
    meeting = settle(domain, NOW + SEPARATION_S)
    assert [is_dispose_message(datagram) for datagram in by(A, to(parting, ROBOT))] == [True]
    assert [is_dispose_message(datagram) for datagram in by(A, to(meeting, ROBOT))] == [False]


def test_who_had_no_ports_was_not_there() -> None:
    domain = make_domain(lan_relay=LAN_RELAY)
    domain.former_ports.note_recorded({A: ()}, domain.inside.by_prefix)
    sent = meet(domain)
    assert domain.inside.by_prefix[A].ports
    told = by(domain.proxy_participants.port_store.prefix, to(sent, INSIDE))
    assert told
    assert not any(map(is_dispose_message, told))


def test_who_is_there_already_keeps_what_he_has() -> None:
    domain = make_domain()
    meet(domain)
    before = domain.inside.by_prefix[A].ports
    domain.former_ports.note_recorded({A: PORTS}, domain.inside.by_prefix)
    meet(domain)
    assert domain.inside.by_prefix[A].ports == before


def test_an_update_of_peers_and_former_ports_is_read() -> None:
    text = ".".join(f"{byte:02x}" for byte in A)
    update = read_body(
        {"peers": ["robot", "192.0.2.1:11400"], "former": {text: [1]}}, ContainerUpdate
    )
    assert update.ros2_peers is not None
    assert [str(peer.port) for peer in update.ros2_peers] == ["0", "11400"]
    assert update.former_ports == {A: (1,)}
    assert read_body({}, ContainerUpdate).ros2_peers is None


@pytest.mark.parametrize(
    "body",
    [{"peers": ["a b"]}, {"peers": ["a"] * 1025}, {"former": {"x": [1]}}, {"former": {"01": "a"}}],
)
def test_bad_updates_are_refused(body: dict[str, object]) -> None:
    with pytest.raises(BodyError):
        read_body(body, ContainerUpdate)
