"""Hostile and clumsy HTTP and XML-RPC, the same on the master port and on a node's port."""

import gc
import gzip
import socket
import struct
import threading
import weakref
import xmlrpc.client
from dataclasses import dataclass
from itertools import product
from typing import Any

import pytest

from examples.demo.fake_http import Address
from rosproxy.net.http_server import HttpConnection
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.protocol.master_methods import MASTER_METHODS
from rosproxy.ros1.protocol.xmlrpc.limits import lease_call, master_call
from rosproxy.ros1.servers.xmlrpc_server import HEADER_TIMEOUT_S, XmlRpcServer
from rosproxy.shared.addresses import HostPort
from tests.integration.net import HOST, NODE, connect, exchange, post, rpc, until, xml

BOTH_LOOPS = True
XML = b"<?xml version='1.0'?>"
CHUNKED = ["Transfer-Encoding: chunked"]
CALL = xml("getPid", "/somebody")
NAMES = ["constructor", "__proto__", "__class__", "_dispatch", "toString", "a" * 1000, "é<&>'"]


@dataclass
class Door:
    """A port with XML-RPC, the pid that answers, and the longest body."""

    address: Address
    pid: int
    longest: int = master_call(4).size

    async def works(self) -> bool:
        """Whether the port still answers correctly."""
        return await rpc(self.address, "getPid", "/n", source=NODE) == [1, "", self.pid]


@pytest.fixture(params=["master port", "published master", "node port"])
async def door(request: Any, make_proxy: Any, master: Any, node: Any) -> Door:
    proxy = await make_proxy(publish_master=True)
    if request.param == "node port":
        await node.publish(proxy.master)
        return Door(proxy.lease(node), node.pid, lease_call(1).size)
    published = HOST, proxy.settings.publish_master
    return Door(proxy.master if request.param == "master port" else published, master.pid)


async def raw(door: Door, request: bytes, slices: int = 0) -> Any:
    return await exchange(door.address, request, slices=slices)


async def test_every_verb_answers(door):
    async with connect(door.address) as wire:
        for verb in ("GET", "HEAD", "PUT", "DELETE", "OPTIONS", "PATCH", "GET"):
            head = f"{verb} /x HTTP/1.1\r\nHost: h\r\n"
            await wire.send(f"{head}Content-Length: 0\r\n\r\n".encode())
            reply = await wire.reply(head=verb == "HEAD")
            assert reply.status == (200 if verb in ("GET", "HEAD") else 405)
            assert b"rosproxy" in reply.body or verb != "GET"
    assert await door.works()


@pytest.mark.parametrize("how", ["reset", "close", "half close"])
async def test_connections_that_end_early_are_survived(door, how):
    for sent in (b"", b"P", b"POS", b"POST", b"POST / HTTP/1.1\r\nHos"):
        async with connect(door.address) as wire:
            await wire.send(sent)
            if how == "reset":
                wire.reset()
            elif how == "half close":
                await wire.half_close()
                assert await wire.outcome() in ("closed", "reset", "answered")
        assert await door.works(), sent


async def test_requests_in_tiny_slices(door):
    for size in (1, 3, 7):
        assert (await raw(door, post(CALL), slices=size)).value == [1, "", door.pid]


async def test_a_header_that_never_ends_costs_a_time_out(door, monkeypatch):
    monkeypatch.setattr("rosproxy.ros1.servers.xmlrpc_server.HEADER_TIMEOUT_S", 0.1)
    async with connect(door.address) as mute, connect(door.address) as kept:
        await mute.send(b"POST / HTTP/1.1\r\nX: ")
        await kept.send(post(CALL))
        await kept.reply()
        assert await mute.outcome() == "closed"
        await kept.send(post(CALL))
        assert (await kept.reply()).value == [1, "", door.pid]


