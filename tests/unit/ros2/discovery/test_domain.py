"""A domain: the fate of each datagram, honest or forged."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.discovery.announcements import to_inside
from rosproxy.ros2.discovery.announcements.to_outside import REPEAT_INTERVAL_S
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.discovery.rediscovery import SEPARATION_S
from rosproxy.ros2.domain_settings import MOST_MAPPINGS, MOST_PER_ADDRESS, Outgoing
from rosproxy.ros2.ports.former_ports import ANSWER_TIMEOUT_S
from rosproxy.ros2.ports.locator_ports import SETTLING_PERIOD_S
from rosproxy.ros2.protocol.addressing import destination, destinations
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.reliable import heartbeats
from rosproxy.ros2.protocol.rtps import source_prefix, source_vendor
from rosproxy.ros2.registry.participants import ShortageKind, TrafficKind
from rosproxy.ros2.rewriting.discovery import DiscoveryMessage, read_discovery
from rosproxy.ros2.sources.rates import BURST, BYTES_PER_UNIT, cost
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap, PortRange
from tests.unit.ros2.discovery.domains import (
    HOST,
    INSIDE,
    LAN_RELAY,
    NEAR,
    NOW,
    OTHER,
    RANGE,
    ROBOT,
    STRANGER,
    A,
    B,
    allowance_left,
    carried,
    dispose_message,
    kept_answer,
    make_domain,
    meet,
    next_number,
    prove,
    reached_at,
    sedp,
    settle,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import (
    data,
    message,
    parameter,
    payload,
    submessage,
)

LONG_RANGE = PortMap(PortRange(45000, 45099), PortRange(46000, 46099))


def test_a_participant_inside_is_told_outside_with_ports_of_the_range() -> None:
    domain = make_domain()
    sent = meet(domain)
    (told,) = to(sent, ROBOT)
    (carried,) = to(sent, LAN_RELAY.host)
    assert told == carried
    meta, user = reached_at(told)
    assert {meta.host, user.host} == {HOST}
    mappings = {mapping.target.port: mapping for _, mapping in domain.mappings.by_port.values()}
    assert (meta.port - 1000, user.port - 1000) == (mappings[7410].port, mappings[7411].port)
    assert [mappings[7410].kind, mappings[7411].kind] == [
        TrafficKind.METATRAFFIC,
        TrafficKind.USER_DATA,
    ]


def test_participants_that_share_a_datagram_are_all_taken_in() -> None:
    """Cyclone DDS packs the participants of a program into a datagram."""
    domain = make_domain()
    source = submessage(0x0C, 0, bytes(4) + b"\x02\x03\x01\x0f" + B)
    sent = domain.heard_inside(spdp(A, INSIDE) + source + spdp(B, INSIDE, 7412)[20:], INSIDE, NOW)
    assert domain.inside.by_prefix.keys() == {A, B}
    assert [source_prefix(told) for told in to(sent, ROBOT)] == [A, B]


def test_the_same_is_told_outside_once_in_a_while() -> None:
    """A crowd that meets repeats itself, and each time goes to all ports of all peers."""
    domain = make_domain()
    assert to(meet(domain), ROBOT)
    again = spdp(A, INSIDE)
    assert not to(domain.heard_inside(again, INSIDE, NOW + REPEAT_INTERVAL_S / 2), ROBOT)
    assert to(domain.heard_inside(spdp(A, INSIDE, lease=30), INSIDE, NOW), ROBOT)  # something new
    assert to(
        domain.heard_inside(spdp(A, INSIDE, lease=30), INSIDE, NOW + REPEAT_INTERVAL_S), ROBOT
    )


@pytest.mark.parametrize("inside", ["fd30::11", "172.30.0.5"])
def test_a_locator_leads_to_the_host_by_its_own_family(inside: str) -> None:
    domain = make_domain()
    domain.settings.hosts = (HOST, "fd77::1")
    (told, *_) = to(domain.heard_inside(spdp(A, inside), inside, NOW), ROBOT)
    assert {":" in locator.host for locator in reached_at(told)} == {":" in inside}


def test_a_locator_leads_to_the_only_address_of_the_host() -> None:
    domain = make_domain()
    (told, *_) = to(domain.heard_inside(spdp(A, "fd30::11"), "fd30::11", NOW), ROBOT)
    assert {locator.host for locator in reached_at(told)} == {HOST}


def test_an_address_of_a_link_outside_is_not_told_inside() -> None:
    domain = make_domain(peers=["fd77::2"])
    meet(domain)
    link = (Pid.DEFAULT_UNICAST_LOCATOR, pack_locator(HostPort("fe80::1", 7411), "<"))
    announcement = spdp(B, "fd77::2")
    padded = announcement[:-4] + parameter(*link) + announcement[-4:]
    length = struct.pack("<H", len(padded) - 24)
    sent = domain.heard_outside(padded[:22] + length + padded[24:], "fd77::2", NOW)
    (told,) = to(sent, INSIDE)
    assert {locator.host for locator in reached_at(told)} == {NEAR, "fd77::2"}


def test_the_discovery_participant_is_reached_by_either_family() -> None:
    domain = make_domain()
    domain.settings.hosts = (HOST, "fd77::1")
    (told,) = to(domain.proxy_participants.announced_outside(), LAN_RELAY.host)
    assert {locator.host for locator in reached_at(told)} == {HOST, "fd77::1"}


def test_a_participant_at_two_networks_is_served_at_the_first() -> None:
    domain = make_domain()
    meet(domain)
    assert domain.heard_inside(spdp(A, OTHER), OTHER, NOW) == []
    assert {mapping.target.host for _, mapping in domain.mappings.by_port.values()} == {INSIDE}


def test_nobody_gets_a_way_to_somebody_elses_address() -> None:
    domain = make_domain()
    sent = domain.heard_inside(spdp(A, OTHER), INSIDE, NOW)
    assert not domain.mappings.by_port
    assert reached_at(to(sent, ROBOT)[0]) == []


def test_what_outside_sends_goes_to_the_locator() -> None:
    domain = make_domain()
    meet(domain)
    (port,) = [
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7411
    ]
    datagram = message(submessage(0x07, 0, bytes(28)), prefix=B)
    assert domain.at_range_port(port, datagram, STRANGER, NOW) == [
        Outgoing(HostPort(INSIDE, 7411), datagram)
    ]


def test_a_participant_outside_is_told_inside_with_a_stand_in() -> None:
    domain = make_domain()
    meet(domain)
    (port,) = [
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7410
    ]
    (sent,) = domain.at_range_port(port, spdp(B, ROBOT), ROBOT, NOW)
    assert sent.target == HostPort(INSIDE, 7410)
    meta, user = reached_at(sent.datagram)
    (stand_in,) = domain.stand_ins.by_port
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
    domain = make_domain(peers=[robot])
    domain.settings.proxy_address_for = lambda _: near
    meet(domain)
    domain.heard_outside(spdp(B, robot), robot, NOW)
    (port,) = [
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7410
    ]
    (sent,) = domain.at_range_port(port, sedp(B, "127.0.1.10", 7000), robot, NOW)
    assert reached_at(sent.datagram) == told


def test_who_comes_later_is_told_of_those_outside() -> None:
    domain = make_domain()
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (told,) = to(meet(domain), INSIDE)[:1]
    assert reached_at(told)[0].host == NEAR


def test_discovery_of_inside_leaves_with_ports_of_the_range() -> None:
    domain = make_domain()
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    meet(domain)
    (stand_in,) = domain.stand_ins.by_port
    *reminders, sent = domain.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW)
    assert sent.target == HostPort(ROBOT, 7410)
    assert {reminder.target for reminder in reminders} == {HostPort(INSIDE, 7410)}
    (locator,) = reached_at(sent.datagram)
    assert locator.host == HOST
    assert domain.mappings.by_port[locator.port - 1000][1].target.port == 7000
    (endpoint,) = domain.inside.by_prefix[A].endpoints.values()
    assert (endpoint.topic, endpoint.type_name) == ("rt/chatter", "Str")


def test_a_stranger_is_not_answered() -> None:
    domain = make_domain()
    meet(domain)
    (port,) = [
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7410
    ]
    assert domain.at_range_port(port, spdp(B, STRANGER), STRANGER, NOW) == []
    assert domain.heard_outside(spdp(B, STRANGER), STRANGER, NOW) == []
    assert not domain.outside.by_prefix


def test_an_announcement_for_another_address_is_refused() -> None:
    domain = make_domain()
    meet(domain)
    assert domain.heard_outside(carried(ROBOT, spdp(B, STRANGER)), LAN_RELAY.host, NOW) == []
    assert not domain.outside.by_prefix


def test_nobody_takes_the_prefix_of_another() -> None:
    domain = make_domain()
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    before = dict(domain.mappings.by_port)
    assert domain.heard_outside(spdp(A, ROBOT), ROBOT, NOW) == []
    assert domain.heard_inside(spdp(B, OTHER), OTHER, NOW) == []
    assert domain.heard_inside(spdp(A, OTHER, 9000), OTHER, NOW) == []
    assert domain.heard_inside(dispose_message(A), OTHER, NOW) == []
    assert domain.heard_outside(carried(STRANGER, dispose_message(B)), LAN_RELAY.host, NOW) == []
    assert domain.mappings.by_port == before
    assert domain.outside.by_prefix.keys() == {B}


def test_an_unproven_participant_gets_no_more_than_it_sent() -> None:
    domain = make_domain(peers=())
    meet(domain)
    heard = spdp(B, ROBOT)
    domain.heard_outside(carried(ROBOT, heard), LAN_RELAY.host, NOW)
    (stand_in,) = domain.stand_ins.by_port
    sent = 0
    for _ in range(20):
        for outgoing in domain.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW):
            sent += len(outgoing.datagram) if outgoing.target.host == ROBOT else 0
    assert 0 < sent <= len(heard)
    (port,) = [
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7410
    ]
    domain.at_range_port(port, sedp(B, ROBOT, 7411, to=A), ROBOT, NOW)
    assert domain.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW)


def test_an_address_has_so_many_participants_and_no_more() -> None:
    domain = make_domain()
    prefixes = [number.to_bytes(12, "big") for number in range(MOST_PER_ADDRESS + 10)]
    prove(domain, INSIDE, prefixes=prefixes)
    for prefix in prefixes:
        domain.heard_inside(spdp(prefix, INSIDE), INSIDE, NOW)
    assert len(domain.inside.by_prefix) == MOST_PER_ADDRESS


def test_a_range_that_is_too_short_is_told() -> None:
    domain = make_domain()
    for number in range(1, 10):
        prefix = number.to_bytes(12, "big")
        address = f"172.30.0.{number}"
        prove(domain, address, prefixes=[prefix])
        domain.heard_inside(spdp(prefix, address), address, NOW)
    assert len(domain.mappings.by_port) == 15  # of 16 ports, the first is for discovery
    shortages = domain.mappings.shortages.values()
    assert all("got no port: no port of" in shortage.text for shortage in shortages)
    assert {shortage.kind for shortage in shortages} == {ShortageKind.RANGE}
    assert domain.mappings.shortages


def test_who_has_gone_gives_everything_back() -> None:
    domain = make_domain()
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    free = domain.ports.pool.free
    domain.expire(NOW + 21)
    assert not domain.inside.by_prefix
    assert not domain.outside.by_prefix
    assert not domain.mappings.by_port
    assert not domain.stand_ins.by_port
    assert domain.ports.pool.free == free + 2
    meet(domain)
    assert to(domain.heard_inside(dispose_message(A), INSIDE, NOW), ROBOT)
    assert not domain.inside.by_prefix
    assert domain.ports.pool.free == free + 2


def test_ports_are_given_once_it_is_known_who_had_which() -> None:
    domain = make_domain()
    told, *asked = domain.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    assert {told.target, *(out.target for out in asked)} == {HostPort(INSIDE, 7410)}
    assert len(to(settle(domain, 0.5), INSIDE)) == 2  # asked again
    assert not domain.mappings.by_port
    assert to(settle(domain, 0.1 + ANSWER_TIMEOUT_S), ROBOT)
    assert domain.mappings.by_port


def test_a_participant_says_which_ports_it_had() -> None:
    domain = make_domain()
    domain.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    answer = kept_answer(domain, A, domain.proxy_participants.port_store.number([45009, 45004]))
    domain.heard_inside(answer, OTHER, 0.2)
    assert (
        not domain.proxy_participants.port_store.prefixes
    )  # an answer from another address does not count
    domain.heard_inside(answer, INSIDE, 0.2)
    settle(domain, SETTLING_PERIOD_S)
    ports = {mapping.target.port: port for port, (_, mapping) in domain.mappings.by_port.items()}
    assert ports == {7410: 45009, 7411: 45004}


def test_what_a_peer_says_of_a_port_counts_more_than_what_others_do() -> None:
    domain = make_domain()
    outsider = bytes([1, 15, *range(10, 20)])
    for prefix, source in ((A, ROBOT), (B, STRANGER)):
        for port in (45002, 45005):
            domain.at_range_port(port, sedp(outsider, ROBOT, 7410, to=prefix), source, 0.1)
    domain.heard_inside(spdp(B, INSIDE), INSIDE, 0.2)
    domain.heard_inside(spdp(A, OTHER), OTHER, 0.3)
    settle(domain, SETTLING_PERIOD_S + ANSWER_TIMEOUT_S)
    ports = {
        participant.prefix: port
        for port, (participant, mapping) in domain.mappings.by_port.items()
        if mapping.kind is TrafficKind.METATRAFFIC
    }
    assert ports[A] in {45002, 45005}
    assert ports[B] not in {45002, 45005}


def test_a_participant_keeps_its_ports_as_soon_as_it_has_them() -> None:
    """The proxy may be killed at any time."""
    domain = make_domain()

    def reminded() -> list[int]:
        told = [
            sent for sent in to(meet(domain), INSIDE) if source_prefix(sent) == port_store.prefix
        ]
        return [beat.first for sent in told for beat in heartbeats(sent)]

    port_store = domain.proxy_participants.port_store
    numbers = reminded()
    assert numbers == [*port_store.numbers(A, domain.inside.by_prefix[A].ports).values()]
    assert reminded() == []  # not by each announcement


def reminded(domain: Domain) -> set[bytes]:
    """The participants that are told again which ports to keep."""
    sent = [out.datagram for out in domain.proxy_participants.port_reminders(NOW)]
    told = [destinations(datagram) for datagram in sent if any(heartbeats(datagram))]
    return set[bytes]().union(*told)


def test_a_participant_that_shares_its_locator_keeps_its_ports() -> None:
    """Participants of a Cyclone DDS process share a locator, and must not take turns."""
    domain = make_domain()
    meet(domain, A)
    meet(domain, B)
    assert reminded(domain) == {A, B}  # neither has answered
    prove(domain, INSIDE, prefixes=[B])
    assert reminded(domain) == {B}
    prove(domain, INSIDE, prefixes=[A])
    assert reminded(domain) == {A}
    in_other_process = bytes(range(12))
    domain.heard_inside(spdp(in_other_process, INSIDE, 7500), INSIDE, NOW)
    assert reminded(domain) == {A, in_other_process}


def test_a_participant_that_has_ended_is_not_reminded() -> None:
    """The proxy forwards between the reminders, so participants may end meanwhile."""
    domain = make_domain()
    meet(domain, A)
    meet(domain, B)
    reminders = domain.proxy_participants.port_reminders(NOW)
    assert next(reminders).target == next(reminders).target
    domain.end_participants_at([INSIDE])
    assert [*reminders] == []
    assert not domain.proxy_participants.port_store._counts


def test_participants_are_reminded_until_they_keep_their_ports() -> None:
    domain = make_domain()
    meet(domain)
    told, reminder = domain.proxy_participants.port_reminders(NOW)
    assert {told.target, reminder.target} == {HostPort(INSIDE, 7410)}
    assert [*domain.proxy_participants.port_reminders(NOW)]
    number = domain.proxy_participants.port_store.number(domain.inside.by_prefix[A].ports)
    domain.heard_inside(kept_answer(domain, A, number), INSIDE, NOW)
    assert [*domain.proxy_participants.port_reminders(NOW)] == []


@given(st.binary(max_size=300), st.sampled_from([INSIDE, ROBOT, STRANGER, LAN_RELAY.host]))
@pytest.mark.parametrize("start", [b"", b"RTPS\x02\x03\x01\x0f" + A, spdp(A, INSIDE)[:120]])
def test_nothing_that_is_sent_breaks_it(start: bytes, rest: bytes, source: str) -> None:
    domain = make_domain()
    datagram = start + rest
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (stand_in,) = domain.stand_ins.by_port
    domain.heard_inside(datagram, source, NOW)
    domain.heard_outside(datagram, source, NOW)
    domain.at_stand_in(stand_in, datagram, source, NOW)
    for port in range(45000, 45016):
        domain.at_range_port(port, datagram, source, NOW)
    domain.expire(NOW)
    assert domain.inside.by_prefix.keys() >= {A}


def test_one_source_may_make_so_much_discovery() -> None:
    domain = make_domain()
    meet(domain)
    domain.rates.charge(INSIDE, int(BURST))
    assert domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW) == []
    assert domain.heard_inside(spdp(B, OTHER), OTHER, NOW)
    assert domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW + 1)


def test_an_announcement_is_charged_with_what_it_leads_to() -> None:
    domain = make_domain()
    for number in range(40):
        domain.heard_outside(spdp(bytes([9, number]) + B[2:], ROBOT), ROBOT, NOW)
    before = allowance_left(domain, INSIDE)
    announcement = spdp(A, INSIDE)
    sent = domain.heard_inside(announcement, INSIDE, NOW)
    led_to = sum(cost(len(out.datagram)) for out in sent)
    assert led_to > 40
    assert allowance_left(domain, INSIDE) == before - cost(len(announcement)) - led_to


def test_nothing_is_read_for_a_participant_that_gets_no_announcements(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For 72 bytes without a locator, the proxy read the announcements of 100 participants in 1.5
    ms, and charged the source only for its own datagram.
    """
    domain = make_domain()
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)

    def read(_: bytes) -> DiscoveryMessage:
        raise AssertionError("an announcement was read")

    monkeypatch.setattr(to_inside, "read_discovery", read)
    guid = A + bytes([0, 0, 1, 0xC1])
    without_locator = message(data(payload([(Pid.PARTICIPANT_GUID, guid)])), prefix=A)
    domain.heard_inside(without_locator, INSIDE, NOW)
    assert A in domain.inside.by_prefix


