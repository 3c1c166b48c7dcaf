"""Hostile datagrams: none breaks a domain, costs much time, or passes the policy."""

import struct
from collections.abc import Iterator
from sys import getsizeof
from typing import NoReturn

import pytest

from rosproxy.ros2.discovery import domain as discovery_domain
from rosproxy.ros2.discovery.announcements.to_outside import ForOutside
from rosproxy.ros2.discovery.domain import MOST_ENDED_PER_CALL
from rosproxy.ros2.discovery.rediscovery import SEPARATION_S
from rosproxy.ros2.domain_settings import MOST_PER_ADDRESS, MOST_PER_HOST, MOST_WAITING
from rosproxy.ros2.ports import locator_ports
from rosproxy.ros2.ports.former_ports import ANSWER_TIMEOUT_S
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import LAST_SEQUENCE_NUMBER, RtpsError
from rosproxy.ros2.registry import participants
from rosproxy.ros2.registry.participants import (
    DdsEndpoint,
    EndpointKind,
    EndpointNotes,
    OutsideParticipant,
    Participant,
    PortMapping,
)
from rosproxy.ros2.rewriting import discovery
from rosproxy.ros2.sources.rates import BURST
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import RuleKind
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
    SEDP_WRITERS,
    STRANGER,
    A,
    B,
    carried,
    dispose_message,
    kept_answer,
    make_domain,
    meet,
    prove,
    sedp,
    settle,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import data, fragment, message, payload, submessage

TOPIC = (Pid.TOPIC_NAME, struct.pack("<I", 11) + b"rt/chatter\0\0")


def heartbeat(first: int, last: int) -> bytes:
    body = struct.pack(">II", 0, SEDP_WRITERS)
    for number in (first, last):
        body += struct.pack("<iI", number >> 32, number & 0xFFFFFFFF)
    return submessage(0x07, 0, body + bytes(4))


def test_a_number_that_has_no_next_one_is_malformed() -> None:
    """The proxy could write no GAP, answer or dispose message, and applied no policy any more."""
    domain = make_domain(judge=lambda kind, *_: kind is not RuleKind.PUBLISH)
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (stand_in,) = domain.stand_ins.by_port
    last = data(payload([TOPIC]), writer=SEDP_WRITERS, sequence=LAST_SEQUENCE_NUMBER)
    over = data(payload([TOPIC]), writer=SEDP_WRITERS, sequence=LAST_SEQUENCE_NUMBER + 1)
    below = data(payload([TOPIC]), writer=SEDP_WRITERS, sequence=-1)
    assert domain.at_stand_in(stand_in, message(last, prefix=A), INSIDE, NOW)
    for bad in (over, below, heartbeat(1, LAST_SEQUENCE_NUMBER + 1)):
        before = domain.refused.count
        assert domain.heard_inside(message(bad, prefix=A), INSIDE, NOW) == []
        assert domain.refused.count == before + 1
    assert domain.heard_inside(message(heartbeat(1, LAST_SEQUENCE_NUMBER), prefix=A), INSIDE, NOW)
    assert to(domain.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW), ROBOT)


def test_the_policy_judges_submessages_behind_an_announcement() -> None:
    """Behind a dispose message, too, and in both directions."""
    domain = make_domain(judge=lambda *_: False)
    meet(domain)
    behind = data(payload([TOPIC]), writer=SEDP_WRITERS)
    (told,) = to(domain.heard_outside(spdp(B, ROBOT) + behind, ROBOT, NOW), INSIDE)
    assert len(told) == len(spdp(B, ROBOT))
    (ended,) = to(domain.heard_inside(dispose_message(A) + behind, INSIDE, NOW), ROBOT)
    for sent in (told, ended):
        assert b"chatter" not in sent
    assert not domain.inside.by_prefix


def test_what_stands_behind_an_announcement_does_not_outlast_a_change_of_the_policy() -> None:
    """The proxy announces a participant anew after the change, with what was allowed before."""
    allowed = True
    domain = make_domain(judge=lambda *_: allowed)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    behind = data(payload([TOPIC]), writer=SEDP_WRITERS)
    domain.heard_inside(spdp(A, INSIDE) + behind, INSIDE, NOW)
    allowed = False
    sent = domain.apply_policy(NOW)
    sent += domain.continue_pending(NOW + SEPARATION_S + 1)
    announced = spdp(A, HOST)
    assert [told for told in to(sent, ROBOT) if len(told) == len(announced)]
    assert not any(b"chatter" in told for told in to(sent, ROBOT))


