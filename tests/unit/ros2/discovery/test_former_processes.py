"""A crashed process sends no dispose message. The next process at the port ends the participant."""

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.protocol.rtps import FAST_DDS, source_prefix
from rosproxy.ros2.rewriting.discovery import read_discovery
from tests.unit.ros2.discovery.domains import (
    CYCLONE_DDS,
    INSIDE,
    NOW,
    OTHER,
    ROBOT,
    make_domain,
    meet,
    of_vendor,
    prove,
    spdp,
)
from tests.unit.ros2.sources.test_address_proofs import answer, questions

RTI = b"\x01\x01"
FORMER = FAST_DDS + bytes([7, 7, 1, 1, 1, 1, 0, 0, 0, 0])
NEXT = FAST_DDS + bytes([7, 7, 2, 2, 2, 2, 0, 0, 0, 0])
SECOND_OF_NEXT = FAST_DDS + bytes([7, 7, 2, 2, 2, 2, 1, 0, 0, 0])


def ended(sent: list[Outgoing], host: str) -> list[bytes]:
    """The participants of the dispose messages to a host."""
    disposed = (
        source_prefix(out.datagram)
        for out in sent
        if out.target.host == host and _is_dispose(out.datagram)
    )
    return list(disposed)


def _is_dispose(datagram: bytes) -> bool:
    return any(announcement.ended for announcement in read_discovery(datagram).announcements)


def inside(domain: Domain, prefix: bytes, answers: bool = True) -> list[Outgoing]:
    """Have a participant inside announce itself at the usual port, and answer the question."""
    sent = domain.heard_inside(spdp(prefix, INSIDE), INSIDE, NOW)
    for asked in questions(sent, INSIDE) if answers else ():
        sent += domain.heard_inside(answer(asked, prefix), INSIDE, NOW)
    return sent


def outside(domain: Domain, prefix: bytes, answers: bool = True) -> list[Outgoing]:
    """Have a participant outside announce itself at the usual port, and answer the question."""
    sent = domain.heard_outside(spdp(prefix, ROBOT), ROBOT, NOW)
    for asked in questions(sent, ROBOT) if answers else ():
        sent += domain.heard_outside(answer(asked, prefix), ROBOT, NOW)
    return sent


def test_inside_a_new_process_ends_the_former_one() -> None:
    domain = make_domain()
    inside(domain, FORMER)
    ports = set(domain.mappings.by_port)
    told = ended(inside(domain, NEXT), ROBOT)
    assert told == [FORMER]
    assert list(domain.inside.by_prefix) == [NEXT]
    assert not ports & domain.mappings.by_port.keys()
    assert len(domain.mappings.by_port) == len(ports)


def test_outside_a_new_process_ends_the_former_one() -> None:
    domain = make_domain()
    meet(domain)
    outside(domain, FORMER)
    told = ended(outside(domain, NEXT), INSIDE)
    assert told == [FORMER]
    assert list(domain.outside.by_prefix) == [NEXT]


@pytest.mark.parametrize("side", [inside, outside])
def test_without_an_answer_nothing_ends(side: object) -> None:
    """The source may be forged."""
    assert callable(side)
    domain = make_domain()
    side(domain, FORMER)
    side(domain, NEXT, answers=False)
    assert {FORMER, NEXT} == domain.inside.by_prefix.keys() | domain.outside.by_prefix.keys()


def test_a_repeated_announcement_of_the_former_one_ends_nothing() -> None:
    domain = make_domain()
    inside(domain, FORMER)
    inside(domain, NEXT)
    inside(domain, FORMER, answers=False)
    assert NEXT in domain.inside.by_prefix


def test_two_participants_of_a_process_stay() -> None:
    domain = make_domain()
    inside(domain, NEXT)
    inside(domain, SECOND_OF_NEXT)
    assert set(domain.inside.by_prefix) == {NEXT, SECOND_OF_NEXT}


def test_another_address_or_port_is_another_process() -> None:
    domain = make_domain()
    inside(domain, FORMER)
    domain.heard_inside(spdp(NEXT, OTHER), OTHER, NOW)
    prove(domain, OTHER, prefixes=[NEXT])
    domain.heard_inside(spdp(SECOND_OF_NEXT, INSIDE, port=7412), INSIDE, NOW)
    prove(domain, INSIDE, prefixes=[SECOND_OF_NEXT])
    domain.heard_inside(spdp(SECOND_OF_NEXT, INSIDE, port=7412), INSIDE, NOW)
    assert len(domain.inside.by_prefix) == 3


@pytest.mark.parametrize(("vendor", "is_ended"), [(CYCLONE_DDS, True), (RTI, False)])
def test_of_implementations_that_share_no_port(vendor: bytes, is_ended: bool) -> None:
    """Of other implementations, the proxy does not know whether two processes share a port."""
    domain = make_domain()
    former = vendor + bytes([3] * 10)
    domain.heard_inside(of_vendor(spdp(former, INSIDE), vendor), INSIDE, NOW)
    inside(domain, NEXT)
    assert (former not in domain.inside.by_prefix) is is_ended


def test_a_former_process_ends_for_one_that_waited_for_ports() -> None:
    """While ports are scarce, a participant gets a port only after an answer."""
    domain = make_domain()
    lives = [FAST_DDS + bytes([7, 7, life, 1, 1, 1, 0, 0, 0, 0]) for life in range(20)]
    for life in lives:
        inside(domain, life)
        domain.heard_inside(spdp(life, INSIDE), INSIDE, NOW)
        assert list(domain.inside.by_prefix) == [life]
    assert len(domain.mappings.by_port) == 2