def test_a_long_announcement_is_charged_for_each_copy() -> None:
    """The charge of a copy grows with its length."""
    domain = make_domain(peers=[f"10.0.1.{number}" for number in range(32)])
    before = allowance_left(domain, INSIDE)
    domain.heard_inside(spdp(A, INSIDE, padding=7000), INSIDE, NOW)
    assert before - allowance_left(domain, INSIDE) > 33 * 7000 / BYTES_PER_UNIT


def targets_of(domain: Domain, announcement: bytes, now: float) -> set[HostPort]:
    sent = domain.heard_inside(announcement, INSIDE, now)
    return {out.target for out in sent if out.target.host == ROBOT}


def test_an_announcement_is_repeated_where_a_peers_participants_are() -> None:
    """Once the peer's participants are known, only to their ports, not to 32 ports each time."""
    domain = make_domain(peers=[])
    domain.settings.peers = (HostPort(ROBOT, 0),)
    everywhere = {HostPort(ROBOT, port) for port in range(7410, 7474, 2)}
    assert targets_of(domain, spdp(A, INSIDE), NOW) == everywhere
    assert targets_of(domain, spdp(A, INSIDE), NOW + 3) == everywhere  # no participant known
    domain.heard_outside(spdp(B, ROBOT, 7440), ROBOT, NOW + 3)
    known = {HostPort(ROBOT, port) for port in (7410, 7412, 7414, 7440)}
    assert targets_of(domain, spdp(A, INSIDE), NOW + 6) == known
    assert targets_of(domain, spdp(bytes([7]) * 12, INSIDE, 7420), NOW + 6) == everywhere


