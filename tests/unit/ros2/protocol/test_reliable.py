"""Heartbeats and questions are made at any time of a long life."""

import pytest

from rosproxy.ros2.protocol.reliable import acknack, heartbeat, nack_frag
from rosproxy.ros2.protocol.rtps import submessages
from rosproxy.ros2.rewriting.discovery import BuiltinWriter
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.discovery.domains import LAN_RELAY, NOW, A, B, carried, make_domain, spdp, to

OWN = bytes(range(12))
WRITER = BuiltinWriter.PUBLICATIONS
COUNTS = (1, 2**31, 2**32 + 1)


@pytest.mark.parametrize("count", COUNTS)
def test_a_count_begins_anew(count: int) -> None:
    """After 2^31 questions, which an attacker gets in ten days, discovery was no longer read."""
    for datagram in (
        heartbeat(OWN, A, WRITER, 1, count),
        acknack(OWN, A, WRITER, 1, (), count, final=True),
        nack_frag(OWN, A, WRITER, 1, [1], count),
    ):
        *_, (_, _, body) = submessages(datagram)
        assert datagram[body.end - 4 : body.end] == (count % 2**32).to_bytes(4, "little")


def test_a_participant_is_met_however_many_questions_were_asked() -> None:
    domain = make_domain(peers=())
    domain.proofs._count = 2**31 - 1
    domain.proxy_participants.discovery_participant._count = 2**31 - 1
    domain.heard_inside(spdp(A, "172.30.0.5"), "172.30.0.5", NOW)
    announced = carried("10.0.0.77", spdp(B, "10.0.0.77", padding=300))
    assert to(domain.heard_outside(announced, LAN_RELAY.host, NOW), "10.0.0.77")
    assert domain.proofs.question("10.0.0.78", A, [HostPort("10.0.0.1", 46000)])
