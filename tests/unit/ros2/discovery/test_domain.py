"""A domain: what becomes of each datagram, honest ones and forged ones."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.leases.ports import PortMap, PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.domain import ANNOUNCED_AGAIN
from rosproxy.ros2.discovery.domain_settings import MOST_PER_ADDRESS, Outgoing
from rosproxy.ros2.discovery.rates import BURST
from rosproxy.ros2.discovery.returning import ANSWER_TIME
from rosproxy.ros2.protocol.announcement import LAST_SEQUENCE
from rosproxy.ros2.protocol.envelope import wrapped
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.reliable import heartbeats
from rosproxy.ros2.protocol.rtps import destination, source_prefix, source_vendor
from rosproxy.ros2.registry.locator_ports import SETTLING
from rosproxy.ros2.registry.participants import LeaseKind
from rosproxy.ros2.rewriting.discovery import read_discovery
from tests.unit.ros2.discovery.domains import (
    EAR,
    HOST,
    INSIDE,
    NEAR,
    NOW,
    OTHER,
    ROBOT,
    SEDP_WRITERS,
    STRANGER,
    A,
    B,
    domain,
    farewell,
    meet,
    reached_at,
    sedp,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import message, parameter, submessage


def test_a_participant_inside_is_told_outside_with_ports_of_the_range() -> None:
    one = domain()
    sent = meet(one)
    (told,) = to(sent, ROBOT)
    (carried,) = to(sent, EAR.host)
    assert told == carried
    meta, user = reached_at(told)
    assert {meta.host, user.host} == {HOST}
    leases = {lease.target.port: lease for _, lease in one.inside.leases.values()}
    assert (meta.port - 1000, user.port - 1000) == (leases[7410].port, leases[7411].port)
    assert [leases[7410].kind, leases[7411].kind] == [LeaseKind.METATRAFFIC, LeaseKind.DATA]


def test_participants_that_share_a_datagram_are_all_taken_in() -> None:
    """Cyclone DDS has those of a program share; all that they said was dropped as malformed."""
    one = domain()
    source = submessage(0x0C, 0, bytes(4) + b"\x02\x03\x01\x0f" + B)
    sent = one.heard_inside(spdp(A, INSIDE) + source + spdp(B, INSIDE, 7412)[20:], INSIDE, NOW)
    assert one.inside.by_prefix.keys() == {A, B}
    assert [source_prefix(told) for told in to(sent, ROBOT)] == [A, B]


def test_the_same_is_told_outside_once_in_a_while() -> None:
    """A crowd that meets repeats itself, and each time goes to all ports of all peers."""
    one = domain()
    assert to(meet(one), ROBOT)
    again = spdp(A, INSIDE)
    assert not to(one.heard_inside(again, INSIDE, NOW + ANNOUNCED_AGAIN / 2), ROBOT)
    assert to(one.heard_inside(spdp(A, INSIDE, lease=30), INSIDE, NOW), ROBOT)  # something new
    assert to(one.heard_inside(spdp(A, INSIDE, lease=30), INSIDE, NOW + ANNOUNCED_AGAIN), ROBOT)


@pytest.mark.parametrize("inside", ["fd30::11", "172.30.0.5"])
def test_a_locator_leads_to_the_host_by_its_own_family(inside: str) -> None:
    one = domain()
    one.settings.hosts = (HOST, "fd77::1")
    (told, *_) = to(one.heard_inside(spdp(A, inside), inside, NOW), ROBOT)
    assert {":" in where.host for where in reached_at(told)} == {":" in inside}


def test_a_locator_leads_to_the_only_address_of_the_host() -> None:
    one = domain()
    (told, *_) = to(one.heard_inside(spdp(A, "fd30::11"), "fd30::11", NOW), ROBOT)
    assert {where.host for where in reached_at(told)} == {HOST}


def test_an_address_of_a_link_outside_is_not_told_inside() -> None:
    one = domain(peers=["fd77::2"])
    meet(one)
    link = (Pid.DEFAULT_UNICAST_LOCATOR, pack_locator(HostPort("fe80::1", 7411), "<"))
    there = spdp(B, "fd77::2")
    padded = there[:-4] + parameter(*link) + there[-4:]
    length = struct.pack("<H", len(padded) - 24)
    sent = one.heard_outside(padded[:22] + length + padded[24:], "fd77::2", NOW)
    (told,) = to(sent, INSIDE)
    assert {where.host for where in reached_at(told)} == {NEAR, "fd77::2"}


def test_the_observer_is_reached_by_either_family() -> None:
    one = domain()
    one.settings.hosts = (HOST, "fd77::1")
    (told, *_) = one.own.announced_outside()
    assert {where.host for where in reached_at(told.datagram)} == {HOST, "fd77::1"}


def test_a_participant_at_two_networks_is_served_at_the_first() -> None:
    one = domain()
    meet(one)
    assert one.heard_inside(spdp(A, OTHER), OTHER, NOW) == []
    assert {lease.target.host for _, lease in one.inside.leases.values()} == {INSIDE}


def test_nobody_gets_a_way_to_somebody_elses_address() -> None:
    one = domain()
    sent = one.heard_inside(spdp(A, OTHER), INSIDE, NOW)
    assert not one.inside.leases
    assert reached_at(to(sent, ROBOT)[0]) == []


def test_what_outside_sends_goes_to_the_locator() -> None:
    one = domain()
    meet(one)
    (port,) = [port for port, (_, lease) in one.inside.leases.items() if lease.target.port == 7411]
    datagram = message(submessage(0x07, 0, bytes(28)), prefix=B)
    assert one.at_lease(port, datagram, STRANGER, NOW) == [
        Outgoing(HostPort(INSIDE, 7411), datagram)
    ]


def test_a_participant_outside_is_told_inside_with_a_stand_in() -> None:
    one = domain()
    meet(one)
    (port,) = [port for port, (_, lease) in one.inside.leases.items() if lease.target.port == 7410]
    (sent,) = one.at_lease(port, spdp(B, ROBOT), ROBOT, NOW)
    assert sent.target == HostPort(INSIDE, 7410)
    meta, user = reached_at(sent.datagram)
    (stand_in,) = one.outside.stand_ins
    assert (meta, user) == (HostPort(NEAR, stand_in), HostPort(ROBOT, 7411))


@pytest.mark.parametrize(
    ("near", "robot", "told"),
    [
        (NEAR, ROBOT, []),
        ("127.0.0.1", ROBOT, []),
        (NEAR, "127.0.1.10", []),
        ("127.0.0.1", "127.0.1.10", [HostPort("127.0.1.10", 7000)]),
    ],
)
def test_loopback_is_for_those_on_this_machine(near: str, robot: str, told: list[HostPort]) -> None:
    one = domain(peers=[robot])
    one.settings.proxy_address_for = lambda _: near
    meet(one)
    one.heard_outside(spdp(B, robot), robot, NOW)
    (port,) = [port for port, (_, lease) in one.inside.leases.items() if lease.target.port == 7410]
    (sent,) = one.at_lease(port, sedp(B, "127.0.1.10", 7000), robot, NOW)
    assert reached_at(sent.datagram) == told


def test_who_comes_later_is_told_of_those_outside() -> None:
    one = domain()
    one.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (told,) = to(meet(one), INSIDE)[:1]
    assert reached_at(told)[0].host == NEAR


def test_discovery_of_inside_leaves_with_ports_of_the_range() -> None:
    one = domain()
    one.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    meet(one)
    (stand_in,) = one.outside.stand_ins
    *reminders, sent = one.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW)
    assert sent.target == HostPort(ROBOT, 7410)
    assert {reminder.target for reminder in reminders} == {HostPort(INSIDE, 7410)}
    (where,) = reached_at(sent.datagram)
    assert where.host == HOST
    assert one.inside.leases[where.port - 1000][1].target.port == 7000
    (endpoint,) = one.inside.by_prefix[A].endpoints.values()
    assert (endpoint.topic, endpoint.type_name) == ("rt/chatter", "Str")


def test_a_stranger_is_not_answered() -> None:
    one = domain()
    meet(one)
    (port,) = [port for port, (_, lease) in one.inside.leases.items() if lease.target.port == 7410]
    assert one.at_lease(port, spdp(B, STRANGER), STRANGER, NOW) == []
    assert one.heard_outside(spdp(B, STRANGER), STRANGER, NOW) == []
    assert not one.outside.by_prefix


def test_an_announcement_for_another_address_is_refused() -> None:
    one = domain()
    meet(one)
    assert one.heard_outside(wrapped(ROBOT, spdp(B, STRANGER)), EAR.host, NOW) == []
    assert not one.outside.by_prefix


def test_nobody_takes_the_prefix_of_another() -> None:
    one = domain()
    meet(one)
    one.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    before = dict(one.inside.leases)
    assert one.heard_outside(spdp(A, ROBOT), ROBOT, NOW) == []
    assert one.heard_inside(spdp(B, OTHER), OTHER, NOW) == []
    assert one.heard_inside(spdp(A, OTHER, 9000), OTHER, NOW) == []
    assert one.heard_inside(farewell(A), OTHER, NOW) == []
    assert one.heard_outside(wrapped(STRANGER, farewell(B)), EAR.host, NOW) == []
    assert one.inside.leases == before
    assert one.outside.by_prefix.keys() == {B}


def test_an_unproven_participant_gets_no_more_than_it_sent() -> None:
    one = domain(peers=())
    meet(one)
    heard = spdp(B, ROBOT)
    one.heard_outside(wrapped(ROBOT, heard), EAR.host, NOW)
    (stand_in,) = one.outside.stand_ins
    sent = 0
    for _ in range(20):
        for outgoing in one.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW):
            sent += len(outgoing.datagram) if outgoing.target.host == ROBOT else 0
    assert 0 < sent <= len(heard)
    (port,) = [port for port, (_, lease) in one.inside.leases.items() if lease.target.port == 7410]
    one.at_lease(port, sedp(B, ROBOT, 7411, to=A), ROBOT, NOW)
    assert one.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW)


def test_an_address_has_so_many_participants_and_no_more() -> None:
    one = domain()
    for number in range(MOST_PER_ADDRESS + 10):
        one.heard_inside(spdp(number.to_bytes(12, "big"), INSIDE), INSIDE, NOW)
    assert len(one.inside.by_prefix) == MOST_PER_ADDRESS


def test_a_range_that_is_too_short_is_told() -> None:
    one = domain()
    for number in range(1, 10):
        one.heard_inside(
            spdp(number.to_bytes(12, "big"), f"172.30.0.{number}"), f"172.30.0.{number}", NOW
        )
    assert len(one.inside.leases) == 15  # of sixteen, one is for discovery
    assert all("--port-range" in text for text in one.inside.port_shortages.values())
    assert one.inside.port_shortages


def test_who_has_gone_gives_everything_back() -> None:
    one = domain()
    meet(one)
    one.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    free = one.ports.pool.free
    one.expire(NOW + 21)
    assert not one.inside.by_prefix
    assert not one.outside.by_prefix
    assert not one.inside.leases
    assert not one.outside.stand_ins
    assert one.ports.pool.free == free + 2
    meet(one)
    assert to(one.heard_inside(farewell(A), INSIDE, NOW), ROBOT)
    assert not one.inside.by_prefix
    assert one.ports.pool.free == free + 2


def test_ports_are_given_once_it_is_known_who_had_which() -> None:
    one = domain()
    told, asked = one.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    assert {told.target, asked.target} == {HostPort(INSIDE, 7410)}
    assert len(to(one.settle(0.5), INSIDE)) == 2  # asked again
    assert not one.inside.leases
    assert to(one.settle(0.1 + ANSWER_TIME), ROBOT)
    assert one.inside.leases


def test_a_participant_says_which_ports_it_had() -> None:
    one = domain()
    one.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    number = one.own.keeper.number([45009, 45004])
    body = struct.pack(">II", 0x000003C7, SEDP_WRITERS) + struct.pack("<iIIi", 0, number, 0, 1)
    meant = submessage(0x0E, 0, one.own.keeper.prefix)
    answer = message(meant, submessage(0x06, 2, body), prefix=A)
    one.heard_inside(answer, OTHER, 0.2)
    assert not one.own.keeper.number_by_prefix  # from somewhere else it is nobody's word
    one.heard_inside(answer, INSIDE, 0.2)
    one.settle(SETTLING)
    ports = {lease.target.port: port for port, (_, lease) in one.inside.leases.items()}
    assert ports == {7410: 45009, 7411: 45004}


def test_a_participant_keeps_its_ports_as_soon_as_it_has_them() -> None:
    """The proxy may be killed at any time."""
    one = domain()

    def reminded() -> list[int]:
        told = [sent for sent in to(meet(one), INSIDE) if source_prefix(sent) == keeper.prefix]
        return [beat.first for sent in told for beat in heartbeats(sent)]

    keeper = one.own.keeper
    numbers = reminded()
    assert numbers == [keeper.number(one.inside.by_prefix[A].ports)]
    assert reminded() == []  # not by each announcement


def test_participants_are_reminded_until_they_keep_their_ports() -> None:
    one = domain()
    meet(one)
    told, reminder = one.own.port_reminders()
    assert {told.target, reminder.target} == {HostPort(INSIDE, 7410)}
    assert one.own.port_reminders()
    ports = [lease.port for lease in one.inside.by_prefix[A].leases.values()]
    one.own.keeper.number_by_prefix[A] = one.own.keeper.number(ports)
    assert one.own.port_reminders() == []


@given(st.binary(max_size=300), st.sampled_from([INSIDE, ROBOT, STRANGER, EAR.host]))
@pytest.mark.parametrize("start", [b"", b"RTPS\x02\x03\x01\x0f" + A, spdp(A, INSIDE)[:120]])
def test_nothing_that_is_sent_breaks_it(start: bytes, rest: bytes, source: str) -> None:
    one, datagram = domain(), start + rest
    meet(one)
    one.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (stand_in,) = one.outside.stand_ins
    one.heard_inside(datagram, source, NOW)
    one.heard_outside(datagram, source, NOW)
    one.at_stand_in(stand_in, datagram, source, NOW)
    for port in range(45000, 45016):
        one.at_lease(port, datagram, source, NOW)
    one.expire(NOW)
    assert one.inside.by_prefix.keys() >= {A}


def test_one_source_may_make_so_much_discovery() -> None:
    one = domain()
    meet(one)
    one.rates.charge(INSIDE, int(BURST))
    assert one.heard_inside(spdp(A, INSIDE), INSIDE, NOW) == []
    assert one.heard_inside(spdp(B, OTHER), OTHER, NOW)
    assert one.heard_inside(spdp(A, INSIDE), INSIDE, NOW + 1)


def test_an_announcement_is_charged_with_what_it_leads_to() -> None:
    one = domain()
    for number in range(40):
        one.heard_outside(spdp(bytes([9, number]) + B[2:], ROBOT), ROBOT, NOW)
    meet(one)
    left = sum(1 for _ in range(int(BURST)) if one.heard_inside(spdp(A, INSIDE), INSIDE, NOW))
    assert left < BURST / 2


@pytest.mark.parametrize("outside", [False, True])
def test_an_answer_to_the_proxy_is_told_to_all(outside: bool) -> None:
    """Cyclone DDS answers the observer's announcement with its own, which names the observer."""
    one = domain()
    meet(one)
    told = spdp(B, ROBOT if outside else OTHER)
    answer = told[:20] + submessage(0x0E, 0, one.own.observer.prefix) + told[20:]
    if outside:
        sent = to(one.heard_outside(answer, ROBOT, NOW), INSIDE)
    else:
        sent = to(one.heard_inside(answer, OTHER, NOW), ROBOT)
    assert [destination(datagram) for datagram in sent] == [None]


