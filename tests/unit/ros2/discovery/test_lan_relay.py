"""The LAN relay: whom the proxy takes for it."""

import pytest

from rosproxy.ros2.discovery import domain as discovery_domain
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.protocol.envelope import wrapped
from rosproxy.ros2.protocol.relay_proof import WINDOW_S, Direction, RelayProof
from tests.unit.ros2.discovery.domains import (
    EAR,
    INSIDE,
    NOW,
    PROOF,
    ROBOT,
    SECRET,
    STRANGER,
    UNIX_TIME,
    B,
    carried,
    make_domain,
    meet,
    spdp,
    to,
)


def watched(domain: Domain) -> list[str]:
    """The reasons of what a domain refuses from now on."""
    reasons = list[str]()
    domain.refused.note = lambda reason, *_: reasons.append(reason)
    return reasons


def made_at(seconds: float, secret: str = SECRET) -> RelayProof:
    return RelayProof(secret, lambda: UNIX_TIME + seconds)


CLAIM = wrapped(STRANGER, spdp(B, STRANGER))
WITHOUT_THE_SECRET: dict[str, tuple[bytes, str]] = {
    "an announcement of its own": (spdp(B, EAR.host), "not_a_peer"),
    "an envelope without a proof": (CLAIM, "relay_proof"),
    "half a proof": (carried(STRANGER, spdp(B, STRANGER))[:20], "relay_proof"),
    "a proof of another secret": (
        made_at(0, "another secret").sealed(Direction.TO_PROXY, CLAIM),
        "relay_proof",
    ),
    "another address in a good one": (
        carried(ROBOT, spdp(B, STRANGER)).replace(wrapped(ROBOT, b""), wrapped(STRANGER, b"")),
        "relay_proof",
    ),
    "what the proxy sends the relay": (PROOF.sealed(Direction.TO_LAN, CLAIM), "relay_proof"),
    "a good one, repeated later": (
        made_at(-WINDOW_S - 1).sealed(Direction.TO_PROXY, CLAIM),
        "relay_proof",
    ),
    "nothing": (b"", "relay_proof"),
}


@pytest.mark.parametrize("how", WITHOUT_THE_SECRET)
def test_a_process_at_the_relays_address_is_not_the_relay(how: str) -> None:
    """Behind Docker's port proxy each client has that address, and was taken for the relay."""
    datagram, reason = WITHOUT_THE_SECRET[how]
    domain = make_domain()
    meet(domain)
    reasons = watched(domain)
    assert domain.heard_outside(datagram, EAR.host, NOW) == []
    assert reasons == [reason]
    assert not domain.outside.by_prefix
    assert not domain.outside.stand_ins
    assert not domain.rediscovery.ear_heard


def test_a_proof_from_another_address_is_not_looked_at() -> None:
    domain = make_domain()
    reasons = watched(domain)
    for source in (STRANGER, INSIDE):
        assert domain.heard_outside(carried(STRANGER, spdp(B, STRANGER)), source, NOW) == []
    assert reasons == ["not_a_peer"] * 2


def test_nothing_is_read_before_the_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is anything charged to the relay, whose allowance others would use up."""
    domain = make_domain()
    for unread in ("read_discovery", "by_source", "unwrapped"):
        monkeypatch.setattr(discovery_domain, unread, None)
    for datagram in (CLAIM, made_at(0, "another secret").sealed(Direction.TO_PROXY, CLAIM)):
        assert domain.heard_outside(datagram, EAR.host, NOW) == []
    assert not domain.rates._by_source


@pytest.mark.parametrize("late", [-WINDOW_S, 0.0, WINDOW_S])
def test_the_relay_is_known_by_its_proof(late: float) -> None:
    domain = make_domain()
    meet(domain)
    sealed = made_at(late).sealed(Direction.TO_PROXY, CLAIM)
    assert to(domain.heard_outside(sealed, EAR.host, NOW), INSIDE)
    assert domain.outside.by_prefix[B].address == STRANGER


def test_what_the_relay_is_told_has_a_proof() -> None:
    domain = make_domain(peers=())
    told = [*meet(domain), *domain.own.announced_outside(), *domain.gone({INSIDE})]
    sealed = [sent.datagram for sent in told if sent.target == EAR]
    assert len(sealed) == 3
    assert all(PROOF.opened(Direction.TO_LAN, datagram) for datagram in sealed)
