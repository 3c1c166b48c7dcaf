"""A node's port: slave API and TCPROS side by side, and which port a node gets."""

import asyncio
import errno
import socket

import pytest

from examples.demo.fake_http import End, free_ports, ok, value
from examples.demo.fake_node import FakeNode
from rosproxy.ros1 import leases
from rosproxy.ros1.clients.master_client import CALLER_ID
from rosproxy.ros1.protocol.tcpros import encode_header
from rosproxy.ros1.registry import endpoint
from rosproxy.shared.connections import sockets
from tests.integration.net import (
    HOST,
    MASTER,
    NODE,
    OTHER_NODE,
    OUTSIDE,
    PROXY,
    Wire,
    connect,
    exchange,
    greet,
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

BOTH_LOOPS = True


async def test_xml_rpc_and_tcpros_share_the_port(proxy, node):
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    async with connect(lease) as subscriber, connect(lease) as caller:
        await subscriber.send(topic_header())
        await caller.send(post(xml("getPid", "/outside")))
        assert (await caller.reply()).value == [1, "", node.pid]
        assert (await read_header(subscriber))["callerid"] == "/talker"
        await subscriber.send(b"hello")
        assert await subscriber.exactly(5) == b"hello"
    assert node.headers[0]["topic"] == "/chatter"


async def test_request_topic_leads_back_to_the_port_it_was_asked_at(proxy, node):
    await node.publish(proxy.master)
    asked = await rpc(proxy.uri(node), "requestTopic", "/outside", "/chatter", [["TCPROS"]])
    port = proxy.endpoint(node).port
    assert asked == [1, f"ready on {HOST}:{port}", ["TCPROS", HOST, port]]


async def test_a_neighbour_is_led_to_the_address_that_it_used(proxy, node):
    await node.publish(proxy.master)
    port = proxy.endpoint(node).port
    near = (PROXY, port)
    asked = await rpc(near, "requestTopic", "/n", "/chatter", [["TCPROS"]], source=OTHER_NODE)
    assert asked[2] == ["TCPROS", PROXY, port]


UNKNOWN = (topic_header("/none"), service_header("/none"), encode_header({"x": "y"}))


async def refuse(node, reader, writer, header):
    writer.write(encode_header({"error": f"no {header}"}))


async def test_an_unknown_topic_or_service_is_refused_in_a_header_as_by_a_node(
    proxy, node, monkeypatch
):
    monkeypatch.setattr(endpoint, "STARTING_S", 0.0)
    node.stream = refuse
    await node.publish(proxy.master)
    asked = await rpc(proxy.uri(node), "requestTopic", "/outside", "/none", [["TCPROS"]])
    assert asked == [-1, "Not a publisher of [/none]", []]
    for header in UNKNOWN:
        assert "has no" in (await greet(proxy.lease(node), header))["error"]
    assert proxy.metric("relay_errors_total", reason="not offered") == len(UNKNOWN)


async def test_a_subscriber_does_not_give_up_on_a_node_that_still_registers(proxy, node):
    """A new node has the URI of a former one. roscpp ignored the master's update, and gave up."""
    node.stream = refuse
    await node.publish(proxy.master)
    assert await knock(proxy.lease(node), topic_header("/later")) == "reset"
    assert proxy.metric("relay_errors_total", reason="not offered") == 1
    assert "has no service" in (await greet(proxy.lease(node), service_header("/later")))["error"]


async def test_a_topic_that_the_node_has_a_port_for_is_its_own_to_refuse(proxy, node):
    node.stream = refuse
    node.name_port_for_any_topic()
    await node.publish(proxy.master)
    assert "no {" in (await greet(proxy.lease(node), topic_header("/none")))["error"]


async def test_a_header_in_tiny_slices(proxy, node):
    await node.publish(proxy.master)
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header(), slices=1)
        assert (await read_header(wire))["callerid"] == "/talker"


@pytest.mark.parametrize(
    "header",
    [
        (1_000_001).to_bytes(4, "little"),
        b"\xff\xff\xff\xff",
        b"\x05\0\0\0\x09\0\0\0x",
        b"\x03\0\0\0\x01\0\0",
        b"\x05\0\0\0\x01\0\0\0x",
    ],
    ids=["too long", "far too long", "field too long", "cut field", "no equals sign"],
)
async def test_a_malformed_header_is_answered_with_an_error(proxy, node, header):
    await node.publish(proxy.master)
    async with connect(proxy.lease(node)) as wire:
        await wire.send(header)
        assert "rosproxy: the connection header" in (await read_header(wire))["error"]
        assert await wire.end() == "closed"
    assert node.headers == []