async def test_connections_that_have_ended_take_no_memory(door, monkeypatch):
    """The timer for the first header kept each connection for another half a minute."""
    made = list[weakref.ref[HttpConnection]]()
    accept = XmlRpcServer.connection_made

    def note(server, connection):
        made.append(weakref.ref(connection))
        accept(server, connection)

    def are_forgotten():
        gc.collect()
        return not any(connection() for connection in made)

    monkeypatch.setattr(XmlRpcServer, "connection_made", note)
    gc.freeze()  # a collection goes through the newer objects only, which takes a hundredth
    try:
        for request in (b"POST", post(CALL)):
            async with connect(door.address) as wire:
                await wire.send(request)
                await until(lambda: made, "the proxy serves the connection")
                wire.reset()
            # The timer would end the connection, too, but later.
            await until(are_forgotten, "the proxy forgets the connection", HEADER_TIMEOUT_S / 3)
            made.clear()
    finally:
        gc.unfreeze()


async def test_several_requests_on_one_connection(door):
    async with connect(door.address) as wire:
        for _ in range(20):
            await wire.send(post(CALL))
            assert (await wire.reply()).value == [1, "", door.pid]


async def test_pipelined_requests_are_answered_in_order(door):
    calls = [xml("getPid", f"/n{i}") if i % 2 else xml("noSuchMethod") for i in range(10)]
    async with connect(door.address) as wire:
        await wire.send(b"".join(map(post, calls)))
        for i in range(10):
            reply = await wire.reply()
            assert (b"faultCode" not in reply.body) or not i % 2


async def test_http_1_0_is_answered_and_closed(door):
    async with connect(door.address) as wire:
        await wire.send(post(CALL, version="1.0"))
        assert (await wire.reply()).value == [1, "", door.pid]
        assert await wire.end() == "closed"


async def test_http_1_0_with_keep_alive_stays_open(door):
    async with connect(door.address) as wire:
        for _ in range(2):
            await wire.send(post(CALL, "Connection: keep-alive", version="1.0"))
            assert (await wire.reply()).value == [1, "", door.pid]


async def test_headers_as_old_clients_write_them(door):
    for lines in (
        ["Content-length:{}"],
        ["content-length: {}", "user-agent: XMLRPC++ 0.7"],
        ["CONTENT-LENGTH:   {}  "],
        ["Content-Length: {}", "Connection: close"],
        ["Content-Length: {}", "Accept-Encoding: gzip", "User-Agent: Python-xmlrpc/3.11"],
    ):
        filled = [line.format(len(CALL)) for line in lines]
        assert (await raw(door, post(CALL, *filled))).value == [1, "", door.pid], lines


async def test_a_client_that_expects_100_continue_gets_it(door):
    request = post(CALL, "Expect: 100-continue")
    head, _, body = request.partition(b"\r\n\r\n")
    async with connect(door.address) as wire:
        await wire.send(head + b"\r\n\r\n")
        assert (await wire.reply()).status == 100
        await wire.send(body)
        assert (await wire.reply()).value == [1, "", door.pid]


async def test_chunked_uploads(door):
    for size in (1, 50, 10000):
        parts = [CALL[i : i + size] for i in range(0, len(CALL), size)]
        body = b"".join(b"%x\r\n%s\r\n" % (len(chunk), chunk) for chunk in parts) + b"0\r\n\r\n"
        reply = await raw(door, post(body, "Transfer-Encoding: chunked"))
        assert reply.value == [1, "", door.pid]


async def test_compressed_uploads_are_refused_unread(door):
    bomb = gzip.compress(b" " * 50_000_000)
    for encoding in ("gzip", "deflate", "br", "GZIP", "identity, gzip"):
        reply = await raw(door, post(bomb, f"Content-Encoding: {encoding}"))
        assert reply.status == 415, encoding
    assert (await raw(door, post(CALL, "Content-Encoding: identity"))).value == [1, "", door.pid]


async def test_a_body_above_the_limit_is_413(door):
    for body, headers in [
        (b" " * (door.longest + 1), []),
        (b" " * 100_001, [f"Content-Length: {10**15}"]),
        (b"%x\r\n" % (2 * door.longest) + b" " * (2 * door.longest) + b"\r\n0\r\n\r\n", CHUNKED),
    ]:
        assert (await raw(door, post(body, *headers))).status == 413
    assert await door.works()


async def test_a_connection_is_usable_after_413(door):
    async with connect(door.address) as wire:
        await wire.send(post(b" " * (door.longest + 1)))
        assert (await wire.reply()).status == 413
        await wire.send(post(CALL))
        assert (await wire.reply()).value == [1, "", door.pid]


