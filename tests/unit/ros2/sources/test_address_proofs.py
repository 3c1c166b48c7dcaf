"""Addresses prove that they receive. A source that may be forged takes no place of others."""

from collections import Counter
from functools import partial

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import (
    MOST_ANNOUNCED_UNPROVEN,
    MOST_INSIDE_UNPROVEN,
    MOST_OUTSIDE,
    MOST_OUTSIDE_UNPROVEN,
    MOST_PER_ADDRESS,
    MOST_PER_HOST,
    MOST_PER_UNPROVEN,
    MOST_WAITING,
    Outgoing,
)
from rosproxy.ros2.ports.former_ports import ANSWER_TIMEOUT_S
from rosproxy.ros2.ports.mappings import PART_FOR_PROVEN
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.reliable import acknowledged
from rosproxy.ros2.protocol.rtps import HEADER_BYTES, PREFIX_BYTES, source_prefix
from rosproxy.ros2.registry.participants import ANSWERED_FACTOR
from rosproxy.ros2.rewriting.discovery import BuiltinWriter, read_discovery
from rosproxy.ros2.sources.address_proofs import (
    ANSWER_KEPT_S,
    LONGEST_ANSWER_BYTES,
    MOST_ADDRESSES,
    MOST_ANSWERS_PER_ADDRESS,
    MOST_EXPIRED_PER_CALL,
    PROOF_KEPT_S,
    AddressProofs,
)
from rosproxy.ros2.sources.rates import BURST, Standing
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap, PortRange
from tests.unit.ros2.discovery.domains import (
    HOST,
    INSIDE,
    LAN_RELAY,
    NOW,
    OTHER,
    RANGE,
    ROBOT,
    STRANGER,
    A,
    B,
    carried,
    make_domain,
    meet,
    prove,
    reached_at,
    sedp,
    settle,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import message, submessage

LAPTOP = "10.0.0.77"
NEIGHBOUR = b"\x01\x0f" + bytes([8] * 10)
LEASE = 300.0
LONG_RANGE = PortMap(PortRange(45000, 45999), PortRange(46000, 46999))
PADDING = 200
"""Bytes that make an announcement as long as a real announcement, which the proxy may answer."""


def named(number: int) -> bytes:
    return b"\x01\x0f\x77" + number.to_bytes(9, "big")


def hear(domain: Domain, prefix: bytes, address: str, now: float = NOW) -> list[Outgoing]:
    """Have the LAN relay tell of a participant."""
    announcement = spdp(prefix, address, lease=LEASE, padding=PADDING)
    return domain.heard_outside(carried(address, announcement), LAN_RELAY.host, now)


def forge(domain: Domain, first: int, count: int) -> list[Outgoing]:
    """Announce participants, each at a different address."""
    sent = list[Outgoing]()
    for number in range(first, first + count):
        sent += hear(domain, named(number), f"10.1.{number // 250}.{number % 250 + 1}")
    return sent


def questions(sent: list[Outgoing], address: str) -> list[bytes]:
    """The questions to participants at an address for a proof that the address receives."""
    return [datagram for datagram in to(sent, address) if destination(datagram) is not None]


def answer(asked: bytes, prefix: bytes) -> bytes:
    """The acknowledgement with which a participant answers a question."""
    body = bytes([0, 0, 3, 0xC7, 0, 0, 3, 0xC2]) + bytes(20)
    return message(
        submessage(0x0E, 0, source_prefix(asked)), submessage(0x06, 0, body), prefix=prefix
    )


def test_forged_sources_keep_nobody_from_being_met() -> None:
    """1,200 announcements with lease durations of 300 s took all places for these 300 s."""
    domain = make_domain()
    meet(domain)
    forge(domain, 0, 1200)
    assert len(domain.outside.by_prefix) == MOST_OUTSIDE_UNPROVEN
    (asked,) = questions(hear(domain, NEIGHBOUR, LAPTOP), LAPTOP)
    told = domain.heard_outside(answer(asked, NEIGHBOUR), LAPTOP, NOW)
    assert source_prefix(to(told, INSIDE)[-1]) == NEIGHBOUR
    assert to(domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW), INSIDE)
    forge(domain, 1200, 1200)
    assert {LAPTOP, ROBOT} <= domain.outside.count_by_address.keys()


