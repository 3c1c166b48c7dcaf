"""Callers of the master port, confirmed addresses of nodes, and distribution of ports."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

import pytest

from examples.demo.fake_http import End, FakeHttpServer, call, host_and_port, value
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from rosproxy.ros1.servers import callers
from rosproxy.shared.setting_kinds import hash_token
from tests.integration.admin.test_admin import metrics
from tests.integration.admin_calls import post, tell, update
from tests.integration.claims import claim, silent_servers
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.net import (
    HOST,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    PROXY,
    THIRD_NODE,
    connect,
    exchange,
    knock,
    refuses,
    rpc,
    topic_header,
    until,
    xml,
)
from tests.integration.net import post as request
from tests.integration.proxy import Proxy

HIDDEN = "127.0.2.99"
"""An inside address at which no node is: that of a gateway which hides where calls come from."""


@pytest.fixture
def _no_source_is_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count no test address as the proxy's machine, whose programs may always call."""
    monkeypatch.setattr("rosproxy.ros1.servers.callers.is_own", lambda address: False)


@pytest.fixture
def _as_if_not_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' addresses are loopback, where a node's word counts for even less."""
    monkeypatch.setattr("rosproxy.ros1.servers.admission.is_loopback", lambda address: False)


def problems(proxy: Proxy) -> dict[str, str]:
    return {row["subject"]: row["text"] for row in proxy.app.status()["problems"]}


def address_of(proxy: Proxy, name: str) -> str:
    """The address that the proxy has for a node."""
    return proxy.ros1.context.registry.by_caller[name].location.address


# Callers of the master port


@pytest.mark.usefixtures("_no_source_is_own")
async def test_the_master_port_is_for_inside_alone(
    proxy: Proxy, node: FakeNode, master: FakeMaster, caplog: pytest.LogCaptureFixture
) -> None:
    uri = f"http://{OUTSIDE}:4000/"
    body = xml("registerPublisher", "/stranger", "/t", "x/Y", uri)
    for _ in range(3):
        reply = await exchange(proxy.master, request(body), OUTSIDE)
        assert reply.status == 403
        assert reply.headers["connection"] == "close"
    for phrase in (OUTSIDE, "127.0.2.0/24", "--inside-network"):
        assert phrase in reply.body.decode()
        assert phrase in problems(proxy)["master port"]
    assert (
        caplog.text.count("is not in an inside network") == 1
    )  # the log has a bounded number of warnings
    assert proxy.metric("strangers_total", standing="outside") == 3
    assert "/stranger" not in master.nodes
    assert (await node.publish(proxy.master))[0] == 1
    assert [problem for problem in problems(proxy) if OUTSIDE in problem] == []


@pytest.mark.usefixtures("_no_source_is_own")
async def test_a_stranger_is_refused_before_anything_of_its_document_is_read(proxy: Proxy) -> None:
    async with connect(proxy.master, OUTSIDE) as wire:
        await wire.send(request(b"", "Content-Length: 1000000"))
        assert (await wire.reply()).status == 403


async def test_programs_on_the_proxys_own_machine_are_let_in(proxy: Proxy) -> None:
    assert (await rpc(proxy.master, "getPid", "/doctor", source=OUTSIDE))[0] == 1
    await tell(proxy, "/containers", selected=[])
    assert (await rpc(proxy.master, "getPid", "/doctor", source="127.0.0.1"))[0] == 1


@pytest.mark.usefixtures("_no_source_is_own")
async def test_where_an_operator_selects_only_its_containers_are_let_in(
    make_proxy: MakeProxy, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 0.05)
    proxy = await make_proxy(linger=60)
    node = await make_node()
    other = await make_node("/other", OTHER_NODE)
    assert (await node.publish(proxy.master))[0] == 1
    assert proxy.app.status()["settings"]["selected"] is None
    assert await update(proxy, selected=[OTHER_NODE]) == (0, 0, 0)
    assert proxy.app.status()["settings"]["selected"] == 1
    assert (await metrics(proxy))["rosproxy_selected_addresses"] == 1
    body = xml("registerPublisher", node.name, "/more", "x/Y", node.uri)
    reply = await exchange(proxy.master, request(body), NODE)
    assert reply.status == 403
    for phrase in (NODE, "is not selected", "POST /containers"):
        assert phrase in reply.body.decode()
        assert phrase in problems(proxy)["master port"]
    assert proxy.metric("strangers_total", standing="unselected") == 1
    assert (await other.publish(proxy.master))[0] == 1
    # Registrations stay until the operator sends "gone".
    assert await proxy.serves(node)
    # Other updates keep the selection. An empty selection selects no address.
    await update(proxy, gone=[THIRD_NODE])
    assert (await other.publish(proxy.master))[0] == 1
    await update(proxy, selected=[])
    assert (await exchange(proxy.master, request(body), OTHER_NODE)).status == 403
    # A restarted proxy does not know the selection yet, and serves its former nodes.
    await proxy.restart()
    assert (await node.publish(proxy.master, "/more"))[0] == 1


@pytest.mark.usefixtures("_no_source_is_own")
async def test_a_new_container_waits_for_the_update_and_loses_nothing(
    proxy: Proxy, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 30.0)
    await update(proxy, selected=[])
    call_ = asyncio.create_task(node.publish(proxy.master))
    waiting = proxy.ros1._callers
    await until(lambda: waiting._waiting.total() == 1, "the call waits")
    await update(proxy, selected=[OTHER_NODE])
    assert not call_.done()
    await update(proxy, selected=[OTHER_NODE, NODE])
    assert (await call_)[0] == 1
    assert waiting._waiting.total() == 0
    assert proxy.metric("strangers_total", standing="unselected") == 0


@pytest.fixture
def _only_localhost_is_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count 127.0.0.1 alone as the proxy's machine."""
    own = "127.0.0.1"
    monkeypatch.setattr("rosproxy.ros1.servers.callers.is_own", lambda address: address == own)


