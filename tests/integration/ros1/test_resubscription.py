"""After a restart, only outside subscribers without a connection get the publisher again."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from itertools import pairwise
from typing import Any

import pytest

from examples.demo.fake_http import End
from examples.demo.fake_http import value as answer
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.ros1 import stack
from rosproxy.ros1.upkeep import resubscriber
from rosproxy.shared.addresses import HostPort
from tests.integration.net import (
    OTHER_NODE,
    OUTSIDE,
    THIRD_NODE,
    connect,
    looks,
    read_header,
    refuses,
    rpc,
    topic_header,
    until,
)
from tests.integration.proxy import Proxy

LOOKS = (3.0, 3.8)
"""Seconds after which the proxy of these tests looks; long enough to connect before."""
AFTERWARDS = 22
"""Looks of the proxy at the master, five a second, until both are over."""


@pytest.fixture(autouse=True)
def _early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resubscriber, "LOOK_DELAYS_S", LOOKS)
    monkeypatch.setattr(stack, "RESUBSCRIBE_INTERVAL_S", 0.05)


@pytest.fixture
async def talker(make_node: Any, proxy: Proxy) -> FakeNode:
    node: FakeNode = await make_node("/talker")
    await node.publish(proxy.master)
    return node


async def make_listener(
    make_node: Any, master: FakeMaster, name: str, address: str = OUTSIDE, topic: str = "/chatter"
) -> FakeNode:
    """A node that the master has as a subscriber, outside unless told otherwise."""
    node: FakeNode = await make_node(name, address)
    await rpc(master.uri, "registerSubscriber", name, topic, "std_msgs/String", node.uri)
    return node


@asynccontextmanager
async def listening(proxy: Proxy, publisher: FakeNode, name: str) -> AsyncIterator[None]:
    """A subscriber's connection for /chatter, like that of roscpp."""
    async with connect(proxy.lease(publisher)) as wire:
        await wire.send(topic_header(caller=name))
        await read_header(wire)
        yield


async def served(proxy: Proxy, *nodes: FakeNode) -> None:
    """Wait until the nodes are served."""
    for node in nodes:
        await until(partial(is_recovered, proxy, node), f"{node.name} is recovered")


def is_recovered(proxy: Proxy, node: FakeNode) -> bool:
    slaves = [e.slave for e in proxy.ros1.context.registry if e.trusted]
    return HostPort(node.address, node.slave.address[1]) in slaves


async def told(node: FakeNode, *uris: str) -> None:
    """Wait until a node knows exactly these publishers of /chatter."""
    await until(lambda: [{*some} for some in node.updates()[-1:]] == [{*uris}], f"{uris} are told")


async def test_a_subscriber_without_connection_gets_updates_at_each_look(
    proxy, talker, master, make_node
):
    lost = await make_listener(make_node, master, "/lost")
    await proxy.restart()
    await served(proxy, talker)
    uri = proxy.uri(talker)
    often = [[], [uri]] * (1 + len(LOOKS))
    await until(lambda: lost.updates() == often, "updates at each look")
    await looks(master, 5)
    assert lost.updates() == often


async def test_a_subscriber_with_a_connection_is_left_alone(proxy, talker, master, make_node):
    lost = await make_listener(make_node, master, "/lost")
    kept = await make_listener(make_node, master, "/kept", "127.0.1.8")
    await proxy.restart()
    await served(proxy, talker)
    uri = proxy.uri(talker)
    await told(kept, uri)
    async with listening(proxy, talker, "/kept"):
        lost.calls.clear()
        kept.calls.clear()
        await until(lambda: lost.updates() == [[], [uri]] * len(LOOKS), "/lost gets updates")
        assert set(map(tuple, kept.updates())) == {(uri,)}


async def test_only_the_publisher_without_connection_is_withdrawn(proxy, talker, master, make_node):
    other = await make_node("/other", OTHER_NODE)
    await other.publish(proxy.master)
    far = "http://127.0.1.7:4000/"
    await rpc(master.uri, "registerPublisher", "/far", "/chatter", "std_msgs/String", far)
    listener = await make_listener(make_node, master, "/listener")
    await proxy.restart()
    await served(proxy, talker, other)
    uris = {proxy.uri(talker), proxy.uri(other), far}
    await told(listener, *uris)
    async with listening(proxy, talker, "/listener"):
        listener.calls.clear()
        without = {proxy.uri(talker), far}

        def looks() -> int:
            """The number of looks with an update. The first may still be of the restart."""
            told = [{*some} for some in listener.updates()]
            return sum(pair == (without, uris) for pair in pairwise(told))

        await until(lambda: looks() >= len(LOOKS), "the subscriber gets updates at each look")
        assert all(proxy.uri(talker) in uris for uris in listener.updates())


async def test_who_is_served_by_udpros_is_left_alone(proxy, talker, master, make_node):
    listener = await make_listener(make_node, master, "/listener")
    row = [0, "/listener", "o", "UDPROS", "/chatter", True, "UDPROS connection"]
    talker.answers["getBusInfo"] = answer([1, "bus info", [row]])
    await proxy.restart()
    await served(proxy, talker)
    await told(listener, proxy.uri(talker))
    listener.calls.clear()
    await looks(master, AFTERWARDS)
    assert [] not in listener.updates()


@pytest.mark.parametrize("hang", [True, False], ids=["hangs", "says nothing of use"])
async def test_a_publisher_without_connection_info_hinders_no_subscriber(
    proxy, talker, master, make_node, hang
):
    listener = await make_listener(make_node, master, "/listener")
    talker.answers["getBusInfo"] = End.HANG if hang else answer([0, "not implemented", 0])
    await proxy.restart()
    await served(proxy, talker)
    await told(listener, proxy.uri(talker))
    listener.calls.clear()
    await until(lambda: [] in listener.updates(), "the subscriber gets an update at a look")


async def test_neighbours_that_need_no_proxy_are_left_alone(proxy, talker, master, make_node):
    neighbour = await make_node("/neighbour", THIRD_NODE)
    await neighbour.subscribe(proxy.master)
    await proxy.restart()
    await served(proxy, talker, neighbour)
    await looks(master, AFTERWARDS)
    assert [] not in neighbour.updates()


async def test_a_subscriber_that_is_gone_hinders_no_other(proxy, talker, master, make_node):
    gone = await make_listener(make_node, master, "/gone")
    listener = await make_listener(make_node, master, "/listener", "127.0.1.8")
    await gone.stop()
    await proxy.restart()
    await served(proxy, talker)
    await told(listener, proxy.uri(talker))
    listener.calls.clear()
    await until(lambda: [] in listener.updates(), "the subscriber gets an update at a look")
    await told(listener, proxy.uri(talker))


async def test_a_subscriber_that_lost_a_silent_node_gets_an_update(
    proxy, talker, master, make_node
):
    listener = await make_listener(make_node, master, "/listener")
    lease = proxy.lease(talker)
    await talker.slave.stop()
    await until(lambda: refuses(lease), "the port refuses")
    await talker.slave.start(talker.address, talker.slave.address[1])
    await until(lambda: [] in listener.updates(), "the subscriber gets an update at a look")
    await told(listener, proxy.uri(talker))
