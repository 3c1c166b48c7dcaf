"""Ports of the master's host: the proxy opens only ports that the master names."""

import asyncio
from contextlib import AsyncExitStack, closing

import pytest

from examples.demo.fake_http import host_and_port
from tests.abuse.apart import APART, APART_MASTER, NODES, STRANGERS
from tests.abuse.conftest import Abused
from tests.integration.net import connect, exchange, post, refuses, rpc, xml

UPDATES = 64 * 1024 * 1024
"""Bytes that the updates may take, of which the option --max-buffered lets 32 MiB in."""
PER_UPDATE = 1000
"""URIs in a call from outside. 63 calls name all ports of a host."""


@pytest.fixture
def aliased(start_apart, apart_master) -> Abused:
    """A proxy that stands in for the master's host, which is another machine."""
    port = host_and_port(apart_master.uri)[1]
    return start_apart(master_uri=f"http://robot:{port}", master_address=APART_MASTER)


def updates(topic: str, first: int, but_not: str = "") -> bytes:
    uris = [f"http://robot:{port}/" for port in range(first, first + PER_UPDATE)]
    uris = [uri for uri in uris if uri != but_not]
    return post(xml("publisherUpdate", "/master", topic, uris))


async def test_updates_that_name_every_port_of_the_masters_host(aliased, apart_master, make_node):
    """A publisherUpdate at a lease must not open a port of the master's host to inside."""
    node = await make_node(address=NODES[0])
    robot = await make_node("/robot", APART_MASTER, host="robot")
    secret = await asyncio.start_server(lambda *_: None, APART_MASTER)
    port = secret.sockets[0].getsockname()[1]
    lease = await aliased.publish(node)
    await robot.publish(host_and_port(apart_master.uri), "/map")
    with closing(secret), aliased.watched(UPDATES):
        asked = len(apart_master.named("getSystemState"))
        sources = (STRANGERS[0], NODES[1], NODES[0])
        calls = [
            exchange(lease, updates(f"/t{number}", first), sources[number % 3])
            for number, first in enumerate(range(1024, 64_000, PER_UPDATE))
        ]
        again = updates("/map", port, but_not=robot.uri)
        calls += [exchange(lease, again, STRANGERS[0]) for _ in range(5)]
        replies = await asyncio.gather(*calls)
        assert {reply.status for reply in replies} <= {200, 503}
        assert aliased.status()["stand_ins"] == []
        assert await refuses((APART, port), NODES[0])
        assert len(apart_master.named("getSystemState")) - asked <= 2 * len(calls)
        assert (await rpc(lease, "getPid", "/n", source=STRANGERS[0]))[2] == node.pid
        # What the master names is opened meanwhile.
        assert (await node.subscribe(aliased.master, "/map"))[2] == [robot.uri]
        stand_in = (APART, host_and_port(robot.uri)[1])
        assert (await rpc(stand_in, "getPid", "/n", source=NODES[0]))[2] == robot.pid


async def test_more_nodes_on_the_masters_host_than_there_are_stand_ins(
    aliased, apart_master, make_node
):
    """A node may register any port at the master. The total of stand-ins is bounded."""
    node = await make_node(address=NODES[0])
    robot = await make_node("/robot", APART_MASTER, host="robot")
    await robot.publish(host_and_port(apart_master.uri), "/map")
    apart_master.calls_back = False
    for number in range(3000):
        apart_master.register(
            "publishers", "/many", f"/r{number}", f"http://robot:{20000 + number}/"
        )
    lease = await aliased.publish(node)
    with aliased.watched():
        assert len((await node.subscribe(aliased.master, "/many"))[2]) == 3000
        assert len(aliased.status()["stand_ins"]) <= 1024
        async with AsyncExitStack() as stack:
            for row in aliased.status()["stand_ins"][:200]:
                await stack.enter_async_context(connect((APART, row["port"]), NODES[1]))
            assert (await node.subscribe(aliased.master, "/map"))[2] == [robot.uri]
            stand_in = (APART, host_and_port(robot.uri)[1])
            assert (await rpc(stand_in, "getPid", "/n", source=NODES[0]))[2] == robot.pid
            assert (await rpc(lease, "getPid", "/n", source=STRANGERS[0]))[2] == node.pid
