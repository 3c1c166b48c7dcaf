"""Unselected callers, forged identities, and used-up ranges: other nodes are served."""

import asyncio
import json
from contextlib import AsyncExitStack
from time import monotonic

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.shared.setting_kinds import hash_token
from tests.abuse.apart import APART_HOST, NODES, STRANGERS
from tests.integration.claims import claim, silent_servers
from tests.integration.net import (
    HOST,
    NODE,
    OTHER_NODE,
    THIRD_NODE,
    connect,
    exchange,
    greet,
    knock,
    post,
    rpc,
    service_header,
    topic_header,
    until,
    xml,
)
from tests.integration.proxy import PORTS

READ_AHEAD = 64 * 1024 * 1024
"""Bytes that may be read ahead of 400 connections, before a call on each is refused."""
AT_ONCE = 3.0
"""Seconds after which a node that registers has been kept waiting, on a busy machine too."""
TOKEN = "the operator's"


def registration(name: str, uri: str) -> bytes:
    return post(xml("registerPublisher", name, "/t", "x/Y", uri))


async def test_strangers_flood_the_master_port(apart, apart_master, make_node):
    node = await make_node(address=NODES[0])
    lease = await apart.publish(node)
    with apart.watched(READ_AHEAD):
        async with AsyncExitStack() as stack:
            for number in range(400):
                source = STRANGERS[number % len(STRANGERS)]
                wire = await stack.enter_async_context(connect(apart.master, source))
                await wire.send(post(b" " * 100_000, "Content-Length: 4000000"))
            calls = [
                exchange(apart.master, registration(f"/s{i}", f"http://{source}:4000/"), source)
                for i, source in enumerate(STRANGERS * 10)
            ]
            refused = asyncio.gather(*calls)
            began = monotonic()
            assert (await node.publish(apart.master, "/more"))[0] == 1
            assert monotonic() - began < AT_ONCE
            assert {reply.status for reply in await refused} == {403}
            assert (await rpc(lease, "getPid", "/n", source=STRANGERS[0]))[2] == node.pid
        assert len(apart.status()["nodes"]) == 1
    assert set(apart_master.nodes) == {node.name}


async def test_unselected_callers_flood_the_master_port(start_apart, make_node):
    """With an operator, a new container waits for the update as long as unselected callers.

    Some callers come before the operator's first update after the start.
    """
    apart = start_apart(admin_token_hash=hash_token(TOKEN))
    node = await make_node(address=NODES[0])
    late = await make_node("/late", NODES[1])

    async def select(*addresses: str) -> None:
        told = json.dumps({"selected": addresses}).encode()
        request = post(told, f"Authorization: Bearer {TOKEN}", path="/containers")
        assert (await exchange(apart.admin, request, STRANGERS[0])).status == 200

    early = asyncio.gather(
        *(
            exchange(apart.master, registration(f"/e{i}", f"http://{source}:4000/"), source)
            for i, source in enumerate(NODES[8:12])
        )
    )
    await until(lambda: apart.status()["master"]["up"], "the master is found")
    await select(NODES[0])
    lease = await apart.publish(node)
    with apart.watched():
        calls = [
            exchange(apart.master, registration(f"/s{i}", f"http://{source}:4000/"), source)
            for i, source in enumerate(NODES[2:8] * 80)
        ]
        refused = asyncio.gather(*calls)
        waiting = asyncio.create_task(late.publish(apart.master))
        assert (await node.publish(apart.master, "/more"))[0] == 1
        await select(NODES[0], NODES[1])
        began = monotonic()
        assert (await waiting)[0] == 1
        assert monotonic() - began < AT_ONCE
        assert (await rpc(lease, "getPid", "/n", source=STRANGERS[0]))[2] == node.pid
        assert {reply.status for reply in [*await refused, *await early]} == {403}
    assert {name for endpoint in apart.status()["nodes"] for name in endpoint["nodes"]} == {
        node.name,
        late.name,
    }


async def test_dead_uris_of_many_sources(abused, make_node):
    """Some refuse, behind some are programs that never answer; all ports go to nodes that live."""
    sources = [f"127.0.2.{number}" for number in range(21, 29)]
    nodes = [await make_node(f"/n{i}", (NODE, THIRD_NODE)[i % 2]) for i in range(PORTS)]
    with abused.watched():
        async with silent_servers(OTHER_NODE, 8) as silent:
            dead = [(source, f"http://{source}:{i}/") for i in range(1, 41) for source in sources]
            mute = [
                (OTHER_NODE, f"http://{server.address[0]}:{server.address[1]}/")
                for server in silent
            ]
            calls = [
                exchange(abused.master, registration(f"/d{i}", uri), source)
                for i, (source, uri) in enumerate([*dead, *mute * 5])
            ]
            attack = asyncio.gather(*calls, return_exceptions=True)
            await until(lambda: len(abused.status()["nodes"]) == PORTS, "all ports are taken")
            for node in nodes:
                began = monotonic()
                assert (await node.publish(abused.master))[0] == 1
                assert monotonic() - began < AT_ONCE
            leases = [abused.lease(node) for node in nodes]
            assert [(await rpc(lease, "getPid", "/n"))[2] for lease in leases] == [100] * PORTS
            attack.cancel()


async def test_forged_addresses_of_others(apart, apart_master, make_node):
    """A forged registration publishes neither an unknown node nor an outside node."""
    evil = await make_node("/evil", NODES[0])
    node = await make_node("/good", NODES[1])
    victims = [await make_node("/victim", NODES[2]), await make_node("/robot", STRANGERS[0])]
    lease = await apart.publish(node)
    with apart.watched():
        for victim in [*victims, node]:
            calls = [
                {"methodName": "registerPublisher", "params": [f"/evil{i}", "/rosout", "*", uri]}
                for i, uri in enumerate([victim.uri] * 100)
            ]
            await rpc(apart.master, "system.multicall", calls, source=evil.address)
        assert (await rpc(lease, "getPid", "/n", source=STRANGERS[1]))[2] == node.pid
        for endpoint in apart.status()["nodes"]:
            address = APART_HOST, endpoint["port"]
            if address != lease:
                assert await knock(address, topic_header("/rosout"), STRANGERS[1]) != "answered"
    asked = {header["callerid"] for victim in victims for header in victim.headers}
    assert asked <= {"/rosproxy"}  # the proxy only asks for the name
    assert apart_master.nodes[node.name].startswith(f"http://{APART_HOST}:{lease[1]}/")
    # Outside reaches the URI of /robot without the proxy, so such a registration may pass.
    assert victims[0].uri not in apart_master.nodes.values()


@pytest.mark.parametrize("kind", ["refusing", "silent"])
async def test_a_range_full_of_stale_claims(start_abused, master, make_node, kind):
    """Former proxies left eight dead nodes. A new node registers in the first second."""
    first = free_ports(PORTS)
    node = await make_node()
    async with silent_servers(OTHER_NODE, PORTS) as silent:
        for number, server in enumerate(silent):
            inside = number + 1 if kind == "refusing" else server.address[1]
            await claim(master, f"/dead{number}", first + number, f"{OTHER_NODE}:{inside}")
        ports = f"{first}-{first + PORTS - 1}"
        abused = start_abused(master_uri=master.uri, port_range=ports)
        began = monotonic()
        with abused.watched():
            assert (await node.serve(abused.master))[0] == 1
            assert monotonic() - began < AT_ONCE
            assert master.holds("services", "/add") == [f"rosrpc://{HOST}:{abused.lease(node)[1]}"]
            assert (await greet(abused.lease(node), service_header()))["callerid"] == node.name
