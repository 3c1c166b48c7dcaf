"""The HTTP server for XML-RPC: answers the requests of a kept connection in order.

aiohttp's parser (llhttp) reads the requests. The server does not use aiohttp's `web.Server`, which
makes a task, a request, a response and a writer for each request. A call would take a third longer.

A reply has a Content-Length and no chunks, as ROS clients expect (xmlrpcpp, XmlRpcClient.cpp).
"""

import asyncio
import logging
import socket
from collections import deque
from collections.abc import Sequence
from functools import lru_cache
from http import HTTPStatus

from aiohttp import HttpVersion, HttpVersion11, StreamReader
from aiohttp.http import HttpRequestParser, RawRequestMessage
from aiohttp.http_exceptions import HttpProcessingError

from rosproxy.net.http_protocol import READ_AHEAD_BYTES, HttpProtocol, wake
from rosproxy.shared.addresses import HostPort, plain_address
from rosproxy.shared.connections.sockets import reset_on_close

log = logging.getLogger(__name__)

IDLE_TIMEOUT_S = 75.0
"""Seconds within which the next request must arrive."""
REST_TIMEOUT_S = 10.0
"""Seconds within which the rest of a body must arrive after the reply.

If the server closed the connection while the client still writes, the client would lose the reply.
"""
MOST_LINE_BYTES = 4096
MOST_HEADERS = 64
"""Most header lines of a request. ROS clients send five."""
MOST_QUEUED_REQUESTS = 8
"""Most requests of a connection that wait for the reply to an earlier request."""


class BadBody(ValueError):
    """A request body that is not HTTP."""


class HttpReply:
    """A whole reply. ``reason``: the reason phrase, if not the usual one of the status.

    ``lines`` are further lines of the header. ``lasts``: whether the connection serves another
    request, if the client wants that.
    """

    __slots__ = ("body", "content_type", "lasts", "lines", "reason", "status")

    def __init__(
        self,
        body: bytes,
        status: int = 200,
        reason: str = "",
        content_type: str = "text/xml",
        lines: str = "",
        lasts: bool = True,
    ) -> None:
        self.body = body
        self.status = status
        self.reason = reason
        self.content_type = content_type
        self.lines = lines
        self.lasts = lasts


def text_reply(
    text: str, status: int = 200, reason: str = "", lines: str = "", lasts: bool = True
) -> HttpReply:
    """A reply with plain text."""
    return HttpReply(text.encode(), status, reason, "text/plain; charset=utf-8", lines, lasts)


class HttpRequest:
    """A request whose header has arrived. ``content`` is the stream of the body."""

    __slots__ = ("_message", "connection", "content", "headers", "method")

    def __init__(
        self, connection: "HttpConnection", message: RawRequestMessage, content: StreamReader
    ) -> None:
        self.connection = connection
        self.content = content
        self.headers = message.headers
        self.method = message.method
        self._message = message

    @property
    def path(self) -> str:
        """The path and the query."""
        url = self._message.url
        return str(url.relative() if url.absolute else url)

    @property
    def content_length(self) -> int | None:
        """The length of the body in bytes; None without ``Content-Length``."""
        length = self.headers.get("Content-Length")
        return None if length is None else int(length)

    def send_continue(self) -> None:
        """Send ``100 Continue`` if the client waits for that before sending the body."""
        waits = self.headers.get("Expect", "").lower() == "100-continue"
        if waits and self._message.version >= HttpVersion11:
            self.connection.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    async def begin(self, size: int) -> None:
        """Send the header of an XML-RPC document of ``size`` bytes. Raises ConnectionError."""
        await self.write(self._head(HttpReply(b""), size))

    async def write(self, data: bytes) -> None:
        """Send data, and wait until the client reads. Raises ConnectionError."""
        self.connection.write(data)
        await self.connection.drain()

    async def send(self, reply: HttpReply) -> None:
        """Send a whole reply. Raises ConnectionError."""
        head = self._head(reply, len(reply.body))
        self.connection.write_message(head, reply.body if self.method != "HEAD" else b"")
        await self.connection.drain()

    def reset(self) -> None:
        """Reset the connection, as if the server had gone. ROS clients then try again."""
        self.connection.reset()

    def _head(self, reply: HttpReply, size: int) -> bytes:
        if self._message.should_close or not reply.lasts:
            self.connection.close()
        return _head(self._message.version, self.connection.lasts, reply, size)


