"""Direction both: stand-ins for the locators of participants outside, and for nothing else."""

import struct
from itertools import count, islice
from math import inf

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.ports.locator_ports import order_for
from rosproxy.ros2.ports.stand_ins import MOST_SHARING
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.registry.participants import TrafficKind
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import STAND_IN_PORTS
from tests.unit.ros2.discovery import domains
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    LAN_RELAY,
    NEAR,
    NOW,
    OTHER,
    ROBOT,
    SEDP_WRITERS,
    STRANGER,
    A,
    B,
    carried,
    make_domain,
    meet,
    reached_at,
    sedp,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import fragment, message, payload, submessage

USER = message(submessage(0x07, 0, bytes(28)), prefix=A)


def both_ways() -> Domain:
    domain = domains.make_domain(both_ways=True)
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    return domain


def stand_in(domain: Domain, kind: TrafficKind) -> int:
    (mapping,) = [
        mapping for mapping in domain.outside.by_prefix[B].mappings.values() if mapping.kind is kind
    ]
    return mapping.port


def test_inside_is_told_of_stand_ins_alone() -> None:
    domain = both_ways()
    (told,) = to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW), INSIDE)
    meta, user = reached_at(told)
    assert meta == HostPort(NEAR, stand_in(domain, TrafficKind.METATRAFFIC))
    assert user == HostPort(NEAR, stand_in(domain, TrafficKind.USER_DATA))


def test_locators_of_readers_and_writers_get_one_too() -> None:
    domain = both_ways()
    (port,) = [
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7410
    ]
    (sent,) = domain.at_range_port(port, sedp(B, ROBOT, 7000), ROBOT, NOW)
    (locator,) = reached_at(sent.datagram)
    assert locator.host == NEAR
    (passed,) = domain.at_stand_in(locator.port, USER, INSIDE, NOW)
    assert passed.target == HostPort(ROBOT, 7000)


def test_what_inside_sends_goes_on_as_it_is() -> None:
    domain = both_ways()
    (sent,) = domain.at_stand_in(stand_in(domain, TrafficKind.USER_DATA), USER, INSIDE, NOW)
    assert (sent.target, sent.datagram) == (HostPort(ROBOT, 7411), USER)
    assert domain.at_stand_in(stand_in(domain, TrafficKind.USER_DATA), USER, OTHER, NOW) == []


def test_no_locator_leads_to_another_host() -> None:
    domain = domains.make_domain(both_ways=True)
    meet(domain)
    datagram = spdp(B, ROBOT).replace(bytes([10, 0, 0, 9]), bytes([10, 0, 0, 8]))
    domain.heard_outside(datagram, ROBOT, NOW)
    (port,) = [
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7410
    ]
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (sent,) = domain.at_range_port(port, sedp(B, "10.0.0.8", 7000), ROBOT, NOW)
    assert reached_at(sent.datagram) == []


def test_after_a_restart_the_discovery_participant_learns_which_ones_there_are() -> None:
    before = both_ways()
    after = both_ways()
    (port,) = [
        p for p, (_, mapping) in before.mappings.by_port.items() if mapping.target.port == 7410
    ]
    before.at_range_port(port, sedp(B, ROBOT, 7000), ROBOT, NOW)
    after.heard_outside(
        sedp(B, ROBOT, 7000, to=after.proxy_participants.discovery_participant.prefix), ROBOT, NOW
    )
    assert after.stand_ins.by_port.keys() == before.stand_ins.by_port.keys()
    (endpoint,) = after.outside.by_prefix[B].endpoints.values()
    assert endpoint.topic == "rt/chatter"


def test_ports_are_given_back() -> None:
    domain = both_ways()
    domain.expire(NOW + 21)
    assert not domain.stand_ins.by_port


def test_a_port_that_is_taken_is_left_alone() -> None:
    domain = both_ways()
    port = stand_in(domain, TrafficKind.USER_DATA)
    domain.stand_ins.block(port)
    (told,) = to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW), INSIDE)
    _, user = reached_at(told)
    assert user.port not in (port, 0)
    assert port not in domain.stand_ins.by_port


