"""Policy: what is denied is told to neither side, and a change has the two meet again."""

import struct
from collections.abc import Iterable

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.discovery.rediscovery import SEPARATION_S
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.policy import verdicts
from rosproxy.ros2.policy.verdicts import LONGEST_NAME
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import SubmessageId, source_prefix, submessages
from rosproxy.ros2.rewriting.discovery import read_discovery
from rosproxy.ros2.sources.rates import DiscoveryRates
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import RuleKind
from tests.unit.ros2.discovery import domains
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    NOW,
    ROBOT,
    SEDP_WRITERS,
    A,
    B,
    meet,
    sedp,
    settle,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import data, payload

NEIGHBOUR = b"\x01\x0f" + bytes(9) + b"\x09"


class Rules:
    """A policy with changeable denials. ``asked`` has all questions."""

    def __init__(self, *denied: RuleKind) -> None:
        self.denied = set(denied)
        self.asked: list[tuple[RuleKind, str, str]] = []

    def __call__(self, kind: RuleKind, name: str, address: str) -> bool:
        self.asked.append((kind, name, address))
        return kind not in self.denied


def met(rules: Rules) -> Domain:
    domain = domains.make_domain(judge=rules)
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    return domain


def outwards(domain: Domain) -> list[Outgoing]:
    (stand_in,) = domain.stand_ins.by_port
    return domain.at_stand_in(stand_in, sedp(A, INSIDE, 7000), INSIDE, NOW)


def inwards(domain: Domain) -> list[Outgoing]:
    (port,) = [
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7410
    ]
    return domain.at_range_port(port, sedp(B, ROBOT, 7000), ROBOT, NOW)


def kinds(sent: list[Outgoing]) -> list[int]:
    return [kind for kind, _, _ in submessages(sent[0].datagram)]


def test_what_is_denied_goes_on_as_a_gap() -> None:
    domain = met(Rules(RuleKind.PUBLISH))
    (sent,) = outwards(domain)
    assert kinds([sent]) == [SubmessageId.GAP, SubmessageId.PAD]
    assert b"chatter" not in sent.datagram
    assert len(sent.datagram) == len(sedp(A, INSIDE, 7000))
    assert kinds(inwards(domain)) == [SubmessageId.DATA]


def test_it_holds_for_what_outside_announces() -> None:
    rules = Rules(RuleKind.SUBSCRIBE)
    domain = met(rules)
    assert kinds(inwards(domain)) == [SubmessageId.GAP, SubmessageId.PAD]
    assert kinds(outwards(domain)) == [SubmessageId.DATA]
    assert rules.asked == [
        (RuleKind.SUBSCRIBE, "/chatter", INSIDE),
        (RuleKind.PUBLISH, "/chatter", INSIDE),
    ]


def test_the_policy_is_asked_once() -> None:
    rules = Rules()
    domain = met(rules)
    outwards(domain)
    outwards(domain)
    assert len(rules.asked) == 1


def test_a_change_has_those_meet_again_whom_it_concerns() -> None:
    rules = Rules()
    domain = met(rules)
    outwards(domain)
    assert domain.apply_policy(NOW) == []
    rules.denied = {RuleKind.PUBLISH}
    parting = domain.apply_policy(NOW)
    assert outwards(domain) == inwards(domain) == []
    assert settle(domain, NOW + SEPARATION_S / 2) == []
    meeting = settle(domain, NOW + SEPARATION_S)
    for host in (ROBOT, INSIDE):
        told = [
            (announced.ended, announced.sample.sequence)
            for sent in (parting, meeting)
            for datagram in to(sent, host)
            for announced in read_discovery(datagram).announcements
        ]
        assert told == [(True, 2), (False, 1)]
    assert kinds(outwards(domain)) == [SubmessageId.GAP, SubmessageId.PAD]
    assert domain.apply_policy(NOW) == []


def test_the_discovery_participant_gets_denied_topics() -> None:
    """Otherwise the discovery participant would ask for the samples again and again."""
    domain = met(Rules(RuleKind.PUBLISH))
    told = sedp(A, INSIDE, 7000, to=domain.proxy_participants.discovery_participant.prefix)
    domain.heard_inside(told, INSIDE, NOW)
    assert len(domain.inside.by_prefix[A].endpoints) == 1
    assert HostPort(INSIDE, 7000) in domain.inside.by_prefix[A].mappings


def announced_topics(domain: Domain, prefix: bytes, names: Iterable[bytes]) -> None:
    """Have a participant inside announce itself with writers of topics."""
    for name in names:
        text = name + bytes(4 - len(name) % 4)
        topic = struct.pack("<I", len(name) + 1) + text
        guid = prefix + bytes([0, 0, 1, 3])
        told = payload([(Pid.ENDPOINT_GUID, guid), (Pid.TOPIC_NAME, topic)])
        writer = data(told, writer=SEDP_WRITERS)
        announcement = spdp(prefix, INSIDE, 7410 + 2 * prefix[-1])
        domain.rates = DiscoveryRates()
        domain.heard_inside(announcement + writer, INSIDE, NOW)


def test_verdicts_of_one_address_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A container took 80 MB by 64 participants with 1,024 topics each, of 1 KB of name."""
    bounds = {"MOST_VERDICTS": 5, "MOST_VERDICTS_PER_ADDRESS": 8, "MOST_VERDICTS_IN_ALL": 10}
    for name, bound in bounds.items():
        monkeypatch.setattr(verdicts, name, bound)
    rules = Rules()
    domain = domains.make_domain(judge=rules)
    for prefix in (A, NEIGHBOUR):
        announced_topics(domain, prefix, (b"rt/%d" % number for number in range(6)))
    first, second = (domain.inside.by_prefix[prefix] for prefix in (A, NEIGHBOUR))
    assert [len(first.verdicts), len(second.verdicts)] == [5, 3]
    parted = domain.apply_policy(NOW)
    assert {A, NEIGHBOUR} <= {source_prefix(datagram) for datagram in to(parted, ROBOT)}
    assert domain.inside.verdicts.count_by_address.total() == 0
    announced_topics(domain, A, [b"rt/" + bytes([120]) * LONGEST_NAME])
    announced_topics(domain, A, ["rt/\N{ROBOT FACE}".encode()])
    assert not first.verdicts
    assert first.has_more_verdicts
    announced_topics(domain, A, [b"rt/0"])
    assert first.verdicts == {(RuleKind.PUBLISH, "/0"): True}
    domain.end_participants_at({INSIDE})
    assert domain.inside.verdicts.count_by_address.total() == 0
