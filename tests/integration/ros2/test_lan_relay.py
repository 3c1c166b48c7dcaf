"""The LAN relay and the proxy, on loopback: each takes from the other what has a good proof.

Loopback addresses can't be claimed. So the proxy refuses here what the relay has heard, and by the
reason a test tells whether the proof was good.
"""

import asyncio
import socket
import struct
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import closing, contextmanager
from itertools import chain, count

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.forwarding.datagrams import bind
from rosproxy.ros2.domain_settings import DomainSettings, LanRelayLink
from rosproxy.ros2.lan_relay import relay as lan_relay
from rosproxy.ros2.lan_relay import sources
from rosproxy.ros2.lan_relay.relay import LanRelay, LanRelaySettings
from rosproxy.ros2.ports.locator_ports import EVIDENCE_PERIOD_S
from rosproxy.ros2.protocol.relay_envelope import address_lists
from rosproxy.ros2.protocol.relay_proof import Direction, RelayProof
from rosproxy.ros2.protocol.rtps import SubmessageId, source_prefix
from rosproxy.ros2.servers.domain_server import DomainServer
from rosproxy.ros2.servers.groups import GROUP, group_socket, join, send_through
from rosproxy.ros2.sources.rates import Standing
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap, PortRange
from tests.integration.net import PATIENCE, until
from tests.integration.own_domain import own_domain
from tests.unit.ros2.discovery.domains import A, B, spdp

PROXY = "127.0.0.1"
"""The proxy's source address on loopback."""
INSIDE = "127.0.7.32"
RELAY = "127.0.7.33"
LAN = "127.0.7.34"
LAPTOP = "127.0.7.35"
DOMAIN = own_domain()
ON_LAN = GROUP, 7400 + 250 * DOMAIN
SECRET = "0123456789abcdef"
FORGED = 50
SHARED = 10
"""Forged sources, and how many datagrams of unproven sources the relay may read."""


class Boundary:
    """A proxy and a LAN relay, each of which may be started again, with any secret."""

    def __init__(self) -> None:
        first = free_ports(16)
        self.ports = PortRange(first, first + 15)
        self.bind = HostPort(RELAY, free_ports(1))
        self.reasons = list[str]()
        self.server: DomainServer | None = None
        self.relay: LanRelay | None = None

    def start_proxy(self, secret: str = SECRET) -> DomainServer:
        if self.server:
            self.server.close()
        settings = DomainSettings(
            number=DOMAIN,
            hosts=(PROXY,),
            ports=PortMap(self.ports, self.ports),
            proxy_address_for=lambda _: PROXY,
            note=lambda reason, *_: self.reasons.append(reason),
            judge=lambda *_: True,
            is_inside=lambda address: address == INSIDE,
            relay=LanRelayLink(self.bind, RelayProof(secret, time.time)),
        )
        times = chain([0.0], count(EVIDENCE_PERIOD_S + 1))  # each datagram comes a second later
        self.server = DomainServer(
            settings,
            PROXY,
            times.__next__,
            settings.is_inside,
            lambda: None,
        )
        assert self.server.start() == [], "other programs have ports of the range"
        return self.server

    def start_relay(self, secret: str = SECRET) -> LanRelay:
        if self.relay:
            self.relay.close()
        discovery = HostPort(PROXY, self.ports.first)
        self.relay = LanRelay(LanRelaySettings(DOMAIN, LAN, self.bind, discovery, secret))
        self.relay.start()
        return self.relay

    def close(self) -> None:
        for program in (self.server, self.relay):
            if program:
                program.close()

    async def hears_the_lan(self) -> None:
        """Hold that the proxy takes from the relay what a laptop announces."""
        self.reasons.clear()
        with closing(bind(LAPTOP, 0)) as laptop:
            send_through(laptop, LAPTOP, loop=True)

            def has_come() -> bool:
                laptop.sendto(spdp(B, LAPTOP), ON_LAN)
                return "claimed_address" in self.reasons

            await until(has_come, "the relay carries what the laptop announces")

    async def is_announced(self) -> None:
        """Hold that the relay takes from the proxy what a participant inside announces."""
        assert self.server
        well_known = PROXY, self.server.domain.settings.unicast_port
        with closing(bind(INSIDE, 0)) as insider, on_lan() as listening:

            def has_come() -> bool:
                insider.sendto(spdp(A, INSIDE), well_known)
                return A in announced(listening)

            await until(has_come, "the LAN hears of the participant inside")


@contextmanager
def on_lan() -> Iterator[socket.socket]:
    """A socket that hears the group."""
    with closing(group_socket(HostPort(*ON_LAN))) as sock:
        join(sock, LAPTOP)
        yield sock


def announced(listening: socket.socket) -> set[bytes]:
    """The prefixes of what waits at a socket."""
    prefixes = set[bytes]()
    try:
        while True:
            prefixes.add(source_prefix(listening.recv(65536)))
    except BlockingIOError:
        return prefixes


