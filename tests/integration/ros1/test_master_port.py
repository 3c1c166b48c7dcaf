"""The master port: forwarding, rewriting, and the replies that ROS's clients insist on."""

import xmlrpc.client

import pytest

from examples.demo.fake_http import End, ok
from tests.integration.net import (
    HOST,
    NODE,
    OUTSIDE,
    PROXY,
    connect,
    exchange,
    post,
    rpc,
    xml,
)

BOTH_LOOPS = True


async def test_a_registration_reaches_the_master_with_the_advertised_address(proxy, master, node):
    assert await node.publish(proxy.master) == [
        1,
        "Registered [/talker] as publisher of [/chatter]",
        [],
    ]
    ((name, topic, type_, uri),) = master.named("registerPublisher")
    assert (name, topic, type_) == ("/talker", "/chatter", "std_msgs/String")
    port = proxy.endpoint(node).port
    assert uri == f"http://{HOST}:{port}/"
    assert port in proxy.settings.ports.listen


async def test_the_outside_publishers_come_back_unchanged(proxy, master, node):
    outside = f"http://{OUTSIDE}:4000/"
    await rpc(master.uri, "registerPublisher", "/far", "/chatter", "std_msgs/String", outside)
    assert await node.subscribe(proxy.master) == [1, "Subscribed to [/chatter]", [outside]]


async def test_a_node_sees_its_own_uri_literally(proxy, node):
    await node.publish(proxy.master)
    assert (await node.subscribe(proxy.master))[2] == [node.uri]
    assert (await node.call(proxy.master, "lookupNode", "/talker"))[2] == node.uri


async def test_neighbours_get_each_others_own_uris(proxy, make_node):
    talker = await make_node("/talker")
    listener = await make_node("/listener", "127.0.2.12")
    await talker.publish(proxy.master)
    assert (await listener.subscribe(proxy.master))[2] == [talker.uri]
    await talker.serve(proxy.master)
    reply = await listener.call(proxy.master, "lookupService", "/add")
    assert reply == [1, f"rosrpc URI: [{talker.service_api}]", talker.service_api]


async def test_a_name_that_resolves_nowhere_is_found_at_the_source_address(
    proxy, master, make_node
):
    talker = await make_node("/talker", host="no-such-host.invalid")
    listener = await make_node("/listener", "127.0.2.12")
    await talker.publish(proxy.master)
    endpoint = proxy.endpoint(talker)
    advertised = f"http://{HOST}:{endpoint.port}/"
    assert master.holds("publishers", "/chatter") == [advertised]
    # A neighbour can't use the name either, so it gets the proxy's own inside address.
    relayed = f"http://{PROXY}:{endpoint.port}/"
    assert (await listener.subscribe(proxy.master))[2] == [relayed]
    assert (await rpc(relayed, "getPid", "/listener", source=listener.address))[2] == talker.pid


@pytest.mark.parametrize(
    ("method", "params"),
    [
        ("registerSubscriber", ("/chatter", "*")),
        ("registerPublisher", ("/chatter", "std_msgs/String")),
        ("registerService", ("/add", "rosrpc://{host}:1")),
        ("subscribeParam", ()),
    ],
)
async def test_every_unregistration_names_exactly_what_was_registered(
    proxy, master, node, method, params
):
    params = [param.format(host=NODE) for param in params]
    register = {"subscribeParam": [node.uri, "/p"]}.get(method, [*params, node.uri])
    assert (await node.call(proxy.master, method, *register))[0] == 1
    undo = {"subscribeParam": [node.uri, "/p"], "registerService": params}
    unregister = undo.get(method, [params[0], node.uri] if params else [])
    name = method.replace("register", "unregister").replace("subscribeP", "unsubscribeP")
    assert (await node.call(proxy.master, name, *unregister))[2] == 1
    assert not any(master.tables.values())
    assert proxy.endpoint(node).unused


