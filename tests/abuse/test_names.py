"""Host names: a neighbour with hanging or too many look-ups keeps no other name from use."""

import asyncio
from contextlib import AsyncExitStack

from examples.demo.fake_http import host_and_port
from tests.abuse.apart import NODES, STRANGERS, a_silent_name_server
from tests.integration.net import (
    OTHER_NODE,
    connect,
    exchange,
    greet,
    knock,
    post,
    rpc,
    topic_header,
    until,
    xml,
)

OF_NODE = "0x7f00020b"
"""A name of NODE, which the system resolves without a name server (inet_aton(3))."""


def registration(name: str, host: str) -> bytes:
    return post(xml("registerPublisher", name, "/t", "x/Y", f"http://{host}:4000/"))


async def seen_by(master, node, topic: str):
    """The publishers that another node inside is given."""
    return (await node.subscribe(master, topic))[2]


async def test_names_that_are_looked_up_while_there_is_no_thread(abused, make_node):
    """After 64 look-ups for which no thread could be started no name was looked up any more."""
    node = await make_node()
    other = await make_node("/other", OTHER_NODE)
    late = await make_node("/late", host=OF_NODE)
    lease = await abused.publish(node)
    with abused.watched():
        async with AsyncExitStack() as stack:
            wire = await stack.enter_async_context(connect(lease))
            await wire.send(topic_header())
            assert await wire.exactly(4)
            abused.group.limit_threads(0)
            calls = [
                exchange(abused.master, registration(f"/n{i}", f"name{i}.invalid"), source)
                for i, source in enumerate([f"127.0.2.{n}" for n in range(21, 31)] * 12)
            ]
            await asyncio.gather(*calls)
            assert await knock(lease, topic_header()) == "reset"
            assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
            abused.group.limit_threads(None)
        assert (await greet(lease, topic_header()))["callerid"] == node.name
        assert (await late.publish(abused.master, "/late"))[0] == 1
        assert await seen_by(abused.master, other, "/late") == [late.uri]


async def test_names_that_hang(start_apart, make_node):
    """A neighbour's names go to a name server that never answers. Another neighbour's names
    resolve.
    """
    with a_silent_name_server({"goodbox": NODES[1]}):
        apart = start_apart()
        node = await make_node("/node", NODES[0])
        other = await make_node("/other", NODES[2])
        named = await make_node("/named", NODES[1], host="goodbox")
        lease = await apart.publish(node)
        with apart.watched():
            calls = [
                exchange(apart.master, registration(f"/n{i}", f"name{i}.test"), NODES[3])
                for i in range(300)
            ]
            attack = asyncio.gather(*calls)
            await until(lambda: "too many name look-ups" in apart.text, "the limit is reached")
            assert (await named.publish(apart.master, "/named"))[0] == 1
            assert await seen_by(apart.master, other, "/named") == [named.uri]
            assert (await rpc(lease, "getPid", "/n", source=STRANGERS[0]))[2] == node.pid
            await attack
        assert host_and_port(named.uri)[0] == "goodbox"