def test_a_peer_with_many_participants_is_told_at_more_ports() -> None:
    """A robot may have more participants than the 32 usual ports."""
    domain = make_domain(peers=())
    domain.settings.peers = (HostPort(ROBOT, 0),)

    def ports_told() -> set[int]:
        announced = domain.proxy_participants.announced_outside()
        return {sent.target.port for sent in announced if sent.target.host == ROBOT}

    def meet_robots(count: int) -> None:
        for number in range(count):
            prefix = b"\x01\x0f" + number.to_bytes(10, "big")
            domain.heard_outside(spdp(prefix, ROBOT, 7410 + 2 * number), ROBOT, NOW)

    assert ports_told() == set(range(7410, 7410 + 2 * 32, 2))
    meet_robots(32)
    assert ports_told() == set(range(7410, 7410 + 2 * 64, 2))
    meet_robots(46)
    assert ports_told() == set(range(7410, 7410 + 2 * 92, 2))
    meet_robots(200)
    assert max(ports_told()) < 7650, "the next ports belong to the next domain"


@pytest.mark.parametrize("outside", [False, True])
def test_an_answer_to_the_proxy_is_told_to_all(outside: bool) -> None:
    """Cyclone DDS answers with an announcement to the discovery participant alone."""
    domain = make_domain()
    meet(domain)
    told = spdp(B, ROBOT if outside else OTHER)
    answer = (
        told[:20]
        + submessage(0x0E, 0, domain.proxy_participants.discovery_participant.prefix)
        + told[20:]
    )
    if outside:
        sent = to(domain.heard_outside(answer, ROBOT, NOW), INSIDE)
    else:
        sent = to(domain.heard_inside(answer, OTHER, NOW), ROBOT)
    assert [destination(datagram) for datagram in sent] == [None]


