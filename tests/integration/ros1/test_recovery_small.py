"""The proxy or the master dies and comes back; small nodes, no ROS."""

import asyncio
from contextlib import AsyncExitStack
from copy import deepcopy
from functools import partial
from typing import Any

import pytest

from examples.demo.fake_http import host_and_port
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from examples.demo.players import Adder, Listener, Talker
from rosproxy.shared.addresses import HostPort
from tests.integration.net import (
    HOST,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    PROXY,
    THIRD_NODE,
    greet,
    looks,
    refuses,
    rpc,
    service_header,
    topic_header,
    until,
)
from tests.integration.process import Process

FAR = f"http://{OUTSIDE}:4000/"


async def answers(uri: str) -> bool:
    try:
        return (await rpc(uri, "getPid", "/outside"))[0] == 1
    except OSError:
        return False


def all_were_told(nodes: list[FakeNode], publisher: str) -> bool:
    """Whether the last publisherUpdate of /update at all nodes has only this publisher."""
    return all(node.updates("/update")[-1:] == [[publisher]] for node in nodes)


def uri_of(master: Any, name: str) -> str:
    return str(master.nodes[name])


def everything(master: Any) -> dict[str, Any]:
    return deepcopy(master.tables)


async def populate(proxy: Any, *nodes: FakeNode) -> None:
    """Make a registration of each kind for each node."""
    for node in nodes:
        await node.publish(proxy.master, "/rosout")
        await node.publish(proxy.master, f"{node.name}/out")
        await node.subscribe(proxy.master, "/update")
        await node.serve(proxy.master, f"{node.name}/add")
        await node.call(proxy.master, "subscribeParam", node.uri, "/p")


@pytest.fixture
async def nodes(make_node: Any) -> list[FakeNode]:
    return [
        await make_node("/a"),
        await make_node("/b", OTHER_NODE),
        await make_node("/c", THIRD_NODE, host="no-such-host.invalid"),
    ]


async def restart(process: Process, while_down: Any = None) -> None:
    """Kill a proxy, do something, restart the proxy, and wait until ready."""
    await asyncio.to_thread(process.kill)
    if while_down:
        await while_down()
    await asyncio.to_thread(process.start)


async def test_a_killed_proxy_serves_the_same_nodes_on_the_same_ports_before_any_probe(
    start_process, master, nodes
):
    process = start_process(probe_interval=3600)
    await populate(process, *nodes)
    before = everything(master)
    await restart(process)
    for node in nodes:
        uri = uri_of(master, node.name)
        await until(partial(answers, uri), f"{node.name} is served")
        assert (await greet(uri, topic_header(f"{node.name}/out")))["callerid"] == node.name
        assert (await greet(uri, service_header(f"{node.name}/add")))["callerid"] == node.name
    await looks(master)
    assert everything(master) == before
    assert not [call for node in nodes for call, _ in node.calls if call == "shutdown"]


async def test_publishers_that_came_and_went_meanwhile_are_made_up_for(proxy, master, nodes):
    await rpc(master.uri, "registerPublisher", "/old", "/update", "std_msgs/String", FAR)
    await populate(proxy, *nodes)
    near = f"http://{OUTSIDE}:4001/"

    async def change() -> None:
        await rpc(master.uri, "unregisterPublisher", "/old", "/update", FAR)
        await rpc(master.uri, "registerPublisher", "/new", "/update", "std_msgs/String", near)

    await proxy.restart(change)
    await until(partial(all_were_told, nodes, near), "all nodes get the publisher")


async def test_outside_subscribers_are_told_again_of_publishers_inside(
    proxy, master, nodes, make_node
):
    far: FakeNode = await make_node("/far", OUTSIDE)
    await populate(proxy, *nodes)
    await rpc(master.uri, "registerSubscriber", "/far", "/a/out", "std_msgs/String", far.uri)
    uri = uri_of(master, "/a")
    await proxy.restart()
    # After a broken connection, a subscriber tries again only for a new publisher.
    await until(lambda: far.updates("/a/out")[-1:] == [[uri]], "the subscriber gets the publisher")
    assert [] in far.updates("/a/out")