def test_some_may_share_a_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "rosproxy.ros2.ports.stand_ins.order_for", lambda key, ports: iter([20_000])
    )
    domain = domains.make_domain(both_ways=True)
    meet(domain)
    for number in range(MOST_SHARING + 1):
        domain.heard_outside(
            spdp(bytes([9, number]) + B[2:], ROBOT, 7410 + 10 * number), ROBOT, NOW
        )
    sent = domain.at_stand_in(20_000, sedp(A, INSIDE, 7000), INSIDE, NOW)
    assert {out.target.port for out in sent} == {7410, 7411, 7420}
    named = sedp(A, INSIDE, 7001, to=bytes([9, 1]) + B[2:])
    sent = domain.at_stand_in(20_000, named, INSIDE, NOW)
    assert {out.target.port for out in sent if out.target.host == ROBOT} == {7420}
    elsewhere = sedp(A, INSIDE, 7001, to=bytes(range(12)))
    assert domain.at_stand_in(20_000, elsewhere, INSIDE, NOW) == []


def test_joined_fragments_go_to_the_reader_that_these_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "rosproxy.ros2.ports.stand_ins.order_for", lambda key, ports: iter([20_000])
    )
    domain = domains.make_domain()
    readers = (bytes([9, 1]) + B[2:], bytes([9, 2]) + B[2:])
    meet(domain)
    for number, reader in enumerate(readers):
        domain.heard_outside(spdp(reader, ROBOT, 7420 + 10 * number), ROBOT, NOW)
    whole = payload([(Pid.TOPIC_NAME, struct.pack("<I", 200) + bytes([65] * 199) + bytes(1))])
    sent = list[Outgoing]()
    for number, chunk in enumerate((whole[:128], whole[128:]), 1):
        for reader in readers:
            part = fragment(chunk, number, 128, len(whole), writer=SEDP_WRITERS)
            datagram = message(submessage(0x0E, 0, reader), part, prefix=A)
            sent += domain.at_stand_in(20_000, datagram, INSIDE, NOW)
    to_each = {
        reader: [out.target.port for out in sent if destination(out.datagram) == reader]
        for reader in readers
    }
    assert to_each == {readers[0]: [7420], readers[1]: [7430]}


def test_who_is_not_named_has_not_been_met(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "rosproxy.ros2.ports.stand_ins.order_for", lambda key, ports: iter([20_000])
    )
    domain = domains.make_domain()
    readers = (bytes([9, 1]) + B[2:], bytes([9, 2]) + B[2:])
    meet(domain)
    for number, reader in enumerate(readers):
        domain.heard_outside(spdp(reader, ROBOT, 7420 + 10 * number), ROBOT, NOW)
    domain.inside.by_prefix[A].dispose_message_times = dict.fromkeys(readers, NOW)
    domain.at_stand_in(20_000, sedp(A, INSIDE, 7001), INSIDE, NOW)
    assert domain.inside.by_prefix[A].dispose_message_times == dict.fromkeys(readers, NOW)
    domain.at_stand_in(20_000, sedp(A, INSIDE, 7001, to=readers[1]), INSIDE, NOW)
    assert domain.inside.by_prefix[A].dispose_message_times == {readers[0]: NOW, readers[1]: inf}


def test_a_port_that_can_not_be_had_now_may_be_had_later() -> None:
    """A lack of sockets must not block ports for ever."""
    domain = both_ways()
    port = stand_in(domain, TrafficKind.USER_DATA)
    domain.stand_ins.block(port, for_good=False)
    assert port not in domain.stand_ins.by_port
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    assert port in domain.stand_ins.by_port


def test_forged_participants_do_not_take_the_port_of_a_peer_before_it_comes() -> None:
    """After a restart Fast DDS inside went on sending to the port that these had taken."""
    (before,) = told_port(make_domain())
    wanted = f"{STRANGER}:7410"
    prefixes = (b"\x01\x0f" + number.to_bytes(10, "big") for number in count())
    chosen = (
        p for p in prefixes if next(order_for(f"{p.hex()} {wanted}", STAND_IN_PORTS)) == before
    )
    domain = make_domain()
    meet(domain)
    for prefix in islice(chosen, MOST_SHARING):
        domain.heard_outside(carried(STRANGER, spdp(prefix, STRANGER)), LAN_RELAY.host, NOW)
    assert len(domain.stand_ins.by_port[before]) == MOST_SHARING
    assert told_port(domain) == [before]


def told_port(domain: Domain) -> list[int]:
    """The ports at which inside is told that the peer gets discovery."""
    meet(domain)
    told = to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW), INSIDE)
    return [reached_at(datagram)[0].port for datagram in told]