def test_an_answer_to_the_discovery_participant_may_announce_its_sender() -> None:
    """On a LAN participants are not configured as peers. They answer directly once the LAN relay
    has heard a participant of the same host.
    """
    domain = make_domain(peers=())
    meet(domain)
    neighbour = b"\x01\x10" + bytes(10)
    domain.heard_outside(carried(ROBOT, spdp(neighbour, ROBOT)), LAN_RELAY.host, NOW)
    answer = spdp(B, ROBOT)
    named = (
        answer[:20]
        + submessage(0x0E, 0, domain.proxy_participants.discovery_participant.prefix)
        + answer[20:]
    )
    assert domain.heard_outside(answer, ROBOT, NOW) == []
    assert to(domain.heard_outside(named, ROBOT, NOW), INSIDE)
    assert to(domain.heard_outside(answer, ROBOT, NOW), INSIDE)
    assert domain.heard_outside(answer, STRANGER, NOW) == []


def test_who_is_gone_is_ended_outside_on_his_behalf() -> None:
    domain = make_domain()
    meet(domain), meet(domain, B, OTHER)
    taken = domain.ports.pool.free
    announced = domain.inside.by_prefix[A].announcement

    sent = domain.end_participants_at({INSIDE})

    assert [out.target for out in sent] == [out.target for out in domain.settings.to_outside(b"")]
    (ended,) = to(sent, LAN_RELAY.host)
    (announcement,) = read_discovery(ended).announcements
    assert (announcement.ended, announcement.sample.prefix, announcement.sample.sequence) == (
        True,
        A,
        next_number(announced),
    )
    assert source_vendor(ended) == A[:2]
    assert [*domain.inside.by_prefix] == [B]
    assert domain.ports.pool.free == taken + 2
    assert domain.end_participants_at({INSIDE}) == []