@pytest.mark.parametrize("count", [1, 2])
def test_fragments_behind_an_announcement_are_not_passed_unread(count: int) -> None:
    """The proxy must not keep the fragments for later participants either."""
    whole = payload([TOPIC, (0x8000, bytes(200))])
    size = len(whole) // count
    behind = b"".join(
        fragment(whole[at : at + size], 1 + at // size, size, len(whole), writer=SEDP_WRITERS)
        for at in range(0, len(whole), size)
    )
    domain = make_domain(judge=lambda *_: False)
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (mapping, *_) = domain.inside.by_prefix[A].mappings.values()
    sent = domain.heard_inside(spdp(A, INSIDE) + behind, INSIDE, NOW)
    sent += domain.heard_inside(dispose_message(A) + behind, INSIDE, NOW)
    sent += domain.heard_outside(spdp(B, ROBOT) + behind, ROBOT, NOW)
    sent += domain.heard_outside(
        carried(STRANGER, spdp(EVIL, STRANGER) + behind), LAN_RELAY.host, NOW
    )
    sent += domain.at_range_port(mapping.port, spdp(B, ROBOT) + behind, ROBOT, NOW)
    assert domain.refused.count == 5
    sent += domain.heard_outside(dispose_message(B) + behind, ROBOT, NOW)
    sent += meet(domain, EVIL, OTHER)
    sent += settle(domain, NOW)
    assert sent
    assert not any(b"chatter" in told.datagram for told in sent)


def test_fragments_are_judged_anew_by_another_policy() -> None:
    allowed = True
    domain = make_domain(judge=lambda *_: allowed)
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (stand_in,) = domain.stand_ins.by_port
    whole = payload([TOPIC, (0x8000, bytes(100))])
    data_frag = fragment(whole, 1, 200, len(whole), writer=SEDP_WRITERS)
    datagram = message(data_frag, prefix=A)
    (sent,) = domain.at_stand_in(stand_in, datagram, INSIDE, NOW)
    assert b"chatter" in sent.datagram
    allowed = False
    domain.apply_policy(NOW)
    settle(domain, NOW + SEPARATION_S)
    (sent,) = domain.at_stand_in(stand_in, datagram, INSIDE, NOW)
    assert b"chatter" not in sent.datagram


def shared_message(prefixes: list[bytes], *in_front: bytes, to_each: bytes) -> bytes:
    """A message in which many participants speak."""
    parts = [
        submessage(0x0C, 0, bytes(4) + b"\x02\x03\x01\x0f" + prefix) + to_each
        for prefix in prefixes
    ]
    return message(*in_front, *parts, prefix=prefixes[0])


def test_what_is_split_is_not_multiplied() -> None:
    """A long INFO_DST went into each part: 65 kB became seven megabytes."""
    domain = make_domain()
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (stand_in,) = domain.stand_ins.by_port
    info_dst = submessage(0x0E, 0, B + bytes(55_000))
    datagram = shared_message([A] * 120, info_dst, to_each=heartbeat(1, 2))
    sent = domain.at_stand_in(stand_in, datagram, INSIDE, NOW)
    assert len(sent) == 121
    assert sum(len(out.datagram) for out in sent) <= 1.5 * len(datagram)


@pytest.mark.parametrize("is_at_range_port", [False, True])
@pytest.mark.parametrize("size", [12, 9000])
def test_an_unproven_participant_has_no_credit_for_copies(
    is_at_range_port: bool, size: int
) -> None:
    """The parts of a split message must not count as received. Otherwise a victim gets 30 times the
    bytes that came in its name.
    """
    domain = make_domain(peers=[])
    domain.heard_outside(carried(STRANGER, spdp(B, STRANGER)), LAN_RELAY.host, NOW)
    meet(domain)
    (port, *_) = domain.mappings.by_port
    info_dst = submessage(0x0E, 0, bytes([7]) * size)
    datagram = shared_message([B] * 100, info_dst, to_each=heartbeat(1, 0))
    if is_at_range_port:
        domain.at_range_port(port, datagram, STRANGER, NOW)
    else:
        domain.heard_outside(datagram, STRANGER, NOW)
    assert len(datagram) < domain.outside.by_prefix[B].credit
    assert domain.outside.by_prefix[B].credit <= len(datagram) + len(spdp(B, STRANGER))


def test_an_exhausted_range_is_not_searched_for_each_locator(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A datagram with two thousand locators blocked the proxy for 140 ms."""
    domain = make_domain()
    ordered = list[str]()

    def order_for(key: str, ports: PortRange) -> Iterator[int]:
        ordered.append(key)
        return iter(ports.ports())

    monkeypatch.setattr(locator_ports, "order_for", order_for)
    locators = [
        (Pid.UNICAST_LOCATOR, pack_locator(HostPort(INSIDE, 1000 + number), "<"))
        for number in range(400)
    ]
    prove(domain, INSIDE)
    meet(domain)
    long = message(data(payload([TOPIC, *locators]), writer=SEDP_WRITERS), prefix=A)
    domain.heard_inside(long, INSIDE, NOW)
    assert len(set(ordered)) == 14  # the limit of an address


def test_one_address_leaves_ports_for_others() -> None:
    """Even if the address has as many participants as allowed."""
    domain = make_domain()
    prefixes = [bytes([1, 15, number]) + bytes(9) for number in range(30)]
    prove(domain, INSIDE, OTHER, prefixes=[*prefixes, B])
    for number, prefix in enumerate(prefixes):
        domain.heard_inside(spdp(prefix, INSIDE, 7410 + 10 * number), INSIDE, NOW)
    assert domain.ports.pool.free == 1  # of 16: one is for discovery, 14 the limit of an address
    assert "as many" in domain.mappings.shortages[prefixes[-1]].text
    meet(domain, B, OTHER)
    assert len(domain.inside.by_prefix[B].mappings) == 1


def test_no_port_of_the_range_leads_to_the_range() -> None:
    """A datagram there never ended: a process on the proxy's own machine could do that."""
    domain = make_domain()
    domain.heard_inside(spdp(A, NEAR, RANGE.listen.first + 2), NEAR, NOW)
    assert not domain.mappings.by_port
    domain.heard_inside(spdp(B, NEAR, 7410), NEAR, NOW)
    assert len(domain.mappings.by_port) == 2


def test_users_data_of_before_a_restart_is_not_charged() -> None:
    domain = make_domain()
    user = message(submessage(0x07, 0, bytes(28)), prefix=B)
    for _ in range(int(BURST) + 5):
        domain.at_range_port(45007, user, ROBOT, 0.5)
    assert domain.heard_outside(spdp(B, ROBOT), ROBOT, 0.6)
    assert B in domain.outside.by_prefix


def test_announcements_and_topics_have_a_length() -> None:
    """The proxy keeps them: with 64 kB each, a single address could take gigabytes."""
    domain = make_domain()
    meet(domain)
    long = message(data(payload([(Pid.TOPIC_NAME, bytes(2000))])), prefix=B)
    filled = message(submessage(0x01, 0, bytes(9000)), prefix=B) + spdp(B, INSIDE)[20:]
    named = payload([(Pid.TOPIC_NAME, struct.pack("<I", 2000) + b"a" * 2000)])
    for bad in (long, filled, message(data(named, writer=SEDP_WRITERS), prefix=A)):
        before = domain.refused.count
        assert domain.heard_inside(bad, INSIDE, NOW) == []
        assert domain.refused.count == before + 1
    assert domain.inside.by_prefix.keys() == {A}


def test_the_texts_of_an_address_take_so_many_bytes() -> None:
    """In Python a wide character makes each character take four bytes: 8,192 texts took 34 MB."""
    notes = EndpointNotes()
    many = [Participant(bytes([n]) * 12, INSIDE, b"", 0) for n in range(4)]
    for participant in many:
        for number in range(2048):
            name = f"\U0001f600{number:05d}" + "x" * 250
            endpoint = DdsEndpoint(EndpointKind.READER, name, f"{name} ")
            notes.note(participant, number.to_bytes(4, "big"), endpoint)
    kept = [endpoint for participant in many for endpoint in participant.endpoints.values()]
    texts = [text for endpoint in kept for text in (endpoint.topic, endpoint.type_name)]
    assert kept
    assert sum(map(getsizeof, texts)) <= 4 * 1024 * 1024


def test_readers_and_writers_of_an_address_have_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    end = DdsEndpoint(EndpointKind.READER, "t", "T")
    monkeypatch.setattr(participants, "MOST_ENDPOINT_BYTES_PER_ADDRESS", 5 * end.size)
    notes = EndpointNotes()
    many = [Participant(bytes([n]) * 12, INSIDE, b"", 0) for n in range(9)]
    for participant in many:
        notes.note(participant, b"0001", end)
        notes.note(participant, b"0001", end)
    assert [len(participant.endpoints) for participant in many] == [1] * 5 + [0] * 4
    notes.note(many[0], b"0001", None)
    notes.note(many[8], b"0001", end)
    assert (
        notes.size
        == notes.size_by_address[INSIDE]
        == sum(len(participant.endpoints) for participant in many) * end.size
        == 5 * end.size
    )
    for participant in many:
        notes.forget(participant)
    assert (notes.size, notes.size_by_address) == (0, {})


def test_one_address_does_not_keep_others_from_waiting_after_a_start() -> None:
    domain = make_domain()
    for number in range(MOST_WAITING + 1):
        domain.heard_inside(spdp(number.to_bytes(12, "big"), INSIDE), INSIDE, 0.1)
    assert len(domain.former_ports.waiting) == MOST_PER_ADDRESS
    assert domain.heard_inside(spdp(A, OTHER), OTHER, 0.2)
    assert A in domain.former_ports.waiting
    settle(domain, 0.2 + ANSWER_TIMEOUT_S)
    assert not domain.former_ports.waiting
    assert domain.heard_inside(spdp(B, INSIDE), INSIDE, 6.0)


def test_one_host_outside_does_not_keep_others_from_being_met() -> None:
    domain = make_domain(peers=(ROBOT, STRANGER))
    for number in range(MOST_PER_HOST + 9):
        domain.heard_outside(spdp(number.to_bytes(12, "big"), ROBOT), ROBOT, NOW)
    assert len(domain.outside.by_prefix) == MOST_PER_HOST
    domain.heard_outside(spdp(B, STRANGER), STRANGER, NOW)
    assert B in domain.outside.by_prefix
    for _ in range(MOST_PER_HOST // MOST_ENDED_PER_CALL + 1):
        domain.expire(NOW + 21)
    assert not domain.outside.count_by_address


def test_the_lan_relay_proves_no_address() -> None:
    """Otherwise a program on the LAN relay's host could make the proxy send to any address."""
    domain = make_domain(peers=())
    domain.proxy_participants.discovery_participant.prefix = bytes([7]) * 12
    meet(domain)
    domain.heard_outside(carried(ROBOT, spdp(B, ROBOT)), LAN_RELAY.host, NOW)
    answer = sedp(B, ROBOT, 7411, to=domain.proxy_participants.discovery_participant.prefix)
    domain.heard_outside(carried(ROBOT, answer), LAN_RELAY.host, NOW)
    assert not domain.outside.by_prefix[B].has_answered
    domain.heard_outside(answer, ROBOT, NOW)
    assert domain.outside.by_prefix[B].has_answered
    assert not domain.outside.by_prefix[B].proven


def test_who_waits_does_not_take_the_prefix_of_somebody_met_meanwhile() -> None:
    domain = make_domain()
    domain.heard_inside(spdp(B, INSIDE), INSIDE, 0.1)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, 0.2)
    settle(domain, 0.1 + ANSWER_TIMEOUT_S)
    assert B in domain.outside.by_prefix
    assert B not in domain.inside.by_prefix


def test_an_announcement_that_names_half_a_destination_hinders_no_policy() -> None:
    """Keeping such an announcement made every later change of the policy fail."""
    denied: list[str] = []
    domain = make_domain(judge=lambda _kind, name, _address: name not in denied)
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    evil = b"\x01\x0f" + bytes([0x5A] * 10)
    told = payload(
        [
            (Pid.PARTICIPANT_GUID, evil + bytes([0, 0, 1, 0xC1])),
            (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(STRANGER, 7410), "<")),
        ]
    )
    for size in (0, 4, 11):
        half = message(submessage(0x0E, 0, bytes(size)), data(told), prefix=evil)
        domain.heard_outside(carried(STRANGER, half), LAN_RELAY.host, NOW)
        domain.heard_inside(half, OTHER, NOW)
    assert evil not in {*domain.outside.by_prefix, *domain.inside.by_prefix}
    denied.append("/chatter")
    domain.apply_policy(NOW)


EVIL = b"\x01\x0f" + bytes([0x5A] * 10)
NAMELESS = data(payload([]), writer=SEDP_WRITERS)
"""A reader or writer without a topic, in 28 bytes: too short to become a GAP."""


@pytest.mark.parametrize(
    "behind",
    [NAMELESS, data(payload([(Pid.TOPIC_NAME, b"\1\0\0\0\0\0\0\0")]), writer=SEDP_WRITERS)],
)
def test_a_writer_without_a_topic_is_refused_without_harm(behind: bytes) -> None:
    """Once the proxy admitted the participant of a hidden writer without a topic. Every later
    change of the policy and every announcement of others then failed.
    """
    denied = [""]
    domain = make_domain(judge=lambda _kind, name, _address: name not in denied)
    domain.heard_inside(spdp(EVIL, INSIDE) + behind, INSIDE, NOW)
    domain.heard_outside(spdp(EVIL, ROBOT) + behind, ROBOT, NOW)
    domain.heard_outside(carried(STRANGER, spdp(EVIL, STRANGER) + behind), LAN_RELAY.host, NOW)
    assert (domain.refused.count, domain.mappings.by_port) == (3, {})
    assert EVIL not in {*domain.inside.by_prefix, *domain.outside.by_prefix}
    meet(domain, A, OTHER)
    assert to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW), OTHER)
    (stand_in,) = domain.stand_ins.by_port
    domain.at_stand_in(stand_in, sedp(A, OTHER, 7000), OTHER, NOW)
    denied.append("/chatter")
    assert domain.apply_policy(NOW)
    assert settle(domain, NOW + SEPARATION_S)


