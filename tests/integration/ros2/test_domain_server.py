"""The sockets of a domain, on loopback: received datagrams go to the domain, results are sent."""

import asyncio
import socket
import struct
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain, count, pairwise, repeat

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.forwarding.datagrams import bind
from rosproxy.ros2.domain_settings import DomainSettings, LanRelayLink, Outgoing
from rosproxy.ros2.ports.former_ports import ANSWER_TIMEOUT_S
from rosproxy.ros2.ports.locator_ports import EVIDENCE_PERIOD_S, SETTLING_PERIOD_S
from rosproxy.ros2.ports.stand_ins import stand_in_port
from rosproxy.ros2.protocol.relay_envelope import MOST_LISTED
from rosproxy.ros2.protocol.rtps import FAST_DDS, HEADER_BYTES, VERSION, source_prefix
from rosproxy.ros2.rewriting.discovery import BuiltinWriter
from rosproxy.ros2.servers.discovery_scheduler import DiscoveryScheduler
from rosproxy.ros2.servers.domain_server import (
    ADMISSION_TIMEOUT_S,
    DATAGRAMS_PER_TURN,
    DomainServer,
)
from rosproxy.ros2.sources.fair_queue import DiscoveryQueue
from rosproxy.ros2.sources.rates import DiscoveryRates, Standing
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap, PortRange
from tests.integration.net import PATIENCE, until
from tests.integration.own_domain import own_domain
from tests.unit.ros2.discovery.domains import (
    PROOF,
    SEDP_WRITERS,
    A,
    B,
    dispose_message,
    reached_at,
    spdp,
)
from tests.unit.ros2.protocol.messages import message, submessage

PROXY = "127.0.7.1"
INSIDE = "127.0.7.2"
OUTSIDE = "127.0.7.9"
RELAY = "127.0.7.3"
DOMAIN = own_domain()


def settings_of(count: int = 16) -> DomainSettings:
    """Settings of a domain with so many ports."""
    first = free_ports(count)
    ports = PortRange(first, first + count - 1)
    return DomainSettings(
        number=DOMAIN,
        hosts=(PROXY,),
        ports=PortMap(ports, ports),
        proxy_address_for=lambda _: PROXY,
        note=lambda *_: None,
        judge=lambda *_: True,
        is_inside=lambda address: address == INSIDE,
        peers=(HostPort(OUTSIDE, 0),),
    )


@pytest.fixture
async def server() -> AsyncIterator[DomainServer]:
    """A server that has been running for a long time."""
    times = chain([0.0], repeat(EVIDENCE_PERIOD_S + 1))
    started = DomainServer(
        settings_of(), PROXY, times.__next__, lambda address: address == INSIDE, lambda: None
    )
    started.start()
    yield started
    started.close()


@pytest.fixture
def well_known(server: DomainServer) -> tuple[str, int]:
    """The well-known port for announcements from inside."""
    return PROXY, server.domain.settings.unicast_port


def participant(address: str) -> socket.socket:
    sock = bind(address, 0)
    sock.setblocking(False)
    return sock


async def announcement(sock: socket.socket, prefix: bytes) -> bytes:
    """The next announcement of a participant that comes in."""
    async with asyncio.timeout(PATIENCE):
        while True:
            datagram = await asyncio.get_running_loop().sock_recv(sock, 65536)
            if source_prefix(datagram) == prefix:
                return datagram


@contextmanager
def outsider_without_a_port(server: DomainServer) -> Iterator[tuple[socket.socket, int]]:
    """A participant outside. Another program holds the port of the participant's stand-in."""
    domain = server.domain
    with ExitStack() as stack:
        while True:
            sock = stack.enter_context(participant(OUTSIDE))
            locator = HostPort(OUTSIDE, sock.getsockname()[1])
            wanted = stand_in_port(f"{B.hex()} {locator}", lambda _: 0, domain.stand_ins._is_taken)
            assert wanted is not None
            with suppress(OSError):  # another program already holds this port
                stack.enter_context(bind(PROXY, wanted))
                break
        domain.settings.peers = (locator,)
        yield sock, wanted