def test_who_has_heard_the_observer_may_announce_itself() -> None:
    """On a LAN, whose participants are nobody's peers, they answer it directly, where one of the
    same host was heard by the ear."""
    one = domain(peers=())
    meet(one)
    neighbour = b"\x01\x10" + bytes(10)
    one.heard_outside(wrapped(ROBOT, spdp(neighbour, ROBOT)), EAR.host, NOW)
    answer = spdp(B, ROBOT)
    named = answer[:20] + submessage(0x0E, 0, one.own.observer.prefix) + answer[20:]
    assert one.heard_outside(answer, ROBOT, NOW) == []
    assert to(one.heard_outside(named, ROBOT, NOW), INSIDE)
    assert to(one.heard_outside(answer, ROBOT, NOW), INSIDE)
    assert one.heard_outside(answer, STRANGER, NOW) == []


def test_who_is_gone_is_ended_outside_on_his_behalf() -> None:
    one = domain()
    meet(one), meet(one, B, OTHER)
    taken = one.ports.pool.free

    sent = one.gone({INSIDE})

    assert [outgoing.target for outgoing in sent] == one.settings.announcement_targets()
    (found,) = read_discovery(sent[0].datagram).announcements
    assert (found.ended, found.sample.prefix, found.sample.sequence) == (True, A, LAST_SEQUENCE)
    assert source_vendor(sent[0].datagram) == A[:2]
    assert [*one.inside.by_prefix] == [B]
    assert one.ports.pool.free == taken + 2
    assert one.gone({INSIDE}) == []


def test_who_is_gone_gets_no_port_any_more() -> None:
    one = domain()
    one.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    assert one.returning.waiting

    one.gone({INSIDE})
    one.settle(SETTLING + ANSWER_TIME + 1)

    assert not one.inside.by_prefix


def test_no_port_of_the_range_stands_in() -> None:
    """Wherever the range lies, for the proxy listens there."""
    one = domain()
    one.heard_outside(spdp(A, ROBOT), ROBOT, NOW)
    meet(one, B)
    (free,) = one.outside.stand_ins

    ports = PortRange(free - 8, free + 7)
    one = domain(ports=PortMap(ports, ports))
    one.heard_outside(spdp(A, ROBOT), ROBOT, NOW)
    meet(one, B)

    (port,) = one.outside.stand_ins
    assert port not in ports
