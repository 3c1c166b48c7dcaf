"""The LAN relay: the proof of its identity, and the addresses that it may claim."""

from collections.abc import Callable

import pytest

from rosproxy.ros2.discovery import domain as discovery_domain
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.relay_envelope import wrapped
from rosproxy.ros2.protocol.relay_proof import WINDOW_S, Direction, RelayProof
from rosproxy.ros2.registry.participants import TrafficKind
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.discovery.domains import (
    HOST,
    INSIDE,
    LAN_RELAY,
    NEAR,
    NOW,
    OTHER,
    PROOF,
    RANGE,
    ROBOT,
    SECRET,
    STRANGER,
    UNIX_TIME,
    A,
    B,
    carried,
    make_domain,
    meet,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import data, message, payload

PUBLISHED = RANGE.advertise.first + 3
LISTEN = RANGE.listen.first + 3


def watched(domain: Domain) -> list[str]:
    """The reasons of what a domain refuses from now on."""
    reasons = list[str]()
    domain.refused.note = lambda reason, *_: reasons.append(reason)
    return reasons


def made_at(seconds: float, secret: str = SECRET) -> RelayProof:
    return RelayProof(secret, lambda: UNIX_TIME + seconds)


CLAIM = wrapped(STRANGER, spdp(B, STRANGER))
WITHOUT_THE_SECRET: dict[str, tuple[bytes, str]] = {
    "the relay's own announcement": (spdp(B, LAN_RELAY.host), "not_a_peer"),
    "an envelope without a proof": (CLAIM, "relay_proof"),
    "half a proof": (carried(STRANGER, spdp(B, STRANGER))[:20], "relay_proof"),
    "a proof of another secret": (
        made_at(0, "another secret").sealed(Direction.TO_PROXY, CLAIM),
        "relay_proof",
    ),
    "another address in a valid envelope": (
        carried(ROBOT, spdp(B, STRANGER)).replace(wrapped(ROBOT, b""), wrapped(STRANGER, b"")),
        "relay_proof",
    ),
    "what the proxy sends the relay": (PROOF.sealed(Direction.TO_LAN, CLAIM), "relay_proof"),
    "a valid envelope, repeated later": (
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
    assert domain.heard_outside(datagram, LAN_RELAY.host, NOW) == []
    assert reasons == [reason]
    assert not domain.outside.by_prefix
    assert not domain.stand_ins.by_port
    assert not domain.rediscovery.lan_relay_heard


def test_an_engine_that_hides_who_sends_is_named() -> None:
    domain = make_domain()
    reasons = watched(domain)
    domain.settings.gateways = frozenset({STRANGER})
    assert domain.heard_outside(spdp(B, STRANGER), STRANGER, NOW) == []
    assert domain.heard_outside(spdp(B, LAN_RELAY.host), LAN_RELAY.host, NOW) == []
    assert reasons == ["hidden_source", "not_a_peer"]


def test_a_proof_from_another_address_is_not_looked_at() -> None:
    domain = make_domain()
    reasons = watched(domain)
    for source in (STRANGER, INSIDE):
        assert domain.heard_outside(carried(STRANGER, spdp(B, STRANGER)), source, NOW) == []
    assert reasons == ["not_a_peer"] * 2


def test_nothing_is_read_before_the_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """The proxy does not charge the relay either: forged datagrams would use up the relay's
    allowance.
    """
    domain = make_domain()
    for unread in ("read_messages", "credited_messages", "unwrapped"):
        monkeypatch.setattr(discovery_domain, unread, None)
    for datagram in (CLAIM, made_at(0, "another secret").sealed(Direction.TO_PROXY, CLAIM)):
        assert domain.heard_outside(datagram, LAN_RELAY.host, NOW) == []
    assert not domain.rates._by_source


@pytest.mark.parametrize("late", [-WINDOW_S, 0.0, WINDOW_S])
def test_the_relay_is_known_by_its_proof(late: float) -> None:
    domain = make_domain()
    meet(domain)
    sealed = made_at(late).sealed(Direction.TO_PROXY, CLAIM)
    assert to(domain.heard_outside(sealed, LAN_RELAY.host, NOW), INSIDE)
    assert domain.outside.by_prefix[B].address == STRANGER


def test_what_the_relay_is_told_has_a_proof() -> None:
    domain = make_domain(peers=())
    told = [
        *meet(domain),
        *domain.proxy_participants.announced_outside(),
        *domain.end_participants_at({INSIDE}),
    ]
    sealed = [sent.datagram for sent in told if sent.target == LAN_RELAY]
    assert len(sealed) == 3
    assert all(PROOF.opened(Direction.TO_LAN, datagram) for datagram in sealed)


IMPOSSIBLE = {
    INSIDE: "an inside address",
    LAN_RELAY.host: "the relay's, inside",
    "172.30.0.255": "broadcast, inside",
    "127.0.0.1": "loopback",
    "::1": "loopback",
    "0.0.0.0": "unspecified",
    "::": "unspecified",
    "239.255.0.1": "multicast",
    "ff02::1": "multicast",
    "255.255.255.255": "broadcast",
    "fe80::1": "of a link",
    "10.99.0.2": "the proxy's own, outside of inside",
}


@pytest.mark.parametrize("address", IMPOSSIBLE)
def test_a_claimed_address_is_not_inside_nor_the_proxys(address: str) -> None:
    """A stand-in led to port 9999 of a host inside, and to the proxy itself."""
    domain = make_domain(both_ways=True)
    domain.settings.proxy_address_for = lambda a: "10.99.0.2" if a == "10.99.0.2" else NEAR
    meet(domain)
    reasons = watched(domain)
    assert domain.heard_outside(carried(address, spdp(B, address, 9999)), LAN_RELAY.host, NOW) == []
    assert reasons == ["claimed_address"]
    assert not domain.outside.by_prefix
    assert not domain.stand_ins.by_port
    assert domain.rediscovery.lan_relay_heard


def test_a_participant_inside_that_the_relay_hears_is_no_fault() -> None:
    """With IPv6 the relay hears such a participant if a program on the host has joined the
    network.
    """
    domain = make_domain()
    meet(domain)
    reasons = watched(domain)
    before = dict(domain.rates._by_source)
    assert domain.heard_outside(carried(INSIDE, spdp(A, INSIDE)), LAN_RELAY.host, NOW) == []
    assert not reasons
    # No charge for the participant: a forged source on the LAN would use up its allowance.
    assert domain.rates._by_source == before


@pytest.mark.parametrize("is_own", [False, True])
@pytest.mark.parametrize("address", [ROBOT, "169.254.7.7", "2001:db8::9", HOST])
def test_any_other_address_may_be_claimed(address: str, is_own: bool) -> None:
    """Programs on the relay's machine have the advertised address, which may be the proxy's."""
    domain = make_domain(both_ways=True)
    if is_own and address == HOST:
        domain.settings.proxy_address_for = lambda a: a
    meet(domain)
    sent = domain.heard_outside(carried(address, spdp(B, address, 7412)), LAN_RELAY.host, NOW)
    assert to(sent, INSIDE)
    leads = {mapping.target for mapping in domain.outside.by_prefix[B].mappings.values()}
    assert leads == {HostPort(address, 7412), HostPort(address, 7413)}


def by_relay(domain: Domain, host: str, port: int) -> None:
    domain.heard_outside(carried(host, spdp(B, host, port)), LAN_RELAY.host, NOW)


def by_peer(domain: Domain, host: str, port: int) -> None:
    domain.heard_outside(spdp(B, host, port), host, NOW)


def at_a_range_port(domain: Domain, host: str, port: int) -> None:
    (mapping, *_) = domain.inside.by_prefix[A].mappings.values()
    domain.at_range_port(mapping.port, spdp(B, host, port), host, NOW)


@pytest.mark.parametrize("way", [by_relay, by_peer, at_a_range_port])
@pytest.mark.parametrize("port", [PUBLISHED, LISTEN, 7410, 20001])
def test_no_stand_in_leads_to_a_port_of_the_proxy(
    way: Callable[[Domain, str, int], None], port: int
) -> None:
    """If the advertised host is the proxy's machine: ports of the range, and of inside."""
    domain = make_domain(peers=(HOST,), both_ways=True)
    domain.settings.proxy_address_for = lambda _: HOST
    domain.stand_ins.by_port[20001] = []
    meet(domain)
    reasons = watched(domain)
    way(domain, HOST, port)
    assert reasons == ["own_port"]
    assert not domain.outside.by_prefix


def test_another_machine_may_have_ports_of_the_same_numbers() -> None:
    domain = make_domain(both_ways=True)
    meet(domain)
    for number, port in enumerate([PUBLISHED, LISTEN, 7410]):
        prefix = B[:-1] + bytes([number])
        domain.heard_outside(carried(ROBOT, spdp(prefix, ROBOT, port)), LAN_RELAY.host, NOW)
    domain.heard_outside(carried(HOST, spdp(B, HOST, LISTEN)), LAN_RELAY.host, NOW)
    assert len(domain.outside.by_prefix) == 4


@pytest.mark.parametrize(
    ("host", "port"), [(HOST, PUBLISHED), (INSIDE, 9999), (NEAR, LISTEN), (OTHER, 7410)]
)
def test_other_locators_of_an_announcement_get_no_stand_in(host: str, port: int) -> None:
    """User's data of inside went through the proxy to inside again."""
    domain = make_domain(peers=(), both_ways=True)
    meet(domain)
    located = [
        (Pid.METATRAFFIC_UNICAST_LOCATOR, HostPort(host, port)),
        (Pid.METATRAFFIC_UNICAST_LOCATOR, HostPort(HOST, 7410)),
        (Pid.DEFAULT_UNICAST_LOCATOR, HostPort(host, port)),
        (Pid.DEFAULT_UNICAST_LOCATOR, HostPort(HOST, 7411)),
    ]
    told = [(pid, pack_locator(locator, "<")) for pid, locator in located]
    datagram = message(data(payload(told)), prefix=B)
    if host == HOST:  # only the first locator for discovery at the claimed address counts
        datagram = message(data(payload(told[1:])), prefix=B)
    assert to(domain.heard_outside(carried(HOST, datagram), LAN_RELAY.host, NOW), INSIDE)
    leads = {
        mapping.target: mapping.kind for mapping in domain.outside.by_prefix[B].mappings.values()
    }
    assert leads == {
        HostPort(HOST, 7410): TrafficKind.METATRAFFIC,
        HostPort(HOST, 7411): TrafficKind.USER_DATA,
    }


def test_a_datagram_from_the_relay_waits_under_its_original_source() -> None:
    """Otherwise a flood on the LAN would delay all datagrams of the relay."""
    domain = make_domain()
    heard = carried(ROBOT, spdp(B, ROBOT))
    assert domain.source_of(heard, LAN_RELAY.host) == ROBOT
    assert domain.source_of(heard, STRANGER) == STRANGER
    for datagram, _ in WITHOUT_THE_SECRET.values():
        assert domain.source_of(datagram, LAN_RELAY.host) == LAN_RELAY.host
