"""``--direction both``: inside reaches outside through the proxy, at ports of the proxy alone."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any
from xmlrpc.client import Binary

import pytest

from examples.demo.fake_http import host_and_port, value
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.forwarding.datagrams import bind
from rosproxy.ros1.protocol.tcpros import encode_header
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.stand_ins.outside_nodes import RETRY_TIMEOUT_S, Outside
from rosproxy.shared.addresses import HostPort, is_address, is_loopback
from tests.integration.admin_calls import tell
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    HOST,
    MASTER,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    PROXY,
    connect,
    knock,
    post,
    read_header,
    refuses,
    rpc,
    service_header,
    topic_header,
    until,
    xml,
)
from tests.integration.proxy import Proxy
from tests.integration.ros1.test_alias import WAYS, look_up, look_up_service

BOTH_LOOPS = True
pytestmark = pytest.mark.usefixtures("machines_apart")


@pytest.fixture
async def proxy(make_proxy: MakeProxy) -> Proxy:
    return await make_proxy(direction="both")


@pytest.fixture
async def robot(make_node: MakeNode, master: FakeMaster) -> FakeNode:
    """A node outside that publishes and serves."""
    made = await make_node("/robot", MASTER)
    await made.publish(host_and_port(master.uri))
    await made.serve(host_and_port(master.uri))
    return made


def stand_ins(proxy: Proxy) -> dict[str, int]:
    """The URIs with stand-ins, with the number of open connections."""
    return {row["uri"]: row["connections"] for row in proxy.app.status()["stand_ins"]}


@pytest.mark.parametrize("way", WAYS)
async def test_whatever_way_a_node_is_named_it_is_reached_at_the_proxy(
    proxy: Proxy, robot: FakeNode, node: FakeNode, way: Callable[..., Awaitable[Any]]
) -> None:
    given = await way(proxy, robot, node)
    assert given != robot.uri
    assert host_and_port(given)[0] in (PROXY, "127.0.0.1")
    assert host_and_port(given)[1] not in proxy.settings.ports.listen
    assert (await rpc(host_and_port(given), "getPid", "/tool", source=NODE)) == [1, "", robot.pid]


async def test_a_topic_flows_through_the_proxy(proxy: Proxy, robot: FakeNode) -> None:
    at = host_and_port(await look_up(proxy, robot))
    asked = await rpc(at, "requestTopic", "/n", "/chatter", [["TCPROS"]], source=NODE)
    assert asked == [1, f"ready on {at[0]}:{at[1]}", ["TCPROS", *at]]
    async with connect(at, NODE) as wire:
        await wire.send(topic_header(caller="/n"))
        assert (await read_header(wire))["callerid"] == "/robot"
        await wire.send(b"x" * 300_000)
        assert await wire.exactly(300_000) == b"x" * 300_000
        assert stand_ins(proxy)[robot.uri] == 1
    await until(lambda: stand_ins(proxy)[robot.uri] == 0, "the relay ends")


async def test_a_service_is_called_through_the_proxy(proxy: Proxy, robot: FakeNode) -> None:
    given = await look_up_service(proxy)
    async with connect(host_and_port(given), NODE) as wire:
        await wire.send(service_header(caller="/tool"))
        assert (await read_header(wire))["callerid"] == "/robot"
    assert robot.headers[0]["service"] == "/add"


async def test_a_subscriber_comes_back_to_the_same_port_after_a_restart(
    proxy: Proxy, robot: FakeNode, node: FakeNode
) -> None:
    given = (await node.subscribe(proxy.master))[2]
    node.calls.clear()
    await proxy.restart()
    await until(lambda: len(node.updates()) > 1, "publisherUpdates by the proxy")
    gone, (again,) = node.updates()[:2]  # subscribers that gave up try again after both updates
    assert gone == []
    assert host_and_port(again)[1] == host_and_port(given[0])[1]
    # The proxy does not know the topic's port yet, and asks the node.
    async with connect(host_and_port(again), NODE) as wire:
        await wire.send(topic_header(caller="/n"))
        assert (await read_header(wire))["callerid"] == "/robot"


async def test_uris_from_inside_are_imported_for_the_master(
    proxy: Proxy, robot: FakeNode, master: FakeMaster
) -> None:
    """As `rosnode cleanup` unregisters another node."""
    given = await look_up(proxy, robot)
    api = await look_up_service(proxy)
    await proxy.restart()  # without memory, but with the same port
    assert await look_up(proxy, robot) == given
    ended = await rpc(proxy.master, "unregisterPublisher", "/robot", "/chatter", given, source=NODE)
    assert ended[2] == 1
    assert await look_up_service(proxy) == api
    ended = await rpc(proxy.master, "unregisterService", "/robot", "/add", api, source=NODE)
    assert ended[2] == 1


async def test_tools_see_addresses_that_they_can_use(
    proxy: Proxy, robot: FakeNode, node: FakeNode, make_node: MakeNode, master: FakeMaster
) -> None:
    other = await make_node("/laptop", OUTSIDE)
    await other.publish(host_and_port(master.uri), "/far")
    await node.publish(proxy.master, "/near")
    rows = [
        [1, other.uri, "i", "TCPROS", "/far", True],
        [2, proxy.uri(node), "i", "TCPROS", "/near", True],
    ]
    robot.answers["getBusInfo"] = value([1, "", rows])
    at = host_and_port(await look_up(proxy, robot))
    seen = (await rpc(at, "getBusInfo", "/tool", source=NODE))[2]
    assert seen[1][1] == node.uri
    assert (await rpc(host_and_port(seen[0][1]), "getPid", "/tool", source=NODE))[2] == other.pid


async def test_a_node_outside_has_no_port_opened_for_what_the_master_does_not_have(
    proxy: Proxy, robot: FakeNode
) -> None:
    strange = f"http://{OUTSIDE}:40000/"
    robot.answers["getBusInfo"] = value([1, "", [[1, strange, "i", "TCPROS", "/chatter", True]]])
    at = host_and_port(await look_up(proxy, robot))
    assert (await rpc(at, "getBusInfo", "/tool", source=NODE))[2][0][1] == strange
    assert strange not in stand_ins(proxy)


async def test_only_inside_is_let_in(proxy: Proxy, robot: FakeNode) -> None:
    at = host_and_port(await look_up(proxy, robot))
    service = host_and_port(await look_up_service(proxy))
    for source in (OUTSIDE, MASTER, "127.0.0.1"):
        assert await knock(at, post(xml("getPid", "/tool")), source) in ("closed", "reset")
        assert await knock(service, service_header(), source) in ("closed", "reset")


async def test_a_node_that_is_gone_refuses_until_it_is_back(proxy: Proxy, robot: FakeNode) -> None:
    at = host_and_port(await look_up(proxy, robot))
    await robot.stop()
    assert await knock(at, post(xml("getPid", "/tool")), NODE) == "reset"
    assert await refuses(at, NODE)
    await robot.start()
    assert host_and_port(await look_up(proxy, robot)) == at
    assert (await rpc(at, "getPid", "/tool", source=NODE))[2] == robot.pid


async def test_a_node_with_a_problem_is_asked_whether_it_lives(
    proxy: Proxy, robot: FakeNode
) -> None:
    """A real call, because a roslisp node ends after a connection without data."""
    await look_up(proxy, robot)
    proxy.ros1.context.problems.add(robot.uri, "a topic can't be reached")
    robot.calls.clear()
    await proxy.ros1.stand_ins.tidy()
    assert [method for method, _ in robot.calls] == ["getPid"]
    assert proxy.app.status()["problems"]
    await robot.stop()
    await proxy.ros1.stand_ins.tidy()
    assert not proxy.app.status()["problems"]


async def test_denied_topics_and_services_are_not_reached_by_an_address_that_is_known(
    make_proxy: MakeProxy, robot: FakeNode
) -> None:
    proxy = await make_proxy(
        direction="both", policy=("deny subscribe /chatter by /spy; deny call /add by /spy",)
    )
    at = host_and_port(await look_up(proxy, robot))
    service = host_and_port(await look_up_service(proxy))
    for caller, may in (("/spy", False), ("/friend", True)):
        asked = await rpc(at, "requestTopic", caller, "/chatter", [["TCPROS"]], source=NODE)
        assert (asked[0] == 1) is may
        for port, header in ((at, topic_header), (service, service_header)):
            async with connect(port, NODE) as wire:
                await wire.send(header(caller=caller))
                assert ("error" in await read_header(wire)) is not may


async def test_another_node_at_the_address_does_not_lend_its_name(
    make_proxy: MakeProxy, robot: FakeNode, make_node: MakeNode
) -> None:
    proxy = await make_proxy(direction="both", policy=("deny subscribe /chatter by /spy",))
    spy = await make_node("/spy", OTHER_NODE)
    await spy.publish(proxy.master, "/own")
    at = host_and_port(await look_up(proxy, robot))
    async with connect(at, OTHER_NODE) as wire:
        await wire.send(topic_header(caller="/friend"))
        assert "error" in await read_header(wire)


async def test_a_uri_from_inside_makes_the_proxy_connect_nowhere(
    proxy: Proxy, node: FakeNode
) -> None:
    """Otherwise a node without a way out gets one by naming an address."""
    secret = await asyncio.start_server(lambda *_: None, OUTSIDE)
    port = secret.sockets[0].getsockname()[1]
    params = "/node", "/t", "x/Y", f"http://{OUTSIDE}:{port}/"
    await rpc(proxy.master, "registerPublisher", *params, source=NODE)
    await node.subscribe(proxy.master, "/t")
    assert f"http://{OUTSIDE}:{port}/" not in stand_ins(proxy)
    secret.close()


async def test_nodes_of_outside_may_run_on_the_proxys_machine(
    proxy: Proxy, robot: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "rosproxy.ros1.stand_ins.outside_nodes.is_own", lambda address: address == MASTER
    )
    at = host_and_port(await look_up(proxy, robot))
    assert (await rpc(at, "getPid", "/tool", source=NODE)) == [1, "", robot.pid]


@pytest.mark.parametrize("port", ["master", "lease"])
async def test_nothing_leads_to_the_proxys_own_ports(
    proxy: Proxy, node: FakeNode, master: FakeMaster, monkeypatch: pytest.MonkeyPatch, port: str
) -> None:
    """A node may register any address of the proxy's machine at the master."""
    monkeypatch.setattr(
        "rosproxy.ros1.stand_ins.outside_nodes.is_own", lambda address: address == MASTER
    )
    await node.publish(proxy.master)
    own = {"master": proxy.settings.master_port, "lease": proxy.lease(node)[1]}
    uri = f"http://{MASTER}:{own[port]}/"
    await rpc(host_and_port(master.uri), "registerPublisher", "/evil", "/t", "x/Y", uri)
    told = (await rpc(proxy.master, "lookupNode", "/tool", "/evil", source=NODE))[2]
    assert await knock(host_and_port(told), post(xml("getPid", "/tool")), NODE) == "reset"
    assert await refuses(host_and_port(told), NODE)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.1.1", "0.0.0.0", "localhost"])
