"""ROS 1 on the kernel plane: forged SYNs at a fast port do not disturb subscribers."""

import struct
import subprocess
from collections.abc import Iterator
from ipaddress import IPv4Network
from socket import IPPROTO_TCP, inet_aton
from typing import Any

import pytest

from examples.demo.fake_http import Address
from tests.abuse.apart import APART_HOST, FAR, NODES, STRANGERS, Apart
from tests.abuse.conftest import Abused
from tests.abuse.ros2_neighbours import Flood
from tests.integration.net import Wire, connect, read_header, rpc, topic_header, until

FORGED_NETWORK = IPv4Network("198.19.0.0/16")
"""The forged sources."""
FORGED_PORTS = (b"\xa0\x00", b"\xa0\x01")
ROUTER = "198.18.1.253"
"""The way to the forged sources. No machine has this address."""
PER_SECOND = 5000
ENOUGH = 70_000
"""A masquerade takes a port of the proxy's address for each SYN: there are some 64,500."""
LIMIT = 120.0
"""Seconds that the forged SYNs may take."""
PEER = STRANGERS[0]
NEWCOMERS = STRANGERS[1:]


@pytest.fixture
def forwarding(_apart: Apart) -> Iterator[Apart]:
    """The proxy's machine, which forwards, and which has a route to the forged sources."""

    def run(*words: str) -> None:
        subprocess.run([*_apart.prefix, *words], check=True)

    run("sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")
    # Without a route Linux answers no SYN. No machine on the cable has the router's address.
    run("ip", "neighbor", "add", ROUTER, "lladdr", "02:00:00:00:00:01", "dev", FAR)
    run("ip", "route", "add", str(FORGED_NETWORK), "via", ROUTER)
    yield _apart
    run("ip", "route", "delete", str(FORGED_NETWORK))
    run("ip", "neighbor", "delete", ROUTER, "dev", FAR)
    run("sh", "-c", "echo 0 > /proc/sys/net/ipv4/ip_forward")


@pytest.fixture
def abused(start_apart, forwarding) -> Abused:
    """A proxy for ROS 1 with the kernel plane."""
    made: Abused = start_apart(data_plane="kernel")
    return made


def syn(source: str, to: Address, port: bytes) -> bytes:
    """An IPv4 packet that opens a TCP connection. The kernel fills in zero fields of the head."""
    head = struct.pack(">BBHHHBBH", 0x45, 0, 40, 0, 0, 64, IPPROTO_TCP, 0)
    addresses = inet_aton(source) + inet_aton(to[0])
    segment = port + struct.pack(">HIIBBH", to[1], 1, 0, 0x50, 0x02, 65535)
    pseudo_head = addresses + struct.pack(">HH", IPPROTO_TCP, 20)
    total = sum(struct.unpack(">14H", pseudo_head + segment))
    folded = (total & 0xFFFF) + (total >> 16)
    checksum = ~((folded & 0xFFFF) + (folded >> 16)) & 0xFFFF
    return head + addresses + segment + struct.pack(">HH", checksum, 0)


def plane(abused: Abused) -> dict[str, Any]:
    """The data plane of the only node's topics in the status."""
    (node,) = abused.status()["nodes"]
    told: dict[str, Any] = node["data_plane"]
    return told


async def follow(wire: Wire) -> None:
    """Subscribe to the topic."""
    await wire.send(topic_header())
    await read_header(wire)


async def echo(wire: Wire, content: bytes) -> None:
    """Check that the node echoes these bytes, and nothing else."""
    await wire.send(content)
    assert await wire.exactly(len(content)) == content


async def test_forged_syns_at_a_fast_port(abused, make_node):
    """SYNs that took all ports of the masquerade kept every new subscriber out for 60 s."""
    node = await make_node("/talker", NODES[0])
    lease = await abused.publish(node)
    topic = await rpc(lease, "requestTopic", "/x", "/chatter", [["TCPROS"]], source=PEER)
    assert topic[2][1] == APART_HOST
    fast_port = APART_HOST, topic[2][2]
    await until(lambda: plane(abused)["plane"] == "kernel", "the kernel forwards")
    forged = [(str(source), fast_port, port) for port in FORGED_PORTS for source in FORGED_NETWORK]
    async with connect(fast_port, PEER) as subscriber:
        await follow(subscriber)
        flood = Flood(forged, is_forged=True, per_second=PER_SECOND, make_packet=syn)
        with abused.watched(), flood:
            await until(lambda: flood.sent >= ENOUGH, "the flood has come", within=LIMIT)
            for source in NEWCOMERS:
                async with connect(fast_port, source) as newcomer:
                    await follow(newcomer)
                    await echo(newcomer, b"new")
                await echo(subscriber, b"old")
