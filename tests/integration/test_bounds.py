"""Bounds of calls, replies and connections: what passes unread, and what is refused."""

import asyncio
import socket
from contextlib import AsyncExitStack, ExitStack
from typing import Any

import pytest

from examples.demo.fake_http import value
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.document import INVALID_PARAMS, INVALID_REQUEST, PARSE_ERROR
from rosproxy.ros1.protocol.xmlrpc.limits import lease_call, master_call
from rosproxy.shared.connections import gate, sockets
from tests.clock import PatientLoop, pass_time
from tests.integration.net import (
    MASTER,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    Wire,
    connect,
    exchange,
    greet,
    knock,
    post,
    rpc,
    topic_header,
    until,
    xml,
)

BOTH_LOOPS = True
LONG = "x" * 3_000_000
LISTED = [[1, 2.5, True, "&<é>", {"methodName": "shutdown", "a": []}]] * 4000
"""Far more elements than a document that is read may have."""


def pid(name: str = "/n") -> bytes:
    return post(xml("getPid", name))


@pytest.mark.parametrize("param_value", [LONG, LISTED], ids=["text", "list"])
async def test_long_parameters_pass_unread_both_ways(proxy, master, monkeypatch, param_value):
    monkeypatch.setattr("rosproxy.ros1.api.master.master_calls.read_request", None)
    assert (await rpc(proxy.master, "setParam", "/n", "/p", param_value, source=NODE))[0] == 1
    assert master.params["/p"] == param_value
    monkeypatch.undo()
    assert (await rpc(proxy.master, "getParam", "/n", "/p", source=NODE))[2] == param_value
    assert proxy.metric("xmlrpc_calls_total", api="master", method="setParam", outcome="answered")


async def test_a_long_parameter_reaches_its_subscriber(proxy, master, node):
    await node.call(proxy.master, "subscribeParam", node.uri, "/p")
    body = xml("paramUpdate", "/master", "/p/", LISTED)
    assert len(body) > lease_call(1).size
    assert (await exchange(proxy.lease(node), post(body), MASTER)).value[0] == 1
    assert ("paramUpdate", ("/master", "/p/", LISTED)) in node.calls
    assert body in [request.body for request in node.requests]


async def test_a_long_call_that_has_to_be_read_does_not_pass_a_node_s_port(proxy, node):
    await node.publish(proxy.master)
    for method in ("publisherUpdate", "requestTopic", "getBusInfo", "shutdown", "system.multicall"):
        reply = await exchange(proxy.lease(node), post(xml(method, "/n", LONG)))
        assert reply.status == 413, method
    assert {caller for _, (caller, *_) in node.calls} <= {"/rosproxy"}
    assert (await rpc(proxy.uri(node), "of_its_own", "/n", LONG))[0] == 1


MANY = [""] * 6000
"""More elements than a call that is read may have, in few bytes."""


async def test_what_holds_no_address_passes_however_short_it_is(make_proxy, master, node):
    proxy = await make_proxy(max_master_call=1)
    await node.call(proxy.master, "subscribeParam", node.uri, "/p")
    many = "<array><data>" + "<value/>" * len(MANY) + "</data></array>"

    def call(method: str, *names: str) -> bytes:
        return xml(method, *names, "MANY").replace(b"<string>MANY</string>", many.encode())

    assert len(call("setParam", "/n", "/p")) < passing.SHORT_BYTES
    assert len(MANY) > master_call(1).elements
    reply = await exchange(proxy.master, post(call("setParam", "/n", "/p")), NODE)
    assert reply.value[0] == 1
    assert master.params["/p"] == MANY
    for method in ("paramUpdate", "of_its_own"):
        reply = await exchange(proxy.lease(node), post(call(method, "/n", "/p")), MASTER)
        assert reply.value[0] == 1, method
        assert (method, ("/n", "/p", MANY)) in node.calls


@pytest.mark.parametrize("param_value", [LONG * 2, LISTED], ids=["text", "list"])
async def test_the_value_of_a_parameter_reaches_whoever_subscribes_to_it(
    proxy, master, node, param_value
):
    master.params["/p"] = param_value
    reply = await node.call(proxy.master, "subscribeParam", node.uri, "/p")
    assert (reply[0], reply[2]) == (1, param_value)
    assert proxy.endpoint(node).names(Kind.PARAM) == ["/p"]


