"""Nodes of client libraries that lack calls of the slave API, or have more TCPROS ports than one.

ROS requires no library to implement everything. A node that lacks a call is neither dead nor
forged. The node stays registered. After a restart of the proxy, the node is served if the proxy can
confirm the name.
"""

import itertools
from functools import partial
from typing import Any
from xmlrpc.client import Fault

import pytest

from examples.demo.fake_http import Answer, host_and_port, value
from examples.demo.fake_node import FakeNode
from rosproxy.ros1.protocol.xmlrpc.limits import SHORT_REPLY
from rosproxy.ros1.registry import endpoint
from tests.clock import pass_time
from tests.integration.net import (
    OTHER_NODE,
    greet,
    looks,
    refuses,
    rpc,
    service_header,
    topic_header,
    until,
)
from tests.integration.proxy import Proxy

BAD_REQUEST = b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n"
LACKING: dict[str, Answer] = {
    "goroslib": BAD_REQUEST,
    "a fault": value(Fault(-1, "method not implemented")),
    "a status": value([-1, "not implemented", 0]),
    "no XML": b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nno",
}
"""Answers of nodes to unknown calls."""
CALLS = ("getPid", "getPublications", "getSubscriptions")
SOME_CALLS = [calls for count in (1, 2, 3) for calls in itertools.combinations(CALLS, count)]


async def answers(uri: str) -> bool:
    """Whether anything in HTTP comes back from there."""
    try:
        await rpc(uri, "getBusInfo", "/outside")
    except OSError:
        return False
    return True


def lack(node: FakeNode, how: str, *calls: str) -> None:
    node.answers.update(dict.fromkeys(calls, LACKING[how]))


async def populate(proxy: Proxy, node: FakeNode) -> None:
    await node.publish(proxy.master, "/rosout")
    await node.publish(proxy.master, "/out")
    await node.subscribe(proxy.master, "/update")
    await node.serve(proxy.master)


@pytest.fixture(params=SOME_CALLS, ids="+".join)
def calls(request: pytest.FixtureRequest) -> tuple[str, ...]:
    return request.param


@pytest.mark.parametrize("how", LACKING)
async def test_a_node_that_lacks_calls_lives(proxy, master, node, how, calls):
    lack(node, how, *calls)
    await populate(proxy, node)
    before = dict(master.nodes)
    await pass_time(10)
    assert not proxy.endpoint(node).is_down
    assert master.nodes == before
    assert (await greet(proxy.lease(node), topic_header("/out")))["callerid"] == node.name


@pytest.mark.parametrize("how", LACKING)
async def test_a_node_that_lacks_calls_is_served_by_the_next_proxy(proxy, master, node, how, calls):
    lack(node, how, *calls)
    await populate(proxy, node)
    uri = master.nodes[node.name]
    await proxy.restart()
    await until(partial(answers, uri), "the node is served")
    assert (await greet(uri, topic_header("/out")))["callerid"] == node.name
    assert (await greet(uri, service_header("/add")))["callerid"] == node.name
    await pass_time(5)
    assert master.nodes == {node.name: uri}
    assert master.holds("services", "/add")


async def test_a_pid_is_taken_whatever_the_status(proxy, node):
    node.answers["getPid"] = value([0, "", 4242])
    await node.publish(proxy.master)
    await until(lambda: proxy.endpoint(node).health.pid == 4242, "the pid is known")


async def test_a_long_answer_to_getpid_is_not_read(proxy, node):
    """With answers of 4 MB with entities, 24 nodes held up the proxy for 7 s at each probe."""
    node.answers["getPid"] = value([1, "x" * SHORT_REPLY.size, 4242])
    await node.publish(proxy.master)
    await until(lambda: proxy.endpoint(node).health.state == "ok", "the node has answered")
    await pass_time(2)
    assert (proxy.endpoint(node).health.state, proxy.endpoint(node).health.pid) == ("ok", None)


async def test_a_node_that_cannot_be_confirmed_stays_registered(proxy, master, node):
    """The node publishes nothing, so the proxy cannot ask for a topic, and knows no port."""
    lack(node, "goroslib", *CALLS)
    await node.subscribe(proxy.master, "/update")
    uri = master.nodes[node.name]
    await proxy.restart()
    await until(lambda: proxy.app.status()["problems"], "the status has a problem")
    (problem,) = proxy.app.status()["problems"]
    assert "can't tell whether this is the node" in problem["text"]
    await pass_time(10)
    assert master.nodes == {node.name: uri}
    assert await refuses(host_and_port(uri))
    await node.subscribe(proxy.master, "/more")  # a call from its own address confirms the node
    assert master.nodes == {node.name: uri}
    await until(partial(answers, uri), "the node is served")
    assert not proxy.app.status()["problems"]


async def test_another_node_without_the_calls_is_not_confirmed(proxy, master, node, make_node):
    """The TCPROS header of the other node has another name."""
    await populate(proxy, node)
    uri = master.nodes[node.name]
    other = await make_node("/other", OTHER_NODE)

    async def replaced() -> None:
        node.name = other.name
        lack(node, "goroslib", "getPublications", "getSubscriptions")

    await proxy.restart(replaced)
    await until(lambda: proxy.app.status()["problems"], "the status has a problem")
    await pass_time(5)
    assert await refuses(host_and_port(uri))


async def on_own_ports(node: FakeNode, *names: str) -> None:
    for name in names:
        await node.open_own_port(name)


async def greeted(proxy: Proxy, node: FakeNode, header: bytes) -> dict[str, Any]:
    return await greet(proxy.lease(node), header)


