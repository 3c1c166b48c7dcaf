"""The datagrams that the kernel drops because a receive buffer is full."""

import socket
from collections.abc import Iterator

import pytest

from rosproxy.forwarding.buffer_sizes import UDP_RECEIVE_BUFFER_BYTES
from rosproxy.forwarding.datagrams import bind
from rosproxy.ros2.servers.receive_buffers import PERIOD_S, ReceiveBuffers

DATAGRAM = bytes(60_000)
TOO_MANY = 2 * UDP_RECEIVE_BUFFER_BYTES // len(DATAGRAM) + 1
"""The kernel may grant twice the buffer, because the sender's records may be small."""


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with bind("127.0.0.1", 0) as sock:
        yield sock


@pytest.fixture
def buffers(receiver: socket.socket) -> ReceiveBuffers:
    made = ReceiveBuffers()
    made.sockets.add(receiver)
    return made


def fill(receiver: socket.socket) -> int:
    """Send more than the buffer takes. Return the number of datagrams that are lost."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(TOO_MANY):
            sender.sendto(DATAGRAM, receiver.getsockname())
    arrived = 0
    try:
        while True:
            receiver.recv(len(DATAGRAM))
            arrived += 1
    except BlockingIOError:
        return TOO_MANY - arrived


def test_what_finds_no_room_counts(receiver: socket.socket, buffers: ReceiveBuffers) -> None:
    assert buffers.overflowed == 0
    lost = fill(receiver)
    assert lost > 0
    assert buffers.overflowed == lost


def test_a_closed_socket_still_counts(receiver: socket.socket, buffers: ReceiveBuffers) -> None:
    lost = fill(receiver)
    buffers.remove(receiver)
    assert buffers.overflowed == lost


def test_the_last_minute_is_counted(receiver: socket.socket, buffers: ReceiveBuffers) -> None:
    assert buffers.overflowed_recently == 0
    fill(receiver)
    buffers.sample(100.0)
    assert buffers.overflowed_recently == 0, "this may have been before the minute"
    lost = fill(receiver)
    buffers.sample(100.0 + PERIOD_S)
    assert buffers.overflowed_recently == lost
    buffers.sample(100.0 + PERIOD_S + 1)
    assert buffers.overflowed_recently == 0


def test_the_size_is_what_the_kernel_has_granted(buffers: ReceiveBuffers) -> None:
    """With NET_ADMIN all of it, else net.core.rmem_max at most."""
    with open("/proc/sys/net/core/rmem_max", encoding="ascii") as file:
        most = int(file.read())
    granted = {UDP_RECEIVE_BUFFER_BYTES, min(UDP_RECEIVE_BUFFER_BYTES, most)}
    assert buffers.size_bytes in granted
    assert ReceiveBuffers().size_bytes == 0
