"""Nodes on the master's host: inside, the host name leads to the proxy, and the ports stay."""

import asyncio
import socket
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from typing import Any

import pytest

from examples.demo.fake_http import Address, End, host_and_port, ok, value
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.servers import callers
from rosproxy.shared.setting_kinds import hash_token
from tests.integration.admin.test_admin import metrics
from tests.integration.admin_calls import update
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    MASTER,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    PROXY,
    Wire,
    connect,
    exchange,
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

BOTH_LOOPS = True
pytestmark = pytest.mark.usefixtures("machines_apart")
MOVED = "127.0.1.2"
"""Another address of the master's host."""


def behind_its_name(master: FakeMaster, **options: Any) -> dict[str, Any]:
    """Options of a proxy that stands in for the master's host with the same ports."""
    port = host_and_port(master.uri)[1]
    named = {"master_uri": f"http://robot:{port}", "master_address": MASTER}
    return {**named, "bind": PROXY, "advertise_host": PROXY, **options}


@pytest.fixture
async def proxy(make_proxy: MakeProxy, master: FakeMaster) -> Proxy:
    return await make_proxy(**behind_its_name(master))


@pytest.fixture
async def robot(make_node: MakeNode, master: FakeMaster) -> FakeNode:
    """A node on the master's host that publishes and serves."""
    made = await make_node("/robot", MASTER, host="robot")
    await made.publish(host_and_port(master.uri))
    await made.serve(host_and_port(master.uri))
    return made


def slave(node: FakeNode, address: str = PROXY) -> Address:
    """The address of a node's slave API for inside."""
    return address, node.slave.address[1]


def service(node: FakeNode, address: str = PROXY) -> Address:
    """The address of a node's services for inside."""
    return address, node.tcpros_port


def stand_ins(proxy: Proxy) -> dict[int, int]:
    """The ports of stand-ins, with the number of connections."""
    return {row["port"]: row["connections"] for row in proxy.app.status()["stand_ins"]}


def problems(proxy: Proxy) -> dict[str, str]:
    return {row["subject"]: row["text"] for row in proxy.app.status()["problems"]}


async def look_up(proxy: Proxy, node: FakeNode) -> Any:
    """A node's slave URI for inside."""
    return (await rpc(proxy.master, "lookupNode", "/tool", node.name, source=NODE))[2]


async def look_up_service(proxy: Proxy) -> Any:
    return (await rpc(proxy.master, "lookupService", "/tool", "/add", source=NODE))[2]


def real_master(proxy: Proxy) -> Address:
    return MASTER, host_and_port(proxy.settings.master_uri)[1]


async def by_subscribing(proxy: Proxy, robot: FakeNode, node: FakeNode) -> Any:
    return (await node.subscribe(proxy.master))[2][0]


async def by_publishing(proxy: Proxy, robot: FakeNode, node: FakeNode) -> Any:
    await robot.subscribe(real_master(proxy))
    return (await node.publish(proxy.master))[2][0]


async def by_lookup(proxy: Proxy, robot: FakeNode, node: FakeNode) -> Any:
    return await look_up(proxy, robot)


async def by_multicall(proxy: Proxy, robot: FakeNode, node: FakeNode) -> Any:
    calls = [
        {"methodName": "getPid", "params": ["/tool"]},
        {"methodName": "lookupNode", "params": ["/tool", "/robot"]},
    ]
    return (await rpc(proxy.master, "system.multicall", calls, source=NODE))[1][0][2]


async def by_update(proxy: Proxy, robot: FakeNode, node: FakeNode) -> Any:
    await node.subscribe(proxy.master, "/later")
    await robot.publish(real_master(proxy), "/later")
    await until(lambda: node.updates("/later"), "a publisherUpdate")
    return node.updates("/later")[0][0]


WAYS = [by_subscribing, by_publishing, by_lookup, by_multicall, by_update]


@pytest.mark.parametrize("way", WAYS)
async def test_whatever_way_a_uri_is_given_it_is_unchanged_and_its_port_is_open(
    proxy: Proxy, robot: FakeNode, node: FakeNode, way: Callable[..., Awaitable[Any]]
) -> None:
    assert stand_ins(proxy) == {}
    assert await refuses(slave(robot), NODE)
    assert await way(proxy, robot, node) == robot.uri
    assert slave(robot)[1] in stand_ins(proxy)
    assert (await rpc(slave(robot), "getPid", "/tool", source=NODE)) == [1, "", robot.pid]


