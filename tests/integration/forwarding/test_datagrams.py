"""The relay of datagrams, in a single direction."""

import asyncio
import socket
from collections.abc import Iterator

import pytest

from rosproxy.forwarding.datagrams import DatagramRelay, bind
from rosproxy.ros2.servers.groups import GROUP, group_socket, join, send_through
from rosproxy.shared.addresses import HostPort
from tests.integration.net import NODE, OTHER_NODE, OUTSIDE, PROXY, until

BOTH_LOOPS = True


@pytest.fixture
def target() -> Iterator[socket.socket]:
    with bind(NODE, 0) as sock:
        yield sock


def sender(address: str) -> socket.socket:
    sock = bind(address, 0)
    sock.setblocking(False)
    return sock


async def received(sock: socket.socket) -> bytes:
    async with asyncio.timeout(5):
        return await asyncio.get_running_loop().sock_recv(sock, 65536)


def relay_to(target: socket.socket, *sources: str) -> tuple[DatagramRelay, list[bool]]:
    """A relay, and the list of its reported ends."""
    ends: list[bool] = []
    address = HostPort(*target.getsockname())
    return DatagramRelay(bind(PROXY, 0), sources, address, lambda: ends.append(True)), ends


async def test_datagrams_arrive_as_they_were_sent(target: socket.socket) -> None:
    relay, _ = relay_to(target, OUTSIDE)
    with sender(OUTSIDE) as out:
        for data in (b"a", b"b" * 1500, b"c" * 60_000):
            out.sendto(data, (PROXY, relay.port))
            assert await received(target) == data
    assert relay.sent == 61_501
    relay.close()


async def test_datagrams_of_other_sources_are_dropped(target: socket.socket) -> None:
    relay, _ = relay_to(target, OUTSIDE)
    with sender(OTHER_NODE) as stranger, sender(OUTSIDE) as out:
        stranger.sendto(b"forged", (PROXY, relay.port))
        await until(lambda: relay.dropped, "the datagram is dropped")
        out.sendto(b"real", (PROXY, relay.port))
        assert await received(target) == b"real"
    relay.close()


async def test_the_end_of_the_target_ends_the_relay_and_the_sender_gets_an_error() -> None:
    gone = bind(NODE, 0)
    relay, ends = relay_to(gone, OUTSIDE)
    gone.close()
    with sender(OUTSIDE) as out:
        out.connect((PROXY, relay.port))
        out.send(b"one")
        await until(lambda: ends, "the relay ends")
        relay.close()
        out.send(b"two")
        with pytest.raises(ConnectionRefusedError):
            await received(out)


@pytest.mark.parametrize("address", ["0.0.0.0", "::"])
def test_multicast_that_another_socket_has_joined_is_not_received(address: str) -> None:
    """A stand-in may have the multicast port of a domain of which the proxy knows nothing."""
    with bind(address, 0) as sock, group_socket(HostPort(GROUP, 0)) as member, sender(NODE) as out:
        join(member, NODE)
        send_through(out, NODE, loop=True)
        port = sock.getsockname()[1]

        out.sendto(b"to the group", (GROUP, port))
        out.sendto(b"to the port", (NODE, port))

        assert sock.recv(100) == b"to the port"