BY_AN_OPERATOR = {"admin_token_hash": hash_token("the operator's")}
"""Options of a proxy with an operator."""


@pytest.mark.usefixtures("_only_localhost_is_own")
async def test_nobody_slips_in_before_an_operator_has_told_whom_it_selects(
    make_proxy: MakeProxy, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For some tenths of a second after each start all of the inside networks were let in."""
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 30.0)
    proxy = await make_proxy(**BY_AN_OPERATOR)
    node = await make_node()
    stranger = await make_node("/stranger", OTHER_NODE)
    body = request(xml("registerPublisher", stranger.name, "/t", "x/Y", stranger.uri))
    good = asyncio.create_task(node.publish(proxy.master))
    bad = asyncio.create_task(exchange(proxy.master, body, OTHER_NODE))
    assert (await rpc(proxy.master, "getPid", "/doctor", source="127.0.0.1"))[0] == 1
    assert (good.done(), bad.done()) == (False, False)
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 0.05)
    await update(proxy, selected=[NODE])
    assert (await good)[0] == 1
    assert (await bad).status == 403
    assert {name for row in proxy.app.status()["nodes"] for name in row["nodes"]} == {node.name}


@pytest.mark.usefixtures("_only_localhost_is_own")
async def test_an_operator_that_is_away_stops_nobody(
    make_proxy: MakeProxy, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 0.3)
    clock = asyncio.get_running_loop().time
    began = clock()
    proxy = await make_proxy(**BY_AN_OPERATOR)
    assert (await node.publish(proxy.master))[0] == 1
    assert clock() - began > 0.3
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 3600.0)
    async with asyncio.timeout(60):
        assert (await node.publish(proxy.master))[0] == 1
    assert (await exchange(proxy.master, request(xml("getPid", "/n")), OUTSIDE)).status == 403


@pytest.mark.usefixtures("_no_source_is_own")
async def test_no_more_than_so_many_calls_wait(
    proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 30.0)
    monkeypatch.setattr(callers, "MOST_WAITING_EACH", 2)
    monkeypatch.setattr(callers, "MOST_WAITING", 3)
    await update(proxy, selected=[])
    waiting = proxy.ros1._callers._waiting
    body = request(xml("getPid", "/n"))
    sources = [NODE, NODE, OTHER_NODE]
    calls = [asyncio.create_task(exchange(proxy.master, body, source)) for source in sources]
    await until(lambda: waiting.total() == 3, "the calls wait")
    for source in (NODE, THIRD_NODE):
        assert (await exchange(proxy.master, body, source)).status == 403
    await update(proxy, selected=[NODE, OTHER_NODE])
    assert [(await call_).status for call_ in calls] == [200] * 3


@pytest.mark.usefixtures("_no_source_is_own")
async def test_the_selection_is_taken_in_while_the_master_is_away(
    make_proxy: MakeProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "UPDATE_TIMEOUT", 0.05)
    proxy = await make_proxy(master_uri="http://127.0.1.1:9")
    reply = await post(proxy, "/containers", f'{{"gone": ["{NODE}"], "selected": []}}')
    assert reply.status == 503
    assert (await exchange(proxy.master, request(xml("getPid", "/n")), NODE)).status == 403


# Confirmed addresses of nodes


@pytest.mark.usefixtures("_as_if_not_loopback")
async def test_a_forged_caller_api_publishes_no_other_node(
    proxy: Proxy, make_node: MakeNode, master: FakeMaster
) -> None:
    """Not even a node that never called the proxy."""
    evil = await make_node("/evil")
    victim = await make_node("/victim", OTHER_NODE)
    await evil.call(proxy.master, "registerPublisher", "/rosout", "rosgraph_msgs/Log", victim.uri)
    assert address_of(proxy, "/evil") == NODE
    told = [row["text"] for row in proxy.app.status()["problems"] if row["subject"] == "/evil"]
    assert any("gives its address as" in text for text in told)
    (endpoint,) = proxy.ros1.context.registry
    calls = len(victim.calls)
    for data in (request(xml("getBusStats", "/outside")), topic_header("/rosout")):
        assert await knock((HOST, endpoint.port), data) != "answered"
    assert len(victim.calls) == calls


Ask = Callable[[FakeNode, Proxy], Any]


def as_rospy(node: FakeNode) -> None:
    """Make a node like rospy: it answers getName, and may have no topic yet."""
    node.answers["getName"] = value([1, "", node.name])
    node.published.clear()


def as_roscpp(node: FakeNode) -> None:
    """Make a node like roscpp: /rosout first, no getName, and getSubscriptions hangs."""
    node.answers["getName"] = node.answers["x"] = value([-1, "no such method", 0])
    node.answers["getSubscriptions"] = End.HANG


def as_roscpp_without_rosout(node: FakeNode) -> None:
    """Make a node like roscpp with init_options::NoRosout, which first registers a service."""
    as_roscpp(node)
    node.published.clear()


async def publish(node: FakeNode, proxy: Proxy) -> Any:
    params = "/rosout", "rosgraph_msgs/Log", node.uri
    return await call(proxy.master, "registerPublisher", node.name, *params, source=HIDDEN)


async def serve(node: FakeNode, proxy: Proxy) -> Any:
    params = f"{node.name}/get_loggers", node.service_api, node.uri
    return await call(proxy.master, "registerService", node.name, *params, source=HIDDEN)


@pytest.mark.usefixtures("_as_if_not_loopback")
@pytest.mark.parametrize(
    ("kind", "first"),
    [(as_rospy, publish), (as_roscpp, publish), (as_roscpp_without_rosout, serve)],
)
async def test_a_node_whose_source_is_hidden_bears_out_its_address_by_its_name(
    proxy: Proxy, make_node: MakeNode, kind: Callable[[FakeNode], None], first: Ask
) -> None:
    node = await make_node("/hidden", OTHER_NODE)
    kind(node)
    assert (await first(node, proxy))[0] == 1
    assert address_of(proxy, "/hidden") == OTHER_NODE
    assert await proxy.serves(node)
    assert problems(proxy) == {}


@pytest.mark.usefixtures("_as_if_not_loopback")
async def test_an_earlier_forgery_from_a_hidden_source_does_not_take_a_nodes_uri(
    proxy: Proxy, make_node: MakeNode
) -> None:
    node = await make_node("/hidden", OTHER_NODE)
    forged = "/t", "x/Y", node.uri
    await call(proxy.master, "registerPublisher", "/evil", *forged, source=HIDDEN)
    assert address_of(proxy, "/evil") == HIDDEN
    by_caller = proxy.ros1.context.registry.by_caller
    await until(lambda: by_caller["/evil"].never_found, "the proxy looks for /evil there")
    assert (await publish(node, proxy))[0] == 1
    assert address_of(proxy, "/hidden") == OTHER_NODE
    code, text, _ = await call(proxy.master, "registerPublisher", "/evil2", *forged, source=HIDDEN)
    assert (code, "has the name /hidden" in text) == (-1, True)


@pytest.mark.usefixtures("_as_if_not_loopback")
async def test_a_node_outside_is_left_to_itself(
    proxy: Proxy, make_node: MakeNode, master: FakeMaster
) -> None:
    """No port leads to an outside node that a bridge between masters registers from inside."""
    far = await make_node("/far", OUTSIDE)
    assert (await publish(far, proxy))[0] == 1
    assert master.nodes["/far"] == far.uri
    assert list(proxy.ros1.context.registry) == []


@pytest.mark.usefixtures("_as_if_not_loopback")
@pytest.mark.parametrize("calls", [(), ("getName", "getPublications", "getPid")])
async def test_so_is_one_that_a_gateway_calls_by_another_name(
    proxy: Proxy, make_node: MakeNode, master: FakeMaster, calls: Sequence[str]
) -> None:
    far = await make_node("/far", OUTSIDE)
    far.answers.update(dict.fromkeys(calls, value([-1, "no such method", 0])))
    params = "/far/chatter", "std_msgs/String", far.uri
    reply = await call(proxy.master, "registerPublisher", "/gateway_far", *params, source=NODE)
    assert reply[0] == 1
    assert master.nodes["/gateway_far"] == far.uri
    assert list(proxy.ros1.context.registry) == []
    assert problems(proxy) == {}
    ended = "/far/chatter", far.uri
    reply = await call(proxy.master, "unregisterPublisher", "/gateway_far", *ended, source=NODE)
    assert reply[2] == 1


@pytest.mark.usefixtures("_as_if_not_loopback")
async def test_the_selection_counts_for_addresses_that_others_register_too(
    proxy: Proxy, make_node: MakeNode
) -> None:
    await update(proxy, selected=[HIDDEN])
    assert (await publish(await make_node("/other", OTHER_NODE), proxy))[0] == 1
    assert list(proxy.ros1.context.registry) == []


# Distribution of ports


def dead_uri(number: int, address: str = NODE) -> str:
    """A URI where no program listens."""
    return f"http://{address}:{number + 1}/"


async def test_the_dead_uris_of_one_source_do_not_take_every_port(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster
) -> None:
    proxy = await make_proxy(cleanup_after=60, linger=60)
    results = [
        await rpc(
            proxy.master, "registerPublisher", f"/d{i}", "/t", "x/Y", dead_uri(i), source=NODE
        )
        for i in range(8)
    ]
    assert [code for code, *_ in results] == [1, 1] + [-1] * 6
    assert "does not answer" in results[-1][1]
    # Live nodes of the same source get all ports.
    crowd = [await make_node(f"/n{i}") for i in range(6)]
    assert [(await node.publish(proxy.master))[0] for node in crowd] == [1] * 6
    # The range is used up: the next node gets the port of a dead node, which is unregistered.
    late = await make_node("/late", OTHER_NODE)
    assert (await late.publish(proxy.master))[0] == 1
    assert await proxy.serves(late)
    assert len({"/d0", "/d1"} & set(master.nodes)) == 1
    assert {node.name for node in crowd} < set(master.nodes)


async def test_several_sources_of_dead_uris_give_way_as_well(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster
) -> None:
    proxy = await make_proxy(cleanup_after=60, linger=60)
    sources = [f"127.0.2.{number}" for number in (21, 22, 23, 24)]
    for number in range(8):
        source = sources[number // 2]
        params = f"/d{number}", "/t", "x/Y", dead_uri(number, source)
        assert (await rpc(proxy.master, "registerPublisher", *params, source=source))[0] == 1
    nodes = [await make_node(f"/n{i}") for i in range(8)]
    await asyncio.gather(*(node.publish(proxy.master) for node in nodes))
    assert set(master.nodes) == {node.name for node in nodes}
    assert len({proxy.lease(node) for node in nodes}) == 8
    ninth = await make_node("/ninth")
    code, text, _ = await ninth.publish(proxy.master)
    assert (code, "--port-range" in text) == (-1, True)


@pytest.fixture
async def mute() -> AsyncIterator[list[FakeHttpServer]]:
    """Eight programs that never say a word."""
    async with silent_servers(OTHER_NODE, 8) as made:
        yield made


@pytest.mark.parametrize("kind", ["refusing", "silent"])
async def test_stale_claims_do_not_keep_a_port_from_a_node_that_lives(
    make_proxy: MakeProxy,
    make_node: MakeNode,
    master: FakeMaster,
    mute: list[FakeHttpServer],
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
) -> None:
    """Eight registrations of dead nodes held eight ports; the next node got none, for ever."""
    monkeypatch.setattr("rosproxy.ros1.upkeep.recovery.CLAIM_GRACE_S", 0.2)
    former = await make_proxy()
    await former.stop()
    ports = former.settings.ports.listen
    for i, (port, server) in enumerate(zip(ports.ports(), mute, strict=True)):
        inside = i + 1 if kind == "refusing" else server.address[1]
        await claim(master, f"/dead{i}", port, f"{OTHER_NODE}:{inside}")
    proxy = await make_proxy(
        port_range=str(ports), cleanup_after=60, probe_timeout=20, probe_interval=60
    )
    node = await make_node("/late")
    assert await node.serve(proxy.master, "/late") == [
        1,
        "Registered [/late] as provider of [/late]",
        1,
    ]
    assert await proxy.serves(node)
    assert master.holds("services", "/late") == [f"rosrpc://{HOST}:{proxy.lease(node)[1]}"]
    assert len(proxy.ros1.context.registry) == 8
    assert len([name for name in master.nodes if name.startswith("/dead")]) == 7
    assert len([name for name in master.tables["services"] if "/dead" in name]) == 7


async def test_a_claim_of_a_node_that_lives_is_not_given_away(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster
) -> None:
    former = await make_proxy()
    nodes = [await make_node(f"/n{i}") for i in range(8)]
    for node in nodes:
        await node.publish(former.master)
    uris = dict(master.nodes)
    await former.stop()
    nodes[0].delay = 0.1  # a slow node
    proxy = await make_proxy(port_range=str(former.settings.ports.listen))
    late = await make_node("/late")
    assert (await late.publish(proxy.master))[0] == -1
    assert master.nodes == uris
    await until(lambda: proxy.serves(nodes[0]), "the slow node is served")
    await nodes[5].stop()
    await until(lambda: proxy.endpoint(nodes[5]).is_down, "the proxy finds a node dead")
    assert (await late.publish(proxy.master))[0] == 1
    assert set(master.nodes) == {"/late", *uris} - {"/n5"}


async def test_what_former_proxies_left_is_cleaned_from_the_master(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster
) -> None:
    """Also that for which the successor has no port, which nothing probes."""
    former = await make_proxy()
    node = await make_node()
    await node.publish(former.master)
    port = former.endpoint(node).port
    uri = former.uri(node)
    await former.stop()
    await claim(master, "/same_port", port, f"{OTHER_NODE}:1")
    await claim(master, "/other_network", port + 1, "10.99.0.5:40001")
    await claim(master, "/foreign", port + 100, f"{OTHER_NODE}:2")  # no port of this proxy
    proxy = await make_proxy(
        port_range=str(former.settings.ports.listen), cleanup_after=0.2, linger=60
    )
    await until(lambda: set(master.nodes) == {node.name, "/foreign"}, "the rest is taken back")
    assert set(master.tables["services"]) == {"/foreign/s"}
    assert proxy.uri(node) == uri
    assert await proxy.serves(node)


async def test_what_an_operator_selects_is_recovered_wherever_it_lies(
    make_proxy: MakeProxy, make_node: MakeNode, master: FakeMaster
) -> None:
    """Some clusters give pods addresses that are in none of the networks known at the start."""
    former = await make_proxy()
    node = await make_node()
    await node.publish(former.master)
    uri = former.uri(node)
    await former.stop()
    proxy = await make_proxy(
        port_range=str(former.settings.ports.listen),
        inside_network=("127.0.2.12/32",),
        cleanup_after=1.0,
    )
    await until(lambda: proxy.app.status()["master"]["up"], "the master is found")
    assert list(proxy.ros1.context.registry) == []
    await update(proxy, selected=[NODE])
    await until(lambda: len(proxy.ros1.context.registry), "the node is found")
    await until(lambda: proxy.serves(node), "the node is served")
    assert proxy.uri(node) == uri == master.nodes[node.name]


async def test_what_is_left_stays_where_nothing_is_cleaned_up(
    make_proxy: MakeProxy, master: FakeMaster
) -> None:
    former = await make_proxy()
    await former.stop()
    ports = former.settings.ports.listen
    await claim(master, "/other_network", ports.first, "10.99.0.5:40001")
    proxy = await make_proxy(port_range=str(ports), cleanup_after=0, master_interval=0.05)
    await until(lambda: proxy.app.status()["master"]["up"], "the master is found")
    await asyncio.sleep(0.1)
    assert "/other_network" in master.nodes


async def test_a_hundred_uris_of_one_node_are_not_all_remembered(
    proxy: Proxy, node: FakeNode
) -> None:
    port = host_and_port(node.uri)[1]
    for number in range(40):
        uri = f"http://name{number}.invalid:{port}/"
        await node.call(proxy.master, "registerPublisher", "/t", "x/Y", uri)
    assert len(proxy.endpoint(node).admissions) <= 16
    assert not await refuses((PROXY, proxy.endpoint(node).port))


async def test_a_late_probe_of_a_dead_node_does_not_close_the_port_of_the_next(
    make_proxy: MakeProxy, make_node: MakeNode
) -> None:
    """The probe ends after a live node has got the port."""
    proxy = await make_proxy(ports=1)
    gone = await make_node("/gone")
    late = await make_node("/late")
    await gone.publish(proxy.master)
    endpoint = proxy.endpoint(gone)
    proxy.ros1.leases.end(endpoint)
    await late.publish(proxy.master)
    assert proxy.endpoint(late).port == endpoint.port
    proxy.ros1.leases.close(endpoint)
    assert await proxy.serves(late)