async def test_a_long_body_that_hides_another_call_never_reaches_the_master(proxy, master):
    body = xml("setParam", "/n", "/p", LONG)
    for hidden in (b"<methodName>registerPublisher</methodName>", b"<!-- <methodName> -->", b"\0"):
        for place in (100_000, len(body) - 40):
            whole = body[:place] + hidden + body[place:]
            assert (await exchange(proxy.master, post(whole), NODE)).fault == INVALID_REQUEST
    assert (await exchange(proxy.master, pid(), NODE)).value[0] == 1
    assert not master.named("setParam")
    assert not master.named("registerPublisher")


async def test_a_long_body_that_ends_early_never_reaches_the_master(proxy, master):
    request = post(xml("setParam", "/n", "/p", LONG))
    async with connect(proxy.master, NODE) as wire:
        await wire.send(request[:-1])
        await wire.half_close()
        assert await wire.outcome() in ("closed", "reset")
    assert not master.named("setParam")


async def test_a_long_call_with_an_odd_head_is_bounded(proxy):
    body = xml("setParam", "/n", "/p", LONG)
    odd = body.replace(b"<methodCall>", b"<methodCall><!-- odd -->")
    assert (await exchange(proxy.master, post(odd), NODE)).value[0] == 1  # read as a whole
    longer = odd.replace(b"xxx", b"xxxxx")
    assert len(longer) > master_call(4).size
    assert (await exchange(proxy.master, post(longer), NODE)).status == 413


def parameters(count: int, param_value: Any) -> list[dict[str, Any]]:
    """The calls of roslaunch for parameters."""
    return [
        {"methodName": "setParam", "params": ["/n", f"/p{i}", param_value]} for i in range(count)
    ]


@pytest.mark.parametrize(
    ("count", "param_value"),
    [(3000, [1, 2]), (2500, "x" * 2000)],
    ids=["many elements", "many bytes"],
)
async def test_a_long_multicall_of_parameters_passes(proxy, master, count, param_value):
    body = xml("system.multicall", parameters(count, param_value))
    assert (await exchange(proxy.master, post(body), NODE)).value == [
        [[1, f"parameter /p{i} set", 0]] for i in range(count)
    ]
    assert master.params[f"/p{count - 1}"] == param_value


async def test_a_long_multicall_with_a_registration_is_read_or_refused(proxy, master, node):
    register = ["/talker", "/chatter", "x/Y", node.uri]
    calls = [*parameters(500, "x" * 500), {"methodName": "registerPublisher", "params": register}]
    body = xml("system.multicall", calls)
    assert passing.SHORT_BYTES < len(body) < master_call(4).size
    assert (await exchange(proxy.master, post(body), NODE)).value[-1][0][0] == 1
    assert master.holds("publishers", "/chatter") == [proxy.uri(node)]
    longer = xml("system.multicall", [*parameters(3000, "x" * 2000), calls[-1]])
    assert (await exchange(proxy.master, post(longer), NODE)).fault == INVALID_REQUEST


async def test_calls_of_a_multicall_are_bounded(proxy):
    calls = [{"methodName": "lookupNode", "params": ["/n", "/m"]}] * 1001
    reply = await exchange(proxy.master, post(xml("system.multicall", calls)), NODE)
    assert reply.fault == INVALID_PARAMS


async def test_a_multicall_ends_with_its_client(proxy, node):
    await node.publish(proxy.master)
    calls = [{"methodName": "getUri", "params": ["/n"]}] * 500
    node.delay = 0.02

    def asked() -> int:
        return sum(method == "getUri" for method, _ in node.calls)

    async with connect(proxy.lease(node)) as wire:
        await wire.send(post(xml("system.multicall", calls)))
        await until(lambda: asked() > 2, "the first calls are made")
    await until(lambda: not proxy.ros1.context.buffered.used, "the call is given up")
    assert asked() < 400


async def test_a_registration_whose_client_has_gone_is_not_half_noted(proxy, master, node):
    await node.publish(proxy.master)
    uris = [f"http://{NODE}:{1 + i}/" for i in range(5)]
    calls = [
        {"methodName": "registerPublisher", "params": [f"/n{i}", "/t", "x/Y", uri]}
        for i, uri in enumerate(uris)
    ]
    async with connect(proxy.master, NODE) as wire:
        await wire.send(post(xml("system.multicall", calls)))
    await until(lambda: not proxy.ros1.context.buffered.used, "the call has ended")
    assert {e.pending for e in proxy.ros1.context.registry} == {False}


