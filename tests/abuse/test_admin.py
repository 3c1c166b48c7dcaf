"""The admin endpoint: with large documents, and with readers that do not read."""

import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from functools import partial

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.registry.participants import MOST_ENDPOINT_BYTES_PER_ADDRESS
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_bounds import MOST_BYTES
from rosproxy_operator.common.proxy_client import ProxyClient
from tests.abuse.apart import APART, APART_HOST, INSIDE, NODES, STRANGERS
from tests.abuse.conftest import Abused
from tests.abuse.ros2_neighbours import WELL_KNOWN, Address, Flood, Participant
from tests.integration.net import until
from tests.unit.ros2.discovery.domains import SEDP_WRITERS, spdp
from tests.unit.ros2.protocol.messages import data, message, payload

NAMES_OF_WRITERS = 64 * 1024 * 1024
"""Bytes for the writers of five addresses, and for making their status."""
GOOD = bytes([1, 15, 1]) + bytes(9)
EVIL = NODES[1:6]
PORTS = 64
ANNOUNCED = APART, WELL_KNOWN
PARTICIPANTS = 4
WRITERS = 2048
"""Participants at an address, and writers of each: more than the proxy remembers."""
WRITER_BYTES = 1200
"""Bytes that such a writer takes at most."""
PER_SECOND = 1000
"""Datagrams that the addresses send in a second: less than the proxy reads of five."""
READERS = 32
MORE = 16 * 1024 * 1024
"""Bytes that readers may take which read nothing."""


@pytest.fixture
def abused(start_abused, _apart) -> Abused:
    """A proxy for ROS 2 on a separate machine."""
    first = free_ports(PORTS)
    return start_abused(
        ros=2,
        prefix=_apart.prefix,
        advertise_host=APART_HOST,
        inside_network=INSIDE,
        admin_bind=f"{APART}:{free_ports(1)}",
        port_range=f"{first}-{first + PORTS - 1}",
        ros2_peer=f"{STRANGERS[0]}:{WELL_KNOWN}",
    )


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value) + 1) + value + b"\0" * (4 - len(value) % 4)


def prefix(address: str, number: int) -> bytes:
    """The GUID prefix of a hostile participant at an address."""
    return bytes([1, 15, 9]) + bytes(map(int, address.split("."))) + number.to_bytes(5, "big")


def writers(address: str, number: int) -> Iterator[tuple[str, Address, bytes]]:
    """The announcements of a participant and of its writers with long names."""
    own = prefix(address, number)
    yield address, ANNOUNCED, spdp(own, address, 9000 + number)
    described = [
        payload(
            [
                (Pid.ENDPOINT_GUID, own + writer.to_bytes(3, "big") + b"\3"),
                (Pid.TOPIC_NAME, text(b"rt/" + b"x" * 240 + b"%d_%d" % (number, writer))),
                # Both names have the longest length that the proxy keeps.
                (Pid.TYPE_NAME, text(b"std_msgs::msg::dds_::" + b"Y" * 200 + b"_")),
            ]
        )
        for writer in range(WRITERS)
    ]
    for start in range(0, WRITERS, 8):
        submessages = [
            data(content, writer=SEDP_WRITERS, sequence=start + offset + 1)
            for offset, content in enumerate(described[start : start + 8])
        ]
        yield address, ANNOUNCED, message(*submessages, prefix=own)


def told_writers(abused: Abused) -> int:
    """The number of hostile participants' writers that the status shows or counts."""
    (domain,) = abused.status()["domains"]
    return sum(
        len(participant["publishes"]) + participant["left_out"]
        for participant in domain["inside"]
        if participant["address"] in EVIL
    )


async def announce_many(abused: Abused) -> None:
    """Fill the proxy's memory for the writers of five addresses, which all answer the proxy."""
    for address in EVIL:
        with closing(Participant(prefix(address, 0), address, 9000)) as evil:
            evil.proves_to_receive(partial(evil.announce, ANNOUNCED))
    said = [
        datagram
        for address in EVIL
        for number in range(PARTICIPANTS)
        for datagram in writers(address, number)
    ]
    with Flood(said, is_forged=False, per_second=PER_SECOND):
        remembered = len(EVIL) * MOST_ENDPOINT_BYTES_PER_ADDRESS / WRITER_BYTES
        await until(lambda: told_writers(abused) >= remembered, "as many are known", 120)


async def test_a_status_of_many_writers_with_long_names(abused: Abused) -> None:
    """With 20 MB, the operator would take the proxy for another program."""
    client = ProxyClient()
    with closing(Participant(GOOD, NODES[0], WELL_KNOWN)) as good:
        good.announce(ANNOUNCED)
        with abused.watched(NAMES_OF_WRITERS):
            await announce_many(abused)
        good.announce(ANNOUNCED)
        try:
            status = await client.status(HostPort(*abused.admin))
        finally:
            await client.close()
    assert 0.8 * MOST_BYTES < len(abused.get("/status")) <= MOST_BYTES
    (domain,) = status.domains
    (shown,) = [p for p in domain.inside if p.address == good.address]
    assert shown.left_out == 0
    assert {p.address for p in domain.inside} == {good.address, *EVIL}
    assert len(domain.inside) == 1 + len(EVIL) * PARTICIPANTS
    for address in EVIL:
        assert any(p.publishes for p in domain.inside if p.address == address)


def is_refused(abused: Abused, source: str) -> bool:
    """Whether an address has the maximum of pending replies."""
    with socket.create_connection(abused.admin, 10, (source, 0)) as asking:
        asking.sendall(b"GET /status HTTP/1.0\r\n\r\n")
        return asking.recv(64).startswith(b"HTTP/1.0 503")


async def test_readers_that_take_nothing(abused: Abused) -> None:
    """32 readers once took 681 MB in 14 s, because replaced readers were kept."""
    await announce_many(abused)
    len(abused.get("/status"))
    with abused.watched(), ExitStack() as stack:
        most = abused.most_memory()
        for _ in range(3):
            for source in EVIL:
                for _ in range(READERS):
                    reader = socket.socket()
                    stack.callback(reader.close)
                    reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                    reader.bind((source, 0))
                    reader.connect(abused.admin)
                    with suppress(ConnectionError):
                        reader.sendall(b"GET /status HTTP/1.1\r\nHost: x\r\n\r\n" * 4)
                await until(partial(is_refused, abused, source), "they stall")
        assert abused.most_memory() - most < MORE
        await until(lambda: not is_refused(abused, NODES[0]), "another address is served")