async def test_a_header_that_never_ends_costs_a_time_out(proxy, node, monkeypatch):
    monkeypatch.setattr("rosproxy.shared.connections.sockets.SILENCE_TIMEOUT_S", 0.2)
    await node.publish(proxy.master)
    for sent in (b"", b"\x01\0", topic_header()[:-1]):
        async with connect(proxy.lease(node)) as wire:
            await wire.send(sent)
            assert await wire.outcome() in ("closed", "reset")
    async with connect(proxy.master) as wire:
        assert await wire.outcome() == "closed"


async def test_a_client_that_leaves_inside_its_header_is_survived(proxy, node):
    await node.publish(proxy.master)
    header = topic_header()
    for size in (0, 2, 4, 10, len(header) - 1):
        for reset in (False, True):
            async with connect(proxy.lease(node)) as wire:
                await wire.send(header[:size])
                if reset:
                    wire.reset()
    assert (await greet(proxy.lease(node), header))["callerid"] == "/talker"
    await proxy.quiet()


async def test_a_header_whose_sender_has_left_is_not_handed_on(proxy, node):
    """A rospy publisher keeps only the connection of a subscriber that sent the last header."""
    await node.publish(proxy.master)
    for _ in range(20):
        async with connect(proxy.lease(node)) as wire:
            await wire.send(topic_header(caller="/left"))
    await greet(proxy.lease(node), topic_header(caller="/stays"))
    await until(lambda: proxy.endpoint(node).connections == 0, "all relays end")
    assert [header["callerid"] for header in node.headers] == ["/stays"]


async def test_a_service_on_a_port_of_its_own_is_found(proxy, make_node):
    node = await make_node()
    other_port = FakeNode("/talker", NODE)
    await node.publish(proxy.master)
    await other_port.tcpros.start(other_port.address)
    try:
        uri = f"rosrpc://{NODE}:{other_port.tcpros_port}"
        await node.call(proxy.master, "registerService", "/add", uri, node.uri)
        await greet(proxy.lease(node), service_header())
        assert [header["service"] for header in other_port.headers] == ["/add"]
        assert node.headers == []
    finally:
        await other_port.stop()


async def test_a_node_that_only_serves_is_reached_without_a_request_topic(proxy, node):
    node.published.clear()
    await node.serve(proxy.master)
    lease = proxy.endpoint(node).port
    reply = await rpc(proxy.settings.master_uri, "lookupService", "/outside", "/add")
    assert reply[2] == f"rosrpc://{HOST}:{lease}"
    assert (await greet(proxy.lease(node), service_header()))["callerid"] == "/talker"


async def test_a_tcpros_port_that_changed_is_asked_for_anew(proxy, node):
    await node.publish(proxy.master)
    await rpc(proxy.uri(node), "requestTopic", "/outside", "/chatter", [["TCPROS"]])
    await node.tcpros.stop()
    await node.tcpros.start(node.address)
    assert (await greet(proxy.lease(node), topic_header()))["callerid"] == "/talker"


async def test_a_node_without_tcpros_is_a_reset(proxy, node):
    await node.publish(proxy.master)
    await node.tcpros.stop()
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header())
        assert await wire.end() == "reset"


async def test_a_node_that_drops_the_connection_at_once_is_a_reset(proxy, node):
    async def drop(node, reader, writer, header):
        Wire(reader, writer).reset()

    node.stream = drop
    await node.publish(proxy.master)
    for _ in range(20):
        async with connect(proxy.lease(node)) as wire:
            await wire.send(topic_header())
            assert await wire.end() in ("reset", "closed")
    await until(lambda: proxy.endpoint(node).connections == 0, "all relays end")


async def test_publisher_updates_are_imported_in_order_without_doubles(proxy, make_node):
    talker = await make_node()
    listener = await make_node("/listener", OTHER_NODE)
    await talker.publish(proxy.master)
    await listener.subscribe(proxy.master)
    far = f"http://{OUTSIDE}:4000/"
    uris = [far, proxy.uri(talker), far, "not a uri"]
    await rpc(proxy.uri(listener), "publisherUpdate", "/master", "/chatter", uris, source=MASTER)
    assert listener.updates()[-1] == [far, talker.uri, "not a uri"]


async def test_bus_info_and_master_uri_are_exported(proxy, make_node):
    talker = await make_node()
    listener = await make_node("/listener", OTHER_NODE)
    await talker.publish(proxy.master)
    await listener.subscribe(proxy.master)
    row = [1, talker.uri, "i", "TCPROS", "/chatter", True]
    listener.answers["getBusInfo"] = value([1, "bus info", [row]])
    listener.answers["getMasterUri"] = value([1, "", f"http://{PROXY}:11311/"])
    info = await rpc(proxy.uri(listener), "getBusInfo", "/outside")
    assert info[2] == [[1, proxy.uri(talker), "i", "TCPROS", "/chatter", True]]
    reply = await rpc(proxy.uri(listener), "getMasterUri", "/outside")
    assert reply[2] == proxy.settings.master_uri


