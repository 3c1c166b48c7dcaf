"""The lifetime of nodes and leases: probes, clean-up, return, linger time."""

import asyncio
import os

from examples.demo.fake_http import End
from tests.clock import pass_time
from tests.integration.net import (
    HOST,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    connect,
    greet,
    looks,
    post,
    read_header,
    refuses,
    rpc,
    topic_header,
    until,
    xml,
)

FAST = {"probe_interval": 0.1, "probe_timeout": 2.0, "cleanup_after": 0.25, "linger": 0.2}
IMPATIENT = {**FAST, "probe_timeout": 0.15}
"""For nodes that are to be found hanging: any may be on a machine that is busy."""


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


async def test_a_node_that_ended_is_refused_before_it_is_cleaned_up(make_proxy, node):
    proxy = await make_proxy(cleanup_after=600)
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    await node.stop()
    await until(lambda: refuses(lease), "the port refuses")
    assert proxy.app.status()["nodes"][0]["state"] == "refused"


async def test_a_call_that_finds_the_node_gone_closes_the_port_at_once(make_proxy, node):
    proxy = await make_proxy(probe_interval=3600, cleanup_after=0)
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    await node.stop()
    async with connect(lease) as wire:
        await wire.send(post(xml("getPid", "/outside")))
        assert await wire.end() == "reset"
    await until(lambda: refuses(lease), "the port refuses")


async def test_a_dead_node_is_cleaned_up_and_its_port_given_back(make_proxy, master, node):
    proxy = await make_proxy(**FAST)
    await node.publish(proxy.master)
    await node.subscribe(proxy.master, "/other")
    await node.serve(proxy.master)
    await node.call(proxy.master, "subscribeParam", node.uri, "/p")
    await node.stop()
    tables = master.tables.values()
    await until(lambda: not any(tables), "the master forgets the node")
    assert master.nodes == {}
    await until(lambda: not len(proxy.ros1.context.registry), "the lease ends")
    assert proxy.ros1.context.registry.pool.free == len(proxy.settings.ports.listen)
    assert proxy.metric("cleanups_total") == 1


async def test_nobody_is_cleaned_up_where_that_is_off(make_proxy, master, node):
    proxy = await make_proxy(**{**FAST, "cleanup_after": 0})
    await node.publish(proxy.master)
    uri = proxy.uri(node)
    await node.stop()
    await until(lambda: refuses(proxy.lease(node)), "the port refuses")
    await looks(master)
    assert master.holds("publishers", "/chatter") == [uri]


async def test_clean_up_waits_for_a_master_that_is_down(make_proxy, master, node):
    proxy = await make_proxy(**FAST)
    await node.publish(proxy.master)
    await node.stop()
    await master.stop()
    await until(lambda: refuses(proxy.lease(node)), "the port refuses")
    await until(lambda: proxy.app.status()["master"]["error"], "the master is missed")
    await master.start()
    await until(lambda: not master.nodes, "the master forgets the node")


async def test_a_hanging_node_blocks_nobody(make_proxy, make_node):
    proxy = await make_proxy(**{**IMPATIENT, "cleanup_after": 0})
    hung = await make_node("/hung")
    fine = await make_node("/fine", OTHER_NODE)
    await hung.publish(proxy.master)
    await fine.publish(proxy.master)
    lease = proxy.lease(hung)
    other = proxy.lease(fine)
    hung.hang = True
    async with connect(lease) as stuck:
        await stuck.send(post(xml("getPid", "/outside")))
        started = asyncio.get_running_loop().time()
        assert (await rpc(other, "getPid", "/outside"))[2] == fine.pid
        assert (await greet(other, topic_header()))["callerid"] == "/fine"
        assert asyncio.get_running_loop().time() - started < 10  # the time-out: 15 s
    await until(lambda: refuses(lease), "the port refuses")
    assert proxy.app.status()["nodes"][0]["state"] == "silent"