@pytest.mark.parametrize("is_told", [False, True], ids=["expires", "told"])
def test_a_participant_that_loses_one_of_two_networks_is_met_anew_at_the_other(
    is_told: bool,
) -> None:
    """Outside gets a dispose message with the next sequence number of the participant."""
    domain = make_domain()
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    domain.rediscovery.lan_relay_heard = True
    first = domain.inside.by_prefix[A].announcement
    elsewhere = spdp(A, OTHER)
    assert not to(domain.heard_inside(elsewhere, OTHER, NOW), ROBOT), "served at the first"
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW + 15)
    ended = domain.end_participants_at({INSIDE}) if is_told else domain.expire(NOW + 21)
    (dispose_message_of_first,) = to(ended, ROBOT)
    (announcement,) = read_discovery(dispose_message_of_first).announcements
    assert announcement.ended
    assert announcement.sample.sequence == next_number(first)

    domain.heard_inside(elsewhere, OTHER, NOW + 22)
    parted = settle(domain, NOW + 22)
    (forgets_robot,) = to(parted, OTHER)
    assert source_prefix(forgets_robot) == B
    assert read_discovery(forgets_robot).announcements[0].ended
    met = settle(domain, NOW + 22 + SEPARATION_S)
    (again,) = to(met, ROBOT)
    assert source_prefix(again) == A
    ports = {RANGE.advertised(port) for port in domain.inside.by_prefix[A].ports}
    assert {locator.port for locator in reached_at(again)} == ports
    assert [source_prefix(datagram) for datagram in to(met, OTHER)] == [B]


