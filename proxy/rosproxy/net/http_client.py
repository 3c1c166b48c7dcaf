"""The HTTP client for XML-RPC: POST over kept connections.

aiohttp's parser (llhttp) reads the responses. The client does not use aiohttp's ClientSession. A
call through ClientSession takes twice as long, because of cookies, redirects and proxies. A
cancelled call of ClientSession closes the connection, and that ends roslisp nodes. This client
leaves such a connection open until the answer has arrived (`rosproxy.net.late_answers`). The client
also refuses compressed bodies: ROS does not compress, and a small body could become huge.

Long bodies that the proxy need not read pass piece by piece, in requests and replies. The proxy
reads a piece only after the receiver has taken the previous pieces. So a body needs about 100 KiB
of memory, whatever the length.
"""

import asyncio
import errno
import re
import socket
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from functools import lru_cache, partial
from typing import Protocol

import aiohttp
from aiohttp.http import HttpResponseParser, RawResponseMessage
from aiohttp.http_exceptions import HttpProcessingError

from rosproxy.net.http_protocol import HttpProtocol, wake
from rosproxy.net.late_answers import LateAnswers
from rosproxy.net.time_limits import TimeLimit, TimeLimits
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.connections.sockets import dial
from rosproxy.shared.http.bodies import BadResponse, TooLong, is_plain, read_bounded
from rosproxy.shared.machine import resolver

MOST_BODY_BYTES = 64 * 1024 * 1024
"""Default bound of an XML-RPC body in bytes."""
LONG_BODY_BYTES = 64 * 1024
"""Bytes. A longer reply passes piece by piece if the proxy need not read the reply."""
PIECE_TIMEOUT_S = 30.0
"""Seconds within which the next piece of a long body must arrive, or leave."""
LONG_BODY_TIMEOUT_S = 600.0
"""Seconds for a whole long body: 64 MiB at 0.9 Mbit/s."""
CONNECT_TIMEOUT_S = 2.0
"""Seconds for the attempt to connect to one address of a peer.

rosmaster calls all subscribers from three threads (master_api.py, NUM_WORKERS). While the proxy
tries to reach a node for such a call, a thread of rosmaster waits. So this time is short.
"""

_NO_CONTROL_OR_SPACE = re.compile(r"[^\x00-\x20\x7f]+")


class LongBody(Protocol):
    """A request body that arrives piece by piece."""

    size: int

    def pieces(self) -> AsyncIterator[bytes]:
        """The pieces, once. An error between two pieces ends the call that sends the body."""


class LongReply:
    """A reply body that passes piece by piece. The receiver must call `close` in any case."""

    def __init__(self, size: int, stream: aiohttp.StreamReader, finish: Callable[[], None]) -> None:
        self.size = size
        self._stream = stream
        self._finish = finish

    async def pieces(self) -> AsyncIterator[bytes]:
        """The pieces, once. Raises aiohttp.ClientError, TimeoutError."""
        loop = asyncio.get_running_loop()
        end = loop.time() + LONG_BODY_TIMEOUT_S
        while not self._stream.at_eof():
            async with asyncio.timeout_at(min(end, loop.time() + PIECE_TIMEOUT_S)):
                piece = await self._stream.readany()
            yield piece

    def close(self) -> None:
        """Keep the connection for other calls if the whole body was read.

        Otherwise the client reads and drops the rest of the body, and then closes the connection.
        """
        self._finish()