async def test_the_port_is_open_before_the_update_arrives(
    proxy: Proxy, robot: FakeNode, node: FakeNode, master: FakeMaster
) -> None:
    refused: list[bool] = []

    def look(*_: Any) -> bytes:
        with socket.socket() as probe:
            refused.append(probe.connect_ex(slave(robot)) != 0)
        return value([1, "", 0])

    node.answers["publisherUpdate"] = look
    await node.subscribe(proxy.master, "/later")
    await robot.publish(host_and_port(master.uri), "/later")
    await until(lambda: refused, "a publisherUpdate")
    assert refused == [False]


async def test_a_service_is_found_at_its_own_port(proxy: Proxy, robot: FakeNode) -> None:
    assert await look_up_service(proxy) == robot.service_api
    assert stand_ins(proxy) == {robot.tcpros_port: 0}
    async with connect(service(robot), NODE) as wire:
        await wire.send(service_header(caller="/tool"))
        assert (await read_header(wire))["callerid"] == "/robot"
        await wire.send(b"x" * 300_000)
        assert await wire.exactly(300_000) == b"x" * 300_000
        assert stand_ins(proxy) == {robot.tcpros_port: 1}
    assert robot.headers == [{"callerid": "/tool", "service": "/add", "md5sum": "*"}]
    await until(lambda: stand_ins(proxy) == {robot.tcpros_port: 0}, "the relay ends")


async def test_a_topic_is_to_be_had_directly_at_the_masters_address(
    proxy: Proxy, robot: FakeNode
) -> None:
    await look_up(proxy, robot)
    asked = await rpc(slave(robot), "requestTopic", "/n", "/chatter", [["TCPROS"]], source=NODE)
    port = robot.tcpros_port
    assert asked == [1, f"ready on {MASTER}:{port}", ["TCPROS", MASTER, port]]
    assert port not in stand_ins(proxy)
    asked = await rpc(slave(robot), "requestTopic", "/n", "/no", [["TCPROS"]], source=NODE)
    assert asked == [-1, "Not a publisher of [/no]", []]


async def test_calls_pass_byte_for_byte_with_their_path(proxy: Proxy, robot: FakeNode) -> None:
    await look_up(proxy, robot)
    body = xml("anything", "/tool", {"a": [1, 2.5]}).replace(b"\n", b" ")
    robot.answers["anything"] = ok(b"<methodResponse>whatever")
    reply = await exchange(slave(robot), post(body, path="/10.0.0.5:40001/a%20b/?c=d"), NODE)
    assert reply.body == b"<methodResponse>whatever"
    sent = robot.requests[-1]
    assert (sent.body, sent.path) == (body, "/10.0.0.5:40001/a%20b/?c=d")
    assert sent.headers["host"] == f"robot:{slave(robot)[1]}"


async def test_what_is_no_call_is_answered_and_not_forwarded(proxy: Proxy, robot: FakeNode) -> None:
    await look_up(proxy, robot)
    for request in (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"PUT / HTTP/1.1\r\nHost: x\r\n\r\n"):
        assert (await exchange(slave(robot), request, NODE)).status in (200, 405)
    assert (await exchange(slave(robot), post(b"<a"), NODE)).fault == -32700
    assert robot.requests == []


async def test_a_body_beyond_the_bound_is_refused(proxy: Proxy, robot: FakeNode) -> None:
    await look_up(proxy, robot)
    size = proxy.ros1.context.master_call.size + 1
    assert (await exchange(slave(robot), post(b"x" * size), NODE)).status == 413
    robot.answers["getPid"] = ok(b"x" * size)
    assert await knock(slave(robot), post(xml("getPid", "/tool")), NODE) == "reset"


async def test_ends_and_resets_pass(proxy: Proxy, robot: FakeNode) -> None:
    ends: asyncio.Queue[Any] = asyncio.Queue()
    over = asyncio.Event()

    async def hold(
        node: FakeNode, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, header: Any
    ) -> None:
        ends.put_nowait(Wire(reader, writer))
        await over.wait()

    robot.stream = hold
    await look_up_service(proxy)
    async with connect(service(robot), NODE) as inside:
        await inside.send(service_header())
        outside = await ends.get()
        await inside.half_close()
        assert await outside.reader.read() == b""
        await outside.send(b"still here")
        assert await inside.exactly(10) == b"still here"
        outside.reset()
        assert await inside.end() == "reset"
    async with connect(service(robot), NODE) as inside:
        await inside.send(service_header())
        outside = await ends.get()
        inside.reset()
        assert await outside.end() == "reset"
    over.set()