def test_inside_is_told_of_so_many_unproven_participants() -> None:
    domain = make_domain()
    meet(domain)
    told = to(forge(domain, 0, 1200), INSIDE)
    ended = {source_prefix(d) for d in told if read_discovery(d).announcements[0].ended}
    assert len(told) == 2 * MOST_ANNOUNCED_UNPROVEN
    assert ended == {named(number) for number in range(MOST_ANNOUNCED_UNPROVEN)}


def test_a_participant_that_is_not_introduced_reaches_nothing_inside() -> None:
    domain = make_domain()
    meet(domain)
    forge(domain, 0, MOST_ANNOUNCED_UNPROVEN)
    hear(domain, B, LAPTOP)
    (port, *_) = domain.mappings.by_port
    for said in (spdp(B, LAPTOP), sedp(B, LAPTOP, 7411, to=A)):
        assert to(domain.at_range_port(port, said, LAPTOP, NOW), INSIDE) == []
    assert not domain.outside.by_prefix[B].mappings
    domain.heard_outside(
        sedp(B, LAPTOP, 7411, to=domain.proxy_participants.discovery_participant.prefix),
        LAPTOP,
        NOW,
    )
    assert not domain.outside.by_prefix[B].mappings
    prove(domain, LAPTOP)
    assert domain.outside.prove(LAPTOP) == ([domain.outside.by_prefix[B]], [])


def test_no_address_takes_the_place_of_another_that_has_fewer() -> None:
    domain = make_domain()
    meet(domain)
    hostile = [f"10.2.0.{number}" for number in range(1, 4)]
    prove(domain, LAPTOP, *hostile)
    for index, address in enumerate(hostile):
        for number in range(MOST_PER_HOST + 5):
            hear(domain, named(1000 * index + number), address)
    assert domain.outside.count_by_address.total() == MOST_OUTSIDE
    assert max(domain.outside.count_by_address.values()) <= MOST_PER_HOST
    for number in range(20):
        hear(domain, named(9000 + number), LAPTOP)
    assert domain.outside.count_by_address[LAPTOP] == 20
    for number in range(300):
        hear(domain, named(9900 + number), hostile[0])
    assert domain.outside.count_by_address[LAPTOP] == 20
    assert domain.outside.count_by_address.total() == MOST_OUTSIDE


def test_many_addresses_of_one_machine_take_no_places_of_others() -> None:
    """A machine may have any number of IPv6 addresses. All 20 participants of the laptop stay."""
    domain = make_domain(peers=())
    addresses = [f"2001:db8::{number:x}" for number in range(1, MOST_OUTSIDE + 11)]
    prove(domain, LAPTOP, STRANGER, *addresses)
    for number in range(20):
        hear(domain, named(number), LAPTOP)
    for number, address in enumerate(addresses):
        hear(domain, named(100 + number), address)
    assert domain.outside.count_by_address[LAPTOP] == 20
    hear(domain, NEIGHBOUR, STRANGER)
    assert NEIGHBOUR in domain.outside.by_prefix
    assert len(domain.outside.by_prefix) == MOST_OUTSIDE


def test_a_place_that_is_given_up_is_told_inside() -> None:
    domain = make_domain()
    meet(domain)
    forge(domain, 0, MOST_OUTSIDE_UNPROVEN)
    assert domain.outside.by_prefix[named(0)].is_announced
    (told,) = to(hear(domain, B, LAPTOP), INSIDE)
    (announcement,) = read_discovery(told).announcements
    assert (source_prefix(told), announcement.ended) == (named(0), True)
    assert named(0) not in domain.outside.by_prefix


def test_an_address_that_proves_to_receive_may_push_out_the_largest() -> None:
    domain = make_domain()
    hostile = [f"10.2.0.{number}" for number in range(1, 3)]
    prove(domain, *hostile)
    for index, address in enumerate(hostile):
        for number in range(MOST_PER_HOST):
            hear(domain, named(1000 * index + number), address)
    (asked,) = questions(hear(domain, B, LAPTOP), LAPTOP)
    domain.heard_outside(answer(asked, B), LAPTOP, NOW)
    assert domain.outside.by_prefix[B].proven
    assert domain.outside.count_by_address.total() == MOST_OUTSIDE


