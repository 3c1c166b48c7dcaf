"""Fast ports for nodes and subscribers, with a fake kernel that forwards nothing."""

from typing import Any

import pytest

from examples.demo.fake_http import Address
from rosproxy.forwarding.kernel import decisions, syncer
from rosproxy.forwarding.kernel import plane as kernel_plane
from rosproxy.forwarding.kernel.decisions import HostForwarding
from rosproxy.forwarding.kernel.tools import Tools
from rosproxy.ros1 import stack
from rosproxy.shared.addresses import Route
from tests.integration.admin_calls import tell
from tests.integration.kernel_fake import FakeTools
from tests.integration.net import (
    NODE,
    OTHER_NODE,
    THIRD_NODE,
    greet,
    refuses,
    rpc,
    topic_header,
    until,
)

TCPROS = [["TCPROS"]]


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> FakeTools:
    """A kernel that may forward to the nodes of these tests, which live on loopback."""
    made = FakeTools()

    async def nothing(mode: str, tools: Tools) -> None:
        return None

    monkeypatch.setattr(stack, "Tools", lambda: made)
    monkeypatch.setattr(kernel_plane, "find_obstacle", nothing)
    monkeypatch.setattr(syncer, "read_forwarding", HostForwarding)
    monkeypatch.setattr(syncer, "route_towards", lambda address: Route("192.0.2.1", 1500))
    monkeypatch.setattr(decisions, "is_loopback", lambda address: False)
    return made


@pytest.fixture
def no_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    async def something(mode: str, tools: Tools) -> str:
        return "not in this test"

    monkeypatch.setattr(kernel_plane, "find_obstacle", something)


async def ask(proxy: Any, node: Any) -> Address:
    """The address that an outside subscriber gets for a node's topic."""
    _, _, (protocol, host, port) = await rpc(
        proxy.uri(node), "requestTopic", "/x", "/chatter", TCPROS
    )
    assert protocol == "TCPROS"
    return host, port


async def test_a_subscriber_is_sent_to_the_fast_port(make_proxy, make_node, kernel):
    proxy = await make_proxy(data_plane="auto")
    node = await make_node("/a")
    await node.publish(proxy.master)
    host, lease = proxy.lease(node)
    assert await ask(proxy, node) == (host, lease + 4)
    assert kernel.forwards == {lease + 4: (NODE, node.tcpros_port)}
    assert (await greet((host, lease + 4), topic_header()))["callerid"] == "/a"
    assert (await greet((host, lease), topic_header()))["callerid"] == "/a"
    status = proxy.app.status()
    assert status["ports"]["free"] == 7
    assert status["data_plane"]["plane"] == "kernel"
    assert status["nodes"][0]["data_plane"]["port"] == lease + 4
    await proxy.stop()
    assert kernel.table is None


async def test_a_service_keeps_to_the_lease(make_proxy, make_node, kernel, master):
    proxy = await make_proxy(data_plane="kernel")
    node = await make_node("/a")
    await node.publish(proxy.master)
    await node.serve(proxy.master)
    host, lease = proxy.lease(node)
    await ask(proxy, node)
    reply = await rpc(master.uri, "lookupService", "/x", "/add")
    assert reply[2] == f"rosrpc://{host}:{lease}"


async def test_the_fast_port_of_a_node_that_ended_refuses(make_proxy, make_node, kernel):
    proxy = await make_proxy(data_plane="auto")
    node = await make_node("/a")
    await node.publish(proxy.master)
    fast = await ask(proxy, node)
    await node.stop()
    await until(lambda: refuses(fast), "the fast port refuses")
    await until(lambda: not kernel.forwards, "nothing is forwarded")


async def test_fast_ports_go_before_a_node_is_refused(make_proxy, make_node, kernel):
    proxy = await make_proxy(data_plane="auto", ports=4)
    nodes = [
        await make_node("/a"),
        await make_node("/b", OTHER_NODE),
        await make_node("/c", THIRD_NODE),
        await make_node("/d", THIRD_NODE),
    ]
    for node in nodes[:2]:
        await node.publish(proxy.master, node.name)
        await node.publish(proxy.master)
        assert (await ask(proxy, node))[1] == proxy.lease(node)[1] + 2
    assert len(kernel.forwards) == 2
    for node in nodes[2:]:
        assert (await node.publish(proxy.master))[0] == 1
        assert proxy.lease(node)[1] not in kernel.forwards
    assert kernel.forwards == {}
    for node in nodes:
        assert await ask(proxy, node) == proxy.lease(node)
        assert (await greet(proxy.lease(node), topic_header()))["callerid"] == node.name


