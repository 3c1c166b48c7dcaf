"""ROS 1 on the kernel plane: the proxy is killed, and starts again with another policy."""

import asyncio
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest

from examples.demo.fake_http import Address
from tests.abuse.apart import APART_HOST, NODES, STRANGERS, Apart
from tests.abuse.conftest import Abused
from tests.integration.net import (
    PATIENCE,
    Wire,
    connect,
    read_header,
    rpc,
    topic_header,
)
from tests.integration.proxy import PORTS

PEER, NEWCOMER = STRANGERS[:2]


@pytest.fixture
def forwarding(_apart: Apart) -> Iterator[None]:
    """Let the proxy's machine forward, as containers of Docker do."""

    def forward(value: int) -> None:
        setting = f"echo {value} > /proc/sys/net/ipv4/ip_forward"
        subprocess.run([*_apart.prefix, "sh", "-c", setting], check=True)

    forward(1)
    yield
    forward(0)


@pytest.fixture
def abused(start_apart, forwarding) -> Abused:
    """A proxy for ROS 1 with the kernel plane."""
    made: Abused = start_apart(data_plane="kernel")
    return made


def plane(abused: Abused) -> dict[str, Any]:
    """The data plane of the talker in the status."""
    (node,) = (n for n in abused.status()["nodes"] if "/talker" in n["nodes"])
    told: dict[str, Any] = node["data_plane"]
    return told


async def fast_port_of(abused: Abused, lease: Address) -> Address:
    """The port by which the kernel forwards the topic.

    While the kernel does not forward, the proxy names the lease, which ends with the proxy.
    """
    async with asyncio.timeout(PATIENCE):
        while True:
            topic = await rpc(lease, "requestTopic", "/x", "/chatter", [["TCPROS"]], source=PEER)
            port: int = topic[2][2]
            told = plane(abused)
            if told["plane"] == "kernel" and told["port"] == port:
                return APART_HOST, port
            await asyncio.sleep(0.05)


async def is_echoed(wire: Wire) -> bool:
    """Whether the node echoes what a subscriber sends. False after the end of the connection."""
    try:
        await wire.send(b"echo")
        return await wire.exactly(4) == b"echo"
    except (OSError, asyncio.IncompleteReadError):
        return False


async def is_cut(wire: Wire) -> None:
    """Check that a connection ends."""
    async with asyncio.timeout(PATIENCE):
        while await is_echoed(wire):
            await asyncio.sleep(0.05)


async def is_refused(port: Address, source: str) -> bool:
    """Whether a port refuses a connection from a source."""
    try:
        async with connect(port, source):
            return False
    except ConnectionRefusedError:
        return True


async def test_a_denied_topic_after_a_kill(abused, make_node, apart_master):
    """The kernel forwarded a topic that the new policy denies, old and new connections.

    The new process knows no node as long as the master is away.
    """
    node = await make_node("/talker", NODES[0])
    fast_port = await fast_port_of(abused, await abused.publish(node))
    async with connect(fast_port, PEER) as subscriber:
        await subscriber.send(topic_header())
        await read_header(subscriber)
        assert await is_echoed(subscriber)
        await apart_master.stop()
        abused.kill()
        assert await is_echoed(subscriber)
        abused.options["policy"] = "deny publish /chatter"
        abused.start()
        await is_cut(subscriber)
    assert await is_refused(fast_port, NEWCOMER)


async def test_a_denied_topic_after_the_node_has_lost_its_fast_port(
    start_apart, forwarding, make_node, tmp_path
):
    """Connections through the lost port stayed when the policy changed."""
    policy = tmp_path / "policy"
    policy.touch()
    abused = start_apart(data_plane="kernel", policy_file=str(policy))
    node = await make_node("/talker", NODES[0])
    fast_port = await fast_port_of(abused, await abused.publish(node))
    async with connect(fast_port, PEER) as subscriber:
        await subscriber.send(topic_header())
        await read_header(subscriber)
        for number in range(1, PORTS):  # each needs a port of the range
            await abused.publish(await make_node(f"/other{number}", NODES[number]))
        assert not plane(abused)["port"]
        assert await is_echoed(subscriber)
        policy.write_text("deny publish /chatter")
        await is_cut(subscriber)