def test_an_unproven_address_has_a_few_participants() -> None:
    domain = make_domain()
    for number in range(MOST_PER_UNPROVEN + 4):
        hear(domain, named(number), LAPTOP)
    assert domain.outside.count_by_address[LAPTOP] == MOST_PER_UNPROVEN
    prove(domain, LAPTOP)
    hear(domain, B, LAPTOP)
    assert B in domain.outside.by_prefix


def test_a_question_goes_to_one_address_alone() -> None:
    """All on a LAN hear the prefix of this participant: a forger could answer for any address."""
    domain = make_domain(peers=())
    meet(domain)
    asked = [
        questions(hear(domain, named(number), address), address)[0]
        for number, address in enumerate((LAPTOP, STRANGER))
    ]
    assert source_prefix(asked[0]) != source_prefix(asked[1])
    hearsay = sedp(
        named(0), LAPTOP, 7411, to=domain.proxy_participants.discovery_participant.prefix
    )
    for forged in (hearsay, answer(asked[1], named(0))):
        domain.heard_outside(forged, LAPTOP, NOW)
        assert not domain.outside.by_prefix[named(0)].proven
    domain.heard_outside(answer(asked[0], named(0)), LAPTOP, NOW)
    assert domain.outside.by_prefix[named(0)].proven
    assert not domain.outside.by_prefix[named(1)].proven


def test_a_participant_that_only_answers_is_sent_three_times_as_much() -> None:
    """Two proxies on a LAN, and participants with DDS Security, prove nothing by a question."""
    domain = make_domain(peers=())
    meet(domain)
    hear(domain, B, LAPTOP)
    outsider = domain.outside.by_prefix[B]
    (port, *_) = domain.mappings.by_port
    before = outsider.credit
    said = sedp(B, LAPTOP, 7411, to=A)
    domain.at_range_port(port, said, LAPTOP, NOW)
    assert outsider.credit == before + ANSWERED_FACTOR * len(said)
    assert outsider.take_credit(outsider.credit)
    assert not outsider.take_credit(1)


def test_a_question_is_no_longer_than_what_came() -> None:
    domain = make_domain(peers=())
    short = domain.heard_outside(carried(LAPTOP, spdp(B, LAPTOP)), LAN_RELAY.host, NOW)
    assert questions(short, LAPTOP) == []  # 140 bytes
    assert questions(hear(domain, B, LAPTOP, NOW + 1), LAPTOP)


@pytest.mark.parametrize("known", [True, False])
def test_a_proxy_answers_for_the_participants_behind_it(known: bool) -> None:
    """Participants inside know nothing of a proxy outside, and cannot answer."""
    asked = make_domain(peers=())
    asking = make_domain(peers=())
    asking.settings.hosts = (LAPTOP,)
    sent = meet(asked)
    (announced,) = to(sent, LAN_RELAY.host)
    (meta, _) = reached_at(announced)
    padded = spdp(A, HOST, meta.port, padding=PADDING)
    (question,) = questions(asking.heard_outside(carried(HOST, padded), LAN_RELAY.host, NOW), HOST)
    if known:
        hear(asked, B, LAPTOP)
    back = asked.at_range_port(meta.port - 1000, question, LAPTOP, NOW)
    assert bool(back) is known
    for out in back:
        assert out.target == HostPort(LAPTOP, 46000)
        assert len(out.datagram) <= len(question)
        prefix = source_prefix(question)
        assert acknowledged(out.datagram, prefix, BuiltinWriter.PUBLICATIONS) == [1]
        asking.heard_outside(out.datagram, HOST, NOW)
    assert asking.outside.by_prefix[A].proven is known


def exchange(proxies: dict[str, Domain]) -> Counter[str]:
    """Have proxies announce themselves until all is said; how many datagrams each has sent."""
    counts = Counter[str]()
    sent = [
        (host, out)
        for host, p in proxies.items()
        for out in p.proxy_participants.announced_outside()
    ]
    while sent:
        source, out = sent.pop(0)
        counts[source] += 1
        assert counts[source] < 100, "the exchange does not end"
        host = out.target.host
        if host in proxies:
            listening = out.target.port - RANGE.advertised(RANGE.listen.first) + RANGE.listen.first
            at = partial(proxies[host].at_range_port, listening)
            heard = at if listening > RANGE.listen.first else proxies[host].heard_outside
            sent += [(host, back) for back in heard(out.datagram, source, NOW)]
    return counts