@pytest.mark.parametrize("how", ["half close", "reset"])
async def test_truncated_bodies(door, how):
    request = post(CALL)
    for missing in (len(CALL), len(CALL) // 2, 1):
        async with connect(door.address) as wire:
            await wire.send(request[:-missing])
            if how == "reset":
                wire.reset()
            else:
                await wire.half_close()
                assert await wire.outcome() == "closed"
        assert await door.works(), missing


async def test_malformed_http_is_400(door):
    for request in (
        post(CALL, "Content-Length: -1"),
        post(CALL, "Content-Length: 1x"),
        post(CALL, "Content-Length: 5", "Content-Length: 6"),
        post(CALL, "X: " + "y" * 20_000),
        post(CALL, *[f"X{i}: 1" for i in range(500)]),
        post(CALL, path="/" + "p" * 20_000),
        b"POST / HTTP/9.9\r\n\r\n",
        b"POST\r\n\r\n",
        b"BREW / HTTP/1.1\r\n\r\n",
        b"POST / HTTP/1.1\r\nbroken header\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: a\x00b\r\n\r\n",
    ):
        assert (await raw(door, request)).status == 400, request[:60]
        assert await door.works(), request[:60]


async def test_other_protocols_are_survived(door):
    for noise in (b"\x16\x03\x01\x02\x00\x01\x00", b"SSH-2.0-x\r\n", b"\0" * 64, b"\xff" * 64):
        async with connect(door.address) as wire:
            await wire.send(noise)
            await wire.half_close()
            await wire.outcome()
        assert await door.works(), noise


def nested(depth: int) -> bytes:
    value = b"<value><array><data>" * depth + b"</data></array></value>" * depth
    return call_xml(b"<params><param>" + value + b"</param></params>")


def call_xml(rest: bytes, method: bytes = b"getPid") -> bytes:
    return XML + b"<methodCall><methodName>" + method + b"</methodName>" + rest + b"</methodCall>"


ENTITIES = b"<!DOCTYPE a [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;'>]>"
MALFORMED = {
    "empty": b"",
    "text": b"hello",
    "unclosed": XML + b"<methodCall><methodName>getPid",
    "wrong root": XML + b"<methodResponse/>",
    "no name": XML + b"<methodCall><params/></methodCall>",
    "empty name": call_xml(b"", method=b""),
    "two names": call_xml(b"<methodName>shutdown</methodName>"),
    "hidden name": call_xml(b"<!-- <methodName>shutdown</methodName> -->"),
    "dtd": b"<!DOCTYPE methodCall SYSTEM 'http://127.0.0.1/x.dtd'>" + call_xml(b""),
    "entities": ENTITIES + call_xml(b"<params><param><value>&b;</value></param></params>"),
    "unknown entity": call_xml(b"<params><param><value>&x;</value></param></params>"),
    "external entity": b"<!DOCTYPE a [<!ENTITY x SYSTEM 'file:///etc/passwd'>]>" + call_xml(b""),
    "deep": nested(100),
    "very deep": nested(100_000),
    "bad utf-8": call_xml(b"<params><param><value>\xff\xfe</value></param></params>"),
    "utf-16": "<?xml version='1.0' encoding='utf-16'?><a/>".encode("utf-16"),
    "odd encoding": b"<?xml version='1.0' encoding='cp037'?><a/>",
    "nul": call_xml(b"<params><param><value>\0</value></param></params>"),
    "control": call_xml(b"<params><param><value>\x01</value></param></params>"),
    "array alone": call_xml(b"<params><param><array/></param></params>"),
    "member alone": call_xml(b"<params><param><value><struct><member/></struct></value></param>"),
}


async def test_malformed_calls_are_faults(door):
    for name, body in MALFORMED.items():
        reply = await raw(door, post(body))
        if len(body) > door.longest:
            assert reply.status == 413 or reply.fault == -32700, name
            continue
        assert (name, reply.status) == (name, 200)
        assert reply.fault in (-32700, -32600), name
        assert await door.works(), name


async def test_a_huge_number_of_elements_is_a_fault(proxy):
    body = call_xml(b"<params>" + b"<a/>" * 600_000 + b"</params>", method=b"registerPublisher")
    assert (await exchange(proxy.master, post(body))).fault == -32700


async def test_unknown_methods_are_the_peers_to_answer(door):
    for name in NAMES:
        for count in (0, 1, 5):
            assert (await raw(door, post(xml(name, *["/n"] * count)))).status == 200, name
        assert await door.works(), name


ODD_VALUES: list[Any] = [0, 1.5, True, "", [], {}, ["x"], {"constructor": 1}, "http://"]
KNOWN = [*MASTER_METHODS, "requestTopic", "publisherUpdate", "getBusInfo", "system.multicall"]


async def test_odd_parameters_are_survived(door):
    async with connect(door.address, NODE) as wire:
        for method in KNOWN:
            await wire.send(post(xml(method)))
            assert (await wire.reply()).status == 200, method
        for method, odd in product(KNOWN, ODD_VALUES):
            for params in ([odd], ["/talker", odd, odd, odd], [odd] * 6):
                await wire.send(post(xml(method, *params)))
                assert (await wire.reply()).status == 200, (method, params)
    assert await door.works()


async def test_odd_names_register_and_unregister(proxy, master, node):
    for topic in (f"/{name}" for name in NAMES):
        assert (await node.publish(proxy.master, topic))[0] == 1
        assert master.holds("publishers", topic) == [proxy.uri(node)]
        assert (await node.call(proxy.master, "unregisterPublisher", topic, node.uri))[2] == 1
        assert not proxy.endpoint(node).registrations


ODD_URIS = [
    "",
    "/",
    "http://",
    "http://x/",
    "http://x:0/",
    "http://x:99999/",
    "http://x:abc/",
    "https://127.0.2.11:5/",
    "http://[::1/",
    "http://a b:5/",
    "http://x:5@y:6/",
    "http://%00:5/",
    "rosrpc://127.0.2.11:5",
]


async def test_odd_slave_uris_are_refused(proxy, node):
    for uri in ODD_URIS:
        code, text, _ = await node.call(proxy.master, "registerPublisher", "/t", "x/Y", uri)
        assert (code, "not of the form" in text) == (-1, True), uri
    assert not len(proxy.ros1.context.registry)
    assert (await node.publish(proxy.master))[0] == 1


async def test_odd_host_names_are_placed_at_their_source(proxy, node):
    for host in ("a" * 300, "é.invalid", "-", "_", "x.", "127.1", "0x7f.1"):
        uri = f"http://{host}:5/"
        assert (await node.call(proxy.master, "registerPublisher", "/t", "x/Y", uri))[0] == 1, uri
    assert {e.location.address for e in proxy.ros1.context.registry} == {NODE}


async def test_multicalls_with_odd_elements_keep_their_order(proxy, node):
    calls: list[Any] = [
        {"methodName": "getPid", "params": ["/n"]},
        {"methodName": "registerPublisher", "params": ["/n", "/t", "x/Y", "no uri"]},
        5,
        {"methodName": 5, "params": 5},
        {"params": []},
        {"methodName": "getPid", "params": []},
    ]
    good = await rpc(proxy.master, "system.multicall", calls[:2], source=NODE)
    assert good[0] == [[1, "", 4711]]
    assert good[1][0][0] == -1
    with pytest.raises((xmlrpc.client.Fault, ConnectionError, EOFError)):
        await rpc(proxy.master, "system.multicall", calls[2:], source=NODE)
    nest = {"methodName": "system.multicall", "params": [[calls[0]]]}
    with pytest.raises(xmlrpc.client.Fault, match="must not contain"):
        await rpc(proxy.master, "system.multicall", [nest])


async def test_length_bytes_of_a_tcpros_header_are_no_http(proxy):
    async with connect(proxy.master) as wire:
        await wire.send(struct.pack("<I", 20) + b"\0" * 20)
        assert (await wire.reply()).status == 400


async def test_a_name_server_that_hangs_does_not_hold_up_a_call_to_a_node(proxy, monkeypatch):
    """aiohttp's resolver would wait for the server, and no task would get the error."""
    answer = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_args, **_more: answer.wait(20) and [])
    try:
        with pytest.raises(Unreachable, match="can't be resolved"):
            await proxy.ros1.context.upstream.post_to_node(
                HostPort("nowhere.invalid", 1), b"", within=30
            )
    finally:
        answer.set()