def test_an_announcement_that_cannot_be_rewritten_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(_: object) -> None:
        raise RtpsError("it can't be withheld")

    domain = make_domain(judge=lambda *_: False)
    monkeypatch.setattr(discovery, "withheld", refuse)
    behind = data(payload([TOPIC]), writer=SEDP_WRITERS)
    domain.heard_inside(spdp(EVIL, INSIDE) + behind, INSIDE, NOW)
    domain.heard_outside(spdp(EVIL, ROBOT) + behind, ROBOT, NOW)
    assert not domain.inside.by_prefix
    assert not domain.mappings.by_port
    assert not domain.outside.by_prefix
    assert meet(domain)
    assert to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW), INSIDE)
    before = domain.outside.by_prefix[B].announcement
    domain.heard_outside(spdp(B, ROBOT) + behind, ROBOT, NOW)
    assert domain.outside.by_prefix[B].announcement == before


def test_one_whose_announcement_is_bad_keeps_no_policy_from_others() -> None:
    denied: list[str] = []
    domain = make_domain(judge=lambda _kind, name, _address: name not in denied)
    meet(domain, EVIL, INSIDE)
    meet(domain, A, OTHER)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (stand_in,) = domain.stand_ins.by_port
    domain.at_stand_in(stand_in, sedp(EVIL, INSIDE, 7000), INSIDE, NOW)
    domain.at_stand_in(stand_in, sedp(A, OTHER, 7000), OTHER, NOW)
    domain.inside.by_prefix[EVIL].announcement = b"no RTPS message"
    denied.append("/chatter")
    domain.apply_policy(NOW)
    assert domain.inside.by_prefix[A].is_separated
    assert spdp(A, OTHER)[:20] in {
        told[:20] for told in to(settle(domain, NOW + SEPARATION_S), ROBOT)
    }
    assert not domain.inside.by_prefix[A].is_separated


