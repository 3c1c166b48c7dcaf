"""Inside is told of participants outside, each of which is read once for all of inside."""

from collections import Counter
from typing import Any

import pytest

from rosproxy.ros2.discovery.announcements import to_inside
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.discovery.rediscovery import SEPARATION_S
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import HEADER_BYTES, source_prefix
from rosproxy.ros2.rewriting.discovery import read_discovery
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    NEAR,
    NOW,
    OTHER,
    ROBOT,
    A,
    B,
    finished,
    make_domain,
    meet,
    reached_at,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import data, message, payload, submessage

ELSEWHERE = "172.31.0.2"
"""The proxy's address on another network inside."""
INSIDERS = ((A, INSIDE), (b"\x01\x0f" + bytes([6] * 10), OTHER))


def named(number: int) -> bytes:
    return b"\x01\x0f\x55" + number.to_bytes(9, "big")


def met() -> Domain:
    """A domain with two participants on each side."""
    domain = make_domain()
    for prefix, address in INSIDERS:
        meet(domain, prefix, address)
    for number in range(2):
        domain.heard_outside(spdp(named(number), ROBOT, 9000 + number), ROBOT, NOW)
    return domain


def count_calls(monkeypatch: pytest.MonkeyPatch, name: str) -> Counter[str]:
    """Count how often the part for outside calls a function."""
    calls = Counter[str]()
    function = getattr(to_inside, name)

    def counted(*args: Any) -> Any:
        calls[name] += 1
        return function(*args)

    monkeypatch.setattr(to_inside, name, counted)
    return calls


def test_an_announcement_is_rewritten_once_for_all_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    """A datagram of 17 kB, in which 120 announced themselves to 50, took a third of a second."""
    domain = met()
    calls = count_calls(monkeypatch, "read_discovery")
    sent = domain.heard_outside(spdp(B, ROBOT, 9100), ROBOT, NOW)
    assert len(to(sent, INSIDE)) == len(to(sent, OTHER)) == 1
    assert calls["read_discovery"] == 1
    domain.heard_outside(spdp(B, ROBOT, 9100), ROBOT, NOW)
    assert calls["read_discovery"] == 1


@pytest.mark.parametrize(("padding", "repeated"), [(0, 0), (5000, 2)])
def test_an_announcement_is_rewritten_once_for_each_network(
    monkeypatch: pytest.MonkeyPatch, padding: int, repeated: int
) -> None:
    """With two networks, 256 announcements were rewritten for each new participant: 24 ms.

    The proxy keeps long announcements for a single network.
    """
    domain = met()
    near = {INSIDE: NEAR, OTHER: ELSEWHERE}
    domain.settings.proxy_address_for = near.__getitem__
    calls = count_calls(monkeypatch, "read_discovery")
    announced = spdp(B, ROBOT, 9100, padding=padding)
    domain.heard_outside(announced, ROBOT, NOW)
    assert calls["read_discovery"] == 2
    domain.heard_outside(announced, ROBOT, NOW)
    assert calls["read_discovery"] == 2 + repeated


def test_a_change_of_policy_reads_no_announcement_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading 256 long announcements again for 50 participants inside took 29 seconds."""
    domain = met()
    calls = count_calls(monkeypatch, "read_discovery")
    for insider in domain.inside.by_prefix.values():
        domain.rediscovery.separate(insider)
    finished(domain, [])
    sent = finished(domain, domain.continue_pending(NOW + SEPARATION_S), NOW + SEPARATION_S)
    told = [source_prefix(datagram) for datagram in to(sent, INSIDE)]
    assert set(told) == {named(0), named(1)}
    assert not calls


def test_each_network_gets_the_proxys_address_there() -> None:
    domain = make_domain()
    domain.settings.proxy_address_for = lambda host: NEAR if host == INSIDE else ELSEWHERE
    for prefix, address in INSIDERS:
        meet(domain, prefix, address)
    for _ in range(2):
        sent = domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
        hosts = [reached_at(to(sent, address)[0])[0].host for address in (INSIDE, OTHER)]
        assert hosts == [NEAR, ELSEWHERE]


def test_an_announcement_inside_follows_the_stand_in_and_the_announcement() -> None:
    domain = met()
    first, *_ = to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW), INSIDE)
    (blocked, _) = reached_at(first)
    domain.stand_ins.block(blocked.port)
    second, *_ = to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW), INSIDE)
    assert reached_at(second)[0].port != blocked.port
    third, *_ = to(domain.heard_outside(spdp(B, ROBOT, 9300), ROBOT, NOW), INSIDE)
    assert reached_at(third)[1] == HostPort(ROBOT, 9301)


def test_inside_is_told_what_a_participant_announces_of_itself_alone() -> None:
    """Heartbeats for the discovery participant must not reach participants inside."""
    domain = met()
    stamp = submessage(0x09, 0, bytes(8))
    locator = pack_locator(HostPort(ROBOT, 9000), "<")
    announced = data(payload([(Pid.METATRAFFIC_UNICAST_LOCATOR, locator)]))
    meant = submessage(0x0E, 0, domain.proxy_participants.discovery_participant.prefix)
    heartbeat = submessage(0x07, 0, bytes(28))
    datagram = message(meant, heartbeat, stamp, announced, heartbeat, prefix=B)
    (told,) = to(domain.heard_outside(datagram, ROBOT, NOW), INSIDE)
    assert len(told) == HEADER_BYTES + len(stamp) + len(announced)
    assert told[HEADER_BYTES : HEADER_BYTES + len(stamp)] == stamp
    assert read_discovery(told).of_participant is not None