class HttpConnection(HttpProtocol):
    """A connection of a client.

    ``busy``: whether a request is being answered. ``source``: the address and port of the client.
    ``local``: the address and port of this machine.
    """

    def __init__(self, server: "HttpServer") -> None:
        loop = asyncio.get_running_loop()
        self._requests_parser = HttpRequestParser(
            self,
            loop,
            READ_AHEAD_BYTES,
            max_line_size=MOST_LINE_BYTES,
            max_field_size=MOST_LINE_BYTES,
            max_headers=MOST_HEADERS,
            payload_exception=BadBody,
            auto_decompress=False,
            max_msg_queue_size=MOST_QUEUED_REQUESTS,
        )
        super().__init__(loop, self._requests_parser)
        self.source = HostPort("", 0)
        self.local = HostPort("", 0)
        self.busy = False
        self._server = server
        self._requests: deque[tuple[RawRequestMessage, StreamReader]] = deque()
        self._content: StreamReader | None = None
        """The body of the request that is being answered."""
        self._arrival: asyncio.Future[None] | None = None
        self._is_closing = False
        """No further request is served."""
        self._has_last = False
        """The last request has arrived, and the server reads no further bytes."""
        self._fault = ""
        """Why the bytes after the last request are not HTTP."""
        self._idle_since = loop.time()
        self._idle_timer: asyncio.TimerHandle | None = None
        self.task: asyncio.Task[None] | None = None

    # What the event loop and the parser call

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to serve requests."""
        super().connection_made(transport)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.source = _host_port(transport.get_extra_info("peername"))
        self.local = _host_port(transport.get_extra_info("sockname"))
        self._idle_timer = self._loop.call_later(IDLE_TIMEOUT_S, self._close_if_idle)
        self._server.connection_made(self)
        self.task = self._loop.create_task(self._serve())

    def data_received(self, data: bytes) -> None:
        """Parse received bytes. aiohttp passes no bytes when the parser may go on."""
        if self._is_closing or self._has_last:
            return
        messages: Sequence[tuple[RawRequestMessage, StreamReader]] = ()
        try:
            messages, is_upgrade, _ = self._requests_parser.feed_data(data)
        except HttpProcessingError as error:
            self._fault = error.message or "not HTTP"
            self._has_last = True
        else:
            self._requests.extend(messages)
            self._has_last = is_upgrade  # the server has no other protocol
        if messages or self._has_last:
            wake(self._arrival)
        if len(self._requests) >= MOST_QUEUED_REQUESTS and not self._buffer_paused:
            self._pause_reading_for_buffer()

    def eof_received(self) -> None:
        """Return None, so that asyncio closes the connection: the client sends nothing more."""

    def connection_lost(self, exc: BaseException | None) -> None:
        """Forget the connection. A call under way runs to the end."""
        super().connection_lost(exc)
        self.close()
        if self._idle_timer is not None:
            self._idle_timer.cancel()
        if self._content is not None and not self._content.is_eof():
            self._content.set_exception(
                exc or ConnectionResetError("the client has closed the connection")
            )
        self._server.connection_lost(self)

    # What the server and the requests call

    @property
    def lasts(self) -> bool:
        """Whether the server serves another request after the current request."""
        return not self._is_closing and bool(self._requests or not self._has_last)

    def close(self) -> None:
        """Serve no further request, and end the connection after the current request."""
        self._is_closing = True
        wake(self._arrival)

    def force_close(self) -> None:
        """End the connection at once."""
        self.close()
        if self.transport is not None:
            self.transport.close()

    def reset(self) -> None:
        """Reset the connection."""
        self.close()
        if self.transport is not None:
            reset_on_close(self.transport.get_extra_info("socket"))
            self.transport.abort()

    async def _serve(self) -> None:
        try:
            while (request := await self._next()) is not None:
                await self._answer(request)
            if self._fault:
                reply = text_reply(f"{self._fault}\n", 400)
                head = _head(HttpVersion11, False, reply, len(reply.body))
                self.write_message(head, reply.body)
        except ConnectionError as error:
            log.debug("the client %s has closed the connection: %s", self.source, error)
        except Exception:
            log.exception("a request from %s failed", self.source)
        finally:
            self.force_close()

    async def _next(self) -> HttpRequest | None:
        """The next request; None if the server serves no further request."""
        while not (self._requests or self._has_last or self._is_closing):
            self._arrival = self._loop.create_future()
            await self._arrival
        if self._is_closing or not self._requests:
            return None
        message, content = self._requests.popleft()
        self._requests_parser.message_consumed()
        if self._buffer_paused and len(self._requests) <= MOST_QUEUED_REQUESTS // 2:
            self.data_received(b"")
            if len(self._requests) < MOST_QUEUED_REQUESTS:
                self._resume_reading_for_buffer()
        return HttpRequest(self, message, content)

    async def _answer(self, request: HttpRequest) -> None:
        self.busy = True
        self._content = request.content
        try:
            await self._server.answer(request)
            if not (request.content.is_eof() or self.gone):
                await self._skip_rest(request.content)
        finally:
            self.busy = False
            self._content = None
            self._idle_since = self._loop.time()

    async def _skip_rest(self, content: StreamReader) -> None:
        """Read and drop the rest of a body. After REST_TIMEOUT_S, serve no further request."""
        try:
            async with asyncio.timeout(REST_TIMEOUT_S):
                while not content.at_eof():
                    await content.readany()
        except (TimeoutError, BadBody):
            self.close()

    def _close_if_idle(self) -> None:
        idle_until = self._idle_since + IDLE_TIMEOUT_S
        now = self._loop.time()
        if self.busy:
            idle_until = now + IDLE_TIMEOUT_S
        if now >= idle_until:
            self.force_close()
        else:
            self._idle_timer = self._loop.call_at(idle_until, self._close_if_idle)


class HttpServer:
    """Serves connections. A subclass implements `answer`."""

    def __init__(self) -> None:
        self._connections: set[HttpConnection] = set()

    def __call__(self) -> HttpConnection:
        """The protocol of a new connection."""
        return HttpConnection(self)

    async def answer(self, request: HttpRequest) -> None:
        """Answer a request. A ConnectionError ends the connection."""
        raise NotImplementedError

    def connection_made(self, connection: HttpConnection) -> None:
        """Add a connection."""
        self._connections.add(connection)

    def connection_lost(self, connection: HttpConnection) -> None:
        """Forget a connection."""
        self._connections.discard(connection)

    async def shutdown(self, within: float) -> None:
        """Close all connections. Requests under way have ``within`` seconds to end."""
        connections = list(self._connections)
        for connection in connections:
            connection.close()
        tasks = [c.task for c in connections if c.task is not None]
        if tasks:
            _, late = await asyncio.wait(tasks, timeout=within)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)
        for connection in connections:
            connection.force_close()


def _host_port(sockname: object) -> HostPort:
    """The address and port in a socket address; empty and 0 if unknown."""
    match sockname:
        case [str(host), int(port), *_]:
            return HostPort(plain_address(host), port)
    return HostPort("", 0)


def _head(version: HttpVersion, lasts: bool, reply: HttpReply, size: int) -> bytes:
    """The header of a reply.

    ``Connection`` is present only if ``lasts`` differs from the default of the HTTP version.
    """
    start = _head_start(version, lasts, reply.status, reply.reason, reply.content_type)
    # roscpp finds the length only with a space after the colon (XmlRpcClient.cpp, readHeader).
    return f"{start}{reply.lines}Content-Length: {size}\r\n\r\n".encode()


@lru_cache
def _head_start(version: HttpVersion, lasts: bool, status: int, reason: str, kind: str) -> str:
    reason = reason or HTTPStatus(status).phrase
    start = f"HTTP/{version.major}.{version.minor} {status} {reason}\r\nContent-Type: {kind}\r\n"
    if lasts != (version >= HttpVersion11):
        start += f"Connection: {'keep-alive' if lasts else 'close'}\r\n"
    return start