async def test_only_the_master_may_control_nodes_where_policy_says_so(make_proxy, node):
    proxy = await make_proxy(slave_control="master")
    await node.publish(proxy.master)
    await node.call(proxy.master, "subscribeParam", node.uri, "/chatter")
    lease = proxy.uri(node)
    controls = ("shutdown", "publisherUpdate", "paramUpdate")
    for method in controls:
        assert (await rpc(lease, method, "/evil", "/chatter", []))[0] == -1
        inner = [{"methodName": method, "params": ["/evil", "/chatter", []]}]
        assert (await rpc(lease, "system.multicall", inner))[0][0][0] == -1
    assert (await rpc(lease, "getPid", "/evil"))[2] == node.pid
    assert not [name for name, _ in node.calls if name in controls]
    for method in controls:
        assert (await rpc(lease, method, "/master", "/chatter", [], source=MASTER))[0] == 1
    assert [name for name, _ in node.calls if name in controls] == list(controls)


@pytest.mark.parametrize(
    "answer", [End.RESET, End.CLOSE, b"HTTP/1.1 404 No\r\nContent-Length: 0\r\n\r\n"]
)
async def test_a_slave_api_that_gives_no_answer_is_a_reset(proxy, node, answer):
    await node.publish(proxy.master)
    for method in ("getBusStats", "requestTopic"):
        node.answers[method] = answer
        async with connect(proxy.lease(node)) as wire:
            await wire.send(post(xml(method, "/outside", "/chatter", [["TCPROS"]])))
            assert await wire.end() == "reset"


async def test_garbage_from_a_node_is_a_fault_where_it_would_be_rewritten(proxy, node):
    await node.publish(proxy.master)
    for body in (b"", b"garbage", b"<methodResponse/>"):
        node.answers["requestTopic"] = node.answers["getBusStats"] = ok(body)
        asked = post(xml("requestTopic", "/outside", "/chatter", [["TCPROS"]]))
        assert (await exchange(proxy.lease(node), asked)).fault < 0
        asked = post(xml("getBusStats", "/outside"))
        assert (await exchange(proxy.lease(node), asked)).body == body


async def test_nodes_are_asked_without_chunks_or_compression(proxy, node):
    await node.publish(proxy.master)
    await exchange(proxy.lease(node), post(xml("getPid", "/o"), "Accept-Encoding: gzip"))
    headers = node.requests[-1].headers
    assert "accept-encoding" not in headers
    assert "transfer-encoding" not in headers
    assert "content-length" in headers
    assert node.requests[-1].path == "/"


async def test_a_registration_never_gets_a_port_outside_the_range(make_proxy, make_node, caplog):
    proxy = await make_proxy(ports=2)
    nodes = [await make_node(f"/n{i}") for i in range(3)]
    for node in nodes[:2]:
        assert (await node.publish(proxy.master))[0] == 1
    code, text, rest = await nodes[2].publish(proxy.master)
    assert (code, rest) == (-1, 0)
    for phrase in (str(proxy.settings.ports.listen), "2 leases held", "--port-range"):
        assert phrase in text
    assert text in caplog.text
    assert proxy.metric("range_exhausted_total") == 1
    # Other nodes go on, and each call of a multicall has a separate answer.
    calls = [
        {"methodName": "getPid", "params": ["/n2"]},
        {"methodName": "registerSubscriber", "params": ["/n2", "/t", "*", nodes[2].uri]},
        {"methodName": "registerSubscriber", "params": ["/n0", "/t", "*", nodes[0].uri]},
    ]
    first, second, third = await rpc(proxy.master, "system.multicall", calls, source=NODE)
    assert (first, second, third[0][0]) == ([[1, "", 4711]], [[-1, text, 0]], 1)
    only = await rpc(proxy.master, "system.multicall", calls[1:2], source=NODE)
    assert only == [[[-1, text, 0]]]


@pytest.mark.parametrize("code", [errno.EADDRINUSE, errno.EMFILE])
async def test_a_port_that_can_not_be_opened(make_proxy, node, monkeypatch, code):
    """Only the port that another program holds is left out of the range."""
    proxy = await make_proxy(ports=2)
    failures = [OSError(code, "the reason")]

    def listen_on(sock):
        if failures:
            raise failures.pop()
        sockets.listen_on(sock)

    monkeypatch.setattr(leases, "listen_on", listen_on)
    answer = await node.publish(proxy.master)
    told = [(problem.subject, problem.text) for problem in proxy.app.runtime.problems.all()]
    if code == errno.EADDRINUSE:
        assert answer[0] == 1
        assert [subject for subject, text in told if "another program has taken port" in text]
    else:
        assert answer[0] == -1
        assert "can't be opened: the reason" in answer[1]
        assert not [text for _, text in told if "another program" in text]
        assert (await node.publish(proxy.master))[0] == 1