@pytest.mark.parametrize("peer_of_second", [HOST, ROBOT])
def test_two_proxies_do_not_ask_each_other_without_end(peer_of_second: str) -> None:
    """Each announced the questions of the other inside, and asked the asking participant again."""
    proxies = {HOST: make_domain(peers=()), LAPTOP: make_domain(peers=())}
    for host, peer in ((HOST, LAPTOP), (LAPTOP, peer_of_second)):
        domain = proxies[host]
        domain.settings.hosts = (host,)
        domain.settings.peers = (HostPort(peer, RANGE.advertised(RANGE.listen.first)),)
        domain.proxy_participants.discovery_participant.prefix = domain.proofs.secret = (
            host.encode().ljust(PREFIX_BYTES, b"-")
        )
        meet(domain, A if host == HOST else B)
    exchange(proxies)
    second = exchange(proxies)
    discovery_prefixes = {
        host: domain.proxy_participants.discovery_participant.prefix
        for host, domain in proxies.items()
    }
    for host, other in ((HOST, LAPTOP), (LAPTOP, HOST)):
        outside = proxies[host].outside
        assert outside.by_prefix.keys() <= {discovery_prefixes[other]}
        assert all(p.proven for p in outside.by_prefix.values())
    # All have answered: nothing but the announcements is left to say.
    assert second.total() <= 6


def test_forged_sources_inside_keep_nobody_from_being_announced() -> None:
    """Eight addresses with 64 participants each took all places, and two took all ports."""
    domain = make_domain(peers=[ROBOT])
    told = list[Outgoing]()
    for number in range(600):
        address = f"172.30.{number // 20 + 1}.9"
        domain.heard_inside(spdp(named(number), address, 7000 + 2 * number), address, NOW)
    assert len(domain.inside.by_prefix) <= MOST_INSIDE_UNPROVEN
    assert domain.ports.pool.free > 0
    asked = questions(domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW), INSIDE)
    for question in asked:
        domain.heard_inside(answer(question, A), INSIDE, NOW)
    told = settle(domain, NOW + ANSWER_TIMEOUT_S)
    assert A in {source_prefix(datagram) for datagram in to(told, ROBOT)}
    assert len(domain.inside.by_prefix[A].mappings) == 2


def test_forged_sources_inside_leave_an_allowance_for_others() -> None:
    """With 2,000 announcements a second, a new participant was not served for 40 s."""
    domain = make_domain(ports=LONG_RANGE)
    domain.settings.peers = tuple(HostPort(f"10.0.0.{number}", 0) for number in range(9, 13))
    for number in range(2000):
        address = f"172.30.0.{10 + number % 200}"
        domain.heard_inside(spdp(named(number), address, 7000 + 2 * number), address, NOW)
    assert len(domain.inside.by_prefix) == MOST_ANNOUNCED_UNPROVEN
    for question in questions(domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW), INSIDE):
        domain.heard_inside(answer(question, A), INSIDE, NOW)
    settle(domain, NOW + ANSWER_TIMEOUT_S)
    assert A in domain.inside.by_prefix


def test_who_gives_its_place_up_inside_is_ended_outside() -> None:
    domain = make_domain(ports=LONG_RANGE)
    for number in range(MOST_PER_ADDRESS):
        announcement = spdp(named(number), OTHER, 7410 + 2 * number)
        domain.inside.meet(read_discovery(announcement), OTHER, NOW)
    prove(domain, OTHER, prefixes=[named(900)])
    told = domain.heard_inside(spdp(named(900), OTHER), OTHER, NOW)
    (ended,) = [d for d in to(told, ROBOT) if read_discovery(d).announcements[0].ended]
    assert source_prefix(ended) == named(0)
    assert named(0) not in domain.inside.by_prefix


