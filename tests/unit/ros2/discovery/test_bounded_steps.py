"""Many participants inside discover many outside: a few at a time, and all in the end."""

from collections import Counter
from functools import partial
from itertools import chain

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.discovery.rediscovery import (
    MOST_PAIRS_PER_PART,
    MOST_VERDICTS_PER_PART,
    SEPARATION_S,
)
from rosproxy.ros2.domain_settings import (
    MOST_DATAGRAMS_PER_PART,
    MOST_MAPPINGS,
    MOST_PER_ADDRESS,
    PARTICIPANTS_TRIED,
    Outgoing,
)
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import source_prefix
from rosproxy.ros2.rewriting.discovery import read_discovery
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.ports import PortMap, PortRange
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    NOW,
    OTHER,
    ROBOT,
    A,
    dispose_message,
    finished,
    make_domain,
    meet,
    sedp,
    spdp,
)
from tests.unit.ros2.protocol.messages import data, message, payload

OUTSIDE_COUNT = 100
INSIDE_COUNT = 20
LONG_RANGE = PortMap(PortRange(45000, 45999), PortRange(45000, 45999))


class Policy:
    """A policy with the same verdict for everything. `count` is the number of questions."""

    def __init__(self) -> None:
        self.allows = True
        self.count = 0

    def __call__(self, kind: RuleKind, name: str, address: str) -> bool:
        self.count += 1
        return self.allows


def inside(number: int) -> bytes:
    return b"\x01\x0f\x01" + number.to_bytes(9, "big")


def outside(number: int) -> bytes:
    return b"\x01\x0f\x02" + number.to_bytes(9, "big")


def crowd(policy: Policy) -> Domain:
    """A domain with many participants at an inside address, one at another, and many outside."""
    domain = make_domain(judge=policy, ports=LONG_RANGE)
    for number in range(OUTSIDE_COUNT):
        domain.heard_outside(spdp(outside(number), ROBOT, 4000 + number), ROBOT, NOW)
    for number in range(INSIDE_COUNT):
        domain.heard_inside(spdp(inside(number), INSIDE, 7000 + 2 * number), INSIDE, NOW)
    meet(domain, A, OTHER)
    (stand_in, *_) = domain.stand_ins.by_port
    for prefix, insider in domain.inside.by_prefix.items():
        domain.at_stand_in(stand_in, sedp(prefix, insider.address, 7000), insider.address, NOW)
    return domain


def parts(domain: Domain, first: list[Outgoing], now: float) -> list[list[Outgoing]]:
    every = [first]
    while domain.is_busy:
        every.append(domain.go_on(now))
    return every


def told(sent: list[Outgoing], ended: bool) -> Counter[str]:
    """For each inside address, the number of announcements or dispose messages of outside."""
    return Counter(
        out.target.host
        for out in sent
        if out.target.host in (INSIDE, OTHER)
        for announced in read_discovery(out.datagram).announcements
        if announced.ended is ended and source_prefix(out.datagram)[:3] == outside(0)[:3]
    )


def test_a_change_of_the_policy_is_applied_in_parts() -> None:
    """With 64 inside and 512 outside nothing else was done for seven seconds."""
    policy = Policy()
    domain = crowd(policy)
    policy.allows = False
    policy.count = 0
    parting = parts(domain, domain.apply_policy(NOW), NOW)
    assert policy.count == INSIDE_COUNT + 1
    every_pair = {INSIDE: INSIDE_COUNT * OUTSIDE_COUNT, OTHER: OUTSIDE_COUNT}
    assert told([*chain(*parting)], ended=True) == every_pair
    later = NOW + SEPARATION_S
    meeting = parts(domain, domain.continue_pending(later), later)
    assert told([*chain(*meeting)], ended=False) == every_pair
    assert not any(insider.is_separated for insider in domain.inside.by_prefix.values())
    most = MOST_PAIRS_PER_PART + 3 * (INSIDE_COUNT + 1)  # three for outside, of each inside
    assert max(map(len, parting + meeting)) <= most


