"""IPv6 and dual stack, if this machine has both."""

import os
import socket
from collections.abc import AsyncIterator
from typing import Any

import pytest

from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    HOST,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    PROXY,
    connect,
    greet,
    rpc,
    service_header,
    topic_header,
    until,
)
from tests.integration.proxy import Proxy


def _has_ipv6() -> bool:
    with socket.socket(socket.AF_INET6, socket.SOCK_STREAM) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            return False
    return True


pytestmark = pytest.mark.skipif(
    not (socket.has_ipv6 and _has_ipv6()) and os.environ.get("CI") != "true",
    reason="this machine has no IPv6 loopback address",
)


@pytest.fixture
async def master6() -> AsyncIterator[FakeMaster]:
    made = FakeMaster("::1")
    await made.start()
    yield made
    await made.stop()


@pytest.fixture
async def proxy6(make_proxy: MakeProxy, master6: FakeMaster) -> Proxy:
    networks = ("127.0.2.0/24", "::1/128")
    proxy = await make_proxy(
        bind="::", master_uri=master6.uri, advertise_host="::1", inside_network=networks
    )
    proxy.master = "::1", proxy.settings.master_port
    return proxy


@pytest.fixture
async def node6(make_node: MakeNode) -> FakeNode:
    return await make_node("/six", "::1")


async def test_a_node_master_and_peers_over_ipv6(
    proxy6: Proxy, master6: FakeMaster, node6: FakeNode
) -> None:
    assert (await node6.publish(proxy6.master))[0] == 1
    port = proxy6.endpoint(node6).port
    uri = f"http://[::1]:{port}/"
    assert master6.holds("publishers", "/chatter") == [uri]
    asked = await rpc(uri, "requestTopic", "/outside", "/chatter", [["TCPROS"]])
    assert asked == [1, f"ready on [::1]:{port}", ["TCPROS", "::1", port]]
    assert (await greet(proxy6.lease(node6), topic_header()))["callerid"] == "/six"
    await node6.serve(proxy6.master)
    assert master6.holds("services", "/add") == [f"rosrpc://[::1]:{port}"]
    assert (await greet(proxy6.lease(node6), service_header()))["callerid"] == "/six"
    assert (await node6.subscribe(proxy6.master))[2] == [node6.uri]
    reply = await rpc(proxy6.master, "getUri", "/six")
    assert reply[2] == f"http://[::1]:{proxy6.settings.master_port}/"


async def test_both_stacks_on_the_same_ports(proxy6: Proxy, make_node: Any) -> None:
    four = await make_node("/four")
    other = await make_node("/other", OTHER_NODE)
    proxy6.master = PROXY, proxy6.settings.master_port
    await four.publish(proxy6.master)
    endpoint = proxy6.endpoint(four)
    assert (endpoint.location.address, endpoint.location.named) == (NODE, True)
    assert (await other.subscribe(proxy6.master))[2] == [four.uri]
    for host in ("::1", HOST):
        assert (await rpc((host, endpoint.port), "getPid", "/outside"))[2] == four.pid
        header = await greet((host, endpoint.port), topic_header())
        assert header["callerid"] == "/four"
    assert proxy6.app.status()["nodes"][0]["address"] == f"{NODE}:{four.slave.address[1]}"


async def test_the_peer_of_a_connection_is_shown_without_a_prefix(
    proxy6: Proxy, node6: FakeNode, make_node: Any
) -> None:
    four = await make_node("/four")
    proxy6.master = PROXY, proxy6.settings.master_port
    await four.publish(proxy6.master)
    async with connect((HOST, proxy6.endpoint(four).port)) as wire:
        await wire.send(topic_header())
        await wire.exactly(4)
        (shown,) = proxy6.app.status()["nodes"][0]["connections"]
        assert shown["peer"] == OUTSIDE


async def test_recovery_over_ipv6(
    proxy6: Proxy, make_proxy: MakeProxy, master6: FakeMaster, node6: FakeNode
) -> None:
    await node6.publish(proxy6.master)
    (uri,) = master6.holds("publishers", "/chatter")
    await proxy6.stop()
    fresh = await make_proxy(
        bind="::",
        master_uri=master6.uri,
        advertise_host="::1",
        inside_network=("::1/128",),
        port_range=str(proxy6.settings.ports.listen),
    )
    await until(lambda: len(fresh.ros1.context.registry), "the node is found")
    await until(lambda: fresh.serves(node6), "the node is served")
    assert (await rpc(uri, "getPid", "/outside"))[2] == node6.pid