def test_forged_sources_keep_nobody_from_waiting_after_a_start() -> None:
    domain = make_domain()
    prove(domain, INSIDE)
    for number in range(MOST_WAITING):
        address = f"172.30.{number // 200 + 1}.{number % 200 + 1}"
        domain.heard_inside(spdp(named(number), address), address, 0.1)
    assert len(domain.former_ports.waiting) == MOST_WAITING
    assert domain.heard_inside(spdp(A, INSIDE), INSIDE, 0.2)
    assert A in domain.former_ports.waiting
    assert len(domain.former_ports.waiting) == MOST_WAITING
    for number in range(MOST_WAITING):
        domain.heard_inside(spdp(named(2000 + number), OTHER), OTHER, 0.3)
    assert A in domain.former_ports.waiting


def test_a_source_is_known_once_it_has_proved_to_receive() -> None:
    domain = make_domain()
    meet(domain)
    assert domain.standing(ROBOT) is Standing.PROVEN  # a peer
    assert domain.standing(INSIDE) is Standing.INSIDE
    assert domain.standing(LAPTOP) is Standing.OUTSIDE
    asked = questions(domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW), INSIDE)
    domain.heard_inside(answer(asked[0], A), INSIDE, NOW)
    assert domain.standing(INSIDE) is Standing.PROVEN
    domain.expire(NOW + 10)
    assert domain.standing(INSIDE) is Standing.PROVEN
    domain.expire(NOW + 21)
    domain.expire(NOW + 22 + PROOF_KEPT_S)
    assert domain.standing(INSIDE) is Standing.INSIDE
    prove(domain, LAPTOP, ROBOT)
    assert domain.standing(LAPTOP) is Standing.PROVEN_OUTSIDE
    assert domain.standing(ROBOT) is Standing.PROVEN


def test_a_process_has_questions_of_its_own() -> None:
    first = AddressProofs(b"one")
    second = AddressProofs(b"another")
    asked = [source_prefix(p.question(LAPTOP, A, [])) for p in (first, second)]
    assert len(Counter(asked)) == 2


def test_a_flood_of_forged_sources_holds_up_no_answer() -> None:
    """An answer was lost by the allowance that all unproven sources share."""
    domain = make_domain(peers=())
    meet(domain)
    (asked,) = questions(hear(domain, B, LAPTOP), LAPTOP)
    forge(domain, 0, 1)
    domain.rates.charge("10.1.0.1", int(BURST), Standing.OUTSIDE)
    said = answer(asked, B)
    assert not domain.must_queue_discovery(said, LAPTOP)
    domain.heard_outside(said, LAPTOP, NOW)
    assert domain.outside.by_prefix[B].proven
    assert domain.must_queue_discovery(said, STRANGER) is domain.outside.is_met(STRANGER)
    assert domain.must_queue_discovery(said + bytes(300), LAPTOP)


def test_a_proven_address_repeats_no_answer_at_any_rate() -> None:
    """Submessages behind a repeated answer need an allowance."""
    domain = make_domain(peers=())
    meet(domain)
    (asked,) = questions(hear(domain, B, LAPTOP), LAPTOP)
    said = answer(asked, B)
    behind = said + spdp(B, LAPTOP)[HEADER_BYTES:]
    assert domain.must_queue_discovery(behind, LAPTOP)
    domain.heard_outside(said, LAPTOP, NOW)
    assert domain.must_queue_discovery(said, LAPTOP)
    domain.rates.charge(LAPTOP, 2 * int(BURST))
    assert not domain.heard_outside(behind, LAPTOP, NOW)


def test_an_answer_inside_is_not_held_up_either() -> None:
    domain = make_domain()
    (asked,) = questions(meet(domain), INSIDE)[-1:]
    domain.rates.charge(INSIDE, int(BURST), Standing.INSIDE)
    said = [answer(q, A) for q in questions(meet(make_domain()), INSIDE)]
    assert asked
    for datagram in said:
        domain.heard_inside(datagram, INSIDE, NOW)
    assert domain.proofs.has(INSIDE)


