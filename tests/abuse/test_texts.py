"""Whatever is said, however long and however often: log, /status and memory stay small."""

import asyncio
from contextlib import AsyncExitStack
from xmlrpc.client import Fault

from examples.demo.fake_http import value
from rosproxy.ros1.protocol.name_lengths import LONGEST_NAME
from rosproxy.shared.documents.status_bounds import MOST_BYTES
from tests.integration.net import (
    HOST,
    NODE,
    OTHER_NODE,
    connect,
    exchange,
    post,
    rpc,
    topic_header,
    xml,
)
from tests.integration.test_texts import FORGED

SUBSCRIBERS = 32 * 1024 * 1024
"""Bytes of 400 relayed connections, and of the status of these."""
REGISTRATIONS = 72 * 1024 * 1024
"""Bytes of multicalls of 400 registrations, of all that are noted, and of the status of these."""
MB = 1000 * 1000
FILLED = "é" * (LONGEST_NAME - 10)
"""Most of the longest allowed name. In JSON each letter takes six characters."""


def register(name: str, topic: str, uri: str) -> dict[str, object]:
    return {"methodName": "registerPublisher", "params": [name, topic, "x/Y", uri]}


async def test_uris_of_a_megabyte_for_one_node(abused, node):
    """A hundred such URIs once took 196 MB for the node's lifetime."""
    lease = await abused.publish(node)
    with abused.watched():
        for number in range(100):
            uri = f"{node.uri}{number}" + "x" * MB
            body = xml("registerPublisher", node.name, "/t", "x/Y", uri)
            reply = await exchange(abused.master, post(body), NODE)
            assert reply.value[0] == -1
            uri = uri[: LONGEST_NAME + number]
            assert (await node.call(abused.master, "registerPublisher", "/t", "x/Y", uri))[0] == 1
        assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
    assert "long_name" in abused.refused()


async def test_a_node_that_registers_as_much_as_it_may(abused, make_node):
    """With the longest names, until the proxy refuses: 2 MB of names, and more in JSON."""
    evil = await make_node("/evil", OTHER_NODE)
    node = await make_node()
    lease = await abused.publish(node)
    with abused.watched(REGISTRATIONS):
        for number in range(6):
            calls = [
                register(evil.name, f"/{FILLED}{number * 400 + i}", evil.uri) for i in range(400)
            ]
            await rpc(abused.master, "system.multicall", calls, source=OTHER_NODE)
        shown = {
            name: endpoint for endpoint in abused.status()["nodes"] for name in endpoint["nodes"]
        }
        assert shown[evil.name]["left_out"] > 0
        assert shown[node.name]["publishes"] == ["/chatter"]
        assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
    assert "too_many_names" in abused.refused()


async def test_subscribers_with_long_names(abused, make_node):
    """From outside, as many as a port accepts from an address."""
    node = await make_node()
    other = await make_node("/other", OTHER_NODE)
    lease = await abused.publish(node)
    other_lease = await abused.publish(other)
    with abused.watched(SUBSCRIBERS):
        async with AsyncExitStack() as stack:
            for number in range(400):
                wire = await stack.enter_async_context(connect(lease))
                await wire.send(topic_header("/chatter", f"/{FILLED}{number}"))
                assert await wire.exactly(4)
            assert len(abused.get("/status")) <= MOST_BYTES
            assert (await rpc(other_lease, "getPid", "/n"))[2] == other.pid


async def test_names_that_forge_lines_of_the_log(abused, master, make_node):
    """Wherever a neighbour may say something: calls, headers, replies, and thousands of times."""
    evil = await make_node("/evil", OTHER_NODE)
    node = await make_node()
    lease = await abused.publish(node)
    await evil.publish(abused.master)
    theirs = abused.lease(evil)
    evil.answers["requestTopic"] = value([-1, FORGED, []])
    evil.answers["getPid"] = value(Fault(1, FORGED))
    with abused.watched():
        for number in range(300):
            name = f"{FORGED}{number}"
            uri = f"http://{OTHER_NODE}:{number + 1}/{name}"
            body = xml("registerPublisher", name, name, name, uri)
            calls = [
                exchange(abused.master, post(body), OTHER_NODE),
                exchange(abused.master, post(xml(name, name)), OTHER_NODE),
                exchange(theirs, post(xml("requestTopic", name, name, [["TCPROS"]]))),
                exchange(theirs, post(xml("publisherUpdate", name, name, [uri]))),
                exchange(theirs, post(b"", "Content-Encoding: \x1b[2J")),
            ]
            await asyncio.gather(*calls, return_exceptions=True)
            async with connect(theirs) as wire:
                await wire.send(topic_header(name, name))
        assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
    assert [line for line in abused.log if not line.startswith("20")] == []
    assert [line for line in abused.log if not line.rstrip("\n").isprintable()] == []
    assert not [line for line in abused.log if line.startswith("2026-01-01")]
    assert HOST in abused.get("/status")