@pytest.mark.parametrize("count", [1, MOST_MAPPINGS])
def test_a_participant_with_other_locators_than_before_is_met_anew(count: int) -> None:
    """After a restart, a forged announcement may come before the participant's own.

    With 16 forged locators the participant got no port. Fast DDS ignores new locators of a known
    participant.
    """
    domain = make_domain(lan_relay=None, ports=LONG_RANGE)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    guid = A + bytes([0, 0, 1, 0xC1])
    others = [
        (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(INSIDE, 9000 + number), "<"))
        for number in range(count)
    ]
    forged = message(data(payload([(Pid.PARTICIPANT_GUID, guid), *others])), prefix=A)
    assert to(domain.heard_inside(forged, INSIDE, NOW), ROBOT)
    meet(domain)
    (ended,) = to(settle(domain, NOW), ROBOT)
    assert read_discovery(ended).announcements[0].ended
    (again,) = to(settle(domain, NOW + SEPARATION_S), ROBOT)
    ports = {RANGE.listen.first + p.port - RANGE.advertise.first for p in reached_at(again)}
    assert {domain.mappings.by_port[port][1].target.port for port in ports} == {7410, 7411}
    assert len(domain.mappings.by_port) <= MOST_MAPPINGS
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW + 3)
    assert not domain.inside.by_prefix[A].is_separated