async def test_a_node_that_registers_during_recovery_does_not_move(proxy, master, nodes):
    await populate(proxy, *nodes)
    before = {node.name: uri_of(master, node.name) for node in nodes}
    master.delay = 0.2
    await proxy.restart()
    for node in nodes:
        assert (await node.publish(proxy.master, "/more"))[0] == 1
    master.delay = 0.0
    fresh = await nodes[0].subscribe(proxy.master, "/a/out")
    assert fresh[2] == [nodes[0].uri]
    assert {node.name: uri_of(master, node.name) for node in nodes} == before
    assert not [call for node in nodes for call, _ in node.calls if call == "shutdown"]


async def test_a_new_node_gets_no_port_that_belongs_to_another(proxy, master, nodes, make_node):
    await populate(proxy, *nodes)
    master.delay = 0.2
    await proxy.restart()
    late: FakeNode = await make_node("/late", OTHER_NODE)
    await late.publish(proxy.master)
    ports = {host_and_port(uri)[1] for uri in master.nodes.values()}
    assert len(ports) == 4


async def test_more_types_of_former_topics_than_the_proxy_can_read(proxy, master, nodes):
    """rosmaster keeps them, so a node could keep all others from a proxy that started."""
    await populate(proxy, *nodes)
    uris = {node.name: uri_of(master, node.name) for node in nodes}
    master.types |= {f"/former{number}": "std_msgs/String" for number in range(80_000)}
    await proxy.restart()
    for uri in uris.values():
        await until(partial(answers, uri), "the node is served")
    assert master.nodes == uris
    assert proxy.app.status()["master"]["up"]


async def test_a_hanging_node_does_not_hold_up_recovery_and_is_served_later(
    make_proxy, master, nodes
):
    proxy = await make_proxy(probe_timeout=8.0, cleanup_after=60)
    await populate(proxy, *nodes)
    nodes[0].hang = True

    async def update() -> None:
        await rpc(master.uri, "registerPublisher", "/new", "/update", "std_msgs/String", FAR)

    clock = asyncio.get_running_loop().time
    started = clock()
    await proxy.restart(update)
    await until(lambda: answers(uri_of(master, "/b")), "the others are served")
    assert clock() - started < 8
    await until(lambda: nodes[1].updates("/update")[-1:] == [[FAR]], "/b gets the update")
    assert await refuses(host_and_port(uri_of(master, "/a")))
    nodes[0].hang = False
    await until(lambda: answers(uri_of(master, "/a")), "the node is served again")
    await until(lambda: nodes[0].updates("/update")[-1:] == [[FAR]], "/a gets the update")


async def test_a_node_that_ended_meanwhile_is_cleaned_up(proxy, master, nodes):
    await populate(proxy, *nodes)
    await proxy.restart(nodes[0].stop)
    # A master does not show parameter subscriptions.
    kinds = ("publishers", "subscribers", "services")
    tables = [master.tables[kind] for kind in kinds]

    def left(name: str) -> bool:
        return any(
            caller == name for table in tables for row in table.values() for caller, _ in row
        )

    await until(lambda: not left("/a"), "the master forgets the node")
    assert left("/b")
    assert left("/c")


async def test_recovery_waits_for_a_master_that_is_down(proxy, master, nodes):
    await populate(proxy, *nodes)
    uri = uri_of(master, "/a")
    await proxy.restart(master.stop)
    assert not await refuses(proxy.master)
    with pytest.raises(ConnectionResetError):
        await nodes[0].publish(proxy.master, "/more")
    await master.start()
    await until(lambda: answers(uri), "the node is served")
    assert uri_of(master, "/a") == uri


def asks_again(master: FakeMaster, asked: int) -> bool:
    return len(master.named("getSystemState")) > asked


async def test_killed_again_and_again(start_process, master, nodes):
    process = start_process(probe_interval=60)
    await populate(process, *nodes)
    before = everything(master)
    for _ in range(3):
        asked = len(master.named("getSystemState"))
        await restart(process)
        await until(partial(asks_again, master, asked), "recovery begins")
    await until(lambda: answers(uri_of(master, "/a")), "the node is served")
    await looks(master)
    assert everything(master) == before


