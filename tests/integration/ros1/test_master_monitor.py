"""The proxy's own calls to the master, and masters with odd or no answers."""

import asyncio
import xmlrpc.client
from contextlib import AsyncExitStack

import pytest

from examples.demo.fake_http import End, free_ports, value
from tests.integration.net import NODE, OUTSIDE, connect, post, refuses, rpc, until, xml

ODD = [5, "x", [], ["ab", "cd", "ef"], [[["/t", [5]]], [], []], [["/t"], [], []], {"a": 1}]


@pytest.mark.parametrize("odd", [*ODD, None], ids=repr)
@pytest.mark.parametrize(
    "method", ["getSystemState", "getTopicTypes", "getPid", "system.multicall"]
)
async def test_odd_answers_of_the_master_to_the_proxys_own_calls_are_survived(
    master, make_proxy, make_node, method, odd
):
    outside = f"http://{OUTSIDE}:4000/"
    await rpc(master.uri, "registerPublisher", "/far", "/chatter", "std_msgs/String", outside)
    answer = odd if method == "system.multicall" else [1, "", odd]
    master.answers[method] = value(answer) if odd is not None else value([-1, "no", 0])
    proxy = await make_proxy(master_interval=0.05)
    await until(lambda: len(master.requests) > 6, "the proxy asks")
    node = await make_node()
    async with connect(proxy.master, NODE) as wire:
        await wire.send(post(xml("registerPublisher", "/talker", "/t", "*", node.uri)))
        assert await wire.outcome() in ("reset", "answered")
    del master.answers[method]
    await until(lambda: proxy.app.status()["master"]["up"], "the proxy takes the master as up")
    assert (await node.publish(proxy.master))[0] == 1


async def test_calls_that_wait_for_recovery_fail_together(master, make_proxy, node, monkeypatch):
    monkeypatch.setattr("rosproxy.ros1.clients.master_client.MASTER_TIMEOUT_S", 2.0)
    master.answers["getSystemState"] = End.HANG
    proxy = await make_proxy()
    started = asyncio.get_running_loop().time()
    async with AsyncExitStack() as stack:
        wires = [await stack.enter_async_context(connect(proxy.master, NODE)) for _ in range(8)]
        for wire in wires:
            await wire.send(post(xml("registerPublisher", "/talker", "/t", "*", node.uri)))
        assert [await wire.end() for wire in wires] == ["reset"] * 8
    assert asyncio.get_running_loop().time() - started < 14  # in turn: 16
    del master.answers["getSystemState"]
    assert (await node.publish(proxy.master))[0] == 1


async def test_a_proxy_that_is_its_own_master_says_so(make_proxy, caplog):
    first = free_ports(4)
    proxy = await make_proxy(
        master_uri=f"http://127.0.0.1:{first}",
        master_port=first,
        admin_bind=f"127.0.0.1:{first + 1}",
        port_range=f"{first + 2}-{first + 3}",
    )
    with pytest.raises(xmlrpc.client.Fault, match="leads back"):
        await rpc(proxy.master, "getPid", "/n")
    await until(lambda: "leads back to the proxy itself" in caplog.text, "the log says so")
    assert not await refuses(proxy.master)


async def test_a_master_that_hangs_is_noticed_long_before_its_calls_time_out(
    master, make_proxy, monkeypatch
):
    monkeypatch.setattr("rosproxy.ros1.upkeep.master_monitor.PID_TIMEOUT_S", 0.2)
    proxy = await make_proxy(master_interval=0.05)
    await until(lambda: proxy.app.status()["master"]["up"], "the master is up")
    master.answers["getPid"] = End.HANG
    await until(lambda: not proxy.app.status()["master"]["up"], "the master is down")
    assert "no answer in 0.2 s" in proxy.app.status()["master"]["error"]
    del master.answers["getPid"]
    await until(lambda: proxy.app.status()["master"]["up"], "the master is up again")


async def test_what_the_master_loses_later_is_registered_again(master, make_proxy, node):
    proxy = await make_proxy(master_interval=0.05)
    await node.publish(proxy.master)
    uri = proxy.uri(node)
    often = len(master.named("getSystemState"))
    await until(lambda: len(master.named("getSystemState")) > often + 2, "nothing is missing")
    for _ in range(2):
        await rpc(master.uri, "unregisterPublisher", node.name, "/chatter", uri)
        await until(lambda: master.holds("publishers", "/chatter") == [uri], "a new registration")


async def test_a_master_port_where_no_program_listens_is_told_in_plain_words(make_proxy):
    port = free_ports(1)
    proxy = await make_proxy(master_uri=f"http://{OUTSIDE}:{port}")
    await until(lambda: proxy.app.status()["master"]["error"], "the master is away")
    assert proxy.app.status()["master"]["error"] == (
        f"master http://{OUTSIDE}:{port}: connection refused. No roscore listens there. Check the "
        "port; roscore listens on 11311 by default"
    )