async def test_probes_of_a_hanging_node_leak_nothing(start_process, make_node):
    process = start_process(**{**IMPATIENT, "cleanup_after": 0})
    hung = await make_node("/hung")
    await hung.publish(process.master)
    hung.hang = True
    await until(lambda: "does not answer" in process.text, "the node counts as silent")
    before = process.descriptors()
    threads = process.threads()
    probes = hung.slave.connections
    await until(lambda: hung.slave.connections >= probes + 6, "six more probes")
    # A pending call has a descriptor. Only leaked descriptors would stay.
    await hung.stop()
    await until(lambda: process.descriptors() <= before, "no more is open than before")
    await until(lambda: process.threads() <= threads, "no more threads than before")


async def test_a_node_that_answers_again_is_served_again(make_proxy, master, node):
    proxy = await make_proxy(**{**IMPATIENT, "cleanup_after": 0})
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    node.hang = True
    await until(lambda: refuses(lease), "the port refuses")
    node.hang = False
    await until(lambda: rpc_works(lease), "the port is served again")
    assert (await greet(lease, topic_header()))["callerid"] == "/talker"
    # Through the master, refused subscribers get the publisher once more.
    await until(lambda: len(master.named("registerPublisher")) == 2, "a second registration")


async def rpc_works(address) -> bool:
    try:
        return (await rpc(address, "getPid", "/outside"))[0] == 1
    except OSError:
        return False


async def test_a_node_that_was_cleaned_up_and_comes_back_is_registered_again(
    make_proxy, master, node
):
    proxy = await make_proxy(**IMPATIENT)
    await node.publish(proxy.master)
    await node.subscribe(proxy.master, "/update")
    await node.serve(proxy.master)
    await node.call(proxy.master, "subscribeParam", node.uri, "/p")
    uri = proxy.uri(node)
    lease = proxy.lease(node)
    node.hang = True
    await until(lambda: not master.nodes, "the node is cleaned up")
    far = f"http://{OUTSIDE}:4000/"
    await rpc(master.uri, "registerPublisher", "/far", "/update", "std_msgs/String", far)
    await looks(master)
    node.hang = False
    await until(lambda: rpc_works(lease), "the port is served again")
    await until(lambda: master.holds("params", "/p"), "all is registered again")
    assert master.holds("publishers", "/chatter") == [uri]
    assert master.holds("subscribers", "/update") == [uri]
    assert master.holds("services", "/add") == [f"rosrpc://{HOST}:{lease[1]}"]
    await until(lambda: node.updates("/update")[-1:] == [[far]], "the missed update arrives")


async def test_another_process_at_a_cleaned_uri_gets_only_what_it_has(make_proxy, master, node):
    proxy = await make_proxy(**IMPATIENT)
    await node.publish(proxy.master)
    await node.publish(proxy.master, "/gone")
    await node.serve(proxy.master)
    lease = proxy.lease(node)
    node.hang = True
    await until(lambda: not master.nodes, "the node is cleaned up")
    del node.published["/gone"]
    node.pid += 1
    node.hang = False
    await until(lambda: rpc_works(lease), "the port is served again")
    await until(lambda: master.holds("publishers", "/chatter"), "the topic is registered again")
    assert master.holds("publishers", "/gone") == master.holds("services", "/add") == []


async def test_a_new_process_that_registers_at_a_cleaned_uri_keeps_what_it_registers(
    make_proxy, master, node
):
    proxy = await make_proxy(**{**FAST, "linger": 60})
    await node.publish(proxy.master)
    await node.serve(proxy.master, "/old")
    await node.stop()
    await until(lambda: not master.nodes, "the node is cleaned up")
    node.pid += 1
    await node.start()
    await node.serve(proxy.master, "/new")
    await node.publish(proxy.master)
    await looks(master)
    endpoint = proxy.endpoint(node)
    registered = {(kind.value, name) for kind, name, _ in endpoint.registrations}
    assert registered == {("publisher", "/chatter"), ("service", "/new")}
    assert master.holds("services", "/new") == [f"rosrpc://{HOST}:{endpoint.port}"]
    assert master.holds("services", "/old") == []
    reply = await node.call(proxy.master, "lookupService", "/new")
    assert reply[2] == node.service_api


