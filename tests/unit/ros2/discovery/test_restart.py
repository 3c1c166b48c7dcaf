"""After a restart a port and a prefix go to the participant that had them."""

from collections import Counter

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.discovery.rediscovery import SEPARATION_S
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.ports.former_ports import ANSWER_TIMEOUT_S
from rosproxy.ros2.ports.locator_ports import EVIDENCE_PERIOD_S, SETTLING_PERIOD_S
from rosproxy.ros2.ports.store import PortStore
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.rtps import source_prefix
from rosproxy.ros2.rewriting.discovery import read_discovery
from tests.unit.ros2.discovery.domains import (
    HOST,
    INSIDE,
    LAN_RELAY,
    NOW,
    OTHER,
    RANGE,
    ROBOT,
    A,
    B,
    carried,
    dispose_message,
    everything,
    kept_answer,
    make_domain,
    meet,
    proof_answer,
    prove,
    reached_at,
    sedp,
    settle,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import message, submessage

KEY = b"a key that no participant knows"
LAPTOP = "10.0.0.7"
PORTS = [45009, 45004]
"""The ports of A before the restart."""
PADDING = 200
THIRD = "172.30.0.7"
C = b"\x01\x0f" + bytes(9) + b"\x07"


def restarted(key: bytes = KEY, peers: tuple[str, ...] = (ROBOT,)) -> Domain:
    """A proxy that has just started, and counts refused datagrams."""
    domain = make_domain(peers=peers, port_store_key=key)
    domain.refused.note = Reasons()
    return domain


class Reasons(Counter[str]):
    """The reasons for which a domain has refused something."""

    def __call__(self, reason: str, *_: str) -> None:
        """Count a refusal."""
        self[reason] += 1


def reasons_of(domain: Domain) -> Reasons:
    """The reasons for which a domain of `restarted` has refused something."""
    reasons = domain.refused.note
    assert isinstance(reasons, Reasons)
    return reasons


def number_of(ports: list[int]) -> int:
    """The number of the port store for these ports, which anyone can compute."""
    return PortStore.of(HOST, RANGE.listen, 0, 0.0).number(ports)


def proof_of(prefix: bytes, ports: list[int], key: bytes = KEY) -> int:
    """The number of the port proof, by the key of a process of the proxy."""
    return PortStore.of(HOST, RANGE.listen, 0, 0.0, key).proof(prefix, ports)


NUMBER = number_of(PORTS)
PROOF = proof_of(A, PORTS)


def come(
    domain: Domain, prefix: bytes, address: str, number: int, now: float, proof: int = 1
) -> None:
    """Announce a participant inside, and answer with its numbers."""
    domain.heard_inside(spdp(prefix, address), address, now)
    domain.heard_inside(kept_answer(domain, prefix, number), address, now)
    if domain.proxy_participants.port_store.key:
        domain.heard_inside(proof_answer(domain, prefix, proof), address, now)


def ports_of(domain: Domain, prefix: bytes) -> list[int]:
    return domain.inside.by_prefix[prefix].ports


def ends_of(prefix: bytes, sent: list[Outgoing], host: str) -> list[bytes]:
    """The datagrams to a host that end a participant."""
    told = (d for d in to(sent, host) if source_prefix(d) == prefix)
    return [d for d in told if (spdp := read_discovery(d).of_participant) and spdp.ended]


FORGED = {
    "none": 1,
    "by another key": proof_of(B, PORTS, b"a guess"),
    "of the rightful participant": PROOF,
}
"""Proofs for the ports of A that another participant can compute, or may have seen."""


@pytest.mark.parametrize("proof", FORGED)
@pytest.mark.parametrize("is_first", [True, False])
def test_a_forged_proof_gets_no_port_of_another_participant(proof: str, is_first: bool) -> None:
    """The attacker got the port in 20 of 20 trials, where outside was silent for a second."""
    domain = restarted()
    claims = [(B, OTHER, FORGED[proof]), (A, INSIDE, PROOF)]
    for prefix, address, claimed in claims if is_first else reversed(claims):
        come(domain, prefix, address, NUMBER, 0.1, claimed)
    settle(domain, SETTLING_PERIOD_S)
    assert ports_of(domain, A) == PORTS
    assert not {*ports_of(domain, B)} & {*PORTS}


@pytest.mark.parametrize("proof", FORGED)
def test_a_participant_with_a_proof_takes_its_port_from_a_liar(proof: str) -> None:
    domain = restarted()
    come(domain, B, OTHER, NUMBER, 0.1, FORGED[proof])
    settle(domain, SETTLING_PERIOD_S)
    assert ports_of(domain, B) == PORTS
    come(domain, A, INSIDE, NUMBER, 3.0, PROOF)
    sent = settle(domain, 3.1)
    assert ports_of(domain, A) == PORTS
    assert not domain.inside.by_prefix[A].is_separated
    assert B not in domain.inside.by_prefix
    assert ends_of(B, sent, ROBOT)
    assert reasons_of(domain)["port_claim"]


def test_a_proof_that_another_participant_has_as_well_gets_the_port_for_neither() -> None:
    """B had the ports first, and A later. The proxy cannot tell which participant lies."""
    domain = restarted()
    come(domain, B, OTHER, NUMBER, 0.1, proof_of(B, PORTS))
    come(domain, A, INSIDE, NUMBER, 0.1, PROOF)
    settle(domain, SETTLING_PERIOD_S)
    for prefix in (A, B):
        assert not {*ports_of(domain, prefix)} & {*PORTS}
        assert domain.inside.by_prefix[prefix].is_separated


def test_a_participant_that_has_lost_a_port_meets_outside_anew() -> None:
    domain = restarted()
    domain.heard_outside(spdp(C, ROBOT), ROBOT, 0.1)
    come(domain, B, OTHER, NUMBER, 0.1)
    settle(domain, SETTLING_PERIOD_S)
    come(domain, A, INSIDE, NUMBER, 3.0, PROOF)
    settle(domain, 3.1)
    domain.heard_inside(spdp(B, OTHER), OTHER, 4.0)
    announce_from(domain, b"\x01\x0f" + bytes(9) + b"\x08", LAPTOP, 4.0)
    parting = settle(domain, 4.1)
    assert ends_of(B, parting, ROBOT)
    assert ends_of(C, parting, OTHER)
    meeting = [d for d in to(settle(domain, 4.1 + SEPARATION_S), ROBOT) if source_prefix(d) == B]
    assert not {locator.port - 1000 for locator in reached_at(meeting[0])} & {*PORTS}


@pytest.mark.parametrize("second", [0.2, 3.0])
def test_two_that_claim_one_port_by_their_word_both_get_others(second: float) -> None:
    """Without a secret neither can prove anything; outside may send to neither at that port."""
    domain = restarted(key=b"")
    come(domain, B, OTHER, NUMBER, 0.1)
    if second > SETTLING_PERIOD_S:
        settle(domain, SETTLING_PERIOD_S)
        assert ports_of(domain, B) == PORTS
    come(domain, A, INSIDE, NUMBER, second)
    settle(domain, second + SETTLING_PERIOD_S)
    come(domain, B, OTHER, NUMBER, second + 2)
    settle(domain, second + 2)
    for prefix in (A, B):
        assert not {*ports_of(domain, prefix)} & {*PORTS}
        assert domain.inside.by_prefix[prefix].is_separated
    come(domain, C, THIRD, 1, EVIDENCE_PERIOD_S - 1)
    settle(domain, EVIDENCE_PERIOD_S - 1)
    assert not {*ports_of(domain, C)} & {*PORTS}


def test_a_peer_decides_between_two_words() -> None:
    domain = restarted(key=b"")
    come(domain, B, OTHER, NUMBER, 0.1)
    come(domain, A, INSIDE, NUMBER, 0.1)
    for port in PORTS:
        domain.at_range_port(port, sedp(C, ROBOT, 7410, to=A), ROBOT, 0.5)
    settle(domain, SETTLING_PERIOD_S)
    assert ports_of(domain, A) == PORTS
    assert not {*ports_of(domain, B)} & {*PORTS}


@pytest.mark.parametrize("source", [OTHER, LAPTOP])
def test_a_forged_name_at_a_port_decides_nothing(source: str) -> None:
    """An attacker inside may send to ports of the range, too, from a proven address."""
    domain = restarted(key=b"")
    prove(domain, OTHER)
    come(domain, B, OTHER, NUMBER, 0.1)
    come(domain, A, INSIDE, NUMBER, 0.1)
    for port in PORTS:
        domain.at_range_port(port, sedp(C, source, 7410, to=B), source, 0.5)
    settle(domain, SETTLING_PERIOD_S)
    assert not {*ports_of(domain, B)} & {*PORTS}


def test_an_address_that_receives_decides_between_two_words() -> None:
    domain = restarted(key=b"", peers=())
    prove(domain, LAPTOP)
    come(domain, B, OTHER, NUMBER, 0.1)
    come(domain, A, INSIDE, NUMBER, 0.1)
    for port in PORTS:
        domain.at_range_port(port, sedp(C, LAPTOP, 7410, to=A), LAPTOP, 0.5)
        domain.at_range_port(port, sedp(C, "10.0.0.66", 7410, to=B), "10.0.0.66", 0.5)
    settle(domain, SETTLING_PERIOD_S)
    assert ports_of(domain, A) == PORTS


def test_the_operators_record_counts_more_than_a_word() -> None:
    domain = restarted(key=b"")
    come(domain, B, OTHER, NUMBER, 0.1)
    settle(domain, SETTLING_PERIOD_S)
    domain.former_ports.note_recorded({A: PORTS}, domain.inside.by_prefix)
    domain.heard_inside(spdp(A, INSIDE), INSIDE, 3.0)
    settle(domain, 3.1)
    assert ports_of(domain, A) == PORTS
    assert B not in domain.inside.by_prefix


def test_a_number_without_a_proof_gets_its_ports_where_no_other_claims_them() -> None:
    domain = restarted()
    come(domain, A, INSIDE, NUMBER, 0.1)
    settle(domain, SETTLING_PERIOD_S)
    assert ports_of(domain, A) == PORTS
    assert not domain.inside.by_prefix[A].is_separated


def test_wrong_proofs_from_many_addresses_take_nothing_from_a_proof() -> None:
    """A right proof counts even after wrong proofs from 300 forged addresses."""
    domain = restarted()
    domain.settings.is_inside = everything
    for number in range(1, 301):
        prefix = b"\x01\x0f" + number.to_bytes(10, "big")
        come(domain, prefix, f"172.31.{number // 250}.{number % 250}", NUMBER, 0.1, PROOF)
    come(domain, A, INSIDE, NUMBER, 0.2, PROOF)
    prove(domain, INSIDE)
    settle(domain, SETTLING_PERIOD_S)
    assert ports_of(domain, A) == PORTS


def test_ports_are_given_once_their_proof_is_known() -> None:
    domain = restarted()
    domain.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    domain.heard_inside(kept_answer(domain, A, NUMBER), INSIDE, 0.1)
    settle(domain, SETTLING_PERIOD_S)
    assert not domain.inside.by_prefix
    domain.heard_inside(proof_answer(domain, A, PROOF), INSIDE, SETTLING_PERIOD_S)
    settle(domain, SETTLING_PERIOD_S)
    assert ports_of(domain, A) == PORTS


def test_a_participant_keeps_its_ports_and_their_proof() -> None:
    domain = make_domain(port_store_key=KEY)
    meet(domain)
    ports = ports_of(domain, A)
    for answer in (
        kept_answer(domain, A, number_of(ports)),
        proof_answer(domain, A, proof_of(A, ports)),
    ):
        assert not domain.has_confirmed_ports(domain.inside.by_prefix[A])
        domain.heard_inside(answer, INSIDE, NOW)
    assert domain.has_confirmed_ports(domain.inside.by_prefix[A])
    assert [*domain.proxy_participants.port_reminders(NOW)] == []


def announce_from(domain: Domain, prefix: bytes, source: str, now: float) -> list[Outgoing]:
    """Have a participant outside announce itself, at a peer's address or by the LAN relay."""
    announcement = spdp(prefix, source, padding=PADDING)
    if domain.settings.is_peer(source):
        return domain.heard_outside(announcement, source, now)
    return domain.heard_outside(carried(source, announcement), LAN_RELAY.host, now)


@pytest.mark.parametrize("start", [0.1, NOW])
def test_an_unproven_address_keeps_no_participant_inside_from_being_served(start: float) -> None:
    """The participant was not served for the whole attack, and 25 s longer."""
    domain = restarted(peers=())
    announce_from(domain, A, LAPTOP, start)
    assert A in domain.outside.by_prefix
    come(domain, A, INSIDE, 1, start + 0.1)
    announce_from(domain, A, LAPTOP, start + 0.2)
    settle(domain, start + ANSWER_TIMEOUT_S + 1)
    announce_from(domain, A, LAPTOP, start + ANSWER_TIMEOUT_S + 2)
    assert A in domain.inside.by_prefix
    assert A not in domain.outside.by_prefix
    assert reasons_of(domain)["prefix"]


@pytest.mark.parametrize("source", [ROBOT, LAPTOP])
@pytest.mark.parametrize("is_answered_first", [True, False])
def test_a_proof_of_before_the_start_beats_peers_and_proven_addresses(
    source: str, is_answered_first: bool
) -> None:
    domain = restarted()
    prove(domain, LAPTOP)
    if is_answered_first:
        come(domain, A, INSIDE, NUMBER, 0.1, PROOF)
    announce_from(domain, A, source, 0.2)
    if not is_answered_first:
        assert A in domain.outside.by_prefix
        come(domain, A, INSIDE, NUMBER, 0.3, PROOF)
    settle(domain, SETTLING_PERIOD_S)
    announce_from(domain, A, source, 3.0)
    assert ports_of(domain, A) == PORTS
    assert A not in domain.outside.by_prefix


def test_what_a_peer_sends_to_a_participant_tells_that_it_was_inside() -> None:
    domain = restarted(key=b"")
    domain.at_range_port(PORTS[0], sedp(C, ROBOT, 7410, to=A), ROBOT, 0.1)
    announce_from(domain, A, ROBOT, 0.2)
    come(domain, A, INSIDE, 1, 0.3)
    settle(domain, SETTLING_PERIOD_S)
    announce_from(domain, A, ROBOT, 3.0)
    assert A in domain.inside.by_prefix


@pytest.mark.parametrize("proof", FORGED.values())
@pytest.mark.parametrize("second", [0.2, SETTLING_PERIOD_S + 1, EVIDENCE_PERIOD_S - 1])
def test_no_address_inside_takes_the_prefix_of_a_peers_participant(
    proof: int, second: float
) -> None:
    """The container was first after the restart, and the robot was heard no more."""
    domain = restarted()
    come(domain, B, OTHER, NUMBER, 0.1, proof)
    settle(domain, SETTLING_PERIOD_S)
    sent = announce_from(domain, B, ROBOT, second)
    sent += domain.heard_inside(spdp(B, OTHER), OTHER, second + 0.1)
    sent += settle(domain, EVIDENCE_PERIOD_S)
    sent += domain.heard_inside(spdp(B, OTHER), OTHER, NOW)
    assert B in domain.outside.by_prefix
    assert B not in domain.inside.by_prefix
    assert ends_of(B, sent, ROBOT) == []  # the robot's neighbours would forget the robot
    assert reasons_of(domain)["prefix"]


def test_an_address_that_proves_to_receive_takes_its_prefix_back() -> None:
    domain = restarted(peers=())
    come(domain, B, OTHER, 1, 0.1)
    settle(domain, SETTLING_PERIOD_S)
    assert B in domain.inside.by_prefix
    asked = to(announce_from(domain, B, LAPTOP, 2.0), LAPTOP)
    (question,) = [d for d in asked if destination(d) == B]
    assert len(question) <= len(spdp(B, LAPTOP, padding=PADDING))
    assert B in domain.inside.by_prefix
    named = submessage(0x0E, 0, source_prefix(question))
    domain.heard_outside(message(named, submessage(0x06, 0, bytes(28)), prefix=B), LAPTOP, 2.1)
    announce_from(domain, B, LAPTOP, 2.2)
    assert B in domain.outside.by_prefix
    assert B not in domain.inside.by_prefix


@pytest.mark.parametrize("source", [ROBOT, LAPTOP])
def test_a_participant_inside_that_is_served_keeps_its_prefix(source: str) -> None:
    domain = restarted()
    prove(domain, LAPTOP)
    meet(domain)
    announce_from(domain, A, source, NOW)
    assert A in domain.inside.by_prefix
    assert A not in domain.outside.by_prefix
    domain.heard_outside(dispose_message(A), source, NOW)
    assert A in domain.inside.by_prefix


def test_only_other_networks_are_told_of_the_end_of_a_forged_participant() -> None:
    """Participants on its own network know the rightful participant and would forget it."""
    domain = restarted(peers=())
    near = {INSIDE: "172.30.0.2", OTHER: "172.30.0.2", THIRD: "172.30.0.3"}
    domain.settings.proxy_address_for = lambda address: near.get(address, "172.30.0.2")
    meet(domain, B, OTHER)
    meet(domain, C, THIRD)
    announce_from(domain, A, LAPTOP, NOW)
    sent = domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    assert ends_of(A, sent, THIRD)
    assert not ends_of(A, sent, OTHER)


def test_what_the_lan_relay_hears_of_itself_is_no_claim() -> None:
    domain = restarted(peers=())
    (announced,) = [d for d in to(meet(domain), LAN_RELAY.host) if source_prefix(d) == A]
    assert domain.heard_outside(carried(HOST, announced), LAN_RELAY.host, NOW) == []
    assert not reasons_of(domain)


def test_nothing_is_kept_of_a_participant_inside_that_is_refused() -> None:
    """The participant waits and answers the port store. A peer's participant has the same
    prefix.
    """
    domain = restarted()
    domain.heard_outside(carried(ROBOT, spdp(A, ROBOT)), LAN_RELAY.host, SETTLING_PERIOD_S)
    come(domain, A, INSIDE, 1, SETTLING_PERIOD_S)
    assert A in domain.proxy_participants.port_store.prefixes
    settle(domain, SETTLING_PERIOD_S + ANSWER_TIMEOUT_S)
    assert A not in domain.inside.by_prefix
    assert reasons_of(domain)["prefix"]
    assert A not in domain.proxy_participants.port_store.prefixes