async def test_nothing_leads_to_loopback(
    proxy: Proxy, master: FakeMaster, monkeypatch: pytest.MonkeyPatch, host: str
) -> None:
    monkeypatch.setattr("rosproxy.ros1.stand_ins.outside_nodes.is_loopback", is_loopback)
    listening = await asyncio.start_server(lambda *_: None, "127.0.0.1")
    port = listening.sockets[0].getsockname()[1]
    uri = f"http://{host}:{port}/"
    await rpc(host_and_port(master.uri), "registerPublisher", "/evil", "/t", "x/Y", uri)
    told = (await rpc(proxy.master, "lookupNode", "/tool", "/evil", source=NODE))[2]
    assert await knock(host_and_port(told), post(xml("getPid", "/tool")), NODE) == "reset"
    listening.close()


async def test_a_node_waits_for_no_row_of_silent_nodes_that_refused_before(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1,000 such nodes, 32 at a time, kept a registration waiting for half a minute."""
    ports = proxy.ros1.stand_ins
    uris = [f"http://{MASTER}:{port}/" for port in range(40000, 40005)]
    tried = list[str]()

    async def refuses(_: Outside, uri: str, target: HostPort) -> bool:
        tried.append(uri)
        await asyncio.sleep(RETRY_TIMEOUT_S)
        return False

    monkeypatch.setattr(Outside, "refuses", refuses)
    monkeypatch.setattr(ports, "_retry_slots", asyncio.Semaphore(1))
    ports._refused.update(dict.fromkeys(uris))
    await ports.listen_for(uris, Caller(NODE, PROXY))
    assert 0 < len(tried) < 3
    assert stand_ins(proxy).keys() == {*uris}


# UDPROS


def udp_offer(topic: str, host: str, port: int) -> list[Any]:
    header = encode_header({"topic": topic, "callerid": "/node", "md5sum": "*"})[4:]
    return ["UDPROS", Binary(header), host, port, 1500]


def offers_heard(node: FakeNode) -> list[Any]:
    """The offers of the last requestTopic that a node got."""
    params: list[Any] = next(params for method, params in node.calls if method == "requestTopic")[2]
    return params


async def test_udpros_from_outside_comes_in_through_the_range(
    make_proxy: MakeProxy, make_node: MakeNode, robot: FakeNode
) -> None:
    proxy = await make_proxy(direction="both", udp=True)
    node = await make_node("/node")
    await node.subscribe(proxy.master)
    at = host_and_port(await look_up(proxy, robot))
    with bind(NODE, 0) as listener, bind(MASTER, 0) as talker:
        port = listener.getsockname()[1]
        offer = udp_offer("/chatter", "node", port)
        await rpc(at, "requestTopic", "/node", "/chatter", [offer], source=NODE)
        ((_, _, host, told, _),) = offers_heard(robot)
        assert (host, told in proxy.settings.ports.listen) == (HOST, True)
        talker.sendto(b"message", (HOST, told))
        async with asyncio.timeout(5):
            assert await asyncio.get_running_loop().sock_recv(listener, 100) == b"message"
        (row,) = proxy.app.status()["udpros"]
        assert (row["topic"], row["port"], row["bytes"]) == ("/chatter", told, 7)
        await node.stop()
        await rpc(proxy.master, "unregisterSubscriber", "/node", "/chatter", node.uri, source=NODE)
        await proxy.ros1.stand_ins.tidy()
        assert not proxy.app.status()["udpros"]


async def test_udpros_goes_out_through_a_port_inside(
    proxy: Proxy, node: FakeNode, master: FakeMaster
) -> None:
    await node.publish(proxy.master)
    with bind(OUTSIDE, 0) as listener, bind(NODE, 0) as talker:
        offer = udp_offer("/chatter", OUTSIDE, listener.getsockname()[1])
        await rpc(
            proxy.lease(node), "requestTopic", "/listener", "/chatter", [offer], source=OUTSIDE
        )
        ((_, _, host, told, _),) = offers_heard(node)
        assert host != OUTSIDE
        talker.sendto(b"message", (host, told))
        async with asyncio.timeout(5):
            assert await asyncio.get_running_loop().sock_recv(listener, 100) == b"message"


@pytest.mark.parametrize(
    ("udp", "topic"), [(False, "/chatter"), (True, "/secret")], ids=["not published", "a lie"]
)
async def test_an_offer_that_can_not_be_had_is_taken_out(
    make_proxy: MakeProxy, make_node: MakeNode, robot: FakeNode, udp: bool, topic: str
) -> None:
    proxy = await make_proxy(direction="both", udp=udp)
    node = await make_node("/node")
    await node.subscribe(proxy.master)
    at = host_and_port(await look_up(proxy, robot))
    offers = [udp_offer(topic, "node", 40000), ["TCPROS"]]
    asked = await rpc(at, "requestTopic", "/node", "/chatter", offers, source=NODE)
    assert offers_heard(robot) == [["TCPROS"]]
    assert asked[2] == ["TCPROS", *at]


async def test_who_asks_for_many_takes_no_udpros_from_others(
    proxy: Proxy, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy.ros1.stand_ins.udpros_relays.MOST_RELAYS", 4)
    monkeypatch.setattr("rosproxy.ros1.stand_ins.udpros_relays.MOST_RELAYS_EACH", 3)
    await node.publish(proxy.master)
    at = proxy.lease(node)
    for source, ports in ((OUTSIDE, [40000]), (MASTER, range(40001, 40010))):
        for port in ports:
            offer = udp_offer("/chatter", source, port)
            await rpc(at, "requestTopic", "/listener", "/chatter", [offer], source=source)
    peers = [row["peer"] for row in proxy.app.status()["udpros"]]
    assert sorted(peers) == [MASTER] * 3 + [OUTSIDE]


async def test_a_network_of_many_addresses_takes_no_udpros_from_others(
    proxy: Proxy, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine may have any number of IPv6 addresses."""

    def network(address: str) -> str:
        return "127.0.9.0/24" if address.startswith("127.0.9.") else address

    monkeypatch.setattr("rosproxy.ros1.stand_ins.udpros_relays.MOST_RELAYS", 4)
    monkeypatch.setattr("rosproxy.ros1.stand_ins.udpros_relays.subnet", network, raising=False)
    await node.publish(proxy.master)
    at = proxy.lease(node)
    for source in (OUTSIDE, *(f"127.0.9.{number}" for number in range(1, 10))):
        offer = udp_offer("/chatter", source, 40000)
        await rpc(at, "requestTopic", "/listener", "/chatter", [offer], source=source)
    peers = [row["peer"] for row in proxy.app.status()["udpros"]]
    assert sorted(peers) == [OUTSIDE, *(f"127.0.9.{number}" for number in (7, 8, 9))]


async def test_a_call_with_many_offers_has_a_single_relay(proxy: Proxy, node: FakeNode) -> None:
    """Each of 500 offers in a call opened a relay, in one turn of the event loop."""
    await node.publish(proxy.master)
    offers = [udp_offer("/chatter", OUTSIDE, port) for port in range(40000, 40010)]
    asked = [*offers, ["TCPROS"]]
    await rpc(proxy.lease(node), "requestTopic", "/l", "/chatter", asked, source=OUTSIDE)
    (relayed, other) = offers_heard(node)
    (row,) = proxy.app.status()["udpros"]
    assert (relayed[3], other) == (row["port"], ["TCPROS"])


async def test_a_search_for_ended_subscriptions_sorts_no_names(
    proxy: Proxy, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To sort 10,000 names for each of 256 relays took 0.25 s, every half minute."""
    await node.publish(proxy.master)
    offer = udp_offer("/chatter", OUTSIDE, 40000)
    await rpc(proxy.lease(node), "requestTopic", "/l", "/chatter", [offer], source=OUTSIDE)
    monkeypatch.setattr(Endpoint, "names", lambda *_: pytest.fail("all names are sorted"))
    proxy.ros1.stand_ins.udpros.sweep()
    assert len(proxy.ros1.stand_ins.udpros) == 1


async def test_who_is_gone_was_not_cut_by_a_policy(
    make_proxy: MakeProxy, make_node: MakeNode, robot: FakeNode
) -> None:
    proxy = await make_proxy(direction="both", udp=True)
    nodes = [await make_node("/one"), await make_node("/other", OTHER_NODE)]
    at = host_and_port(await look_up(proxy, robot))
    for node, source in zip(nodes, (NODE, OTHER_NODE), strict=True):
        await node.subscribe(proxy.master)
        offer = udp_offer("/chatter", "node", 40000)
        await rpc(at, "requestTopic", node.name, "/chatter", [offer], source=source)
    assert len(proxy.app.status()["udpros"]) == 2
    gone = nodes[0]
    await rpc(proxy.master, "unregisterSubscriber", gone.name, "/chatter", gone.uri, source=NODE)
    rules = {"name": "a", "mode": "enforce", "rules": ["deny subscribe /chatter"]}
    answer = await tell(proxy, "/policy", layers=[{**rules, "addresses": None}])
    assert answer["cut"] == 1
    assert not proxy.app.status()["udpros"]


async def test_a_name_that_changes_its_address_leads_nowhere_else(
    proxy: Proxy, master: FakeMaster, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An attacker's name server may give another address the second time."""
    robot = await make_node("/robot", MASTER, host="robot.example")
    await robot.publish(host_and_port(master.uri))
    at = host_and_port(await look_up(proxy, robot))
    asked: list[str] = []

    async def resolve(host: str, source: str) -> list[str]:
        if is_address(host):
            return [host]
        asked.append(host)
        return [MASTER] if len(asked) == 1 else [NODE]

    for module in ("shared.machine.resolver", "ros1.stand_ins.outside_nodes"):
        monkeypatch.setattr(f"rosproxy.{module}.resolve", resolve)
    assert (await rpc(at, "getPid", "/tool", source=NODE))[2] == robot.pid
    assert asked == ["robot.example"]
