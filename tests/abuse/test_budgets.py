"""Requests that are too large, too many or endless are refused, and other callers are served."""

import asyncio
import gzip
from contextlib import AsyncExitStack, suppress

from examples.demo.fake_http import value
from rosproxy.ros1.protocol.xmlrpc.document import INVALID_PARAMS, PARSE_ERROR
from tests.integration.net import (
    NODE,
    OTHER_NODE,
    OUTSIDE,
    connect,
    exchange,
    post,
    rpc,
    until,
    xml,
)

DOCUMENTS = 48 * 1024 * 1024
"""Bytes of documents: 32 MiB by --max-buffered, and a single parsed document."""
SLOW_CALLS = 32 * 1024 * 1024
"""Bytes that may be under way of 20 calls that pass, each with a connection to the master."""
UPLOADS = 96 * 1024 * 1024
"""Bytes of uploads: 32 MiB by --max-buffered, and what is read ahead of 200 connections."""
MB = 1000 * 1000


def many_publishers(count: int, method: bytes = b"publisherUpdate") -> bytes:
    values = b"<value>http://h:1/</value>" * count
    return (
        b"<?xml version='1.0'?><methodCall><methodName>" + method + b"</methodName><params>"
        b"<param><value>/master</value></param><param><value>/chatter</value></param>"
        b"<param><value><array><data>" + values + b"</data></array></value></param>"
        b"</params></methodCall>"
    )


async def test_a_small_body_that_inflates_to_a_huge_one(abused, node):
    lease = await abused.publish(node)
    bomb = gzip.compress(many_publishers(490_000))
    with abused.watched():
        for _ in range(5):
            for target in (lease, abused.master):
                reply = await exchange(target, post(bomb, "Content-Encoding: gzip"))
                assert reply.status == 415
        assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
    assert abused.refused() == {"compressed"}


async def test_documents_with_too_many_elements_and_with_as_many_as_there_may_be(abused, node):
    lease = await abused.publish(node)
    with abused.watched(DOCUMENTS):
        for target, method in ((lease, b"publisherUpdate"), (abused.master, b"registerService")):
            whole = many_publishers(490_000, method)
            assert (await exchange(target, post(whole), NODE)).status == 413
        many = many_publishers(18_000, b"registerService")
        few = many_publishers(9_900)
        calls = [exchange(abused.master, post(many), NODE) for _ in range(10)]
        calls += [exchange(lease, post(few)) for _ in range(10)]
        replies = await asyncio.gather(*calls)
        assert {reply.status for reply in replies} <= {200, 503}
        assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
    assert "long_body" in abused.refused()


def with_a_long_tag(body: bytes, content: bytes) -> bytes:
    return body.replace(b"<value>", b"<value" + content + b">", 1)


async def test_documents_with_tags_of_megabytes(abused, node):
    """Once a document of 4 MiB took 460 MB, and a document of 11 MB took 370 MB and 1.1 s."""
    lease = await abused.publish(node)
    attributes = b"".join(b" a%x=''" % number for number in range(90_000))
    call = xml("registerPublisher", node.name, "/t", "x/Y", node.uri)
    several = xml("system.multicall", [{"methodName": "setParam", "params": ["/n", "/p", 1]}])
    spaces = b" " * 3_900_000
    with abused.watched():
        for long_tag in (with_a_long_tag(call, spaces), with_a_long_tag(call, attributes)):
            reply = await exchange(abused.master, post(long_tag), NODE)
            assert reply.fault == PARSE_ERROR
        update = with_a_long_tag(many_publishers(1), spaces[:1_000_000])
        assert (await exchange(lease, post(update))).fault == PARSE_ERROR
        for content in (attributes * 10, spaces * 10, b"><!--" + spaces * 10 + b"--"):
            long_call = post(with_a_long_tag(several, content))
            with suppress(ConnectionError):
                assert (await exchange(abused.master, long_call, NODE)).fault == PARSE_ERROR
        assert (await rpc(lease, "getPid", "/n"))[2] == node.pid


async def test_uploads_that_are_never_finished(abused, node):
    lease = await abused.publish(node)
    body_start = b" " * 900_000
    with abused.watched(UPLOADS):
        async with AsyncExitStack() as stack:
            for number in range(200):
                source = OUTSIDE if number % 2 else f"127.0.1.{number}"
                wire = await stack.enter_async_context(connect(lease, source))
                with suppress(ConnectionError):
                    await wire.send(post(body_start, "Content-Length: 1000000"))
            assert (await rpc(lease, "getPid", "/n", source="127.0.1.200"))[2] == node.pid
            assert (await rpc(abused.master, "getPid", "/n", source=NODE))[0] == 1
    assert "over_budget" in abused.refused()