async def test_a_range_full_of_fast_ports_is_probed_through_one_of_them(
    make_proxy, make_node, kernel, monkeypatch
):
    """Fast ports count as free for the probe."""
    monkeypatch.setattr("rosproxy.ros1.range_probe.MASTER_TIMEOUT_S", 0.3)
    proxy = await make_proxy(data_plane="auto", ports=4)
    nodes = [await make_node("/a"), await make_node("/b", OTHER_NODE)]
    for node in nodes:
        await node.publish(proxy.master)
        await ask(proxy, node)
    lost, kept = kernel.forwards
    told = await tell(proxy, "/probe")
    assert [(p["port"], p["from_proxy"]) for p in told["probes"]] == [(lost, "ok")]
    assert set(kernel.forwards) == {kept}
    assert proxy.app.status()["ports"]["free"] == 2
    for node in nodes:
        assert (await ask(proxy, node))[1] == proxy.lease(node)[1] + 2
    assert set(kernel.forwards) == {lost, kept}


async def test_a_range_without_partners_has_no_fast_ports(make_proxy, make_node, kernel, caplog):
    caplog.set_level("INFO")
    proxy = await make_proxy(data_plane="auto", ports=1)
    node = await make_node("/a")
    await node.publish(proxy.master)
    for _ in range(2):
        assert await ask(proxy, node) == proxy.lease(node)
    assert caplog.text.count("has no second port in the range for a fast port") == 1


async def test_without_the_kernel_nobody_is_sent_to_a_fast_port(make_proxy, make_node, no_kernel):
    proxy = await make_proxy(data_plane="auto")
    node = await make_node("/a")
    await node.publish(proxy.master)
    assert await ask(proxy, node) == proxy.lease(node)
    assert proxy.app.status()["data_plane"]["reason"] == "not in this test"


async def test_who_reconnects_after_a_restart_without_the_kernel_is_served(
    make_proxy, make_node, no_kernel
):
    proxy = await make_proxy(data_plane="auto", ports=4)
    node = await make_node("/a")
    await node.publish(proxy.master)
    host, lease = proxy.lease(node)
    assert await refuses((host, lease + 2))
    await proxy.restart()
    await until(lambda: len(proxy.ros1.context.registry), "the node is found")
    await until(lambda: proxy.serves(node), "the node is served")
    assert (await greet((host, lease + 2), topic_header()))["callerid"] == "/a"
    assert proxy.app.status()["ports"]["free"] == 3
    others = [await make_node(f"/n{number}", OTHER_NODE) for number in range(3)]
    for other in others:
        assert (await other.publish(proxy.master))[0] == 1
    assert (await greet((host, lease + 2), topic_header()))["callerid"] != "/a"


async def test_topics_that_a_rule_may_deny_go_through_the_proxy(make_proxy, make_node, kernel):
    rules = "deny publish /other by /b*; deny serve /x by /c*"
    proxy = await make_proxy(data_plane="kernel", policy=rules, linger=60.0)
    nodes = [await make_node(name) for name in ("/a", "/b", "/c")]
    for node in nodes:
        await node.publish(proxy.master)
    ports = [(await ask(proxy, node))[1] for node in nodes]
    assert [port == proxy.endpoint(n).port for port, n in zip(ports, nodes, strict=True)] == [
        False,
        True,
        True,
    ]
    fast = proxy.endpoint(nodes[0]).fast_port
    await until(lambda: fast in kernel.forwards, "the kernel forwards the port")
    layer = {"name": "more", "rules": ["deny publish /other"]}
    assert (await tell(proxy, "/policy", layers=[layer]))["hidden"] == 0
    assert proxy.endpoint(nodes[0]).fast_port is None
    await until(lambda: fast not in kernel.forwards, "the kernel forwards the port no longer")
    await until(lambda: kernel.forgotten, "connections are cut")
    assert (await ask(proxy, nodes[0]))[1] == proxy.endpoint(nodes[0]).port
    await proxy.restart()
    await until(lambda: len(proxy.ros1.context.registry) == 3, "the nodes are found again")
    assert proxy.endpoint(nodes[1]).fast_port is None
