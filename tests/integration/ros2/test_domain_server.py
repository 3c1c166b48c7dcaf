"""The sockets of a domain, on loopback: what they hear goes to it, what follows is sent."""

import asyncio
import socket
from collections.abc import AsyncIterator
from itertools import chain, repeat

import pytest

from rosproxy.forwarding.datagrams import bind
from rosproxy.leases.ports import PortMap, PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.discovery_rates import DiscoveryRates
from rosproxy.ros2.discovery.domain_settings import DomainSettings
from rosproxy.ros2.protocol.rtps import source_prefix
from rosproxy.ros2.registry.locator_ports import REMEMBERED, stand_in_port
from rosproxy.ros2.servers.domain_server import DomainServer
from tests.integration.net import PATIENCE
from tests.unit.ros2.discovery.domains import A, B, reached_at, spdp

PROXY, INSIDE, OUTSIDE = "127.0.7.1", "127.0.7.2", "127.0.7.9"
DOMAIN = 80
RANGE = PortRange(21_000, 21_015)


@pytest.fixture
async def server() -> AsyncIterator[DomainServer]:
    """One that has long been running."""
    settings = DomainSettings(
        number=DOMAIN,
        hosts=(PROXY,),
        ports=PortMap(RANGE, RANGE),
        proxy_address_for=lambda _: PROXY,
        note=lambda *_: None,
        judge=lambda *_: True,
        peers=(HostPort(OUTSIDE, 0),),
    )
    times = chain([0.0], repeat(REMEMBERED + 1))
    started = DomainServer(
        settings, PROXY, times.__next__, lambda address: address == INSIDE, lambda: None
    )
    started.start()
    yield started
    started.close()


def participant(address: str) -> socket.socket:
    sock = bind(address, 0)
    sock.setblocking(False)
    return sock


async def stand_ins_told(sock: socket.socket, prefix: bytes) -> list[HostPort]:
    """Where the next announcement of a participant says that it is reached for discovery."""
    async with asyncio.timeout(PATIENCE):
        while True:
            datagram = await asyncio.get_running_loop().sock_recv(sock, 65536)
            if source_prefix(datagram) == prefix:
                return reached_at(datagram)[:1]


async def test_no_stand_in_is_announced_that_can_not_be_opened(server: DomainServer) -> None:
    """Inside believes the first locators of a participant for as long as that lives."""
    with participant(INSIDE) as insider, participant(OUTSIDE) as outsider:
        inside_port, outside_port = (s.getsockname()[1] for s in (insider, outsider))
        locator = HostPort(OUTSIDE, outside_port)
        wanted = stand_in_port(f"{B.hex()} {locator}", lambda _: 0, lambda _: False)
        assert wanted is not None
        with bind(PROXY, wanted):
            outsider.sendto(spdp(B, OUTSIDE, outside_port), (PROXY, RANGE.first))
            insider.sendto(
                spdp(A, INSIDE, inside_port), (PROXY, server.domain.settings.unicast_port)
            )
            async with asyncio.timeout(PATIENCE):
                while wanted not in server.domain.outside.blocked:
                    await asyncio.sleep(0.01)
            outsider.sendto(spdp(B, OUTSIDE, outside_port), (PROXY, RANGE.first))

            (told,) = await stand_ins_told(insider, B)

        (opened,) = server.domain.outside.stand_ins
        assert told == HostPort(PROXY, opened)
        assert opened != wanted


async def test_who_is_not_selected_has_an_allowance_of_discovery(
    server: DomainServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is held back of it has to be read, too, which takes long."""
    server.select([])
    held = server._selected.held_announcements
    with participant(INSIDE) as insider:
        port, target = insider.getsockname()[1], (PROXY, server.domain.settings.unicast_port)
        with monkeypatch.context() as patch:
            asked = asyncio.Event()

            def none_left(*_: object) -> bool:
                asked.set()
                return False

            patch.setattr(DiscoveryRates, "take", none_left)
            insider.sendto(spdp(A, INSIDE, port), target)
            async with asyncio.timeout(PATIENCE):
                await asked.wait()
        insider.sendto(spdp(B, INSIDE, port), target)
        async with asyncio.timeout(PATIENCE):
            while not held:
                await asyncio.sleep(0.01)
    assert held[INSIDE].keys() == {B}