def test_a_proxy_that_retires_has_both_sides_forget_each_other() -> None:
    """Participants rediscover each other by a later proxy, and Fast DDS takes no number twice."""
    domain = make_domain()
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    announced = domain.inside.by_prefix[A].announcement

    sent = domain.retire(NOW)

    (ended,) = to(sent, LAN_RELAY.host)
    (outward,) = read_discovery(ended).announcements
    (inward,) = (read_discovery(datagram).announcements[0] for datagram in to(sent, INSIDE))
    assert (outward.ended, outward.sample.prefix) == (True, A)
    assert outward.sample.sequence == next_number(announced)
    assert (inward.ended, inward.sample.prefix) == (True, B)
    assert inward.sample.sequence == next_number(spdp(B, ROBOT))
    assert not domain.inside.by_prefix
    assert domain.retire(NOW) == []


def test_who_is_gone_gets_no_port_any_more() -> None:
    domain = make_domain()
    domain.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    assert domain.former_ports.waiting

    domain.end_participants_at({INSIDE})
    settle(domain, SETTLING_PERIOD_S + ANSWER_TIMEOUT_S + 1)

    assert not domain.inside.by_prefix


def test_a_participant_that_ends_while_waiting_is_not_announced() -> None:
    """Outside would take the participant for present."""
    domain = make_domain()
    domain.former_ports.note_recorded({A: [45003]}, ())
    domain.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    domain.heard_inside(spdp(B, OTHER), OTHER, 0.1)
    domain.heard_inside(dispose_message(B), INSIDE, 0.2)  # from another address: ignored
    domain.heard_inside(dispose_message(A), INSIDE, 0.2)

    sent = settle(domain, SETTLING_PERIOD_S + ANSWER_TIMEOUT_S)

    assert {source_prefix(told) for told in to(sent, ROBOT)} == {B}
    assert domain.inside.by_prefix.keys() == {B}
    assert not domain.former_ports.recorded
    domain.heard_inside(spdp(A, INSIDE), INSIDE, 7.0)
    assert domain.former_ports.waiting.keys() == {A}


def test_no_port_of_the_range_stands_in() -> None:
    """Wherever the range lies, for the proxy listens there."""
    domain = make_domain()
    domain.heard_outside(spdp(A, ROBOT), ROBOT, NOW)
    meet(domain, B)
    (free,) = domain.stand_ins.by_port

    ports = PortRange(free - 8, free + 7)
    domain = make_domain(ports=PortMap(ports, ports))
    domain.heard_outside(spdp(A, ROBOT), ROBOT, NOW)
    meet(domain, B)

    (port,) = domain.stand_ins.by_port
    assert port not in ports
