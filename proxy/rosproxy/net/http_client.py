"""The client's side of XML-RPC: POST over kept connections.

aiohttp's connection and parser do the work. Its ClientSession is left out: cookies, redirects,
proxies and the like take longer than all the rest of a call that is forwarded.
"""

import asyncio
import errno
import re
import time
from collections.abc import Mapping

import aiohttp
from aiohttp.client_proto import ResponseHandler

from rosproxy.net import resolver
from rosproxy.net.addresses import HostPort
from rosproxy.net.sockets import dial

MAX_BODY = 64 * 1024 * 1024
"""Longest XML-RPC body in bytes, either way."""
CONNECT_TIMEOUT = 2.0
SEPARATE_BODY = 64 * 1024
"""Bytes from which on a body is not copied to stand behind its header."""

_SENDABLE = re.compile(r"[^\x00-\x20\x7f]+")


class HttpClient:
    """Calls one kind of peer.

    ``headers`` are sent with each call. A connection that is not used for ``keepalive`` seconds is
    closed; there are never more than ``most`` in use. ``source`` is who gives the peers' names (see
    `resolver`). ``last`` is the address reached last.
    """

    def __init__(
        self, headers: Mapping[str, str], keepalive: float, most: int, source: str = ""
    ) -> None:
        self.last: str | None = None
        lines = {"Content-Type": "text/xml", "User-Agent": "rosproxy", **headers}
        self._headers = "".join(f"{name}: {text}\r\n" for name, text in lines.items())
        self._keepalive, self._limit = keepalive, asyncio.Semaphore(most)
        self._source = source
        self._idle: dict[HostPort, list[tuple[float, ResponseHandler]]] = {}
        self._used: set[ResponseHandler] = set()
        self._sweeper: asyncio.TimerHandle | None = None
        self._closed = False

    async def post(
        self, where: HostPort, path: str, host: str, body: bytes, within: float
    ) -> bytes:
        """A reply's body, within so many seconds; ``host`` is what the peer is called.

        All calls can be repeated without harm, so a kept connection that turns out to be closed
        costs one more try. Raises OSError, TimeoutError, aiohttp.ClientError, ValueError.
        """
        head = self._head(path, host, len(body))
        async with asyncio.timeout(within), self._limit:
            kept = self._take(where)
            if kept is not None:
                try:
                    return await self._exchange(where, kept, head, body)
                except (aiohttp.ClientError, ConnectionError) as error:
                    if not _was_closed(error):
                        raise
            return await self._exchange(where, await self._connect(where), head, body)

    async def close(self) -> None:
        """Close all connections."""
        self._closed = True
        if self._sweeper is not None:
            self._sweeper.cancel()
        for handler in [*self._used, *(one for idle in self._idle.values() for _, one in idle)]:
            handler.close()
        self._idle.clear()
        await asyncio.sleep(0)

    def _head(self, path: str, host: str, size: int) -> bytes:
        if not (_SENDABLE.fullmatch(path) and _SENDABLE.fullmatch(host)):
            raise ValueError(f"{host}{path} can't be asked for")
        first = f"POST {path} HTTP/1.1\r\nHost: {host}\r\n"
        return f"{first}{self._headers}Content-Length: {size}\r\n\r\n".encode()

    async def _exchange(
        self, where: HostPort, handler: ResponseHandler, head: bytes, body: bytes
    ) -> bytes:
        self._used.add(handler)
        try:
            handler.set_response_params(read_until_eof=True)
            if handler.transport is None:
                raise aiohttp.ServerDisconnectedError
            for piece in pieces(head, body):
                handler.transport.write(piece)
            reply = await _answer(handler)
        except BaseException:
            handler.close()
            raise
        finally:
            self._used.discard(handler)
        self._keep(where, handler)
        return reply

    async def _connect(self, where: HostPort) -> ResponseHandler:
        """A new connection; never redirected or led elsewhere than to ``where``."""
        if self._closed:
            raise ConnectionAbortedError("the proxy is stopping")
        loop = asyncio.get_running_loop()
        failure = OSError(None, f"host name {where.host} can't be resolved")
        for address in await resolver.resolve(where.host, self._source):
            try:
                sock = await dial(HostPort(address, where.port), CONNECT_TIMEOUT)
            except OSError as error:
                failure = error
                continue
            _, handler = await loop.create_connection(lambda: ResponseHandler(loop), sock=sock)
            self.last = address
            return handler
        raise failure

    def _take(self, where: HostPort) -> ResponseHandler | None:
        """The connection that was used last, if one is left that can still be used."""
        idle = self._idle.get(where, [])
        while idle:
            _, handler = idle.pop()
            if handler.is_connected() and not handler.should_close:
                return handler
            handler.close()
        return None

    def _keep(self, where: HostPort, handler: ResponseHandler) -> None:
        if handler.should_close or not handler.is_connected() or self._closed:
            handler.close()
            return
        self._idle.setdefault(where, []).append((time.monotonic(), handler))
        if self._sweeper is None:
            loop = asyncio.get_running_loop()
            self._sweeper = loop.call_later(self._keepalive, self._sweep)

    def _sweep(self) -> None:
        """Close what was not used for long."""
        before, self._sweeper = time.monotonic() - self._keepalive, None
        for where, idle in self._idle.items():
            for _, handler in (old for old in idle if old[0] <= before):
                handler.close()
            self._idle[where] = [one for one in idle if one[0] > before]
        self._idle = {where: idle for where, idle in self._idle.items() if idle}
        if self._idle:
            loop = asyncio.get_running_loop()
            self._sweeper = loop.call_later(self._keepalive / 2, self._sweep)


def pieces(head: bytes, body: bytes) -> tuple[bytes, ...]:
    """What to write one after the other: both at once, unless that would copy a long body."""
    return (head + body,) if len(body) < SEPARATE_BODY else (head, body)


async def _answer(handler: ResponseHandler) -> bytes:
    """The body of a response with status 200."""
    try:
        message, payload = await handler.read()
        while 100 <= message.code < 200:
            message, payload = await handler.read()
    except aiohttp.http.HttpProcessingError as error:
        raise ValueError(f"no HTTP: {error.message}") from error
    if message.code != 200:
        raise ValueError(f"HTTP status {message.code}")
    return await read_bounded(payload)


async def read_bounded(stream: aiohttp.StreamReader) -> bytes:
    """All of a body. Raises ValueError if it is longer than MAX_BODY."""
    parts, size = list[bytes](), 0
    while not stream.at_eof():
        part = stream.read_nowait() if stream.is_eof() else await stream.readany()
        size += len(part)
        if size > MAX_BODY:
            raise ValueError(f"a body of more than {MAX_BODY} bytes")
        parts.append(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _was_closed(error: BaseException) -> bool:
    """Whether the peer had closed the connection, or reset it."""
    closed = aiohttp.ServerDisconnectedError, ConnectionResetError, BrokenPipeError
    number = error.errno if isinstance(error, OSError) else None
    return isinstance(error, closed) or number in (errno.ECONNRESET, errno.EPIPE)