async def test_no_stand_in_is_announced_that_can_not_be_opened(
    server: DomainServer, well_known: tuple[str, int]
) -> None:
    """Inside believes the first locators of a participant for as long as that lives."""
    discovery = PROXY, server.domain.settings.discovery_port
    with participant(INSIDE) as insider, outsider_without_a_port(server) as (outsider, wanted):
        inside_port, outside_port = (s.getsockname()[1] for s in (insider, outsider))
        outsider.sendto(spdp(B, OUTSIDE, outside_port), discovery)
        insider.sendto(spdp(A, INSIDE, inside_port), well_known)
        await announcement(outsider, A)  # announcements without such a port pass
        await until(lambda: wanted in server.domain.stand_ins.blocked, "the port is blocked")
        outsider.sendto(spdp(B, OUTSIDE, outside_port), discovery)

        told, *_ = reached_at(await announcement(insider, B))

        (opened,) = server.domain.stand_ins.by_port
        assert told == HostPort(PROXY, opened)
        assert opened != wanted


async def test_a_participant_on_the_lan_relays_machine_is_not_inside() -> None:
    """Such a participant often announces itself on the inside network first, and then on the LAN.

    The proxy then took the participant for one of inside, and refused the LAN relay's announcement.
    """
    settings = settings_of()
    settings.relay = LanRelayLink(HostPort(RELAY, 1), PROOF)
    inside = {INSIDE, RELAY}
    times = chain([0.0], repeat(EVIDENCE_PERIOD_S + 1))
    server = DomainServer(settings, PROXY, times.__next__, inside.__contains__, lambda: None)
    server.start()
    well_known = PROXY, settings.unicast_port
    try:
        with participant(RELAY) as on_host, participant(INSIDE) as insider:
            on_host.sendto(spdp(B, RELAY, on_host.getsockname()[1]), well_known)
            insider.sendto(spdp(A, INSIDE, insider.getsockname()[1]), well_known)
            await until(lambda: server.domain.inside.by_prefix, "a participant is served")
    finally:
        server.close()
    assert server.domain.inside.by_prefix.keys() == {A}


