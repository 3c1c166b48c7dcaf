"""Requests on kept connections, from clients that behave in every way."""

import asyncio
from collections.abc import AsyncIterator

import pytest

from rosproxy.net import http_server
from rosproxy.net.http_server import (
    IDLE_TIMEOUT_S,
    MOST_QUEUED_REQUESTS,
    REST_TIMEOUT_S,
    HttpConnection,
    HttpReply,
    HttpRequest,
    HttpServer,
)
from tests.clock import pass_time
from tests.integration.net import MASTER, connect, post, until


class Echo(HttpServer):
    """Answers with the body of each request, once ``may_answer`` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.answered = list[bytes]()
        self.begun = 0
        self.ended = 0
        self.reads_body = True
        self.address = ("", 0)
        self.may_answer = asyncio.Event()
        self.may_answer.set()

    async def answer(self, request: HttpRequest) -> None:
        self.begun += 1
        await self.may_answer.wait()
        body = await request.content.read() if self.reads_body else b"unread"
        self.answered.append(body)
        await request.send(HttpReply(body))

    def connection_lost(self, connection: HttpConnection) -> None:
        super().connection_lost(connection)
        self.ended += 1


@pytest.fixture
async def echo() -> AsyncIterator[Echo]:
    server = Echo()
    listener = await asyncio.get_running_loop().create_server(server, MASTER, 0)
    server.address = listener.sockets[0].getsockname()[:2]
    yield server
    listener.close()
    server.may_answer.set()
    await server.shutdown(5)
    await until(lambda: not server._connections, "all connections are closed")


async def test_more_pipelined_requests_than_are_read_at_once_are_answered_in_order(echo):
    count = 5 * MOST_QUEUED_REQUESTS
    async with connect(echo.address) as wire:
        await wire.send(b"".join(post(b"%d" % number) for number in range(count)))
        bodies = [(await wire.reply()).body for _ in range(count)]
    assert bodies == [b"%d" % number for number in range(count)]


async def test_while_requests_wait_no_more_are_read(echo):
    echo.may_answer.clear()
    async with connect(echo.address) as wire:
        sending = asyncio.create_task(wire.send(post(b"x" * 1000) * 20_000))
        await wire.stalls()
        (connection,) = echo._connections
        assert len(connection._requests) <= MOST_QUEUED_REQUESTS
        sending.cancel()
        wire.reset()


async def test_what_is_no_http_is_refused_after_the_requests_before_it(echo):
    async with connect(echo.address) as wire:
        await wire.send(post(b"first"))
        assert (await wire.reply()).body == b"first"
        await wire.send(b"\x00\x01 nonsense\r\n\r\n")
        reply = await wire.reply()
        assert reply.status == 400
        assert reply.headers["connection"] == "close"
        assert await wire.end() == "closed"
    assert echo.answered == [b"first"]


async def test_an_upgrade_to_another_protocol_is_answered_as_the_last_request(echo):
    async with connect(echo.address) as wire:
        await wire.send(post(b"plain", "Upgrade: websocket", "Connection: upgrade"))
        reply = await wire.reply()
        assert (reply.status, reply.body) == (200, b"plain")
        assert reply.headers["connection"] == "close"
        assert await wire.end() == "closed"


async def test_a_connection_is_kept_until_it_was_idle_for_long(echo):
    async with connect(echo.address) as wire:
        await wire.send(post(b"one"))
        await wire.reply()
        await pass_time(IDLE_TIMEOUT_S / 2)
        await wire.send(post(b"two"))
        assert (await wire.reply()).body == b"two"
        await pass_time(IDLE_TIMEOUT_S + 1)
        assert await wire.end() == "closed"


async def test_an_answer_that_takes_long_is_not_idle_time(echo):
    echo.may_answer.clear()
    async with connect(echo.address) as wire:
        await wire.send(post(b"slow"))
        await until(lambda: echo.begun, "the request is being answered")
        await pass_time(2 * IDLE_TIMEOUT_S + 1)
        echo.may_answer.set()
        assert (await wire.reply()).body == b"slow"


async def test_closing_lets_the_request_end_that_is_being_answered(echo):
    echo.may_answer.clear()
    async with connect(echo.address) as wire:
        await wire.send(post(b"now") + post(b"later"))
        await until(lambda: echo.begun, "the request is being answered")
        (connection,) = echo._connections
        connection.close()
        echo.may_answer.set()
        reply = await wire.reply()
        assert reply.body == b"now"
        assert reply.headers["connection"] == "close"
        assert await wire.end() == "closed"
    assert echo.answered == [b"now"]


async def test_a_request_is_answered_to_its_end_though_its_client_has_gone(echo):
    echo.may_answer.clear()
    async with connect(echo.address) as wire:
        await wire.send(post(b"gone"))
        await until(lambda: echo.begun, "the request is being answered")
    await until(lambda: echo.ended, "the server sees the end")
    echo.may_answer.set()
    await until(lambda: echo.answered == [b"gone"], "the request is answered")


async def test_the_next_request_follows_a_body_that_was_not_read(echo):
    echo.reads_body = False
    body = b"y" * 1_000_000
    async with connect(echo.address) as wire:
        for _ in range(2):
            await wire.send(post(body))
            assert (await wire.reply()).body == b"unread"


async def test_a_rest_of_a_body_that_does_not_come_ends_the_connection(echo):
    echo.reads_body = False
    async with connect(echo.address) as wire:
        await wire.send(post(b"half", "Content-Length: 1000"))
        assert (await wire.reply()).body == b"unread"
        await pass_time(REST_TIMEOUT_S + 1)
        assert await wire.end() == "closed"


async def test_a_fault_in_a_server_ends_the_connection_and_is_logged(
    echo, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    async def fail(_: HttpRequest) -> None:
        raise RuntimeError("a fault")

    monkeypatch.setattr(echo, "answer", fail)
    async with connect(echo.address) as wire:
        await wire.send(post(b"x"))
        assert await wire.end() == "closed"
    assert "a fault" in caplog.text
    caplog.clear()


async def test_a_shutdown_waits_for_answers_and_cancels_late_ones(
    echo, monkeypatch: pytest.MonkeyPatch
):
    echo.may_answer.clear()
    async with connect(echo.address) as wire:
        await wire.send(post(b"late"))
        await until(lambda: echo.begun, "the request is being answered")
        await echo.shutdown(0)
        assert await wire.end() == "closed"
    assert echo.answered == []


async def test_a_long_header_is_refused(echo):
    long = "X-Long: " + "a" * 2 * http_server.MOST_LINE_BYTES
    async with connect(echo.address) as wire:
        await wire.send(post(b"x", long))
        assert (await wire.reply()).status == 400
