"""Inside nodes among themselves and with outside: the addresses that each caller gets."""

import asyncio
from ipaddress import ip_network

import pytest

from examples.demo.fake_http import value
from examples.demo.fake_node import FakeNode
from rosproxy.net.network_changes import NetworkChanges
from tests.integration.net import (
    HOST,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    PROXY,
    THIRD_NODE,
    connect,
    greet,
    knock,
    post,
    refuses,
    rpc,
    service_header,
    topic_header,
    until,
    xml,
)


@pytest.fixture
async def twins(make_node):
    """Two nodes in different containers with the same URI."""
    first = await make_node("/first", NODE, host="localhost")
    second = FakeNode("/second", OTHER_NODE, host="localhost")
    second.slave.address = OTHER_NODE, first.slave.address[1]
    await second.start()
    yield first, second
    await second.stop()


async def test_nodes_that_give_the_same_uri_are_told_apart(proxy, master, twins):
    first, second = twins
    assert first.uri == second.uri
    for node in twins:
        await node.publish(proxy.master, f"{node.name}/out")
        await node.serve(proxy.master, f"{node.name}/add")
    assert proxy.uri(first) != proxy.uri(second)
    for node in twins:
        assert master.holds("publishers", f"{node.name}/out") == [proxy.uri(node)]
        assert (await rpc(proxy.uri(node), "getPid", "/outside"))[2] == node.pid
        header = await greet(proxy.lease(node), service_header(f"{node.name}/add"))
        assert header["callerid"] == node.name


async def test_each_sees_itself_literally_and_the_other_through_the_proxy(proxy, twins):
    first, second = twins
    await first.publish(proxy.master)
    await second.publish(proxy.master)
    seen = (await second.subscribe(proxy.master))[2]
    port = proxy.endpoint(first).port
    relayed = f"http://{PROXY}:{port}/"
    assert seen == [relayed, second.uri]
    asked = await rpc(relayed, "requestTopic", "/second", "/chatter", [["TCPROS"]], source=NODE)
    assert asked[2] == ["TCPROS", PROXY, port]
    assert (await greet((PROXY, port), topic_header()))["callerid"] == "/first"


async def test_a_service_of_a_neighbour_without_a_usable_name_is_relayed(proxy, twins, make_node):
    first, _ = twins
    caller = await make_node("/caller", THIRD_NODE)
    await first.serve(proxy.master)
    reply = await caller.call(proxy.master, "lookupService", "/add")
    assert reply[2] == f"rosrpc://{PROXY}:{proxy.endpoint(first).port}"
    assert (await first.call(proxy.master, "lookupService", "/add"))[2] == first.service_api


async def test_a_tool_inside_can_unregister_whatever_it_was_told_of(proxy, master, make_node):
    tool = await make_node("/tool", THIRD_NODE)
    direct = await make_node("/direct")
    relayed = await make_node("/relayed", OTHER_NODE, "x.invalid")
    for node in (direct, relayed):
        await node.publish(proxy.master)
        await node.serve(proxy.master, f"{node.name}/add")
    far = f"http://{OUTSIDE}:4000/"
    await rpc(master.uri, "registerPublisher", "/far", "/chatter", "std_msgs/String", far)
    for name in ("/direct", "/relayed", "/far"):
        uri = (await tool.call(proxy.master, "lookupNode", name))[2]
        gone = await rpc(
            proxy.master, "unregisterPublisher", name, "/chatter", uri, source=tool.address
        )
        assert gone[2] == 1, (name, uri)
    for name in ("/direct", "/relayed"):
        api = (await tool.call(proxy.master, "lookupService", f"{name}/add"))[2]
        gone = await rpc(
            proxy.master, "unregisterService", name, f"{name}/add", api, source=tool.address
        )
        assert gone[2] == 1, (name, api)
    assert master.nodes == {}
    assert not any(e.registrations for e in proxy.ros1.context.registry)


async def test_an_offer_of_udpros_passes_unharmed(proxy, node):
    await node.publish(proxy.master)
    reply = [1, "", ["UDPROS", NODE, 4321, 7, 1500, b"header"]]
    node.answers["requestTopic"] = value(reply)
    offer = [["UDPROS", b"\0\1binary", OUTSIDE, 1234, 1500], ["TCPROS"]]
    asked = await rpc(proxy.uri(node), "requestTopic", "/outside", "/chatter", offer)
    assert asked[:2] == reply[:2]
    assert asked[2][:3] == ["UDPROS", HOST, 4321]  # datagrams come from there
    assert asked[2][5].data == b"header"
    seen = node.calls[-1][1][2]
    assert (seen[0][1].data, seen[0][2:], seen[1]) == (
        b"\0\1binary",
        [OUTSIDE, 1234, 1500],
        ["TCPROS"],
    )


async def test_a_parameter_reaches_its_subscriber(proxy, node):
    await node.call(proxy.master, "subscribeParam", node.uri, "/p")
    await rpc(proxy.uri(node), "paramUpdate", "/master", "/p", {"a": [1, 2.5, True]})
    assert node.calls[-1] == ("paramUpdate", ("/master", "/p", {"a": [1, 2.5, True]}))


async def test_a_parameter_reaches_who_subscribed_to_a_namespace_it_is_in(proxy, node):
    await node.call(proxy.master, "subscribeParam", node.uri, "/robot")
    await rpc(proxy.uri(node), "paramUpdate", "/master", "/robot/arm/speed/", 1)
    assert node.calls[-1] == ("paramUpdate", ("/master", "/robot/arm/speed/", 1))
    reply = await rpc(proxy.uri(node), "paramUpdate", "/master", "/robots/", 1)
    text = f"rosproxy: /talker ({node.uri}) has not subscribed to parameter /robots/"
    assert reply == [-1, text, 0]