async def test_an_unselected_source_has_an_allowance_of_discovery(
    server: DomainServer, well_known: tuple[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The proxy parses held announcements, too, which takes time."""
    server.select([])
    held = server._selected.held_announcements
    with participant(INSIDE) as insider:
        port = insider.getsockname()[1]
        with monkeypatch.context() as patch:
            asked = asyncio.Event()

            def none_left(*_: object) -> bool:
                asked.set()
                return False

            patch.setattr(DiscoveryRates, "take", none_left)
            insider.sendto(spdp(A, INSIDE, port), well_known)
            async with asyncio.timeout(PATIENCE):
                await asked.wait()
        insider.sendto(spdp(B, INSIDE, port), well_known)
        await until(lambda: held, "an announcement is held")
    assert held[INSIDE].keys() == {B}
    assert [*server.unselected] == [INSIDE]
    server.select([INSIDE])
    assert not server.unselected


async def test_participants_that_have_waited_are_admitted_in_turn() -> None:
    """Admitting 64 participants with claims at once blocks the event loop for 0.6 s."""
    times = chain([0.0], repeat(SETTLING_PERIOD_S + ANSWER_TIMEOUT_S))
    server = DomainServer(
        settings_of(64), PROXY, times.__next__, lambda address: address == INSIDE, lambda: None
    )
    # Each look at the clock is a second later, so a round admits a single participant.
    server._scheduler = DiscoveryScheduler(count().__next__)
    server.start()
    prefixes = [bytes([1, 15, number]) + bytes(9) for number in range(20)]
    for number, prefix in enumerate(prefixes):
        announcement = spdp(prefix, INSIDE, 9000 + 2 * number)
        server.domain.heard_inside(announcement, INSIDE, 0.1)
    table = server.domain.inside.by_prefix
    await server.expire()
    assert not table
    server.domain.heard_inside(dispose_message(prefixes[-1]), INSIDE, SETTLING_PERIOD_S)
    counts = list[int]()
    while len(table) < len(prefixes) - 1:
        await asyncio.sleep(0)
        counts.append(len(table))
    assert max(after - before for before, after in pairwise([0, *counts])) == 1
    await server.expire()
    await asyncio.sleep(0)
    assert prefixes[-1] not in table  # the participant ended before the turn
    server.close()


async def test_a_participant_whose_turn_is_lost_gets_another_one() -> None:
    """In a flood the longest queue loses the last items."""
    now = 0.0
    server = DomainServer(
        settings_of(), PROXY, lambda: now, lambda address: address == INSIDE, lambda: None
    )
    server.start()
    server.domain.heard_inside(spdp(A, INSIDE), INSIDE, 0.1)
    now = SETTLING_PERIOD_S + ANSWER_TIMEOUT_S
    await server.expire()
    server._scheduler._queue = DiscoveryQueue()
    for _ in range(3):
        await asyncio.sleep(0)
    assert not server.domain.inside.by_prefix
    now += ADMISSION_TIMEOUT_S
    await server.expire()
    for _ in range(3):
        await asyncio.sleep(0)
    assert A in server.domain.inside.by_prefix
    server.close()


async def test_of_heartbeats_that_wait_only_the_last_one_of_a_stream_is_read(
    server: DomainServer,
) -> None:
    """Fast DDS repeats heartbeats 25 times a second, which would fill the queue of a slow proxy."""
    read = list[bytes]()

    def take(datagram: bytes, _source: str, _now: float, _: int) -> list[Outgoing]:
        read.append(datagram)
        return []

    def heartbeat(count: int, writer: int = SEDP_WRITERS) -> bytes:
        body = struct.pack(">II", writer + 5, writer) + struct.pack("<iIiIi", 0, 1, 0, 5, count)
        return message(submessage(0x0E, 0, B), submessage(0x07, 0, body), prefix=A)

    with participant(INSIDE) as sender, participant(PROXY) as sock:
        for count in range(1, 6):
            sender.sendto(heartbeat(count), sock.getsockname())
        sender.sendto(heartbeat(1, BuiltinWriter.SUBSCRIPTIONS), sock.getsockname())
        server._scheduler.put("another source", Standing.PROVEN, 0, list)
        server._take_in(sock, take, lambda *_: True)
        await until(lambda: not server._scheduler.is_behind, "all is read")
    assert read == [heartbeat(5), heartbeat(1, BuiltinWriter.SUBSCRIPTIONS)]


def of_many(prefixes: Sequence[bytes]) -> bytes:
    """A datagram in which several participants announce themselves to a participant."""
    parts = list[bytes]()
    for number, prefix in enumerate(prefixes):
        parts.append(submessage(0x0C, 0, bytes(4) + VERSION + FAST_DDS + prefix))
        parts += [] if number else [submessage(0x0E, 0, B)]
        parts.append(spdp(prefix, INSIDE, 9000 + 2 * number)[HEADER_BYTES:])
    return message(*parts, prefix=A)


async def test_the_participants_in_a_datagram_are_read_in_turn(server: DomainServer) -> None:
    """The proxy announced 48 participants to the whole other side in a single step of 0.25 s."""
    server._scheduler = DiscoveryScheduler(count().__next__)
    prefixes = [bytes([1, 15, number]) + bytes(9) for number in range(60)]
    datagram = of_many(prefixes)
    read = list[bytes]()
    received = 0

    def take(part: bytes, source: str, now: float, size: int) -> list[Outgoing]:
        nonlocal received
        received += size
        read.append(source_prefix(part))
        return []

    server._read_in_turn(take, datagram, INSIDE, None)
    counts = [len(read)]
    while len(read) < len(prefixes):
        await asyncio.sleep(0)
        counts.append(len(read))
    assert read == prefixes
    assert max(after - before for before, after in pairwise([0, *counts])) == 1
    assert received == len(datagram)  # although the messages repeat the destination


async def test_acknowledgements_of_several_participants_wait_as_a_whole(
    server: DomainServer,
) -> None:
    """Fifty participants of Cyclone DDS in a process send fifty in a datagram: apart, they filled
    the queue of discovery, and a hundred participants were discovered in 3 s instead of 1.5 s.
    """
    server._scheduler.put("another source", Standing.PROVEN, 0, list)
    read = list[bytes]()

    def take(part: bytes, _source: str, _now: float, _: int) -> list[Outgoing]:
        read.append(part)
        return []

    acknowledgement = submessage(0x06, 0, bytes(24))
    sources = [submessage(0x0C, 0, bytes(4) + VERSION + FAST_DDS + bytes(12))] * 50
    whole = message(*(source + acknowledgement for source in sources), prefix=A)
    server._read_in_turn(take, whole, INSIDE, None)
    await until(lambda: not server._scheduler.is_behind, "all is read")
    assert read == [whole]


async def test_announcements_that_were_held_are_read_in_turn(server: DomainServer) -> None:
    """The first selection may have 2,048 participants: 0.4 s in a single step."""
    server._scheduler = DiscoveryScheduler(count().__next__)
    prefixes = [bytes([1, 15, number]) + bytes(9) for number in range(8)]
    for number, prefix in enumerate(prefixes):
        server._selected.hold(INSIDE, spdp(prefix, INSIDE, 9000 + 2 * number))
    server.select([INSIDE])
    table = server.domain.inside.by_prefix
    assert len(table) <= 1
    await until(lambda: len(table) > 1, "the other participants are read")


async def test_announcements_of_the_proxy_are_sent_in_turns(
    server: DomainServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """489 participants took 0.06 s and more every three seconds."""
    monkeypatch.setattr("rosproxy.ros2.servers.domain_server.SENT_PER_TURN", 4, raising=False)
    sent = [0]

    def send(outgoing: Iterable[Outgoing]) -> None:
        sent[-1] += len([*outgoing])

    monkeypatch.setattr(server, "_send", send)
    server.select(f"127.0.8.{number}" for number in range(50))
    sent[:] = [0]
    announcing = asyncio.create_task(server.announce())
    while not announcing.done():
        await asyncio.sleep(0)
        sent.append(0)
    assert sum(sent) > 100
    assert max(sent) <= 4 + 2 * 3  # and further datagrams of a turn, some by multicast


async def test_the_lan_relay_is_told_of_proven_addresses_in_turns(
    server: DomainServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """4,096 addresses took 0.1 s in a single step, every three seconds."""
    lists = [0]

    def send(outgoing: Iterable[Outgoing]) -> None:
        lists[-1] += sum(out.target.host == RELAY for out in outgoing)

    server.domain.settings.relay = LanRelayLink(HostPort(RELAY, 7500), PROOF)
    for number in range(4 * MOST_LISTED):
        address = f"10.1.{number // 256}.{number % 256}"
        answer = source_prefix(server.domain.proofs.question(address, A, []))
        server.domain.proofs.note(address, message(submessage(0x0E, 0, answer), prefix=A), 1.0)
    monkeypatch.setattr(server, "_send", send)
    telling = asyncio.create_task(server._tell_relay())
    while not telling.done():
        await asyncio.sleep(0)
        lists.append(0)
    assert sum(lists) == 4
    assert max(lists) == 1


async def test_a_datagram_that_leads_to_many_ends_the_turn_of_its_socket(
    server: DomainServer,
) -> None:
    """Eleven answers proved eleven addresses of a machine: no message passed for 0.16 s."""
    many = [Outgoing(HostPort(OUTSIDE, 9), b"announced")] * DATAGRAMS_PER_TURN
    taken = list[bytes]()

    def take(datagram: bytes, *_: object) -> list[Outgoing]:
        taken.append(datagram)
        return many

    with participant(INSIDE) as receiver, participant(OUTSIDE) as sender:
        for number in range(3):
            sender.sendto(bytes([number]), receiver.getsockname())
        for turn in range(1, 4):
            server._take_in(receiver, take, lambda *_: False)
            assert len(taken) == turn
