"""Recovery of many nodes: what is asked once for all must not be asked once for each."""

import asyncio
from typing import Any

import pytest

from examples.demo.fake_http import host_and_port
from examples.demo.fake_node import FakeNode
from tests.integration.net import looks, refuses, until
from tests.integration.proxy import Proxy

NODES = 7


@pytest.fixture
async def nodes(make_node: Any) -> list[FakeNode]:
    return [await make_node(f"/n{number}") for number in range(NODES)]


async def populate(proxy: Proxy, nodes: list[FakeNode]) -> None:
    for node in nodes:
        await node.publish(proxy.master, f"{node.name}/out")


def all_served(proxy: Proxy) -> bool:
    registry = proxy.ros1.context.registry
    return len(registry) == NODES and all(endpoint.trusted for endpoint in registry)


async def test_each_node_is_asked_for_its_topics_once(make_proxy, master, nodes):
    proxy = await make_proxy(probe_interval=60, probe_timeout=3)
    await populate(proxy, nodes)
    for node in nodes:
        node.calls.clear()
        node.delay = 0.6  # the proxy asks meanwhile
    await proxy.restart()
    await until(lambda: all_served(proxy), "all are served")
    await looks(master)  # and the prober, more often
    for node in nodes:
        assert [method for method, _ in node.calls].count("getPublications") == 1


async def test_nodes_that_answer_late_are_announced_together(make_proxy, master, nodes):
    """An announcement reads the whole graph. Once for each node would take quadratic time."""
    proxy = await make_proxy(master_interval=60, cleanup_after=60, probe_timeout=0.3)
    await populate(proxy, nodes)
    for node in nodes:
        node.hang = True
    await proxy.restart()
    for node in nodes:
        uri = master.nodes[node.name]
        assert await refuses(host_and_port(uri))
    await asyncio.sleep(0.5)
    master.delay = 0.1
    before = len(master.named("getSystemState"))
    for node in nodes:
        node.hang = False
    await until(lambda: all_served(proxy), "all are served")

    def announced() -> bool:
        calls = master.named("registerPublisher")
        return {f"{node.name}/out" for node in nodes} <= {call[1] for call in calls[NODES:]}

    await until(announced, "all are announced")
    assert len(master.named("getSystemState")) - before < NODES