async def test_a_node_gets_no_updates_for_parameters_of_the_former_node_at_its_port(proxy, node):
    """The master keeps parameter subscriptions by URI, and forgets none."""
    await node.publish(proxy.master)
    assert (await rpc(proxy.uri(node), "paramUpdate", "/master", "/p/", 1))[0] == -1
    assert "paramUpdate" not in [name for name, _ in node.calls]


async def test_a_recovered_node_is_told_of_parameters(proxy, node):
    await node.publish(proxy.master)
    await node.call(proxy.master, "subscribeParam", node.uri, "/p")
    await proxy.restart()
    await until(lambda: len(proxy.ros1.context.registry), "the proxy finds the node at the master")
    await until(lambda: proxy.endpoint(node).trusted, "the node is recovered")
    assert (await rpc(proxy.uri(node), "paramUpdate", "/master", "/p/", 1))[0] == 1
    assert node.calls[-1] == ("paramUpdate", ("/master", "/p/", 1))


async def test_an_update_of_a_parameter_does_not_overtake_the_subscription(proxy, master, node):
    await node.publish(proxy.master)
    master.delay = 0.2
    subscribing = asyncio.create_task(node.call(proxy.master, "subscribeParam", node.uri, "/p"))
    await until(lambda: proxy.endpoint(node).pending, "the subscription is pending")
    assert (await rpc(proxy.uri(node), "paramUpdate", "/master", "/p/", 1))[0] == 1
    assert subscribing.done()
    await subscribing


async def test_an_update_does_not_overtake_the_registration_before_it(proxy, master, node):
    await node.subscribe(proxy.master, "/other")
    uri = proxy.uri(node)
    master.delay = 0.2
    registering = asyncio.create_task(node.subscribe(proxy.master))
    await until(lambda: proxy.endpoint(node).pending, "the registration is pending")
    far = f"http://{OUTSIDE}:4000/"
    await rpc(uri, "publisherUpdate", "/master", "/chatter", [far])
    assert registering.done()
    assert await registering == [1, "Subscribed to [/chatter]", []]
    assert node.updates() == [[far]]


async def test_a_call_for_a_former_node_of_a_port_does_not_reach_the_next(make_proxy, make_node):
    proxy = await make_proxy(ports=1, linger=0.0)
    former = await make_node("/former")
    next_ = await make_node("/next", OTHER_NODE)
    await former.publish(proxy.master)
    lease = proxy.lease(former)
    former_path = f"/{NODE}:{former.slave.address[1]}/"
    async with connect(lease) as kept:
        await kept.send(post(xml("getPid", "/outside")))
        await kept.reply()
        await former.call(proxy.master, "unregisterPublisher", "/chatter", former.uri)
        await until(lambda: refuses(lease), "the lease ends")
        assert await kept.end() in ("closed", "reset")
    await next_.publish(proxy.master)
    assert proxy.lease(next_) == lease
    reason = "[/former] Reason: new node registered with same name"
    assert await rpc(lease, "shutdown", "/master", reason) == [1, "", 0]
    # Former versions of the proxy handed out URIs with a path.
    shutdown = post(xml("shutdown", "/master", "moved"), path=former_path)
    assert await knock(lease, shutdown) == "reset"
    assert "shutdown" not in dict(next_.calls)
    assert (await rpc(lease, "getPid", "/outside"))[2] == next_.pid


async def test_outside_nodes_are_never_touched(proxy, master, node, make_node):
    """URIs and services of other hosts pass unchanged."""
    stranger = await make_node("/far", OUTSIDE)
    far = stranger.uri
    await rpc(master.uri, "registerPublisher", "/far", "/chatter", "std_msgs/String", far)
    await rpc(master.uri, "registerService", "/far", "/far/add", f"rosrpc://{OUTSIDE}:5", far)
    near_miss = f"http://{HOST}:{proxy.settings.ports.listen.last}/"  # no endpoint
    await rpc(master.uri, "registerPublisher", "/odd", "/chatter", "std_msgs/String", near_miss)
    assert (await node.subscribe(proxy.master))[2] == [far, near_miss]
    assert (await node.call(proxy.master, "lookupNode", "/far"))[2] == far
    assert (await node.call(proxy.master, "lookupService", "/far/add"))[
        2
    ] == f"rosrpc://{OUTSIDE}:5"
    assert await knock((HOST, proxy.settings.ports.listen.last), b"x") == "refused"
    assert stranger.slave.connections == 0


class EverythingChanges(NetworkChanges):
    """Reports a change of networks before each call."""

    def noticed(self, _now: float) -> bool:
        return True


async def test_a_network_that_the_proxy_joins_while_it_runs_counts_at_once(
    make_proxy, make_node, monkeypatch: pytest.MonkeyPatch
):
    networks = [ip_network("127.0.5.0/24")]
    monkeypatch.setattr("rosproxy.ros1.context.interface_networks", lambda **_: tuple(networks))
    monkeypatch.setattr("rosproxy.ros1.context.NetworkChanges", EverythingChanges)
    proxy = await make_proxy(inside_network=())
    talker = await make_node("/talker")
    listener = await make_node("/listener", OTHER_NODE)
    networks.append(ip_network("127.0.2.0/24"))
    await talker.publish(proxy.master)
    assert (await listener.subscribe(proxy.master))[2] == [talker.uri]