PEERS = [f"10.0.0.{number}" for number in range(9, 13)]
PORTS_OF_ALL = 1 + len(PEERS) * PARTICIPANTS_TRIED
"""The datagrams for outside with which a participant is announced, or ends."""


def among_peers(policy: Policy) -> Domain:
    """A domain with the peers `PEERS`, one participant outside, and many inside."""
    domain = make_domain(peers=PEERS, judge=policy, ports=LONG_RANGE)
    domain.settings.peers = tuple(HostPort(peer, 0) for peer in PEERS)
    domain.heard_outside(spdp(outside(0), ROBOT), ROBOT, NOW)
    for number in range(INSIDE_COUNT):
        domain.heard_inside(spdp(inside(number), INSIDE, 7000 + 2 * number), INSIDE, NOW)
    (stand_in,) = domain.stand_ins.by_port
    for prefix in domain.inside.by_prefix:
        domain.at_stand_in(stand_in, sedp(prefix, INSIDE, 7000), INSIDE, NOW)
    return domain


def test_a_part_has_few_datagrams_for_the_peers() -> None:
    """With 128 inside and 4 peers, one step sent 17,568 datagrams in 122 ms."""
    policy = Policy()
    domain = among_peers(policy)
    policy.allows = False
    parting = parts(domain, domain.apply_policy(NOW), NOW)
    later = NOW + SEPARATION_S
    meeting = parts(domain, domain.continue_pending(later), later)
    assert not any(insider.is_separated for insider in domain.inside.by_prefix.values())
    for every in (parting, meeting):
        assert sum(map(len, every)) >= INSIDE_COUNT * PORTS_OF_ALL
        assert max(map(len, every)) < MOST_DATAGRAMS_PER_PART + PORTS_OF_ALL


def test_a_call_ends_few_participants_among_many_peers() -> None:
    """With 4 peers, one step sent 8,256 datagrams in 48 ms."""
    domain = among_peers(Policy())
    left = INSIDE_COUNT
    while sent := domain.expire(NOW + 100):
        assert len(sent) < MOST_DATAGRAMS_PER_PART + PORTS_OF_ALL
        left -= len(sent) // PORTS_OF_ALL
        assert len(domain.inside.by_prefix) == left
    assert not left


def test_questions_about_former_ports_are_repeated_in_parts() -> None:
    """With 512 waiting participants, one step took 35 ms twice a second."""
    domain = make_domain(ports=LONG_RANGE, port_store_key=b"key")
    for number in range(4 * MOST_PER_ADDRESS):
        address = f"172.30.0.{10 + number // MOST_PER_ADDRESS}"
        domain.heard_inside(spdp(inside(number), address, 7000 + 2 * number), address, 0.1)
    every = parts(domain, domain.continue_pending(0.5), 0.5)
    assert max(map(len, every)) <= MOST_DATAGRAMS_PER_PART
    assert sum(map(len, every)) == 4 * 4 * MOST_PER_ADDRESS


@pytest.mark.parametrize("change", ["move", "retire", "end"])
def test_a_change_for_all_participants_is_made_in_parts(change: str) -> None:
    """With 128 inside and 4 peers, one step sent over 16,000 datagrams."""
    domain = among_peers(Policy())
    changes = {
        "move": partial(domain.move_to, ("10.0.0.5",), NOW),
        "retire": partial(domain.retire, NOW),
        "end": partial(domain.end_participants_at, {INSIDE}),
    }
    every = parts(domain, changes[change](), NOW)
    assert max(map(len, every)) < MOST_DATAGRAMS_PER_PART + 2 * PORTS_OF_ALL
    of_inside = [out for out in chain(*every) if inside(0)[:11] in out.datagram]
    assert len(of_inside) == INSIDE_COUNT * PORTS_OF_ALL
    assert len(domain.inside.by_prefix) == (INSIDE_COUNT if change == "move" else 0)


