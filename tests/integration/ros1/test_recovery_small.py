"""The proxy or the master dies and comes back; small nodes, no ROS."""

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from time import monotonic
from typing import Any

import pytest

from rosproxy.demo.boundary import Boundary
from rosproxy.demo.master import Master as DemoMaster
from rosproxy.demo.node import Node as DemoNode
from rosproxy.demo.service import add
from tests.integration.net import (
    HOST,
    MASTER,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    PROXY,
    THIRD_NODE,
    knock,
    refuses,
    rpc,
    until,
    where,
)
from tests.integration.node import Node, greet, service_header, topic_header
from tests.integration.process import Process

FAR = f"http://{OUTSIDE}:4000/"


async def answers(uri: str) -> bool:
    try:
        return (await rpc(uri, "getPid", "/outside"))[0] == 1
    except OSError:
        return False


def all_were_told(nodes: list[Node], publisher: str) -> bool:
    """Whether all know that one publisher, and no other, has news."""
    return all(node.updates("/news")[-1:] == [[publisher]] for node in nodes)


def uri_of(master: Any, name: str) -> str:
    return str(master.book.nodes[name])


def everything(master: Any) -> dict[str, Any]:
    return {kind: dict(table.rows) for kind, table in master.book.tables.items()}


async def populate(proxy: Any, *nodes: Node) -> None:
    """Register nodes with one of each kind."""
    for node in nodes:
        await node.publish(proxy.master, "/rosout")
        await node.publish(proxy.master, f"{node.name}/out")
        await node.subscribe(proxy.master, "/news")
        await node.serve(proxy.master, f"{node.name}/add")
        await node.call(proxy.master, "subscribeParam", node.uri, "/p")


@pytest.fixture
async def nodes(make_node: Any) -> list[Node]:
    return [
        await make_node("/a"),
        await make_node("/b", OTHER_NODE),
        await make_node("/c", THIRD_NODE, host="no-such-host.invalid"),
    ]


async def restart(process: Process, while_down: Any = None) -> float:
    """Kill a proxy, do something, start it again; the time at which it was started."""
    await asyncio.to_thread(process.kill)
    if while_down:
        await while_down()
    started = monotonic()
    await asyncio.to_thread(process.start)
    return started


async def test_a_killed_proxy_serves_the_same_nodes_on_the_same_ports_within_2_seconds(
    start_process, master, nodes
):
    process = start_process()
    await populate(process, *nodes)
    before = everything(master)
    started = await restart(process)
    for node in nodes:
        uri = uri_of(master, node.name)
        await until(partial(answers, uri), f"{node.name} is served")
        assert (await greet(uri, topic_header(f"{node.name}/out")))["callerid"] == node.name
        assert (await greet(uri, service_header(f"{node.name}/add")))["callerid"] == node.name
    assert monotonic() - started < 2
    await asyncio.sleep(0.3)
    assert everything(master) == before
    assert not [call for node in nodes for call, _ in node.calls if call == "shutdown"]


async def test_publishers_that_came_and_went_meanwhile_are_made_up_for(proxy, master, nodes):
    await rpc(master.uri, "registerPublisher", "/old", "/news", "std_msgs/String", FAR)
    await populate(proxy, *nodes)
    near = f"http://{OUTSIDE}:4001/"

    async def change() -> None:
        await rpc(master.uri, "unregisterPublisher", "/old", "/news", FAR)
        await rpc(master.uri, "registerPublisher", "/new", "/news", "std_msgs/String", near)

    await proxy.restart(change)
    await until(partial(all_were_told, nodes, near), "they are told")


async def test_outside_subscribers_are_told_again_of_publishers_inside(
    proxy, master, nodes, make_node
):
    far: Node = await make_node("/far", OUTSIDE)
    await populate(proxy, *nodes)
    await rpc(master.uri, "registerSubscriber", "/far", "/a/out", "std_msgs/String", far.uri)
    uri = uri_of(master, "/a")
    await proxy.restart()
    # A publisher whose connection broke is tried again only when it is new.
    await until(lambda: far.updates("/a/out")[-1:] == [[uri]], "the subscriber is told")
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
    late: Node = await make_node("/late", OTHER_NODE)
    await late.publish(proxy.master)
    ports = {where(uri)[1] for uri in master.book.nodes.values()}
    assert len(ports) == 4


async def test_a_hanging_node_does_not_hold_up_recovery_and_is_served_later(
    make_proxy, master, nodes
):
    proxy = await make_proxy(probe_timeout=1.0, cleanup_after=60)
    await populate(proxy, *nodes)
    nodes[0].hang = True

    async def news() -> None:
        await rpc(master.uri, "registerPublisher", "/new", "/news", "std_msgs/String", FAR)

    started = monotonic()
    await proxy.restart(news)
    await until(lambda: answers(uri_of(master, "/b")), "the others are served")
    assert monotonic() - started < 2
    await until(lambda: nodes[1].updates("/news")[-1:] == [[FAR]], "the others are told")
    assert await refuses(where(uri_of(master, "/a")))
    nodes[0].hang = False
    await until(lambda: answers(uri_of(master, "/a")), "it is served again")
    await until(lambda: nodes[0].updates("/news")[-1:] == [[FAR]], "it is told as well")