@pytest.fixture
async def boundary() -> AsyncIterator[Boundary]:
    made = Boundary()
    yield made
    made.close()


Start = Callable[[Boundary], object]
ORDERS: dict[str, list[Start]] = {
    "proxy first": [Boundary.start_proxy, Boundary.start_relay],
    "relay first": [Boundary.start_relay, Boundary.start_proxy],
}


@pytest.mark.parametrize("order", ORDERS)
async def test_both_may_start_again_in_any_order(boundary: Boundary, order: str) -> None:
    for start in ORDERS[order]:
        start(boundary)
    await boundary.hears_the_lan()
    await boundary.is_announced()
    for start in ORDERS[order]:
        start(boundary)
        await boundary.hears_the_lan()
        await boundary.is_announced()


async def test_a_process_at_the_relays_address_is_refused(boundary: Boundary) -> None:
    """The address alone does not make a process the relay."""
    server = boundary.start_proxy()
    discovery = PROXY, boundary.ports.first
    forged = RelayProof("another secret", time.time).sealed(Direction.TO_PROXY, spdp(B, LAPTOP))
    with closing(bind(RELAY, 0)) as process:
        process.sendto(forged, discovery)
        await until(lambda: boundary.reasons == ["relay_proof"], "the forged proof is refused")
        process.sendto(spdp(B, RELAY), discovery)
        await until(lambda: "not_a_peer" in boundary.reasons, "no proof: refused")
    assert not server.domain.outside.by_prefix
    assert not server.domain.rediscovery.lan_relay_heard