def test_a_participant_that_has_gone_before_its_part_is_left_out() -> None:
    domain = among_peers(Policy())
    *_, last = domain.inside.by_prefix.values()
    sent = domain.end_participants_at({INSIDE})
    assert domain.is_busy
    domain.disposal.forget_inside(last)
    sent += finished(domain, [])
    assert len(sent) == (INSIDE_COUNT - 1) * PORTS_OF_ALL
    assert not any(last.prefix in out.datagram for out in sent)


def test_addresses_take_turns() -> None:
    policy = Policy()
    domain = crowd(policy)
    policy.allows = False
    finished(domain, domain.apply_policy(NOW))
    later = NOW + SEPARATION_S
    sent = domain.continue_pending(later)
    while told(sent, ended=False)[OTHER] < OUTSIDE_COUNT:
        sent += domain.go_on(later)
    assert told(sent, ended=False)[INSIDE] < 2 * OUTSIDE_COUNT


def test_a_participant_stays_apart_until_it_has_all_dispose_messages() -> None:
    policy = Policy()
    domain = crowd(policy)
    policy.allows = False
    domain.apply_policy(NOW)
    assert domain.is_busy
    later = NOW + SEPARATION_S
    assert not told(domain.continue_pending(later), ended=False)
    finished(domain, [], later)
    assert all(insider.is_separated for insider in domain.inside.by_prefix.values())


def test_verdicts_are_judged_again_a_few_at_a_time() -> None:
    """64,000 verdicts took five seconds with a hundred rules."""
    policy = Policy()
    domain = crowd(policy)
    for insider in domain.inside.by_prefix.values():
        insider.verdicts = {(RuleKind.PUBLISH, f"/t{number}"): True for number in range(100)}
    policy.count = 0
    domain.apply_policy(NOW)
    assert policy.count == MOST_VERDICTS_PER_PART
    assert finished(domain, []) == []
    assert policy.count == 100 * (INSIDE_COUNT + 1)


def test_a_participant_that_has_gone_is_not_parted() -> None:
    policy = Policy()
    domain = crowd(policy)
    policy.allows = False
    for insider in domain.inside.by_prefix.values():
        insider.verdicts = {(RuleKind.PUBLISH, f"/t{number}"): False for number in range(100)}
    domain.apply_policy(NOW)
    policy.allows = True
    domain.end_participants_at({INSIDE})
    assert not told(finished(domain, []), ended=True)[INSIDE]


def with_ports(prefix: bytes, first: int) -> bytes:
    """An announcement with as many locators as a participant may have ports."""
    locators = [
        (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(INSIDE, first + number), "<"))
        for number in range(MOST_MAPPINGS)
    ]
    return message(data(payload(locators)), prefix=prefix)


def test_no_more_work_waits_than_there_are_participants() -> None:
    """Each change of ports added work for all outside: with 40 participants, 120 pieces a second.

    Work for participants that had gone remained as well.
    """
    domain = crowd(Policy())
    domain.rediscovery.lan_relay_heard = True  # else separations wait for the relay
    for half_seconds in range(1, 21):
        now = NOW + half_seconds / 2
        for prefix in (inside(0), inside(1), inside(100 + half_seconds)):
            for first in (8000, 9000):
                domain.heard_inside(with_ports(prefix, first + half_seconds * 20), INSIDE, now)
        domain.continue_pending(now)
        domain.heard_inside(dispose_message(inside(100 + half_seconds)), INSIDE, now)
    (waiting,) = domain.rediscovery._waiting.values()
    assert set(waiting) == {inside(0), inside(1)}


def test_a_participant_that_changes_its_ports_again_lets_others_go_first() -> None:
    domain = crowd(Policy())
    for prefix in (inside(0), inside(1)):
        domain.rediscovery.separate(domain.inside.by_prefix[prefix])
    domain.rediscovery.separate(domain.inside.by_prefix[inside(0)])
    (waiting,) = domain.rediscovery._waiting.values()
    assert list(waiting) == [inside(1), inside(0)]