async def test_a_node_restarted_on_its_uri_is_reachable_as_soon_as_it_registers(
    make_proxy, master, node
):
    proxy = await make_proxy(**{**FAST, "cleanup_after": 0})
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    await node.stop()
    await until(lambda: refuses(lease), "the port refuses")
    node.pid += 1
    await node.start()
    await node.publish(proxy.master)
    assert (await rpc(lease, "getPid", "/outside"))[2] == node.pid
    assert (await greet(lease, topic_header()))["callerid"] == "/talker"
    await looks(master)
    assert not await refuses(lease)


async def test_what_a_former_process_at_the_same_uri_registered_is_taken_back(
    make_proxy, master, make_node
):
    proxy = await make_proxy(probe_interval=0.1)
    node = await make_node("/first")
    await node.publish(proxy.master, "/old")
    node.name = "/second"
    node.pid = node.pid + 1
    node.published = {}
    await node.publish(proxy.master, "/new")
    await until(lambda: not master.holds("publishers", "/old"), "the old topic is taken back")
    assert master.holds("publishers", "/new") == [proxy.uri(node)]
    assert "/first" not in master.nodes


async def test_a_restart_under_the_same_name_elsewhere_ends_the_old_process(
    proxy, master, make_node
):
    old = await make_node()
    new = await make_node("/talker", OTHER_NODE)
    await old.publish(proxy.master)
    await new.publish(proxy.master)
    assert proxy.uri(old) != proxy.uri(new)
    await until(lambda: "shutdown" in dict(old.calls), "the old node gets a shutdown")
    assert "shutdown" not in dict(new.calls)
    calls = [{"methodName": "unregisterPublisher", "params": ["/talker", "/chatter", old.uri]}]
    await rpc(proxy.master, "system.multicall", calls, source=NODE)
    assert master.holds("publishers", "/chatter") == [proxy.uri(new)]
    assert proxy.endpoint(new).registrations


async def test_a_lease_lingers_and_ends(make_proxy, master, node):
    proxy = await make_proxy(**{**FAST, "linger": 60})
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    await node.call(proxy.master, "unregisterPublisher", "/chatter", node.uri)
    await looks(master)
    assert await rpc_works(lease)
    await pass_time(60)
    await until(lambda: refuses(lease), "the lease ends")


async def test_a_lease_with_a_connection_does_not_end(make_proxy, master, node):
    proxy = await make_proxy(**{**FAST, "linger": 0.0})
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    async with connect(lease) as wire:
        await wire.send(topic_header())
        await read_header(wire)
        await node.call(proxy.master, "unregisterPublisher", "/chatter", node.uri)
        await looks(master)
        assert not await refuses(lease)
        await wire.send(b"x")
        assert await wire.exactly(1) == b"x"
    await until(lambda: refuses(lease), "the lease ends")


async def test_a_lease_does_not_end_while_its_registration_is_on_its_way(make_proxy, master, node):
    proxy = await make_proxy(**{**FAST, "linger": 0.0})
    master.delay = 0.3
    await node.publish(proxy.master)
    master.delay = 0.0
    assert await rpc_works(proxy.lease(node))
    await node.call(proxy.master, "unregisterPublisher", "/chatter", node.uri)
    await until(lambda: not len(proxy.ros1.context.registry), "the lease ends")


async def test_a_registration_that_the_master_refuses_holds_no_port(make_proxy, master, node):
    proxy = await make_proxy(**FAST)
    master.answers["registerPublisher"] = End.RESET
    async with connect(proxy.master, NODE) as wire:
        await wire.send(post(xml("registerPublisher", "/talker", "/t", "x/Y", node.uri)))
        assert await wire.end() == "reset"
    await until(lambda: not len(proxy.ros1.context.registry), "the lease ends")
    assert proxy.ros1.context.registry.pool.free == len(proxy.settings.ports.listen)


async def test_many_short_lives_leak_nothing(make_proxy, make_node):
    proxy = await make_proxy(**{**FAST, "linger": 0.0})
    node = await make_node()

    async def live() -> None:
        for _ in range(8):
            await node.publish(proxy.master)
            await rpc(proxy.uri(node), "getPid", "/outside")
            await node.call(proxy.master, "unregisterPublisher", "/chatter", node.uri)
            await until(lambda: not len(proxy.ros1.context.registry), "the lease ends")

    await live()
    before = descriptors()
    await live()
    await until(lambda: descriptors() <= before + 2, "nothing is left open")