async def test_types_pass_unchanged_in_both_directions(proxy, master):
    body = (
        b"<?xml version='1.0'?><methodCall><methodName>setParam</methodName><params><param><value>"
        b"/n</value></param><param><value>/p</value></param><param><value><struct><member><name>"
        b"\xc3\xa9</name><value><i4>-7</i4></value></member><member><name>d</name><value><double>"
        b"1.50</double></value></member><member><name>b</name><value><base64>AAEC\n</base64>"
        b"</value></member><member><name>t</name><value><dateTime.iso8601>20240101T00:00:00"
        b"</dateTime.iso8601></value></member><member><name>e</name><value></value></member>"
        b"<member><name>x</name><value><boolean>1</boolean></value></member></struct></value>"
        b"</param></params></methodCall>\n"
    )
    await exchange(proxy.master, post(body), NODE)
    assert body in [request.body for request in master.requests]
    answer = body.replace(b"methodCall>", b"methodResponse>").replace(
        b"<methodName>setParam</methodName>", b""
    )
    master.answers["getParam"] = ok(answer)
    reply = await exchange(proxy.master, post(xml("getParam", "/n", "/p")), NODE)
    assert reply.body == answer


@pytest.mark.parametrize("path", ["/", "/RPC2", "/any/thing?q#f", "//", "/%00"])
async def test_every_path_is_the_master(proxy, path):
    reply = await exchange(proxy.master, post(xml("getPid", "/n"), path=path), NODE)
    assert reply.value == [1, "", 4711]


async def test_the_master_is_asked_at_the_path_of_its_uri(master, make_proxy):
    proxy = await make_proxy(master_uri=master.uri + "/RPC2")
    await rpc(proxy.master, "getPid", "/n")
    assert {request.path for request in master.requests} == {"/RPC2"}


async def test_get_uri_gives_the_proxy_as_the_caller_names_it(proxy):
    port = proxy.settings.master_port
    assert (await rpc(proxy.master, "getUri", "/n"))[2] == f"http://{PROXY}:{port}/"
    request = post(xml("getUri", "/n"), "X-Other: 1").replace(b"somewhere", b"rosproxy:11311")
    assert (await exchange(proxy.master, request)).value[2] == "http://rosproxy:11311/"


async def test_a_multicall_is_rewritten_call_by_call(proxy, master, node):
    await node.publish(proxy.master)
    calls = [
        {"methodName": "registerSubscriber", "params": ["/talker", "/a", "*", node.uri]},
        {"methodName": "noSuchMethod", "params": []},
        {"methodName": "lookupNode", "params": ["/talker", "/talker"]},
        {"methodName": "unregisterPublisher", "params": ["/talker", "/chatter", node.uri]},
    ]
    results = await rpc(proxy.master, "system.multicall", calls, source=NODE)
    assert results[0] == [[1, "Subscribed to [/a]", []]]
    assert results[1]["faultCode"] == 1
    assert results[2] == [[1, "node api", node.uri]]
    assert results[3][0][2] == 1
    assert master.holds("publishers", "/chatter") == []
    assert master.holds("subscribers", "/a") == [proxy.uri(node)]


@pytest.mark.parametrize("offer", [(), ("Accept-Encoding: gzip, deflate",)])
@pytest.mark.parametrize("method", ["getParam", "registerSubscriber"])
async def test_replies_have_a_length_and_are_neither_chunked_nor_compressed(
    proxy, master, node, offer, method
):
    plain = xmlrpc.client.dumps(([1, "x" * 3000, []],), methodresponse=True).encode()
    master.answers[method] = ok(plain)
    body = xml(method, "/talker", "/chatter", "*", node.uri)
    reply = await exchange(proxy.master, post(body, *offer), NODE)
    assert (reply.status, reply.body) == (200, plain)
    assert reply.headers["content-length"] == str(len(plain))
    assert not reply.headers.keys() & {"transfer-encoding", "content-encoding"}
    assert not any("accept-encoding" in request.headers for request in master.requests)


async def test_a_chunked_reply_of_the_master_is_passed_on_with_a_length(proxy, master):
    plain = xmlrpc.client.dumps(([1, "", 5],), methodresponse=True).encode()
    chunks = b"".join(b"%x\r\n%s\r\n" % (1, plain[i : i + 1]) for i in range(len(plain)))
    master.answers["getPid"] = ok(chunks + b"0\r\n\r\n", "Transfer-Encoding: chunked")
    reply = await exchange(proxy.master, post(xml("getPid", "/n")))
    assert reply.body == plain