async def test_each_topic_and_service_has_a_port_of_its_own(proxy, master, node):
    await on_own_ports(node, "/rosout", "/out", "/too", "/add")
    await populate(proxy, node)
    await node.publish(proxy.master, "/too")
    for _ in range(2):  # the second time from what is known
        for topic in ("/out", "/too"):
            assert (await greeted(proxy, node, topic_header(topic)))["callerid"] == node.name
        assert (await greeted(proxy, node, service_header("/add")))["callerid"] == node.name
    uri = master.nodes[node.name]
    await proxy.restart()
    await until(partial(answers, uri), "the node is served")
    for topic in ("/too", "/out"):
        assert (await greeted(proxy, node, topic_header(topic)))["callerid"] == node.name


async def test_a_port_that_refuses_is_asked_for_anew_and_no_other_is_forgotten(proxy, node):
    await on_own_ports(node, "/rosout", "/out", "/too", "/add")
    await populate(proxy, node)
    await node.publish(proxy.master, "/too")
    for topic in ("/out", "/too"):
        await greeted(proxy, node, topic_header(topic))
    await node.open_own_port("/out")  # anew
    asked = len([1 for method, _ in node.calls if method == "requestTopic"])
    for topic in ("/too", "/out"):
        assert (await greeted(proxy, node, topic_header(topic)))["callerid"] == node.name
    assert (await greeted(proxy, node, service_header("/add")))["callerid"] == node.name
    assert len([1 for method, _ in node.calls if method == "requestTopic"]) == asked + 1


async def test_a_topic_that_has_no_port_is_refused(proxy, node, monkeypatch):
    monkeypatch.setattr(endpoint, "STARTING_S", 0.0)
    await on_own_ports(node, "/out")
    await populate(proxy, node)
    await greeted(proxy, node, topic_header("/out"))
    assert "has no topic /none" in (await greeted(proxy, node, topic_header("/none")))["error"]


async def test_ports_of_services_survive_a_restart(proxy, master, node):
    await on_own_ports(node, "/rosout", "/out", "/add", "/sub")
    await populate(proxy, node)
    await node.serve(proxy.master, "/sub")
    uri = master.nodes[node.name]
    for _ in range(2):
        await proxy.restart()
        await until(partial(answers, uri), "the node is served")
        for service in ("/sub", "/add"):
            header = await greeted(proxy, node, service_header(service))
            assert header["callerid"] == node.name


async def test_a_node_that_only_serves_is_found_by_its_service(proxy, master, node):
    lack(node, "goroslib", *CALLS)
    node.published.clear()
    await on_own_ports(node, "/add")
    await node.serve(proxy.master)
    uri = master.nodes[node.name]
    await proxy.restart()
    await until(partial(answers, uri), "the node is served")
    assert (await greeted(proxy, node, service_header("/add")))["callerid"] == node.name


async def test_a_service_of_unknown_port_is_refused_and_leads_nowhere_else(proxy, master, node):
    """The proxy's parameter at the master has lost the ports of services."""
    await on_own_ports(node, "/rosout", "/out", "/add")
    await populate(proxy, node)
    uri = master.nodes[node.name]
    (name,) = master.params

    async def lose() -> None:
        master.params[name] = "\n".join(
            " ".join(line.split(" ")[:2]) for line in master.params[name].splitlines()
        )

    await proxy.restart(lose)
    await until(partial(answers, uri), "the node is served")
    with pytest.raises((EOFError, ConnectionResetError)):
        await greeted(proxy, node, service_header("/add"))
    await looks(master)
    assert master.holds("services", "/add")


async def test_a_uri_without_a_slash_at_the_end_is_the_same_after_a_restart(proxy, master, node):
    node.uri_form = "http://{}"
    await populate(proxy, node)
    assert (await node.subscribe(proxy.master, "/out"))[2] == [node.uri]  # the literal URI
    uri = master.nodes[node.name]
    await proxy.restart()
    await until(partial(answers, uri), "the node is served")
    assert (await node.publish(proxy.master, "/more"))[0] == 1
    assert (await node.subscribe(proxy.master, "/more"))[2] == [node.uri]
    assert master.nodes == {node.name: uri}
    for topic in ("/out", "/more", "/rosout"):
        reply = await node.call(proxy.master, "unregisterPublisher", topic, node.uri)
        assert reply[2] == 1, topic
    for topic in ("/out", "/more", "/update"):
        reply = await node.call(proxy.master, "unregisterSubscriber", topic, node.uri)
        assert reply[2] == 1, topic
    reply = await node.call(proxy.master, "unregisterService", "/add", node.service_api)
    assert reply[2] == 1
    assert not master.nodes


async def test_a_uri_without_a_host_is_at_the_callers_address(proxy, master, node, make_node):
    """roslisp gives such a URI if ROS_HOSTNAME is empty."""
    node.uri_form = f"http://:{node.slave.address[1]}"
    await populate(proxy, node)
    uri = master.nodes[node.name]
    assert (await greet(uri, topic_header("/out")))["callerid"] == node.name
    neighbour = await make_node("/neighbour", OTHER_NODE)
    at_node = f"http://{node.address}:{node.slave.address[1]}"
    assert (await neighbour.subscribe(proxy.master, "/out"))[2] == [at_node]
    api = f"rosrpc://:{node.tcpros_port}"
    assert (await node.call(proxy.master, "registerService", "/own", api, node.uri))[0] == 1
    assert (await greet(uri, service_header("/own")))["callerid"] == node.name
    await proxy.restart()
    await until(partial(answers, uri), "the node is served")
    assert (await node.publish(proxy.master, "/more"))[0] == 1
    assert master.nodes[node.name] == uri
    reply = await node.call(proxy.master, "unregisterPublisher", "/out", node.uri)
    assert reply[2] == 1
    reply = await node.call(proxy.master, "unregisterService", "/own", api)
    assert reply[2] == 1