@pytest.mark.parametrize("speaks_another", [False, True])
def test_an_announcement_beside_an_answer_is_charged(speaks_another: bool) -> None:
    """Otherwise an address could exceed its allowance with announcements behind an answer.

    Each announcement goes to all ports of the peers at once, and no other source would have its
    turn.
    """
    domain = make_domain()
    prove(domain, INSIDE, ROBOT)
    meet(domain)
    for address, hear_it, must_queue in (
        (INSIDE, domain.heard_inside, domain.must_queue_inside),
        (ROBOT, domain.heard_outside, domain.must_queue_discovery),
    ):
        asked = domain.proofs.question(address, B, [])
        ends = submessage(0x0E, 0, bytes(PREFIX_BYTES))
        info_src = submessage(0x0C, 0, bytes(4) + b"\2\3\1\x0f" + NEIGHBOUR)
        told = spdp(NEIGHBOUR if speaks_another else B, address)[HEADER_BYTES:]
        hidden = answer(asked, B) + (ends + info_src if speaks_another else b"") + told
        assert len(hidden) <= LONGEST_ANSWER_BYTES
        assert must_queue(hidden, address)
        domain.rates.take(address, 0, NOW)
        domain.rates.charge(address, int(BURST))
        assert hear_it(hidden, address, NOW) == []
        assert not {B, NEIGHBOUR} & domain.inside.by_prefix.keys()
        assert not {B, NEIGHBOUR} & domain.outside.by_prefix.keys()


def test_an_answer_counts_though_its_participant_has_lost_its_place() -> None:
    domain = make_domain(peers=())
    meet(domain)
    (asked,) = questions(hear(domain, B, LAPTOP), LAPTOP)
    forge(domain, 0, MOST_OUTSIDE_UNPROVEN)
    assert B not in domain.outside.by_prefix
    domain.heard_outside(answer(asked, B), LAPTOP, NOW)
    assert to(hear(domain, B, LAPTOP), INSIDE)
    assert domain.outside.by_prefix[B].proven


def test_an_address_that_is_full_pushes_out_no_other() -> None:
    domain = make_domain()
    forge(domain, 0, MOST_OUTSIDE_UNPROVEN - MOST_PER_UNPROVEN)
    for number in range(3 * MOST_PER_UNPROVEN):
        hear(domain, named(5000 + number), STRANGER)
    assert domain.outside.count_by_address[STRANGER] == MOST_PER_UNPROVEN
    assert len(domain.outside.by_prefix) == MOST_OUTSIDE_UNPROVEN
    assert named(0) in domain.outside.by_prefix


def test_an_address_inside_that_is_full_pushes_out_no_other() -> None:
    domain = make_domain()
    for number in range(MOST_INSIDE_UNPROVEN + 3 * MOST_PER_ADDRESS):
        address = OTHER if number >= MOST_PER_ADDRESS else INSIDE
        domain.inside.meet(read_discovery(spdp(named(number), address)), address, NOW)
    assert domain.inside.count_by_address == {INSIDE: MOST_PER_ADDRESS, OTHER: MOST_PER_ADDRESS}
    assert domain.inside.participant_to_end(A, OTHER) is None
    assert domain.inside.participant_to_end(A, "172.30.0.9") is domain.inside.by_prefix[named(0)]


def crowd_at(domain: Domain, address: str, now: float) -> None:
    """Announce as many participants at an address as may be there; none answers."""
    for number in range(MOST_PER_ADDRESS):
        announcement = spdp(named(number), address, 9000 + 2 * number, lease=LEASE)
        domain.heard_inside(announcement, address, now)


def answers_what_it_is_asked(domain: Domain, now: float) -> None:
    """Announce A, and answer the question to A."""
    sent = domain.heard_inside(spdp(A, INSIDE), INSIDE, now)
    for asked in questions(sent, INSIDE):
        if destination(asked) == A and domain.proofs.is_first_answer(INSIDE, answer(asked, A)):
            domain.heard_inside(answer(asked, A), INSIDE, now)


def test_forged_participants_at_an_address_keep_no_new_one_from_a_place() -> None:
    """64 announcements in five minutes, by a forged source, kept a container's new nodes out."""
    domain = make_domain(ports=LONG_RANGE)
    prove(domain, INSIDE, prefixes=[B])
    crowd_at(domain, INSIDE, NOW)
    answers_what_it_is_asked(domain, NOW)
    assert to(meet(domain), ROBOT)
    assert A in domain.inside.by_prefix
    crowd_at(domain, INSIDE, NOW)
    assert A in domain.inside.by_prefix
    assert domain.inside.count_by_address[INSIDE] == MOST_PER_ADDRESS