async def test_only_inside_is_let_in(proxy: Proxy, robot: FakeNode) -> None:
    await look_up(proxy, robot)
    await look_up_service(proxy)
    for source in (OUTSIDE, MASTER, "127.0.0.1"):
        assert await knock(slave(robot), post(xml("getPid", "/tool")), source) in _CLOSED
        assert await knock(service(robot), service_header(), source) in _CLOSED
    assert robot.calls == []
    assert robot.headers == []


_CLOSED = ("closed", "reset")


@pytest.mark.parametrize(
    "options",
    [{"master_address": None}, {"master_uri": "http://127.0.1.1:{port}"}],
    ids=["no master address", "the master's host is an address"],
)
async def test_nothing_happens_without_need(
    make_proxy: MakeProxy,
    master: FakeMaster,
    robot: FakeNode,
    options: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def resolve(host: str, source: str) -> list[str]:
        return [MASTER]

    monkeypatch.setattr("rosproxy.shared.machine.resolver.resolve", resolve)
    port = host_and_port(master.uri)[1]
    changed = {name: text and text.format(port=port) for name, text in options.items()}
    proxy = await make_proxy(**behind_its_name(master, **changed))
    assert await look_up(proxy, robot) == robot.uri
    assert await look_up_service(proxy) == robot.service_api
    assert stand_ins(proxy) == {}
    assert await refuses(slave(robot), NODE)


async def test_nodes_with_addresses_or_of_other_hosts_are_left_alone(
    proxy: Proxy, master: FakeMaster, make_node: MakeNode
) -> None:
    for name, host in (("/one", MASTER), ("/two", "laptop")):
        node = await make_node(name, MASTER, host=host)
        await node.publish(host_and_port(master.uri))
        assert await look_up(proxy, node) == node.uri
    assert stand_ins(proxy) == {}


async def gone(proxy: Proxy, robot: FakeNode) -> None:
    """End a node with aliases. Connections from inside are reset."""
    await robot.stop()
    assert await knock(slave(robot), post(xml("getPid", "/tool")), NODE) == "reset"
    assert await knock(service(robot), service_header(), NODE) == "reset"


async def test_a_node_that_is_gone_refuses_until_it_is_back(proxy: Proxy, robot: FakeNode) -> None:
    await look_up(proxy, robot)
    await look_up_service(proxy)
    await gone(proxy, robot)
    for _ in range(2):
        assert await refuses(slave(robot), NODE)
        assert await refuses(service(robot), NODE)
        assert stand_ins(proxy) == {}
        assert await look_up(proxy, robot) == robot.uri
        assert await look_up_service(proxy) == robot.service_api
    await robot.start()
    assert await look_up(proxy, robot) == robot.uri
    assert stand_ins(proxy) == {slave(robot)[1]: 0}
    assert (await rpc(slave(robot), "getPid", "/tool", source=NODE))[2] == robot.pid


async def test_open_relays_outlive_the_port(proxy: Proxy, robot: FakeNode) -> None:
    await look_up_service(proxy)
    async with connect(service(robot), NODE) as wire:
        await wire.send(service_header())
        await read_header(wire)
        robot.tcpros.stop_listening()
        assert await knock(service(robot), service_header(), NODE) == "reset"
        assert await refuses(service(robot), NODE)
        await wire.send(b"hello")
        assert await wire.exactly(5) == b"hello"


async def test_a_node_that_does_not_answer_is_no_node_that_is_gone(
    proxy: Proxy, robot: FakeNode
) -> None:
    await look_up(proxy, robot)
    robot.answers["getPid"] = End.RESET
    assert await knock(slave(robot), post(xml("getPid", "/tool")), NODE) == "reset"
    assert stand_ins(proxy) == {slave(robot)[1]: 0}


async def test_ports_that_the_proxy_needs_itself_are_a_problem(
    proxy: Proxy, master: FakeMaster
) -> None:
    settings = proxy.settings
    own = [settings.ports.listen.last, settings.master_port, settings.admin.port]
    uris = [f"http://robot:{port}/" for port in own]
    for uri in uris:
        await rpc(master.uri, "registerPublisher", f"/{uri[-6:-1]}", "/t", "x/Y", uri)
    seen = (await rpc(proxy.master, "registerSubscriber", "/n", "/t", "*", uris[0], source=NODE))[2]
    assert seen == uris
    assert stand_ins(proxy) == {}
    told = problems(proxy)
    uses = ("the range ", "the proxy's master API", "the admin endpoint")
    for uri, port, use in zip(uris, own, uses, strict=True):
        assert f"port {port} " in told[uri]
        assert use in told[uri]
        assert f"ROS_IP={MASTER}" in told[uri]


async def test_a_port_that_is_taken_is_a_problem_until_it_is_free(
    proxy: Proxy, robot: FakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    with socket.socket() as other:
        other.bind(slave(robot))
        other.listen()
        for _ in range(3):
            assert await look_up(proxy, robot) == robot.uri
        assert "in use" in problems(proxy)[robot.uri]
        assert [record.message for record in caplog.records if robot.uri in record.message]
    assert sum(robot.uri in record.message for record in caplog.records) == 1
    await look_up(proxy, robot)
    assert robot.uri not in problems(proxy)
    assert (await rpc(slave(robot), "getPid", "/tool", source=NODE))[2] == robot.pid


async def test_the_problem_of_a_node_that_has_ended_is_forgotten(
    proxy: Proxy, robot: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as slave_socket, socket.socket() as service_socket:
        for taken, address in ((slave_socket, slave(robot)), (service_socket, service(robot))):
            taken.bind(address)
            taken.listen()
        await look_up(proxy, robot)
        await look_up_service(proxy)
        await proxy.ros1.stand_ins.tidy()
        assert set(problems(proxy)) == {robot.uri, robot.service_api}
        await robot.stop()
        await proxy.ros1.stand_ins.tidy()
        assert set(problems(proxy)) == {robot.service_api}
        monkeypatch.setattr("rosproxy.ros1.stand_ins.stand_in_ports.SERVICE_PROBLEM_KEPT_S", 0.0)
        await proxy.ros1.stand_ins.tidy()
        assert problems(proxy) == {}


async def test_the_proxys_own_ports_are_no_aliases_where_it_shares_the_name(
    make_proxy: MakeProxy, master: FakeMaster, node: FakeNode
) -> None:
    proxy = await make_proxy(**behind_its_name(master, advertise_host="robot"))
    await node.publish(proxy.master)
    assert await look_up(proxy, node) == node.uri
    assert stand_ins(proxy) == {}
    assert problems(proxy).keys() == {"advertised host"}  # no name server knows PROXY


@pytest.fixture
async def crowd(make_node: MakeNode, master: FakeMaster) -> list[FakeNode]:
    """Three nodes on the master's host."""
    made = [await make_node(f"/r{i}", MASTER, host="robot") for i in range(3)]
    for node in made:
        await node.publish(host_and_port(master.uri), node.name)
        await node.serve(host_and_port(master.uri), node.name)
    return made


async def test_ports_are_bounded_and_the_least_used_goes_first(
    proxy: Proxy, crowd: list[FakeNode], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy.ros1.registry.stand_ins.MOST_STAND_INS", 2)
    first, second, third = crowd
    await look_up(proxy, first)
    await look_up(proxy, second)
    await look_up(proxy, first)
    await look_up(proxy, third)
    assert set(stand_ins(proxy)) == {slave(first)[1], slave(third)[1]}
    assert await refuses(slave(second), NODE)


async def test_ports_in_use_are_kept(
    proxy: Proxy, crowd: list[FakeNode], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy.ros1.registry.stand_ins.MOST_STAND_INS", 2)
    async with AsyncExitStack() as stack:
        for node in crowd[:2]:
            await rpc(proxy.master, "lookupService", "/tool", node.name, source=NODE)
            wire = await stack.enter_async_context(connect(service(node), NODE))
            await wire.send(service_header())
            await read_header(wire)
        assert await look_up(proxy, crowd[2]) == crowd[2].uri
        assert set(stand_ins(proxy)) == {node.tcpros_port for node in crowd[:2]}
        assert "all 2 stand-in ports are in use" in problems(proxy)[crowd[2].uri]
    await until(lambda: set(stand_ins(proxy).values()) == {0}, "the relays end")
    await look_up(proxy, crowd[2])
    assert crowd[2].uri not in problems(proxy)
    assert slave(crowd[2])[1] in stand_ins(proxy)


async def test_of_a_topic_with_too_many_publishers_the_same_keep_their_ports(
    proxy: Proxy,
    crowd: list[FakeNode],
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    master: FakeMaster,
) -> None:
    monkeypatch.setattr("rosproxy.ros1.registry.stand_ins.MOST_STAND_INS", 2)
    for robot in crowd:
        await robot.publish(host_and_port(master.uri), "/shared")
    await node.subscribe(proxy.master, "/shared")
    ports = set(stand_ins(proxy))
    assert len(ports) == 2
    for _ in range(3):
        await node.subscribe(proxy.master, "/shared")
        assert set(stand_ins(proxy)) == ports
    left_out = [robot.uri for robot in crowd if slave(robot)[1] not in ports]
    assert "all 2 stand-in ports are in use" in problems(proxy)[left_out[0]]


async def test_another_address_counts_for_new_connections(proxy: Proxy, robot: FakeNode) -> None:
    await look_up(proxy, robot)
    await look_up_service(proxy)
    moved = FakeNode("/moved", MOVED, host="robot")
    moved.slave.address = MOVED, slave(robot)[1]
    await moved.start()
    moved.pid = 77
    try:
        proxy.ros1.context.upstream.master_address = MOVED
        assert (await rpc(slave(robot), "getPid", "/tool", source=NODE))[2] == 77
        moved.published["/chatter"] = "std_msgs/String"
        asked = await rpc(slave(robot), "requestTopic", "/n", "/chatter", [["TCPROS"]], source=NODE)
        assert asked[2] == ["TCPROS", MOVED, moved.tcpros_port]
        assert await knock(service(robot), service_header(), NODE) == "reset"
    finally:
        await moved.stop()


async def test_an_address_that_leads_back_makes_no_loop(
    proxy: Proxy, robot: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    await look_up(proxy, robot)
    await look_up_service(proxy)
    monkeypatch.setattr("rosproxy.ros1.stand_ins.outside_nodes.is_own", lambda address: True)
    proxy.ros1.context.upstream.master_address = PROXY
    assert await knock(service(robot), service_header(), NODE) == "reset"
    assert await refuses(service(robot), NODE)
    assert await knock(slave(robot), post(xml("getPid", "/tool")), NODE) == "reset"
    assert robot.headers == []


async def test_a_recovered_subscriber_is_given_open_ports(
    proxy: Proxy, robot: FakeNode, node: FakeNode
) -> None:
    await node.subscribe(proxy.master)
    node.calls.clear()
    await proxy.restart()
    assert stand_ins(proxy) == {}
    await until(node.updates, "a publisherUpdate by the proxy")
    assert node.updates()[0] == [robot.uri]
    assert stand_ins(proxy) == {slave(robot)[1]: 0}


async def test_nodes_on_the_masters_host_are_told_at_its_address(
    proxy: Proxy, robot: FakeNode, node: FakeNode, master: FakeMaster
) -> None:
    """Updates from the proxy to outside subscribers also go to the master's address."""
    await robot.subscribe(host_and_port(master.uri))
    await node.publish(proxy.master)
    robot.calls.clear()
    await proxy.restart()
    await until(robot.updates, "a publisherUpdate by the proxy")
    assert robot.updates()[0] == [robot.uri]
    assert stand_ins(proxy) == {}


async def test_alias_ports_are_measured(proxy: Proxy, robot: FakeNode) -> None:
    assert (await metrics(proxy))["rosproxy_stand_ins"] == 0
    await look_up(proxy, robot)
    await rpc(slave(robot), "getPid", "/tool", source=NODE)
    samples = await metrics(proxy)
    assert samples["rosproxy_stand_ins"] == 1
    label = "{api=stand_in,method=getPid,outcome=answered}"
    assert samples[f"rosproxy_xmlrpc_calls_total{label}"] == 1


async def test_a_proxy_that_stops_ends_connections_and_ports(proxy: Proxy, robot: FakeNode) -> None:
    await look_up(proxy, robot)
    await look_up_service(proxy)
    async with connect(service(robot), NODE) as relayed, connect(slave(robot), NODE) as caller:
        await relayed.send(topic_header())
        await read_header(relayed)
        await caller.send(post(xml("getPid", "/tool")))
        await caller.reply()
        await proxy.stop()
        assert await relayed.outcome() in _CLOSED
        assert await caller.outcome() in _CLOSED
    assert await refuses(slave(robot), NODE)
    assert await refuses(service(robot), OTHER_NODE)
    await proxy.ros1.stand_ins.listen_for([robot.uri], Caller(NODE, PROXY))
    assert await refuses(slave(robot), NODE)


async def test_an_update_without_the_masters_confirmation_opens_no_port(
    proxy: Proxy, robot: FakeNode, node: FakeNode, master: FakeMaster
) -> None:
    """A node must not open ports of the master's host by a publisherUpdate at its own lease."""
    await node.subscribe(proxy.master, "/t")
    secret = await asyncio.start_server(lambda *_: None, MASTER)
    port = secret.sockets[0].getsockname()[1]
    forged = [f"http://robot:{port}/", f"rosrpc://robot:{port}"]
    for topic, uris in (("/t", forged), ("/chatter", forged), ("/t", [robot.uri])):
        for source in (NODE, OUTSIDE, MASTER):
            params = "/master", topic, uris
            assert (await rpc(proxy.uri(node), "publisherUpdate", *params, source=source))[0] == 1
    assert stand_ins(proxy) == {}
    assert await refuses((PROXY, port), NODE)
    # A publisher that the master has opens its port, with any caller.
    await rpc(proxy.uri(node), "publisherUpdate", "/master", "/chatter", [robot.uri, *forged])
    assert set(stand_ins(proxy)) == {slave(robot)[1]}
    secret.close()


async def test_updates_that_come_together_share_a_question_to_the_master(
    proxy: Proxy, robot: FakeNode, node: FakeNode, master: FakeMaster
) -> None:
    await node.subscribe(proxy.master, "/t")
    before = len(master.named("getSystemState"))
    master.delay = 0.05
    updates = (
        rpc(proxy.uri(node), "publisherUpdate", "/m", f"/t{i}", [f"http://robot:{i + 1}/"])
        for i in range(30)
    )
    await asyncio.gather(*updates)
    assert len(master.named("getSystemState")) - before < 10
    assert stand_ins(proxy) == {}


async def test_an_update_is_passed_on_while_the_master_is_away(
    proxy: Proxy, robot: FakeNode, node: FakeNode, master: FakeMaster
) -> None:
    await node.subscribe(proxy.master, "/t")
    lease = proxy.uri(node)
    await master.stop()
    assert (await rpc(lease, "publisherUpdate", "/master", "/t", [robot.uri]))[0] == 1
    assert node.updates("/t") == [[robot.uri]]
    assert stand_ins(proxy) == {}


async def test_only_tcpros_is_relayed(proxy: Proxy, robot: FakeNode) -> None:
    """Other protocols do not pass, even at a port that the master names."""
    await look_up_service(proxy)
    before = robot.tcpros.connections
    for data in (b"\x00\x01\x02\x03garbage", b"\xff\xff\xff\xff", b"\x04\x00\x00\x00abcd"):
        async with connect(service(robot), NODE) as wire:
            await wire.send(data)
            await wire.half_close()  # ends a wait for more bytes
            assert await wire.outcome() in ("closed", "reset", "answered")
    assert robot.tcpros.connections == before


async def test_only_those_who_are_selected_are_let_in(proxy: Proxy, robot: FakeNode) -> None:
    await look_up(proxy, robot)
    assert (await rpc(slave(robot), "getPid", "/tool", source=NODE))[0] == 1
    await update(proxy, selected=[OTHER_NODE])
    assert (await rpc(slave(robot), "getPid", "/tool", source=OTHER_NODE))[0] == 1
    assert await knock(slave(robot), post(xml("getPid", "/tool")), NODE) in ("closed", "reset")


async def test_an_alias_port_waits_for_an_operator_that_has_told_nothing_yet(
    make_proxy: MakeProxy, master: FakeMaster, robot: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 30.0)
    operated = behind_its_name(master, admin_token_hash=hash_token("the operator's"))
    proxy = await make_proxy(**operated)
    assert await look_up(proxy, robot) == robot.uri  # a program on the proxy's machine
    ask = post(xml("getPid", "/tool"))
    both = [asyncio.create_task(knock(slave(robot), ask, source)) for source in (NODE, OTHER_NODE)]
    assert (await rpc(proxy.master, "getPid", "/doctor", source="127.0.0.1"))[0] == 1
    assert not any(asked.done() for asked in both)
    await update(proxy, selected=[NODE])
    assert await both[0] == "answered"
    assert await both[1] in _CLOSED
    assert await knock(slave(robot), ask, NODE) == "answered"
    assert await knock(slave(robot), ask, OTHER_NODE) in _CLOSED
