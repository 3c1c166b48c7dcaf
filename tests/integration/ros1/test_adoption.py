"""Nodes that registered around the proxy: adopted without being shut down, whatever happens."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import pytest

from examples.demo.fake_http import free_ports, host_and_port
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.ros1.clients.master_client import MasterClient, Unreachable
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.upkeep.registrar import Registrar
from tests.integration.admin_calls import post, update
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    NODE,
    OTHER_NODE,
    OUTSIDE,
    THIRD_NODE,
    greet,
    refuses,
    rpc,
    service_header,
    topic_header,
    until,
)
from tests.integration.proxy import Proxy

PATIENT = {"cleanup_after": 60.0, "linger": 60.0}


def container(address: str = NODE, *names: str) -> dict[str, Any]:
    return {"address": address, "names": list(names)}


async def adopt(proxy: Proxy, *containers: dict[str, Any]) -> int:
    """Report arrived containers. Return the number of adopted nodes."""
    return (await update(proxy, arrived=containers or [container()]))[2]


async def register_directly(master: FakeMaster, node: FakeNode) -> None:
    """Make a registration of each kind at the real master directly."""
    real = host_and_port(master.uri)
    for topic in ("/chatter", "/rosout"):
        await node.publish(real, topic)
    await node.subscribe(real, "/back")
    await node.serve(real)
    await node.call(real, "subscribeParam", node.uri, "/rosout_disable_topics_generation")


def all_of(master: FakeMaster, name: str = "/talker") -> dict[str, list[str]]:
    """By topic, service or parameter, the URIs that the master has of a node."""
    registrations: dict[str, list[str]] = {}
    for table in master.tables.values():
        for key, row in table.items():
            for caller, uri in row:
                if caller == name:
                    registrations.setdefault(key, []).append(uri)
    return registrations


def leased(proxy: Proxy, node: FakeNode) -> dict[str, list[str]]:
    """The expected registrations once the node is behind the proxy."""
    uri = proxy.uri(node)
    (host, port) = proxy.lease(node)
    names = ("/chatter", "/rosout", "/back", "/rosout_disable_topics_generation")
    return {name: [uri] for name in names} | {"/add": [f"rosrpc://{host}:{port}"]}


def shutdowns(*nodes: FakeNode) -> list[Any]:
    return [call for node in nodes for call in node.calls if call[0] == "shutdown"]


async def test_a_stray_is_adopted(proxy: Proxy, master: FakeMaster, node: FakeNode) -> None:
    await register_directly(master, node)
    assert await adopt(proxy) == 1
    assert all_of(master) == leased(proxy, node)
    lease = proxy.lease(node)
    assert (await greet(lease, topic_header()))["callerid"] == "/talker"
    assert (await greet(lease, service_header()))["callerid"] == "/talker"
    endpoint = proxy.endpoint(node)
    types = {
        registration.name: registration.type for registration in endpoint.registrations.values()
    }
    assert types["/chatter"] == types["/back"] == "std_msgs/String"
    assert await adopt(proxy) == 0
    assert not shutdowns(node)


async def test_it_unregisters_by_what_it_calls_itself(
    proxy: Proxy, master: FakeMaster, node: FakeNode
) -> None:
    await register_directly(master, node)
    await adopt(proxy)
    uri = node.uri
    await node.call(proxy.master, "unregisterPublisher", "/chatter", uri)
    await node.call(proxy.master, "unregisterPublisher", "/rosout", uri)
    await node.call(proxy.master, "unregisterSubscriber", "/back", uri)
    await node.call(proxy.master, "unregisterService", "/add", node.service_api)
    parameter = "/rosout_disable_topics_generation"
    await node.call(proxy.master, "unsubscribeParam", uri, parameter)
    assert not all_of(master)
    assert not proxy.endpoint(node).registrations


async def test_who_is_told_of_it(
    proxy: Proxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    outside = await make_node("/outside", OUTSIDE)
    inside = await make_node("/inside", OTHER_NODE)
    await register_directly(master, node)
    await outside.subscribe(host_and_port(master.uri))
    reply = await inside.subscribe(proxy.master)
    assert reply[2] == [node.uri]
    await adopt(proxy)
    await until(lambda: outside.updates()[-1:] == [[proxy.uri(node)]], "outside is told")
    await until(inside.updates, "inside is told")
    assert {tuple(update) for update in inside.updates()} == {(node.uri,)}


async def test_its_own_subscription_goes_on_without_a_gap(
    proxy: Proxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    outside = await make_node("/outside", OUTSIDE)
    inside = await make_node("/inside", OTHER_NODE)
    await outside.publish(host_and_port(master.uri), "/back")
    await inside.publish(proxy.master, "/back")
    await register_directly(master, node)
    await adopt(proxy)
    await until(lambda: node.updates("/back"), "the node gets the publishers")
    assert node.updates("/back") == [[outside.uri, inside.uri]]


async def test_two_strays_that_hear_each_other_directly(
    proxy: Proxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    listener = await make_node("/listener", OTHER_NODE)
    await node.publish(host_and_port(master.uri))
    await listener.subscribe(host_and_port(master.uri))
    assert await adopt(proxy, container(), container(OTHER_NODE)) == 2
    assert {tuple(update) for update in listener.updates()} == {(node.uri,)}


@pytest.mark.parametrize("host", ["c1", "C1", "127.0.2.11", "3f2a91c0b7de"])
async def test_the_names_of_a_container(
    proxy: Proxy, master: FakeMaster, make_node: MakeNode, host: str
) -> None:
    node = await make_node("/talker", NODE, host)
    await register_directly(master, node)
    assert await adopt(proxy, container(NODE, "c1", "3f2a91c0b7de")) == 1
    assert all_of(master) == leased(proxy, node)
    await node.publish(proxy.master, "/more")
    assert master.holds("publishers", "/more") == [proxy.uri(node)]
    assert not shutdowns(node)


async def test_a_name_that_only_its_container_knows_is_not_given_to_neighbours(
    proxy: Proxy, master: FakeMaster, make_node: MakeNode
) -> None:
    node = await make_node("/talker", NODE, "c1.invalid")
    await register_directly(master, node)
    assert await adopt(proxy, container(NODE, "c1.invalid")) == 1
    neighbour = await make_node("/neighbour", OTHER_NODE)
    (uri,) = (await neighbour.subscribe(proxy.master))[2]
    assert host_and_port(uri)[1] == proxy.lease(node)[1]


async def test_nodes_elsewhere_are_left_alone(
    proxy: Proxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    outside = await make_node("/talker", OUTSIDE, "c1")
    await register_directly(master, outside)
    before = all_of(master)
    assert await adopt(proxy, container(NODE), container(OTHER_NODE, "c2")) == 0
    assert await adopt(proxy, container(NODE, "c1")) == 0  # no node answers there
    assert await adopt(proxy, container(OUTSIDE, "c1")) == 0  # not inside
    assert all_of(master) == before
    texts = [problem.text for problem in proxy.ros1.context.problems.all()]
    assert any("no node answers at" in text for text in texts)
    assert any("is not in an inside network" in text for text in texts)


async def test_another_node_at_the_same_port(
    proxy: Proxy, master: FakeMaster, node: FakeNode
) -> None:
    """The registration at the master is from a former container of that name."""
    await node.call(
        host_and_port(master.uri), "registerPublisher", "/old", "std_msgs/String", node.uri
    )
    assert await adopt(proxy) == 0
    assert master.holds("publishers", "/old") == [node.uri]


async def twins(make_node: MakeNode, *topics: str) -> list[FakeNode]:
    """Nodes of two containers with the same host name and port."""
    port = free_ports(1)
    first = await make_node("/first", NODE, "twin", port)
    second = await make_node("/second", OTHER_NODE, "twin", port)
    assert first.uri == second.uri
    for node, topic in zip((first, second), topics, strict=True):
        node.published = {topic: "std_msgs/String"}
    return [first, second]


async def test_two_containers_with_the_same_names(
    proxy: Proxy, master: FakeMaster, make_node: MakeNode
) -> None:
    first, second = await twins(make_node, "/a", "/b")
    await first.publish(host_and_port(master.uri), "/a")
    await second.publish(host_and_port(master.uri), "/b")
    assert await adopt(proxy, container(NODE, "twin"), container(OTHER_NODE, "twin")) == 2
    assert master.holds("publishers", "/a") == [proxy.uri(first)]
    assert master.holds("publishers", "/b") == [proxy.uri(second)]
    assert proxy.uri(first) != proxy.uri(second)


async def test_two_containers_that_can_not_be_told_apart_are_left_alone(
    proxy: Proxy, master: FakeMaster, make_node: MakeNode
) -> None:
    first, _ = await twins(make_node, "/a", "/a")
    await first.publish(host_and_port(master.uri), "/a")
    assert await adopt(proxy, container(NODE, "twin"), container(OTHER_NODE, "twin")) == 0
    assert master.holds("publishers", "/a") == [first.uri]


async def test_several_names_of_one_process(
    proxy: Proxy, master: FakeMaster, node: FakeNode
) -> None:
    """As in a nodelet manager."""
    await register_directly(master, node)
    await rpc(master.uri, "registerPublisher", "/nodelet", "/points", "std_msgs/String", node.uri)
    node.published["/points"] = "std_msgs/String"
    assert await adopt(proxy) == 2
    assert proxy.endpoint(node).caller_ids == ["/nodelet", "/talker"]
    assert master.holds("publishers", "/points") == [proxy.uri(node)]


@pytest.mark.parametrize("key", ["/talker/diagnostic_period", "/robot/name", "/nobody/knows"])
async def test_a_node_that_is_subscribed_to_a_parameter_is_left_as_it_was(
    proxy: Proxy, master: FakeMaster, node: FakeNode, key: str
) -> None:
    """The master does not show parameter subscriptions, and would shut the node down for a
    remaining one.
    """
    master.params["/robot/name"] = 1
    await register_directly(master, node)
    await node.call(host_and_port(master.uri), "subscribeParam", node.uri, key)
    before = all_of(master)
    assert await adopt(proxy) == 0
    del before[
        "/rosout_disable_topics_generation"
    ]  # lost: this subscription cannot be distinguished
    assert all_of(master) == before
    problems = [p for p in proxy.ros1.context.problems.all() if p.subject == "/talker"]
    assert "Restart the container of the node" in problems[-1].text
    assert not shutdowns(node)
    assert not proxy.endpoint(node).registrations


async def test_one_node_that_can_not_be_adopted_does_not_stop_the_others(
    proxy: Proxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    other = await make_node("/other", OTHER_NODE)
    await other.publish(host_and_port(master.uri), "/b")
    await register_directly(master, node)
    await node.call(host_and_port(master.uri), "subscribeParam", node.uri, "/nobody/knows")
    assert await adopt(proxy, container(), container(OTHER_NODE)) == 1
    assert master.holds("publishers", "/b") == [proxy.uri(other)]
    assert master.holds("publishers", "/chatter") == [node.uri]
    assert not shutdowns(node, other)


async def test_it_registers_through_the_proxy_before_the_update(
    proxy: Proxy, master: FakeMaster, make_node: MakeNode
) -> None:
    node = await make_node("/talker", NODE, "c1.invalid")
    await register_directly(master, node)
    assert (await node.publish(proxy.master, "/more"))[0] == 1
    assert all_of(master) == leased(proxy, node) | {"/more": [proxy.uri(node)]}
    assert await adopt(proxy, container(NODE, "c1.invalid")) == 0
    assert not shutdowns(node)


async def test_an_adopted_node_registers_directly_again(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    """The master drops the node's registrations and calls shutdown, which the proxy does not pass
    on.
    """
    proxy = await make_proxy(**PATIENT)
    await register_directly(master, node)
    await adopt(proxy)
    await node.publish(host_and_port(master.uri), "/more")
    expected = leased(proxy, node) | {"/more": [proxy.uri(node)]}
    await until(lambda: all_of(master) == expected, "all is behind the proxy again")
    assert not shutdowns(node)


async def test_an_adopted_node_registers_directly_after_a_restart_of_the_proxy(
    make_proxy: MakeProxy, master: FakeMaster, make_node: MakeNode
) -> None:
    proxy = await make_proxy(**PATIENT)
    node = await make_node("/talker", NODE, "c1.invalid")
    await register_directly(master, node)
    await adopt(proxy, container(NODE, "c1.invalid"))
    await proxy.restart()
    await until(lambda: len(proxy.ros1.context.registry), "the proxy finds the node at the master")
    await until(lambda: proxy.endpoint(node).trusted, "the node is recovered")
    await node.publish(host_and_port(master.uri), "/more")
    uri = proxy.uri(node)
    await until(lambda: all_of(master).get("/more") == [uri], "the new topic is behind the proxy")
    await until(lambda: all_of(master).get("/chatter") == [uri], "so is /chatter")
    assert not shutdowns(node)


async def test_a_late_shutdown_is_not_passed_on(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    """The reason is over: the master has the node by the proxy's URI again."""
    proxy = await make_proxy(**PATIENT, probe_interval=60.0)
    await node.publish(proxy.master)
    node.published["/lost"] = "std_msgs/String"
    reason = "[/talker] Reason: new node registered with same name"
    assert await rpc(proxy.uri(node), "shutdown", "/master", reason) == [1, "", 0]
    assert not shutdowns(node)
    await until(lambda: "/lost" in all_of(master), "the missing topic is registered")
    assert not proxy.endpoint(node).has_registered_directly