def test_forged_participants_at_an_address_keep_none_from_waiting_after_a_start() -> None:
    """A participant that has answered still waits for its former ports."""
    domain = make_domain(ports=LONG_RANGE)
    crowd_at(domain, INSIDE, 0.1)
    answers_what_it_is_asked(domain, 0.2)
    answers_what_it_is_asked(domain, 0.3)
    assert A in domain.former_ports.waiting
    crowd_at(domain, INSIDE, 0.4)
    assert A in domain.former_ports.waiting
    settle(domain, ANSWER_TIMEOUT_S + 0.5)
    assert A in domain.inside.by_prefix


def test_forged_participants_at_proven_addresses_take_three_quarters_of_the_range() -> None:
    """The last quarter is only for participants that answer: proven addresses may be forged."""
    domain = make_domain()
    prove(domain, INSIDE, OTHER, prefixes=[B])
    for address in (INSIDE, OTHER):
        crowd_at(domain, address, NOW)
    assert domain.ports.pool.free == len(RANGE.listen) // PART_FOR_PROVEN
    answers_what_it_is_asked(domain, NOW)
    settle(domain, NOW + ANSWER_TIMEOUT_S)
    assert len(domain.inside.by_prefix[A].mappings) == 2


def test_a_participant_that_never_answers_pushes_out_none_at_its_address() -> None:
    """With DDS Security none answers: 70 processes of a container took turns else."""
    domain = make_domain(ports=LONG_RANGE)
    crowd_at(domain, INSIDE, NOW)
    before = [*domain.inside.by_prefix]
    meet(domain)
    assert [*domain.inside.by_prefix] == before


def test_an_address_with_participants_stays_proven_while_many_others_prove() -> None:
    """An attacker with 4,096 addresses must not push out the proofs of others."""
    domain = make_domain()
    prove(domain, INSIDE)
    meet(domain)
    for number in range(2 * MOST_ADDRESSES):
        prove(domain, f"fd00::{number:x}")
        if number % 100 == 0:
            domain.expire(NOW)
    assert domain.proofs.has(INSIDE)
    assert domain.proofs.has_answered(INSIDE, A)
    assert len(domain.proofs.addresses) == MOST_ADDRESSES


def test_answers_in_the_name_of_many_are_forgotten() -> None:
    domain = make_domain()
    prove(domain, INSIDE)
    domain.heard_inside(spdp(A, INSIDE, lease=LEASE), INSIDE, NOW)
    prove(domain, OTHER, prefixes=map(named, range(2 * MOST_ANSWERS_PER_ADDRESS)))
    assert not domain.proofs.has_answered(OTHER, named(0))
    assert domain.proofs.has_answered(OTHER, named(2 * MOST_ANSWERS_PER_ADDRESS - 1))
    domain.expire(NOW + ANSWER_KEPT_S + 1)
    assert not domain.proofs.has_answered(OTHER, named(2 * MOST_ANSWERS_PER_ADDRESS - 1))
    assert domain.proofs.has_answered(INSIDE, A)


def test_the_answers_of_a_few_addresses_are_looked_at_at_a_time() -> None:
    """4,096 addresses with 128 answers each took 0.4 s, twice a second."""
    proofs = AddressProofs(b"a secret")
    count = 2 * MOST_EXPIRED_PER_CALL + 1
    for number in range(count):
        address = f"10.1.{number // 256}.{number % 256}"
        asked = proofs.question(address, A, [])
        answer = message(submessage(0x0E, 0, source_prefix(asked)), prefix=A)
        assert proofs.note(address, answer, NOW)
    later = NOW + ANSWER_KEPT_S + 1
    left = list[int]()
    while proofs._answered:
        proofs.expire(later)
        left.append(len(proofs._answered))
    assert left == [count - MOST_EXPIRED_PER_CALL, 1, 0]


def test_addresses_whose_answers_still_count_let_others_have_a_turn() -> None:
    proofs = AddressProofs(b"a secret")
    proofs._answered = {str(n): {A: NOW + 1.0} for n in range(MOST_EXPIRED_PER_CALL)}
    proofs._answered["gone"] = {A: NOW - 1.0}
    proofs.expire(NOW)
    proofs.expire(NOW)
    assert "gone" not in proofs._answered
    assert len(proofs._answered) == MOST_EXPIRED_PER_CALL