class ClientConnection(HttpProtocol):
    """A connection to a peer, an HTTP server, for a single call at a time."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        # A reply without a length ends with the connection, as in HTTP/1.0 (read_until_eof).
        self._responses = HttpResponseParser(
            self,
            loop,
            LONG_BODY_BYTES,
            payload_exception=aiohttp.ClientPayloadError,
            read_until_eof=True,
            auto_decompress=False,
        )
        super().__init__(loop, self._responses)
        self._messages: deque[tuple[RawResponseMessage, aiohttp.StreamReader]] = deque()
        self._content: aiohttp.StreamReader | None = None
        """The body of the latest response."""
        self._arrival: asyncio.Future[None] | None = None
        self._failure: Exception | None = None
        self._is_persistent = True

    @property
    def reusable(self) -> bool:
        """Whether the connection can carry another call."""
        is_read = self._content is None or self._content.is_eof()
        is_open = self.transport is not None and not self.transport.is_closing()
        return self._is_persistent and is_read and is_open and not self._messages

    def data_received(self, data: bytes) -> None:
        """Parse received bytes. aiohttp passes b"" to let a paused parser go on."""
        if self._failure is not None:
            return
        try:
            messages, _, _ = self._responses.feed_data(data)
        except HttpProcessingError as error:
            self._fail(ValueError(f"the answer is not HTTP: {error.message}"))
            return
        for message, content in messages:
            self._messages.append((message, content))
            self._content = content
            self._is_persistent = self._is_persistent and not message.should_close
        if messages:
            wake(self._arrival)

    def eof_received(self) -> None:
        """Return None, so that asyncio closes the connection: the peer sends nothing more."""

    def connection_lost(self, exc: BaseException | None) -> None:
        """End the call under way with an error."""
        try:
            self._responses.feed_eof()  # ends a body without a length
        except Exception as error:
            if self._content is not None:
                text = f"the body is not complete: {exc or error}"
                self._content.set_exception(aiohttp.ClientPayloadError(text))
        super().connection_lost(exc)
        self._fail(exc if isinstance(exc, OSError) else aiohttp.ServerDisconnectedError())

    async def answer(self) -> tuple[aiohttp.StreamReader, int | None]:
        """The body of the next response, and the length if the header has ``Content-Length``.

        Skips responses with status 1xx. Raises BadResponse for another status than 200, OSError,
        aiohttp.ClientError, ValueError.
        """
        status = 100
        while 100 <= status < 200:
            while not self._messages:
                if self._failure is not None:
                    raise self._failure
                self._arrival = self._loop.create_future()
                await self._arrival
            message, payload = self._messages.popleft()
            status = message.code
        if status != 200:
            raise BadResponse(f"HTTP status {status}")
        if not is_plain(message.headers):
            raise BadResponse("the body is compressed")
        length = None if message.chunked else message.headers.get("Content-Length")
        return payload, int(length) if length else None

    def close(self) -> None:
        """Close the connection."""
        self._is_persistent = False
        if self.transport is not None:
            self.transport.close()

    def _fail(self, error: Exception) -> None:
        self._is_persistent = False
        self._failure = self._failure or error
        wake(self._arrival)


class HttpClient:
    """Sends XML-RPC calls to peers. One client calls the master, another calls nodes.

    ``headers``: sent with each call. ``keepalive``: seconds until an idle connection is closed; the
    check may come half that time later. ``most``: the highest number of connections in use at once.
    Connections with a long body, and connections in ``late``, do not count. ``longest``: bound of a
    reply body in bytes. ``source`` says where the peers' names come from (see `resolver.resolve`).
    ``last_address``: the address of the latest new connection.
    """

    def __init__(
        self,
        headers: Mapping[str, str],
        keepalive: float,
        most: int,
        longest: int = MOST_BODY_BYTES,
        source: str = "",
    ) -> None:
        self.last_address: str | None = None
        lines = {"Content-Type": "text/xml", "User-Agent": "rosproxy", **headers}
        self._headers = "".join(f"{name}: {text}\r\n" for name, text in lines.items())
        self._keepalive = keepalive
        self._places = asyncio.Semaphore(most)
        self._time_limits = TimeLimits()
        self._source = source
        self._longest = longest
        self._idle: dict[HostPort, list[tuple[float, ClientConnection]]] = {}
        self._used: set[ClientConnection] = set()
        self.late = LateAnswers()
        self._sweeper: asyncio.TimerHandle | None = None
        self._closed = False

    async def post(
        self,
        peer: HostPort,
        path: str,
        host: str,
        body: bytes,
        within: float,
        longest: int | None = None,
    ) -> bytes:
        """Send a request; return the body of the reply, at most ``longest`` bytes.

        ``within``: seconds for the whole call. ``host``: the text of the ``Host`` header. If a kept
        connection turns out to be closed, the client sends the request again on a new connection.
        ROS calls may be repeated without harm. Raises OSError, TimeoutError, aiohttp.ClientError,
        ValueError.
        """
        head = self._head(path, host, len(body))
        with TimeLimit(self._time_limits, within):
            async with self._places:
                connection, stream, size = await self._ask(peer, head, body)
                self._require(size, longest or self._longest, connection)
                return await self._read_whole(peer, connection, stream, longest or self._longest)

    async def pass_on(
        self, peer: HostPort, path: str, host: str, body: bytes | LongBody, within: float
    ) -> bytes | LongReply:
        """Send a request; return the body of the reply.

        A reply body of more than LONG_BODY_BYTES is a LongReply, except a reply without
        ``Content-Length``. ``within``: seconds until a long reply begins, or a short reply ends.
        For a LongBody, connecting may take ``within`` seconds. After the end of the body, the reply
        has ``within`` seconds again. A LongBody uses a new connection, because the client can't
        send the pieces twice. Raises the errors of `post` and of ``body.pieces``.
        """
        if isinstance(body, bytes):
            head = self._head(path, host, len(body))
            with TimeLimit(self._time_limits, within):
                async with self._places:
                    return await self._pass_reply(peer, *await self._ask(peer, head, body))
        # A long body does not count among ``most``: short calls would wait for the long body.
        head = self._head(path, host, body.size)
        async with asyncio.timeout(within):
            connection = await self._connect(peer)
        self._used.add(connection)
        try:
            async with asyncio.timeout(LONG_BODY_TIMEOUT_S):
                await _upload(connection, head, body)
        except BaseException:
            self._drop(connection)
            raise
        async with asyncio.timeout(within):
            answer = await self._await_answer(connection)
            return await self._pass_reply(peer, connection, *answer)

    def encoded_request(self, path: str, host: str, body: bytes) -> bytes:
        """The bytes of a request, for a connection outside this client. Raises ValueError."""
        return self._head(path, host, len(body)) + body

    async def close(self) -> None:
        """Close all connections."""
        self._closed = True
        if self._sweeper is not None:
            self._sweeper.cancel()
        for connection in [*self._used, *(h for idle in self._idle.values() for _, h in idle)]:
            connection.close()
        self._idle.clear()
        await self.late.end()
        await asyncio.sleep(0)  # asyncio closes a transport's socket in the loop's next turn

    def close_after_answer(self, sock: socket.socket, received: bytes = b"") -> None:
        """Close a connection that this client did not make, once the answer on it is complete.

        ``received``: the part of the answer that was already read. Without an answer, the
        connection is closed after LATE_TIMEOUT_S.
        """
        self.late.wait(partial(_drain_socket, sock, received), sock.close)

    def _head(self, path: str, host: str, size: int) -> bytes:
        start = _request_start(path, host)
        return f"{start}{self._headers}Content-Length: {size}\r\n\r\n".encode()

    async def _ask(
        self, peer: HostPort, head: bytes, body: bytes
    ) -> tuple[ClientConnection, aiohttp.StreamReader, int | None]:
        """Send a request; return the connection, the body and the length of the response."""
        kept = self._take(peer)
        if kept is not None:
            try:
                return kept, *await self._exchange(kept, head, body)
            except (aiohttp.ClientError, ConnectionError) as error:
                if not _was_closed(error):
                    raise
        connection = await self._connect(peer)
        return connection, *await self._exchange(connection, head, body)

    async def _exchange(
        self, connection: ClientConnection, head: bytes, body: bytes
    ) -> tuple[aiohttp.StreamReader, int | None]:
        self._used.add(connection)
        connection.write_message(head, body)
        return await self._await_answer(connection)

    async def _await_answer(
        self, connection: ClientConnection
    ) -> tuple[aiohttp.StreamReader, int | None]:
        try:
            return await connection.answer()
        except asyncio.CancelledError:  # timeout, or the caller has gone
            self._used.discard(connection)
            self.late.wait(partial(_drain_answer, connection), connection.close)
            raise
        except BaseException:
            self._drop(connection)
            raise

    async def _read_whole(
        self,
        peer: HostPort,
        connection: ClientConnection,
        stream: aiohttp.StreamReader,
        longest: int,
    ) -> bytes:
        try:
            reply = await read_bounded(stream, longest)
        except asyncio.CancelledError:  # the header has come in time, but not the whole body
            self._used.discard(connection)
            self.late.wait(partial(_drain_body, stream), connection.close)
            raise
        except BaseException:
            self._drop(connection)
            raise
        self._finish(peer, connection)
        return reply

    async def _pass_reply(
        self,
        peer: HostPort,
        connection: ClientConnection,
        stream: aiohttp.StreamReader,
        size: int | None,
    ) -> bytes | LongReply:
        if size is None or size <= LONG_BODY_BYTES:
            return await self._read_whole(peer, connection, stream, self._longest)
        self._require(size, self._longest, connection)
        return LongReply(size, stream, partial(self._finish_long, peer, connection, stream))

    def _require(self, size: int | None, longest: int, connection: ClientConnection) -> None:
        """Raise TooLong for a body of which the header tells that it is longer."""
        if size is not None and size > longest:
            self._drop(connection)
            raise TooLong(longest)

    def _drop(self, connection: ClientConnection) -> None:
        self._used.discard(connection)
        connection.close()

    def _finish_long(
        self, peer: HostPort, connection: ClientConnection, stream: aiohttp.StreamReader
    ) -> None:
        if connection.reusable or connection.gone:
            self._finish(peer, connection)
            return
        self._used.discard(connection)  # the caller has gone, and the peer still writes the reply
        self.late.wait(partial(_drain_body, stream), connection.close)

    async def _connect(self, peer: HostPort) -> ClientConnection:
        """A new connection to ``peer``, by the first address that accepts. Raises OSError."""
        if self._closed:
            raise ConnectionAbortedError("the proxy is stopping")
        loop = asyncio.get_running_loop()
        failure = OSError(None, f"host name {peer.host} can't be resolved")
        for address in await resolver.resolve(peer.host, self._source):
            try:
                sock = await dial(HostPort(address, peer.port), CONNECT_TIMEOUT_S)
            except OSError as error:
                failure = error
                continue
            _, connection = await loop.create_connection(ClientConnection, sock=sock)
            self.last_address = address
            return connection
        raise failure

    def _take(self, peer: HostPort) -> ClientConnection | None:
        """Take the most recent idle connection that can carry a call; None without any."""
        idle = self._idle.get(peer, [])
        while idle:
            _, connection = idle.pop()
            if connection.reusable:
                return connection
            connection.close()
        return None

    def _finish(self, peer: HostPort, connection: ClientConnection) -> None:
        """Keep a connection for other calls, if it can carry another call."""
        self._used.discard(connection)
        if not connection.reusable or self._closed:
            connection.close()
            return
        loop = asyncio.get_running_loop()
        self._idle.setdefault(peer, []).append((loop.time(), connection))
        if self._sweeper is None:
            self._sweeper = loop.call_later(self._keepalive, self._sweep)

    def _sweep(self) -> None:
        """Close connections that have been idle for ``keepalive`` seconds."""
        loop = asyncio.get_running_loop()
        expiry = loop.time() - self._keepalive
        self._sweeper = None
        for peer, idle in self._idle.items():
            for _, connection in (pair for pair in idle if pair[0] <= expiry):
                connection.close()
            self._idle[peer] = [pair for pair in idle if pair[0] > expiry]
        self._idle = {peer: idle for peer, idle in self._idle.items() if idle}
        if self._idle:
            self._sweeper = loop.call_later(self._keepalive / 2, self._sweep)


@lru_cache
def _request_start(path: str, host: str) -> str:
    if not (_NO_CONTROL_OR_SPACE.fullmatch(path) and _NO_CONTROL_OR_SPACE.fullmatch(host)):
        raise ValueError(
            f"{host}{path} can't be requested: "
            "the host or the path is empty, or has spaces or control characters"
        )
    return f"POST {path} HTTP/1.1\r\nHost: {host}\r\n"


class CallFailed(Exception):
    """Another program could not be called, or refused the call; the message has the reason."""


async def _upload(connection: ClientConnection, head: bytes, body: LongBody) -> None:
    """Send a long body as fast as the peer reads. Raises TimeoutError if the peer stalls."""
    connection.write(head)
    async for piece in body.pieces():
        async with asyncio.timeout(PIECE_TIMEOUT_S):
            connection.write(piece)
            await connection.drain()


async def _drain_answer(connection: ClientConnection) -> None:
    stream, _ = await connection.answer()
    await _drain_body(stream)


async def _drain_body(stream: aiohttp.StreamReader) -> None:
    while not stream.at_eof():
        await stream.readany()


async def _drain_socket(sock: socket.socket, received: bytes) -> None:
    """Read and drop an answer of which ``received`` has come. Close the socket."""
    loop = asyncio.get_running_loop()
    _, connection = await loop.create_connection(ClientConnection, sock=sock)
    try:
        if received:
            connection.data_received(received)
        await _drain_answer(connection)
    finally:
        connection.close()


def _was_closed(error: BaseException) -> bool:
    """Whether an error means that the peer has closed or reset the connection."""
    closed = aiohttp.ServerDisconnectedError, ConnectionResetError, BrokenPipeError
    number = error.errno if isinstance(error, OSError) else None
    return isinstance(error, closed) or number in (errno.ECONNRESET, errno.EPIPE)