async def test_a_master_that_answers_http_1_0_without_a_length_is_understood(proxy, master):
    plain = xmlrpc.client.dumps(([1, "", 5],), methodresponse=True).encode()
    master.answers["getParam"] = b"HTTP/1.0 200 OK\r\nConnection: close\r\n\r\n" + plain
    for _ in range(3):
        assert (await exchange(proxy.master, post(xml("getParam", "/n", "/x")))).body == plain


async def test_while_the_master_is_down_calls_are_reset_and_work_again_after(proxy, master, node):
    await master.stop()
    for body in (xml("getPid", "/n"), xml("registerPublisher", "/n", "/t", "*", node.uri)):
        async with connect(proxy.master, NODE) as wire:
            await wire.send(post(body))
            assert await wire.end() == "reset"
    await master.start()
    assert (await node.publish(proxy.master))[0] == 1


@pytest.mark.parametrize(
    "answer",
    [
        b"HTTP/1.1 500 Oops\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 404 Not Found\r\nContent-Length: 3\r\n\r\nno\n",
        b"SSH-2.0-OpenSSH_9\r\n",
        b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\nContent-Encoding: gzip\r\n\r\nnope",
        End.CLOSE,
        End.RESET,
    ],
    ids=["500", "404", "no-http", "bad-gzip", "closed", "reset"],
)
@pytest.mark.parametrize("method", ["getParam", "registerPublisher"])
async def test_a_master_that_gives_no_answer_is_a_reset(proxy, master, node, answer, method):
    master.answers[method] = answer
    async with connect(proxy.master, NODE) as wire:
        await wire.send(post(xml(method, "/talker", "/chatter", "*", node.uri)))
        assert await wire.end() == "reset"


async def test_the_proxy_itself_never_waits_for_a_hanging_master(proxy, master, node, monkeypatch):
    monkeypatch.setattr("rosproxy.ros1.clients.master_client.MASTER_TIMEOUT_S", 0.3)
    master.answers["registerPublisher"] = End.HANG
    async with connect(proxy.master, NODE) as wire, connect(proxy.master, NODE) as other:
        await wire.send(post(xml("registerPublisher", "/talker", "/chatter", "*", node.uri)))
        await other.send(post(xml("getPid", "/n")))
        assert (await other.reply()).value[2] == 4711
        assert await wire.end() == "reset"


async def test_garbage_from_the_master_passes_where_nothing_is_rewritten(proxy, master):
    master.answers["getParam"] = ok(b"not xml")
    assert (await exchange(proxy.master, post(xml("getParam", "/n", "/p")))).body == b"not xml"


@pytest.mark.parametrize(
    "reply",
    [b"", b"not xml", b"<methodResponse/>", b"<methodResponse><params/></methodResponse>"],
)
async def test_garbage_from_the_master_is_a_fault_where_it_would_be_rewritten(
    proxy, master, node, reply
):
    master.answers["registerPublisher"] = ok(reply)
    body = xml("registerPublisher", "/talker", "/chatter", "*", node.uri)
    assert (await exchange(proxy.master, post(body), NODE)).fault < 0


async def test_the_published_master_forwards_unchanged_apart_from_its_uri(master, make_proxy, node):
    proxy = await make_proxy(publish_master=True)
    port = proxy.settings.publish_master
    published = HOST, port
    await node.publish(proxy.master)
    assert (await rpc(published, "getUri", "/far"))[2] == f"http://{HOST}:{port}/"
    assert (await rpc(published, "lookupNode", "/far", "/talker"))[2] == proxy.uri(node)
    outside = f"http://{OUTSIDE}:4000/"
    body = xml("registerSubscriber", "/far", "/chatter", "*", outside)
    reply = await exchange(published, post(body))
    assert reply.value[2] == [proxy.uri(node)]
    assert body in [request.body for request in master.requests]
    both = [{"methodName": name, "params": ["/far"]} for name in ("getUri", "getPid")]
    results = await rpc(published, "system.multicall", both)
    assert [result[0][2] for result in results] == [f"http://{HOST}:{port}/", 4711]
