"""Calls over kept connections, with peers that end connections in every way."""

import asyncio
import gzip
import socket
import struct
from collections.abc import AsyncIterator, Awaitable, Callable

import aiohttp
import pytest

from rosproxy.net.http_client import HttpClient, LongReply
from rosproxy.net.late_answers import LATE_TIMEOUT_S
from rosproxy.shared.addresses import HostPort
from tests.clock import pass_time
from tests.integration.net import MASTER, until

REPLY = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok"
Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Peer:
    """A server. ``serve`` handles a connection, ``accepted`` counts connections."""

    def __init__(self) -> None:
        self.serve: Serve = self.answer_always
        self.accepted = self.open = 0
        self.heads: list[bytes] = []

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._connected, MASTER, 0)
        self.address = HostPort(*self._server.sockets[0].getsockname()[:2])

    def stop(self) -> None:
        self._server.close()

    async def request(self, reader: asyncio.StreamReader) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        self.heads.append(head)
        await reader.readexactly(int(head.partition(b"Content-Length: ")[2].split()[0]))

    async def answer_always(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while True:
            await self.request(reader)
            writer.write(REPLY)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.accepted = self.accepted + 1
        self.open = self.open + 1
        try:
            await self.serve(reader, writer)
        except (OSError, asyncio.IncompleteReadError):
            pass
        finally:
            self.open -= 1
            writer.close()


@pytest.fixture
async def peer() -> AsyncIterator[Peer]:
    made = Peer()
    await made.start()
    yield made
    made.stop()
    await until(lambda: made.open == 0, "the client closes all connections")


@pytest.fixture
async def client(peer: Peer) -> AsyncIterator[HttpClient]:
    made = HttpClient({"X-Test": "1"}, 0.3, 4)
    yield made
    await made.close()


async def post(client: HttpClient, peer: Peer, body: bytes = b"hello", within: float = 5) -> bytes:
    return await client.post(peer.address, "/a/b", "robot:11311", body, within)


async def test_calls_one_after_the_other_share_a_connection(client, peer):
    assert [await post(client, peer) for _ in range(5)] == [b"ok"] * 5
    assert peer.accepted == 1
    assert peer.heads[0].startswith(b"POST /a/b HTTP/1.1\r\nHost: robot:11311\r\n")
    for line in (b"Content-Type: text/xml", b"X-Test: 1", b"Content-Length: 5"):
        assert line in peer.heads[0].split(b"\r\n")


async def test_a_connection_that_is_not_used_is_closed(client, peer):
    await post(client, peer)
    assert peer.open == 1
    await until(lambda: peer.open == 0, "the idle connection is closed")


async def test_no_more_calls_are_under_way_than_allowed(client, peer):
    async def slowly(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            await peer.request(reader)
            await asyncio.sleep(0.05)
            writer.write(REPLY)

    peer.serve = slowly
    assert await asyncio.gather(*(post(client, peer) for _ in range(12))) == [b"ok"] * 12
    assert peer.accepted == 4


@pytest.fixture
def answer(peer: Peer) -> asyncio.Event:
    """Set this event to make the peer answer. The peer then waits for the end of the connection."""
    event = asyncio.Event()

    async def late(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        due = asyncio.create_task(event.wait())
        ended = asyncio.create_task(reader.read())
        await asyncio.wait([due, ended], return_when=asyncio.FIRST_COMPLETED)
        writer.write(REPLY)
        due.cancel()
        await ended

    peer.serve = late
    return event


async def give_up(client: HttpClient, peer: Peer) -> None:
    with pytest.raises(TimeoutError):
        await post(client, peer, within=0.1)


async def test_a_peer_that_answers_late_finds_its_caller_on_the_connection(client, peer, answer):
    await give_up(client, peer)
    assert (peer.open, len(client.late)) == (1, 1)
    answer.set()
    await until(lambda: not peer.open, "the connection closes after the answer")
    assert len(client.late) == 0


@pytest.mark.parametrize("read_before", [b"", REPLY[:30]], ids=["nothing", "a part"])
async def test_a_connection_of_the_caller_is_closed_after_the_answer(client, peer, read_before):
    """The peer keeps the connection open, as HTTP/1.1 allows."""
    is_due = asyncio.Event()

    async def late(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        writer.write(read_before)
        await is_due.wait()
        writer.write(REPLY[len(read_before) :])
        await reader.read()

    peer.serve = late
    loop = asyncio.get_running_loop()
    sock = socket.socket()
    sock.setblocking(False)
    await loop.sock_connect(sock, (peer.address.host, peer.address.port))
    await loop.sock_sendall(sock, client.encoded_request("/", "robot", b"hello"))
    received = await loop.sock_recv(sock, 100) if read_before else b""
    client.close_after_answer(sock, received)
    assert received == read_before
    await until(lambda: len(peer.heads) == 1, "the peer has the request")
    assert len(client.late) == 1
    is_due.set()
    await until(lambda: not client.late, "the client waits for no answer any more")
    await until(lambda: peer.open == 0, "the connection closes after the answer")


@pytest.mark.parametrize("is_long", [False, True], ids=["short call", "long call"])
@pytest.mark.parametrize("begun", [b"", REPLY[:-1]], ids=["nothing", "all but the last byte"])
async def test_a_peer_writes_its_whole_late_answer_before_the_connection_closes(
    client, peer, begun, is_long
):
    is_due = asyncio.Event()
    ended_early = list[bool]()

    async def late(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        writer.write(begun)
        ended = asyncio.create_task(reader.read())
        due = asyncio.create_task(is_due.wait())
        await asyncio.wait([ended, due], return_when=asyncio.FIRST_COMPLETED)
        ended_early.append(ended.done())
        due.cancel()
        writer.write(REPLY[len(begun) :])
        await ended

    peer.serve = late
    body = Pieces(1) if is_long else b"hello"
    with pytest.raises(TimeoutError):
        await client.pass_on(peer.address, "/", "robot", body, 0.2)
    assert len(client.late) == 1
    is_due.set()
    await until(lambda: peer.open == 0, "the connection closes after the answer")
    assert ended_early == [False]
    assert len(client.late) == 0


async def test_a_peer_that_never_answers_loses_its_caller_in_the_end(client, peer, answer):
    await give_up(client, peer)
    await pass_time(LATE_TIMEOUT_S)
    await until(lambda: not peer.open, "the connection is closed")
    assert len(client.late) == 0
    peer.serve = peer.answer_always
    assert await post(client, peer) == b"ok"


async def test_no_more_answers_are_waited_for_than_allowed(client, peer, answer, monkeypatch):
    monkeypatch.setattr("rosproxy.net.late_answers.MOST_LATE", 2)
    await asyncio.gather(*(give_up(client, peer) for _ in range(4)))
    assert len(client.late) == 2
    await until(lambda: peer.open == 2, "the other connections are closed")
    await client.close()
    assert len(client.late) == 0


async def test_what_is_left_after_the_end_is_closed_at_once(client, peer, answer):
    await client.late.end()
    await give_up(client, peer)
    assert len(client.late) == 0


@pytest.mark.parametrize("reset", [False, True], ids=["closed", "reset"])
@pytest.mark.parametrize("when", ["between", "in the call"])
async def test_a_kept_connection_that_ends_costs_one_more_try(client, peer, reset, when):
    async def once(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        writer.write(REPLY)
        if when == "in the call":
            await reader.readexactly(1)
        if reset:
            sock = writer.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            writer.transport.abort()

    peer.serve = once
    assert [await post(client, peer) for _ in range(3)] == [b"ok"] * 3
    assert peer.accepted == 3


async def test_who_has_gone_refuses_in_spite_of_a_kept_connection(client, peer):
    async def once(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        writer.write(REPLY)
        await reader.readexactly(1)

    peer.serve = once
    await post(client, peer)
    peer.stop()
    with pytest.raises(ConnectionRefusedError):
        await post(client, peer)


async def test_a_new_connection_that_is_closed_is_not_tried_again(client, peer):
    async def hang_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)

    peer.serve = hang_up
    with pytest.raises(aiohttp.ServerDisconnectedError):
        await post(client, peer)
    assert peer.accepted == 1


@pytest.mark.parametrize(
    "reply",
    [b"nonsense\r\n\r\n", b"HTTP/1.1 302 F\r\nLocation: /\r\nContent-Length: 0\r\n\r\n"],
    ids=["no HTTP", "a redirect"],
)
async def test_what_is_no_reply_is_told_as_such(client, peer, reply):
    async def odd(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        writer.write(reply)

    peer.serve = odd
    with pytest.raises(ValueError, match="HTTP"):
        await post(client, peer)


async def test_a_reply_beyond_the_bound_is_refused(client, peer):
    async def long(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            await peer.request(reader)
            size = 100_000 + (len(peer.heads) > 1)
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % size + b"x" * size)

    peer.serve = long
    assert len(await client.post(peer.address, "/", "robot", b"x", 5, longest=100_000)) == 100_000
    with pytest.raises(ValueError, match="100000 bytes"):
        await client.post(peer.address, "/", "robot", b"x", 5, longest=100_000)
    await until(lambda: peer.open == 0, "the connection is closed")


async def test_a_compressed_reply_is_not_inflated(client, peer):
    async def bomb(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        body = gzip.compress(b"x" * 50_000_000)
        head = b"HTTP/1.1 200 OK\r\nContent-Encoding: gzip\r\nContent-Length: %d\r\n\r\n"
        writer.write(head % len(body) + body)

    peer.serve = bomb
    with pytest.raises(ValueError, match="compressed"):
        await post(client, peer)


class Pieces:
    """A long body; ``fails`` after so many pieces."""

    def __init__(self, count: int, fails: bool = False) -> None:
        self.size = count * 70_000
        self._count = count
        self._fails = fails
        self.given = 0

    async def pieces(self) -> AsyncIterator[bytes]:
        for _ in range(self._count):
            if self._fails and self.given == self._count // 2:
                raise LookupError("the rest does not come")
            self.given += 1
            yield b"x" * 70_000


async def pass_on(client: HttpClient, peer: Peer, body: bytes | Pieces) -> bytes | LongReply:
    return await client.pass_on(peer.address, "/", "robot", body, 5)


async def test_a_long_reply_comes_piece_by_piece_and_keeps_its_connection(client, peer):
    async def long(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            await peer.request(reader)
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 5000000\r\n\r\n" + b"x" * 5_000_000)

    peer.serve = long
    for _ in range(2):
        reply = await pass_on(client, peer, b"hello")
        assert isinstance(reply, LongReply)
        assert sum([len(piece) async for piece in reply.pieces()]) == reply.size == 5_000_000
        reply.close()
    assert peer.accepted == 1
    unread = await pass_on(client, peer, b"hello")
    assert isinstance(unread, LongReply)
    unread.close()
    await until(lambda: peer.open == 0, "a connection with an unread reply is closed")


async def test_a_peer_can_write_the_whole_long_reply_although_the_caller_has_gone(client, peer):
    written = list[bool]()

    async def long(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 20000000\r\n\r\n")
        for _ in range(20):
            writer.write(b"x" * 1_000_000)
            await writer.drain()
        written.append(True)
        await reader.read()

    peer.serve = long
    reply = await pass_on(client, peer, b"hello")
    assert isinstance(reply, LongReply)
    reply.close()
    await until(lambda: peer.open == 0, "the connection closes after the reply")
    assert written == [True]
    assert len(client.late) == 0


async def test_long_replies_do_not_take_the_place_of_short_calls(client, peer):
    async def long(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            await peer.request(reader)
            size = 5_000_000 if len(peer.heads) <= 8 else 5
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % size + b"x" * size)

    peer.serve = long
    unread = [await pass_on(client, peer, b"hello") for _ in range(8)]
    assert await post(client, peer) == b"xxxxx"
    for reply in unread:
        assert isinstance(reply, LongReply)
        reply.close()


async def test_a_long_body_goes_on_a_new_connection(client, peer):
    await post(client, peer)
    body = Pieces(50)
    assert await pass_on(client, peer, body) == b"ok"
    assert body.given == 50
    assert peer.accepted == 2


async def test_a_long_body_that_fails_is_cut_before_its_end(client, peer):
    whole: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await peer.request(reader)
        whole.append(b"all")

    peer.serve = serve
    with pytest.raises(LookupError):
        await pass_on(client, peer, Pieces(50, fails=True))
    await until(lambda: peer.open == 0, "the connection is closed")
    assert not whole


async def test_a_peer_that_does_not_read_holds_a_long_body_up(client, peer, monkeypatch):
    monkeypatch.setattr("rosproxy.net.http_client.PIECE_TIMEOUT_S", 0.3)
    over = asyncio.Event()

    async def idle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await over.wait()

    peer.serve = idle
    body = Pieces(500)
    with pytest.raises(TimeoutError):
        await pass_on(client, peer, body)
    over.set()
    assert body.given < 300


@pytest.mark.parametrize("size", [10, 300_000])
async def test_bodies_of_any_size_arrive(client, peer, size):
    assert await post(client, peer, b"x" * size) == b"ok"
    assert f"Content-Length: {size}".encode() in peer.heads[0]


@pytest.mark.parametrize("bad", ["/a b", "/a\r\nX: y", ""])
async def test_nothing_else_than_a_path_gets_into_a_header(client, peer, bad):
    with pytest.raises(ValueError, match="can't be requested"):
        await client.post(peer.address, bad, "robot", b"", 1)
    assert peer.accepted == 0


async def test_a_closed_client_makes_no_calls(client, peer):
    await post(client, peer)
    await client.close()
    await until(lambda: peer.open == 0, "all connections are closed")
    with pytest.raises(ConnectionAbortedError):
        await post(client, peer)