async def test_the_same_uri_gets_the_same_port_again(make_proxy, make_node):
    proxy = await make_proxy(linger=0.0)
    node = await make_node()
    other = await make_node("/other", OTHER_NODE)
    await node.publish(proxy.master)
    lease = proxy.lease(node)
    uri = proxy.uri(node)
    await node.call(proxy.master, "unregisterPublisher", "/chatter", node.uri)
    await until(lambda: not len(proxy.ros1.context.registry), "the lease ends")
    assert await refuses(lease)
    await other.publish(proxy.master)
    await node.publish(proxy.master)
    assert proxy.uri(node) == uri


async def test_an_idle_lease_gives_way_where_the_range_is_short(make_proxy, make_node):
    proxy = await make_proxy(ports=1, linger=60.0)
    node = await make_node()
    other = await make_node("/other", OTHER_NODE)
    await node.publish(proxy.master)
    await node.call(proxy.master, "unregisterPublisher", "/chatter", node.uri)
    await until(lambda: proxy.endpoint(node).idle_since is not None, "the node counts as idle")
    assert (await other.publish(proxy.master))[0] == 1
    assert (await rpc(proxy.uri(other), "getPid", "/o"))[2] == other.pid
    assert (await node.publish(proxy.master))[0] == -1


async def test_the_advertised_range_may_differ_by_an_offset(make_proxy, master, node):
    first = free_ports(8)
    proxy = await make_proxy(ports=8, advertise_port_range=f"{first}-{first + 7}")
    await node.publish(proxy.master)
    listening = proxy.endpoint(node).port
    (uri,) = master.holds("publishers", "/chatter")
    shown = first + listening - proxy.settings.ports.listen.first
    assert uri.startswith(f"http://{HOST}:{shown}/")
    offer = ("requestTopic", "/outside", "/chatter", [["TCPROS"]])
    asked = await rpc((HOST, listening), *offer, host=f"{HOST}:{shown}")
    assert asked == [1, f"ready on {HOST}:{shown}", ["TCPROS", HOST, shown]]


async def test_a_port_that_another_program_holds_is_passed_over(make_proxy, make_node, caplog):
    first = free_ports(6)
    with socket.create_server(("0.0.0.0", first)):
        proxy = await make_proxy(
            port_range=f"{first}-{first + 2}",
            master_port=first + 3,
            admin_bind=f"127.0.0.1:{first + 4}",
        )
        nodes = [await make_node(f"/n{i}") for i in range(3)]
        codes = [(await node.publish(proxy.master))[0] for node in nodes]
        assert codes == [1, 1, -1]
        assert [proxy.endpoint(node).port for node in nodes[:2]] == [first + 1, first + 2]
    assert f"held by other programs: [{first}]" in caplog.text


async def test_no_other_program_takes_a_port_of_the_range(proxy, node):
    """A free port, a leased port, and a formerly leased port."""
    (await node.publish(proxy.master))
    leased = proxy.endpoint(node).port
    free = proxy.settings.ports.listen.last

    def bound(port: int) -> bool:
        with socket.socket() as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                other.bind(("0.0.0.0", port))
            except OSError:
                return False
            return True

    assert [bound(free), bound(leased)] == [False, False]
    async with connect((HOST, leased)) as wire:
        await wire.send(topic_header())
        await read_header(wire)
        proxy.ros1.leases.close(proxy.endpoint(node))
        assert not bound(leased)
        proxy.ros1.leases.open(proxy.endpoint(node))
        assert await proxy.serves(node)


async def test_parallel_registrations_of_one_new_node_share_a_port(proxy, master, node):
    master.delay = 0.05
    await asyncio.gather(*(node.publish(proxy.master, f"/t{i}") for i in range(20)))
    assert len(proxy.ros1.context.registry) == 1
    assert {master.holds("publishers", f"/t{i}")[0] for i in range(20)} == {proxy.uri(node)}


async def test_a_node_gets_a_header_of_a_subscriber_that_has_gone_meanwhile(
    proxy, node: FakeNode, monkeypatch: pytest.MonkeyPatch
):
    """A rospy publisher accepts no connection while reporting a connection without a header."""
    await node.publish(proxy.master)
    has_ended = iter([False, True])  # after its header; after the connection to the node
    monkeypatch.setattr("rosproxy.shared.connections.sockets.has_ended", lambda _: next(has_ended))
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header(caller="/n"))
        assert await wire.reader.read() == b""
    assert [header["callerid"] for header in node.headers] == [CALLER_ID]