async def test_many_shutdowns_of_a_stranger_are_one_task(
    make_proxy: MakeProxy, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each call left a task that asked the node, and the tasks waited for each other."""
    proxy = await make_proxy(**PATIENT)
    await node.publish(proxy.master)
    asked = list[Endpoint]()
    may_answer = asyncio.Event()

    async def reconcile(_: Registrar, endpoint: Endpoint) -> None:
        asked.append(endpoint)
        await may_answer.wait()

    monkeypatch.setattr(Registrar, "reconcile", reconcile)
    reason = f"[{node.name}] Reason: new node registered with same name"
    for _ in range(20):
        assert await rpc(proxy.uri(node), "shutdown", "/master", reason) == [1, "", 0]
    waiting = [t for t in asyncio.all_tasks() if t.get_name().startswith("taking over")]
    assert len(waiting) == 2
    may_answer.set()
    await asyncio.gather(*waiting)
    assert asked == [proxy.endpoint(node)] * 2
    assert not shutdowns(node)


async def test_a_shutdown_that_is_meant_is_passed_on(
    proxy: Proxy, master: FakeMaster, node: FakeNode, make_node: MakeNode
) -> None:
    await register_directly(master, node)
    await adopt(proxy)
    await rpc(proxy.uri(node), "shutdown", "/rosnode", "user request")
    assert len(shutdowns(node)) == 1
    another = await make_node("/talker", OUTSIDE)
    await another.publish(host_and_port(master.uri))
    await until(lambda: len(shutdowns(node)) == 2, "the older node of the name is shut down")


async def test_what_it_drops_around_the_proxy_is_dropped(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    proxy = await make_proxy(**PATIENT)
    await register_directly(master, node)
    await adopt(proxy)
    del node.published["/chatter"], node.subscribed["/back"]
    await until(lambda: not {"/chatter", "/back"} & set(all_of(master)), "both are dropped")
    assert "/add" in all_of(master)


async def test_after_the_end_of_an_adopted_node_nothing_is_left(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    proxy = await make_proxy(**PATIENT)
    await register_directly(master, node)
    await adopt(proxy)
    lease = proxy.lease(node)
    await node.stop()
    await until(lambda: not all_of(master), "the master has no registrations")
    assert await refuses(lease)


Multicall = Callable[[MasterClient, Sequence[Any]], Awaitable[list[Any]]]


def failing(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """Let the first multicall with this method find the master away."""
    real: Multicall = MasterClient.multicall
    failures: list[str] = []

    async def multicall(self: MasterClient, calls: Sequence[Any]) -> list[Any]:
        if not failures and any(call[0] == method for call in calls):
            failures.append(method)
            raise Unreachable("the master is away")
        return await real(self, calls)

    monkeypatch.setattr(MasterClient, "multicall", multicall)


@pytest.mark.parametrize("method", ["registerPublisher", "registerService"])
async def test_a_failed_registration_is_made_later(
    make_proxy: MakeProxy,
    master: FakeMaster,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
) -> None:
    proxy = await make_proxy(**PATIENT)
    await register_directly(master, node)
    failing(monkeypatch, method)
    reply = await post(proxy, "/containers", json.dumps({"arrived": [container()]}))
    assert reply.status == 503
    assert not all_of(master)
    expected = set(leased(proxy, node)) - {"/rosout_disable_topics_generation"}
    await until(lambda: expected <= set(all_of(master)), "upkeep registers the node")
    assert all_of(master)["/chatter"] == [proxy.uri(node)]
    assert not shutdowns(node)


@pytest.mark.parametrize("method", ["unregisterPublisher", "lookupService", "lookupNode"])
async def test_taking_back_fails_and_is_tried_again(
    make_proxy: MakeProxy,
    master: FakeMaster,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
) -> None:
    proxy = await make_proxy(**PATIENT)
    await register_directly(master, node)
    before = all_of(master)
    failing(monkeypatch, method)
    reply = await post(proxy, "/containers", json.dumps({"arrived": [container()]}))
    assert reply.status == 503
    assert all_of(master) == before
    assert await adopt(proxy) == 1
    assert all_of(master) == leased(proxy, node)
    assert not shutdowns(node)


async def test_the_range_is_exhausted(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster, node: FakeNode
) -> None:
    proxy = await make_proxy(ports=1, **PATIENT)
    await (await make_node("/first", THIRD_NODE)).publish(proxy.master, "/x")
    await register_directly(master, node)
    before = all_of(master)
    assert await adopt(proxy) == 0
    assert all_of(master) == before
    texts = [p.text for p in proxy.ros1.context.problems.all() if p.subject == "/talker"]
    assert any("no port of the range is left" in text for text in texts)


async def test_one_is_taken_over_from_a_former_container(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster, node: FakeNode
) -> None:
    """The registry still has the name from a container that is gone."""
    proxy = await make_proxy(**PATIENT)
    former = await make_node("/talker", OTHER_NODE)
    await former.publish(proxy.master)
    await former.stop()
    master.forget()
    await register_directly(master, node)
    assert await adopt(proxy) == 1
    assert all_of(master) == leased(proxy, node)
    assert not proxy.endpoint(former).names(Kind.PUBLISHER)


async def test_many_at_once(proxy: Proxy, make_node: MakeNode, master: FakeMaster) -> None:
    nodes = [await make_node(f"/n{i}", NODE) for i in range(6)]
    for node in nodes:
        await node.publish(host_and_port(master.uri), f"{node.name}/a")
        await node.subscribe(host_and_port(master.uri), "/shared")
    assert await adopt(proxy) == 6
    for node in nodes:
        assert master.holds("publishers", f"{node.name}/a") == [proxy.uri(node)]
    assert sorted(master.holds("subscribers", "/shared")) == sorted(map(proxy.uri, nodes))
    assert not shutdowns(*nodes)