async def test_readers_that_never_read_a_large_parameter(abused, node, master):
    lease = await abused.publish(node)
    master.answers["getParam"] = value("x" * 20 * MB)
    with abused.watched():
        async with AsyncExitStack() as stack:
            for _ in range(20):
                wire = await stack.enter_async_context(connect(abused.master, OTHER_NODE))
                wire.reader._limit = 1  # type: ignore[attr-defined] # reads nothing by itself
                wire.writer.transport.pause_reading()  # type: ignore[attr-defined]
                await wire.send(post(xml("getParam", "/n", "/big")))
            reply = await exchange(abused.master, post(xml("getParam", "/n", "/big")), NODE)
            assert len(reply.body) > 20 * MB
            assert (await rpc(lease, "getPid", "/n"))[2] == node.pid


async def test_another_program_makes_the_parameter_of_leases_large(abused, node, master):
    await abused.publish(node)
    kept = dict(master.params)
    (name,) = kept
    with abused.watched():
        master.params[name] = "x" * 60 * MB
        await until(lambda: master.params == kept, "the parameter is restored")
        assert abused.status()["master"]["up"]


async def test_a_large_parameter_that_is_set_slowly_by_many(abused, node, master):
    lease = await abused.publish(node)
    body = xml("setParam", "/n", "/big", "x" * 20 * MB)
    with abused.watched(SLOW_CALLS):
        async with AsyncExitStack() as stack:
            for _ in range(20):
                wire = await stack.enter_async_context(connect(abused.master, OTHER_NODE))
                await wire.send(post(body)[: 2 * MB])
            assert (await exchange(abused.master, post(body), NODE)).value[0] == 1
            assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
    assert len(master.params["/big"]) == 20 * MB


async def test_half_sent_requests_at_the_admin_endpoint(abused, node):
    lease = await abused.publish(node)
    with abused.watched():
        async with AsyncExitStack() as stack:
            for number in range(400):
                wire = await stack.enter_async_context(connect(abused.admin, OUTSIDE))
                half = b"POST /retire HTTP/1.1\r\nHost: x\r\nContent-Length: 1000\r\n"
                await wire.send(half if number % 2 else half + b"\r\n{")
            assert abused.status()["pid"] == abused.pid
            assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
        async with AsyncExitStack() as stack:
            for _ in range(200):
                wire = await stack.enter_async_context(connect(abused.admin, OUTSIDE))
                wire.writer.transport.pause_reading()  # type: ignore[attr-defined]
                await wire.send(b"GET /status HTTP/1.1\r\nHost: x\r\n\r\n" * 5)


async def test_a_multicall_of_twenty_thousand_calls(abused, node):
    lease = await abused.publish(node)
    calls = [{"methodName": "getPid", "params": ["/n"]}] * 20_000
    with abused.watched():
        for target in (lease, abused.master):
            body = xml("system.multicall", calls)
            reply = await exchange(target, post(body), NODE)
            assert reply.status in (200, 413)
        small = xml("system.multicall", calls[:1001])
        assert (await exchange(lease, post(small))).fault in (PARSE_ERROR, INVALID_PARAMS)
        asked = len([call for call in node.calls if call[0] == "getPid"])
        node.delay = 0.05
        async with connect(lease) as wire:
            await wire.send(post(xml("system.multicall", calls[:1000])))
        await asyncio.sleep(0.5)
        node.delay = 0
        assert len([call for call in node.calls if call[0] == "getPid"]) - asked < 100
        assert (await rpc(lease, "getPid", "/n"))[2] == node.pid


async def test_connections_that_say_nothing(abused, node):
    lease = await abused.publish(node)
    with abused.watched():
        async with AsyncExitStack() as stack:
            for number in range(700):
                target = lease if number % 2 else abused.master
                wire = await stack.enter_async_context(connect(target, OTHER_NODE))
                if number % 3:
                    await wire.send(b"POST / HTTP/1.1\r\nX: ")
            assert (await rpc(lease, "getPid", "/n", source=OTHER_NODE))[2] == node.pid
            assert (await rpc(lease, "getPid", "/n"))[2] == node.pid
    assert "silent_connections" in abused.refused()