async def test_too_many_elements_are_a_fault(proxy, node):
    await node.publish(proxy.master)
    for address, limits in ((proxy.lease(node), lease_call(1)), (proxy.master, master_call(4))):
        params = b"<param><value/></param>" * (limits.elements // 2)
        method = "registerService" if address == proxy.master else "requestTopic"
        body = xml(method).replace(b"<params>", b"<params>" + params)
        assert passing.SHORT_BYTES < len(body) < limits.size
        assert (await exchange(address, post(body), NODE)).fault == PARSE_ERROR


async def test_the_bounds_of_calls_are_options(make_proxy, node):
    proxy = await make_proxy(max_lease_call=2, max_master_call=1)
    await node.publish(proxy.master)
    topics = [f"http://{NODE}:{1024 + i}/" for i in range(6000)]  # 12,000 elements
    update = post(xml("publisherUpdate", "/master", "/other", topics))
    assert (await exchange(proxy.lease(node), update, MASTER)).value[0] == 1
    register = post(xml("registerPublisher", "/n", "/t", "x" * master_call(1).size, node.uri))
    assert (await exchange(proxy.master, register, NODE)).status == 413


async def test_a_call_that_only_the_master_may_make_is_not_parsed(make_proxy, node, monkeypatch):
    proxy = await make_proxy(slave_control="master")
    await node.call(proxy.master, "subscribeParam", node.uri, "/p")
    monkeypatch.setattr("rosproxy.ros1.api.slave.xmlrpc.parse_call", None)
    for body in (
        xml("publisherUpdate", "/m", "/t", ["x"] * 100),
        xml("paramUpdate", "/m", "/p", LONG),
    ):
        reply = await exchange(proxy.lease(node), post(body))
        text = "rosproxy: only the master's host may call this method (--slave-control master)"
        assert reply.value[:2] == [-1, text]
    monkeypatch.undo()
    assert (await exchange(proxy.lease(node), pid())).value[0] == 1
    assert (
        await exchange(proxy.lease(node), post(xml("paramUpdate", "/m", "/p", LONG)), MASTER)
    ).value[0] == 1


async def test_over_the_byte_budget_is_503_and_told(make_proxy, node):
    proxy = await make_proxy(max_buffered=1)
    await node.publish(proxy.master)
    body = xml("publisherUpdate", "/m", "/t", ["x" * 1000] * 400)
    async with AsyncExitStack() as stack:
        for _ in range(2):
            wire = await stack.enter_async_context(connect(proxy.lease(node)))
            await wire.send(post(body)[:-1])
        reply = await exchange(proxy.lease(node), post(body))
        assert reply.status == 503
        assert b"at most 524288 bytes of requests and replies are accepted at once" in reply.body
        assert (await rpc(proxy.master, "getPid", "/n", source=NODE))[0] == 1
    assert proxy.metric("refused_total", reason="over_budget")
    (problem,) = proxy.app.status()["problems"]
    assert problem["subject"] == "refused: over budget"
    await until(lambda: not proxy.ros1.context.buffered.used, "all is given back")


async def test_an_idle_reader_is_cut_and_a_slow_reader_is_not(proxy, master, monkeypatch):
    def cut_soon(sock: socket.socket) -> None:
        idles = sock.getpeername()[0] == NODE
        sockets.end_if_stalled(sock, 1.0 if idles else sockets.WRITE_TIMEOUT_S)

    monkeypatch.setattr("rosproxy.ros1.servers.xmlrpc_server.end_if_stalled", cut_soon)
    master.answers["getParam"] = value("x" * 20_000_000)

    async def open_reader(source: str) -> socket.socket:
        sock = socket.socket()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        sock.setblocking(False)
        sock.bind((source, 0))
        loop = asyncio.get_running_loop()
        await loop.sock_connect(sock, proxy.master)
        await loop.sock_sendall(sock, post(xml("getParam", "/n", "/p")))
        return sock

    idle = await open_reader(NODE)
    slow = await open_reader(OTHER_NODE)
    loop = asyncio.get_running_loop()
    passes = proxy.ros1.context.unread_calls
    await until(lambda: passes.used == 2, "both replies are pending")
    await until(lambda: passes.used == 1, "the kernel cuts the idle reader")
    taken = len(await loop.sock_recv(slow, 100_000))
    if isinstance(loop, PatientLoop):
        for _ in range(13):
            await pass_time(5)  # the proxy has no time limit for a reply
            # The kernel's clock is real, and this time may take the proxy long.
            taken += len(await loop.sock_recv(slow, 100_000))
    while taken < 20_000_000:
        chunk = await loop.sock_recv(slow, 1_000_000)
        assert chunk, f"the slow reader was cut after {taken} bytes"
        taken += len(chunk)
    idle.close()
    slow.close()


async def test_a_source_with_too_many_connections_is_refused_and_others_are_not(make_proxy, node):
    proxy = await make_proxy(max_connections_per_source=20)
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    async with AsyncExitStack() as stack:
        for number in range(20):
            wire = await stack.enter_async_context(connect(lease))
            await wire.send(pid() if number % 2 else topic_header())
            assert await wire.exactly(1)
        assert await knock(lease, b"") == "reset"
        assert (await exchange(lease, pid(), OTHER_NODE)).value[0] == 1
    assert proxy.metric("refused_total", reason="connections_per_source")
    await until(lambda: not proxy.ros1.context.gate._by_source.of(OUTSIDE), "all have gone")
    assert (await exchange(lease, pid())).value[0] == 1


async def test_connections_to_one_port_are_bounded(make_proxy, make_node):
    proxy = await make_proxy(max_connections_per_lease=16)
    busy = await make_node("/one")
    other = await make_node("/other", OTHER_NODE)
    for node in (busy, other):
        await node.publish(proxy.master)
    async with AsyncExitStack() as stack:
        for number in range(16):
            wire = await stack.enter_async_context(
                connect(proxy.lease(busy), f"127.0.1.{20 + number}")
            )
            await wire.send(topic_header())
            assert await wire.exactly(1)
        assert await knock(proxy.lease(busy), b"") == "reset"
        assert (await greet(proxy.lease(other), topic_header()))["callerid"] == "/other"


async def test_the_longest_silent_connection_goes_first(proxy, node, monkeypatch):
    monkeypatch.setattr(gate, "MOST_WAITING", 4)
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    waiting = proxy.ros1.context.gate._waiting

    def newest() -> int:
        return max(waiting.get(OUTSIDE, {}), default=-1)

    async def wait_in_line(stack: AsyncExitStack, said: bytes = b"") -> Wire:
        last = newest()
        wire = await stack.enter_async_context(connect(lease))
        await until(lambda: newest() > last, "it waits")
        await wire.send(said)
        return wire

    async with AsyncExitStack() as stack:
        wires = [await wait_in_line(stack, said) for said in (b"P", b"", topic_header()[:10])]
        wires.append(await wait_in_line(stack))
        last = newest()
        await wires[3].send(b"POST / HTTP/1.1\r\n")
        await until(lambda: newest() > last, "the connection waits for the rest of a request")
        assert (await exchange(lease, pid(), OTHER_NODE)).value[0] == 1
        for wire in wires:
            assert (await exchange(lease, pid())).value[0] == 1
            assert await wire.outcome() in ("closed", "reset", "answered")
            await wait_in_line(stack)  # another connection takes the place


async def test_a_compressed_reply_is_not_inflated(proxy, master):
    master.answers["getParam"] = (
        b"HTTP/1.1 200 OK\r\nContent-Encoding: gzip\r\nContent-Length: 5\r\n\r\nxxxxx"
    )
    async with connect(proxy.master, NODE) as wire:
        await wire.send(post(xml("getParam", "/n", "/p")))
        assert await wire.end() == "reset"


async def test_admin_connections_of_one_source_are_bounded(proxy, monkeypatch):
    monkeypatch.setattr(proxy.app._admin._runner.server, "most", 3)
    address = proxy.settings.admin.host, proxy.settings.admin.port
    ask = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"
    async with connect(address) as first, connect(address) as second, connect(address) as third:
        await second.send(ask)
        assert (await second.reply()).status == 200
        assert (await exchange(address, ask, OTHER_NODE)).status == 200
        assert (await exchange(address, ask)).status == 200
        assert await first.outcome() == "closed"
        await third.send(ask)
        assert (await third.reply()).status == 200


async def test_so_are_those_that_come_in_one_moment(proxy, monkeypatch):
    monkeypatch.setattr(proxy.app._admin._runner.server, "most", 3)
    address = proxy.settings.admin.host, proxy.settings.admin.port
    with ExitStack() as stack:  # all before the proxy has its turn
        conns = [stack.enter_context(socket.create_connection(address)) for _ in range(20)]
        for conn in conns:
            conn.setblocking(False)

        def has_ended(conn: socket.socket) -> bool:
            try:
                return not conn.recv(1)
            except BlockingIOError:
                return False

        await until(lambda: sum(map(has_ended, conns)) == 17, "all but three have ended")
        assert not any(map(has_ended, conns[-3:]))


async def test_a_half_sent_body_at_the_admin_endpoint_is_408(proxy, monkeypatch):
    monkeypatch.setattr("rosproxy.admin.admin_server.BODY_TIMEOUT", 0.1)
    address = proxy.settings.admin.host, proxy.settings.admin.port
    async with connect(address) as wire:
        await wire.send(post(b"{", "Content-Length: 10", path="/probe"))
        assert (await wire.reply()).status == 408