async def test_a_process_at_the_proxys_address_announces_nothing(
    boundary: Boundary, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever had the proxy's address was announced to the LAN."""
    relay = boundary.start_relay()
    good = RelayProof(SECRET, time.time)
    forged = RelayProof("another secret", time.time).sealed(Direction.TO_LAN, spdp(B, PROXY))
    reflected = good.sealed(Direction.TO_PROXY, spdp(B, PROXY))
    old = RelayProof(SECRET, lambda: time.time() - 60).sealed(Direction.TO_LAN, spdp(B, PROXY))
    refused = [spdp(B, PROXY), forged, reflected, old]
    target = boundary.bind.host, boundary.bind.port
    with closing(bind(PROXY, 0)) as process, on_lan() as listening:
        for datagram in refused:
            process.sendto(datagram, target)
        # The relay announces this later datagram, so all earlier datagrams have been processed.
        process.sendto(good.sealed(Direction.TO_LAN, spdp(A, PROXY)), target)
        async with asyncio.timeout(PATIENCE):
            datagram = await asyncio.get_running_loop().sock_recv(listening, 65536)
    assert source_prefix(datagram) == A
    assert (relay.dropped, relay.to_lan) == (len(refused), 1)
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1
    assert "the datagram has no proof. Use the same version for the proxy" in warnings[0]


async def test_refused_datagrams_cost_the_proxy_none_of_its_allowance(boundary: Boundary) -> None:
    relay = boundary.start_relay()
    target = boundary.bind.host, boundary.bind.port
    good = RelayProof(SECRET, time.time)
    with closing(bind(PROXY, 0)) as process:
        process.sendto(spdp(B, PROXY), target)
        await until(lambda: relay.dropped == 1, "the datagram is refused")
        assert not relay._proxy_rates._by_source
        process.sendto(good.sealed(Direction.TO_LAN, spdp(A, PROXY)), target)
        await until(lambda: relay.to_lan == 1, "the proxy is announced")
    assert PROXY in relay._proxy_rates._by_source


async def test_repeated_lists_of_proven_addresses_have_a_bound(
    boundary: Boundary, small_allowance: None
) -> None:
    """Each list of 256 addresses takes milliseconds, and the relay read any number of lists."""
    relay = boundary.start_relay()
    (listed,) = address_lists([f"192.0.2.{number}" for number in range(256)])
    await use_up(boundary, listed, relay)


async def test_announcements_cost_the_lists_of_proven_addresses_nothing(
    boundary: Boundary, small_allowance: None
) -> None:
    """A proxy with 600 participants uses up its allowance, and the relay read no lists."""
    relay = boundary.start_relay()
    await use_up(boundary, spdp(A, PROXY), relay)
    (listed,) = address_lists([LAPTOP])
    with closing(bind(PROXY, 0)) as process:
        sealed = RelayProof(SECRET, time.time).sealed(Direction.TO_LAN, listed)
        process.sendto(sealed, (boundary.bind.host, boundary.bind.port))

    def is_proven() -> bool:
        now = asyncio.get_running_loop().time()
        return relay._sources.standing(LAPTOP, now) is Standing.PROVEN

    await until(is_proven, "the relay reads the list")


@pytest.fixture
def small_allowance(monkeypatch: pytest.MonkeyPatch) -> None:
    """An allowance of the proxy at the relay that does not refill."""
    monkeypatch.setattr(lan_relay, "SOURCE_UNITS_PER_SECOND", 0.0)
    monkeypatch.setattr(lan_relay, "SOURCE_BURST_UNITS", 20.0)


async def use_up(boundary: Boundary, content: bytes, relay: LanRelay) -> None:
    """Repeat a datagram of the proxy until the relay drops it."""
    proof = RelayProof(SECRET, time.time)
    with closing(bind(PROXY, 0)) as process:

        def is_dropped() -> bool:
            # A proof that has expired would be dropped, too.
            sealed = proof.sealed(Direction.TO_LAN, content)
            process.sendto(sealed, (boundary.bind.host, boundary.bind.port))
            return relay.dropped > 0

        await until(is_dropped, "the relay leaves repeated datagrams unread")


async def test_different_secrets_are_reported(
    boundary: Boundary, caplog: pytest.LogCaptureFixture
) -> None:
    """By the proxy's counter, and in the log of the relay."""
    server = boundary.start_proxy()
    boundary.start_relay("another secret")
    with closing(bind(LAPTOP, 0)) as laptop:
        send_through(laptop, LAPTOP, loop=True)

        def proxy_refuses() -> bool:
            laptop.sendto(spdp(B, LAPTOP), ON_LAN)
            return "relay_proof" in boundary.reasons

        def relay_refuses() -> bool:
            server._send(server.domain.proxy_participants.announced_outside())
            return bool(caplog.records)

        await until(proxy_refuses, "the proxy refuses what the relay carries")
        await until(relay_refuses, "the relay refuses what the proxy announces")
    assert "Give the proxy and its LAN relay the same secret" in caplog.text


async def test_unproven_sources_share_one_allowance(
    boundary: Boundary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an allowance for each forged source, the proxy would get all announcements."""
    monkeypatch.setattr(sources, "UNPROVEN_PER_SECOND", 0.0)
    monkeypatch.setattr(sources, "UNPROVEN_BURST", float(SHARED))
    relay = boundary.start_relay()
    for number in range(FORGED):
        announce(f"127.0.8.{number + 1}", bytes([number]) * 12)
    await until(lambda: relay.from_lan + relay.dropped == FORGED, "the relay has read all")
    assert relay.from_lan == SHARED
    (listed,) = address_lists([LAPTOP])
    sealed = RelayProof(SECRET, time.time).sealed(Direction.TO_LAN, listed)
    with closing(bind(PROXY, 0)) as process:
        process.sendto(sealed, (boundary.bind.host, boundary.bind.port))

    def is_carried() -> bool:
        announce(LAPTOP, B)
        return relay.from_lan > SHARED

    await until(is_carried, "the relay carries what a proven address announces")


async def test_each_announcement_in_a_datagram_counts(
    boundary: Boundary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A datagram of 7 KiB led to 128 datagrams to the proxy, and cost as much as 29."""
    monkeypatch.setattr(sources, "UNPROVEN_PER_SECOND", 0.0)
    monkeypatch.setattr(sources, "UNPROVEN_BURST", float(SHARED))
    relay = boundary.start_relay()
    announcements = [spdp(bytes([number]) * 12, LAPTOP) for number in range(FORGED)]
    with closing(bind(LAPTOP, 0)) as laptop:
        send_through(laptop, LAPTOP, loop=True)
        laptop.sendto(announcements[0] + b"".join(map(after_info_src, announcements[1:])), ON_LAN)
    await until(lambda: relay.from_lan + relay.dropped == FORGED, "the relay has read all")
    assert relay.from_lan < SHARED


def after_info_src(message: bytes) -> bytes:
    """The submessages of a message, after an INFO_SRC with its GUID prefix."""
    return struct.pack("<BBH4x", SubmessageId.INFO_SRC, 1, 20) + message[4:]


def announce(address: str, prefix: bytes) -> None:
    """Have a participant at an address announce itself to the LAN."""
    with closing(bind(address, 0)) as sock:
        send_through(sock, address, loop=True)
        sock.sendto(spdp(prefix, address), ON_LAN)


async def test_the_relay_is_told_which_addresses_are_proven(boundary: Boundary) -> None:
    server = boundary.start_proxy()
    relay = boundary.start_relay()
    proofs = server.domain.proofs
    for address in (INSIDE, LAPTOP):
        proofs._until[address] = float("inf")
    await server.announce()

    def standing(address: str) -> Standing:
        return relay._sources.standing(address, asyncio.get_running_loop().time())

    await until(lambda: standing(LAPTOP) is Standing.PROVEN, "the relay knows the laptop")
    assert standing(INSIDE) is Standing.OUTSIDE