async def test_a_node_that_ended_meanwhile_is_cleaned_up(proxy, master, nodes):
    await populate(proxy, *nodes)
    await proxy.restart(nodes[0].stop)
    # Of parameters a master tells nobody who subscribes to them.
    kinds = ("publishers", "subscribers", "services")
    tables = [master.book.tables[kind] for kind in kinds]

    def left(name: str) -> bool:
        return any(table.has_node(name) for table in tables)

    await until(lambda: not left("/a"), "the master forgets it")
    assert left("/b")
    assert left("/c")


async def test_recovery_waits_for_a_master_that_is_down(proxy, master, nodes):
    await populate(proxy, *nodes)
    uri = uri_of(master, "/a")
    await proxy.restart(master.stop)
    assert await knock(proxy.master, b"") in ("silent", "closed")
    with pytest.raises(ConnectionResetError):
        await nodes[0].publish(proxy.master, "/more")
    await master.start()
    await until(lambda: answers(uri), "it is served")
    assert uri_of(master, "/a") == uri


async def test_killed_again_and_again(start_process, master, nodes):
    process = start_process()
    await populate(process, *nodes)
    before = everything(master)
    for _ in range(3):
        await restart(process)
        await asyncio.sleep(0.03)
    await until(lambda: answers(uri_of(master, "/a")), "it is served")
    await asyncio.sleep(0.3)
    assert everything(master) == before


async def test_registrations_are_made_again_at_a_master_without_memory(proxy, master, nodes):
    await populate(proxy, *nodes)
    before = everything(master)
    await master.restart()
    await rpc(master.uri, "registerPublisher", "/new", "/news", "std_msgs/String", FAR)
    await until(lambda: everything(master)["params"] == before["params"], "all are back")
    after = everything(master)
    assert after["services"] == before["services"]
    assert {k: sorted(v) for k, v in after["publishers"].items() if k != "/news"} == {
        k: sorted(v) for k, v in before["publishers"].items()
    }
    await until(partial(all_were_told, nodes, FAR), "they are told")


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
    await until(lambda: proxy.app.status()["master"]["pid"] == master.pid, "it is noticed")
    await asyncio.sleep(0.3)
    assert len(master.named("registerPublisher", "registerSubscriber", "registerService")) == calls


async def test_a_name_that_somebody_else_took_meanwhile_is_left_to_them(
    proxy, master, nodes, make_node
):
    await populate(proxy, *nodes)
    successor: Node = await make_node("/a", OUTSIDE)
    await master.stop()
    master.forget()
    master.pid += 1
    master.book.register("publishers", "/a/out", "/a", successor.uri)
    await master.start()
    await until(lambda: "/b" in master.book.nodes, "the others are registered again")
    await asyncio.sleep(0.5)
    assert uri_of(master, "/a") == successor.uri
    assert "shutdown" not in dict(successor.calls)
    assert not proxy.endpoint(nodes[0]).registrations


async def test_a_node_that_is_down_is_not_registered_at_a_new_master(make_proxy, master, nodes):
    proxy = await make_proxy(cleanup_after=0)
    await populate(proxy, *nodes)
    await nodes[0].stop()
    await until(lambda: refuses(proxy.lease(nodes[0])), "its port refuses")
    await master.restart()
    await until(lambda: "/c" in master.book.nodes, "the others are registered again")
    await asyncio.sleep(0.3)
    assert "/a" not in master.book.nodes


class Lively:
    """The demo's own nodes, which connect for real."""

    def __init__(self, stack: AsyncExitStack, name: str, master: str, address: str) -> None:
        leave = (("127.0.0.0/8", address),)
        self.boundary = Boundary(leave_from=leave)
        self.node = DemoNode(name, master, address, address, self.boundary)
        stack.callback(self.node.close)


@asynccontextmanager
async def publishing(publisher: Any) -> AsyncIterator[None]:
    """A message each 20 ms."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(0.02):
            publisher.publish()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        await asyncio.to_thread(thread.join)


async def test_messages_flow_again_within_2_seconds_at_the_embedded_master(start_process):
    async with AsyncExitStack() as stack:
        leave = (("127.0.0.0/8", MASTER),)
        real = DemoMaster(MASTER, Boundary(leave_from=leave))
        stack.callback(real.close)
        process = start_process(master_uri=real.uri)
        inner = f"http://{PROXY}:{process.master[1]}/"
        inside = Lively(stack, "/inside", inner, NODE)
        outside = Lively(stack, "/outside", real.uri, OUTSIDE)
        out, in_ = inside.node.advertise("/out"), outside.node.advertise("/in")
        heard_outside = outside.node.subscribe("/out")
        heard_inside = inside.node.subscribe("/in")
        inside.node.serve("/add")
        for lively in (inside, outside):
            lively.node.start()
        await stack.enter_async_context(publishing(out))
        await stack.enter_async_context(publishing(in_))

        def flowing(counts: tuple[int, int]) -> bool:
            return heard_outside.received.count > counts[0] and (
                heard_inside.received.count > counts[1]
            )

        await until(lambda: flowing((5, 5)), "messages flow both ways")
        started = await restart(process)
        counts = heard_outside.received.count, heard_inside.received.count
        await until(lambda: flowing((counts[0] + 5, counts[1] + 5)), "messages flow again")
        assert monotonic() - started < 2
        call = asyncio.to_thread(add, outside.boundary, real.uri, "/outside", "/add", 2, 3)
        assert await call == 5
        assert HOST in (await rpc(real.uri, "lookupService", "/x", "/add"))[2]