async def test_registrations_are_made_again_at_a_master_without_memory(proxy, master, nodes):
    await populate(proxy, *nodes)
    before = everything(master)
    await master.restart()
    await rpc(master.uri, "registerPublisher", "/new", "/update", "std_msgs/String", FAR)
    await until(lambda: everything(master)["params"] == before["params"], "all are back")
    after = everything(master)
    assert after["services"] == before["services"]
    assert {k: sorted(v) for k, v in after["publishers"].items() if k != "/update"} == {
        k: sorted(v) for k, v in before["publishers"].items()
    }
    await until(partial(all_were_told, nodes, FAR), "all nodes get the publisher")


async def test_what_a_master_forgot_without_a_restart_is_noticed(make_proxy, master, nodes):
    proxy = await make_proxy(master_interval=0.05)
    await populate(proxy, *nodes)
    before = everything(master)
    master.forget()
    await until(lambda: everything(master)["services"] == before["services"], "all are back")


async def test_a_restarted_master_that_kept_its_memory_is_left_alone(proxy, master, nodes):
    await populate(proxy, *nodes)
    calls = len(master.named("registerPublisher", "registerSubscriber", "registerService"))
    await master.stop()
    master.pid += 1
    await master.start()
    await until(lambda: proxy.app.status()["master"]["pid"] == master.pid, "a new master")
    await looks(master)
    assert len(master.named("registerPublisher", "registerSubscriber", "registerService")) == calls


async def test_a_name_that_another_node_took_meanwhile_stays_with_that_node(
    proxy, master, nodes, make_node
):
    await populate(proxy, *nodes)
    successor: FakeNode = await make_node("/a", OUTSIDE)
    await master.stop()
    master.forget()
    master.pid += 1
    master.register("publishers", "/a/out", "/a", successor.uri)
    await master.start()
    await until(lambda: "/b" in master.nodes, "the others are registered again")
    await looks(master)
    assert uri_of(master, "/a") == successor.uri
    assert "shutdown" not in dict(successor.calls)
    slave = HostPort(nodes[0].address, nodes[0].slave.address[1])
    assert not [e for e in proxy.ros1.context.registry if e.slave == slave and e.registrations]


async def test_a_node_that_is_down_is_not_registered_at_a_new_master(make_proxy, master, nodes):
    proxy = await make_proxy(cleanup_after=0)
    await populate(proxy, *nodes)
    await nodes[0].stop()
    await until(lambda: refuses(proxy.lease(nodes[0])), "the port refuses")
    await master.restart()
    await until(lambda: "/c" in master.nodes, "the others are registered again")
    await looks(master)
    assert "/a" not in master.nodes


async def test_messages_flow_again(start_process, master):
    process = start_process()
    inner = f"http://{PROXY}:{process.master[1]}/"
    talker = Talker("/t", NODE, topic="/out")
    far_talker = Talker("/ft", OUTSIDE, topic="/in")
    listener = Listener("/l", OTHER_NODE, topic="/in")
    far_listener = Listener("/fl", OUTSIDE, topic="/out")
    adder = Adder("/a", THIRD_NODE, service="/add")
    heard = far_listener.received, listener.received

    def flowing(*counts: int) -> bool:
        return all(
            len(messages) >= count + 5 for messages, count in zip(heard, counts, strict=True)
        )

    async with AsyncExitStack() as stack:
        for node in (talker, far_talker, listener, far_listener, adder):
            await node.start()
            stack.push_async_callback(node.stop)
            await node.register(inner if node.address.startswith("127.0.2.") else master.uri)
        for speaker in (talker, far_talker):
            stack.callback(asyncio.create_task(speaker.talk()).cancel)
        await until(lambda: flowing(0, 0), "messages flow both ways")
        await restart(process)
        counts = [len(messages) for messages in heard]
        await until(lambda: flowing(*counts), "messages flow again")
        assert await far_listener.add(master.uri, "/add", 2, 3) == 5
        assert HOST in master.holds("services", "/add")[0]