def test_one_outside_whose_announcement_is_bad_keeps_none_inside_apart() -> None:
    domain = make_domain()
    meet(domain, EVIL, INSIDE)
    meet(domain, A, OTHER)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    for insider in domain.inside.by_prefix.values():
        domain.rediscovery.separate(insider)
    domain.go_on(NOW)
    domain.outside.by_prefix[B].announcement = b"no RTPS message"
    settle(domain, NOW + SEPARATION_S)
    assert not any(insider.is_separated for insider in domain.inside.by_prefix.values())


def test_a_new_port_looks_at_no_other_locators(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each new port looked at all ports of the address: a datagram took 0.85 s."""
    domain = make_domain(ports=PortMap(PortRange(45000, 45999), PortRange(45000, 45999)))
    count = 30
    for number in range(count):
        domain.heard_inside(spdp(bytes([1, 15, 7, number, *bytes(8)]), INSIDE, 7000), INSIDE, NOW)
        port = 8000 + 2 * number
        domain.heard_inside(spdp(bytes([1, 15, 8, number, *bytes(8)]), INSIDE, port), INSIDE, NOW)
    looks = list[PortMapping]()
    reads_discovery_at = Participant.reads_discovery_at

    def counted(participant: Participant, mapping: PortMapping) -> bool:
        looks.append(mapping)
        return reads_discovery_at(participant, mapping)

    monkeypatch.setattr(Participant, "reads_discovery_at", counted)
    domain.heard_inside(spdp(EVIL, INSIDE, 9000), INSIDE, NOW)
    assert len(looks) <= 2


def test_answers_of_participants_that_get_no_place_are_forgotten() -> None:
    """If few ports were free, a container could fill the memory with answers of made-up ones."""
    domain = make_domain()
    others = [bytes([1, 15, 7, number, *bytes(8)]) for number in range(6)]
    prove(domain, OTHER, prefixes=others)
    for number, prefix in enumerate(others):
        domain.heard_inside(spdp(prefix, OTHER, 7000 + 2 * number), OTHER, NOW)
    for number in range(100):
        prefix = bytes([1, 15, 8, number, *bytes(8)])
        domain.heard_inside(spdp(prefix, INSIDE), INSIDE, NOW)
        domain.heard_inside(kept_answer(domain, prefix, 99), INSIDE, NOW)
        settle(domain, NOW)
    assert domain.inside.by_prefix.keys() == set(others)
    store = domain.proxy_participants.port_store
    assert not store._answers
    assert store._counts.keys() <= set(others)
    assert not domain.ports._ports_claimed


def test_what_waits_is_kept_as_it_came() -> None:
    """An announcement of 6 kB took 270 kB after reading it, and 512 of them 138 MB."""
    domain = make_domain()
    padding = [(Pid.PAD, b"")] * 500
    locator = (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(INSIDE, 7410), "<"))
    datagram = message(*[data(payload([locator, *padding]))] * 3, prefix=EVIL)
    assert domain.heard_inside(datagram, INSIDE, 0.1)
    (waiting,) = domain.former_ports.waiting.values()
    assert {type(value) for value in waiting} == {str, bytes, HostPort, float}
    assert waiting.datagram == datagram


def test_one_that_waits_and_is_malformed_keeps_no_others_waiting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    domain = make_domain()
    domain.heard_inside(spdp(EVIL, INSIDE), INSIDE, 0.1)
    domain.heard_inside(spdp(A, OTHER), OTHER, 0.1)
    rewritten = ForOutside.rewritten

    def refusing(for_outside: ForOutside, told: discovery.DiscoveryMessage) -> bytes:
        if for_outside.insider.prefix == EVIL:
            raise RtpsError("malformed")
        return rewritten(for_outside, told)

    monkeypatch.setattr(ForOutside, "rewritten", refusing)
    assert to(settle(domain, 0.1 + ANSWER_TIMEOUT_S), ROBOT)
    assert domain.inside.by_prefix[A].mappings


def test_of_strangers_nothing_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forged sources have an allowance each."""
    domain = make_domain()
    meet(domain)
    monkeypatch.setattr(discovery_domain, "read_messages", None)
    domain.heard_outside(spdp(B, STRANGER), STRANGER, NOW)
    for port in domain.mappings.by_port:
        domain.at_range_port(port, message(prefix=B), STRANGER, NOW)
    assert STRANGER not in domain.rates._by_source


class Unwalked(dict[bytes, OutsideParticipant]):
    """A table that no caller may walk through."""

    def values(self) -> NoReturn:
        raise AssertionError


def test_the_participants_at_an_address_are_found_without_the_others() -> None:
    """An answer, and an announcement for each peer, walked through up to 1,792 participants."""
    domain = make_domain()
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    domain.outside.by_prefix = Unwalked(domain.outside.by_prefix)
    assert domain.outside.at(ROBOT) == [domain.outside.by_prefix[B]]
    assert domain.outside.at(STRANGER) == []
    domain.heard_outside(dispose_message(B), ROBOT, NOW)
    assert domain.outside.at(ROBOT) == []


class Counted(tuple[HostPort, ...]):
    """Peers that count how often a caller walks through them."""

    walks = 0

    def __iter__(self) -> Iterator[HostPort]:
        Counted.walks += 1
        return super().__iter__()


def test_whether_an_address_is_a_peers_is_known_without_the_other_peers() -> None:
    """With 256 peers each check took 16 us, and a datagram needs six."""
    settings = make_domain().settings
    for peers in ((ROBOT, OTHER), (STRANGER,)):
        settings.peers = Counted(HostPort(peer, 0) for peer in peers)
        for address in (ROBOT, OTHER, STRANGER):
            assert settings.is_peer(address) is (address in peers)
    assert Counted.walks == 2
