"""The HTTP server of XML-RPC: aiohttp reads requests, a service makes the replies.

What peers expect (ros_comm/utilities/xmlrpcpp, Python's xmlrpc.client): a Content-Length always,
no chunks, no compression, any path. Errors are XML-RPC faults with HTTP status 200.
"""

import asyncio
import logging
import socket
from collections import defaultdict
from collections.abc import Awaitable, Callable
from functools import lru_cache
from typing import Any

from aiohttp import HttpVersion, HttpVersion11, web

from rosproxy.net.addresses import HostPort, parse_host_port, plain_address
from rosproxy.net.http_client import pieces, read_bounded
from rosproxy.net.sockets import peek, reset_on_close
from rosproxy.ros1.clients.master import LOOP_HEADER, Unreachable
from rosproxy.ros1.protocol.tcpros import speaks_http
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.telemetry.metrics import Metrics

log = logging.getLogger(__name__)

BODY_TIMEOUT = 60.0
"""Seconds in which a request's body must arrive."""
HEADER_TIMEOUT = 30.0
"""Seconds in which the header of a connection's first request must arrive."""
STOP_TIMEOUT = 0.5
"""Seconds that calls under way get to end when the server stops."""


class IncomingCall:
    """One XML-RPC request: its body, who sent it and where it arrived."""

    def __init__(self, request: web.BaseRequest, body: bytes) -> None:
        protocol = request.protocol
        self.body = body
        self.path = request.path_qs
        self.source = _source(request)
        self.local = _address(protocol.sockname)
        self.host_header = request.headers.get("Host", "")
        self.loop_id = request.headers.get(LOOP_HEADER, "")

    def comes_from(self, instance: str) -> bool:
        """Whether a proxy itself made this call."""
        return self.loop_id.partition(" ")[0] == instance

    @property
    def reached_locally(self) -> bool:
        """Whether the caller named the very address and port of this machine that it reached.

        So does a neighbour that was given the proxy's inside address; whoever comes through a
        published port names the host instead.
        """
        return parse_host_port(self.host_header) == self.local


XmlRpcService = Callable[[IncomingCall], Awaitable[bytes]]
"""Makes the reply to a call. Raises XmlRpcError for a fault, Unreachable for a reset."""


Guard = Callable[[str], Awaitable[str | None]]
"""Why a source's calls are refused, in one line, before they are read; None if they are not."""


async def counted(metrics: Metrics, api: str, method: str, reply: Awaitable[bytes]) -> bytes:
    """A forwarded call's reply, once it is counted whether there was one. Raises Unreachable."""
    try:
        answer = await reply
    except Unreachable:
        metrics.count(api, method, "unreachable")
        raise
    metrics.count(api, method, "answered")
    return answer


class XmlRpcServer(web.Server):
    """Turns accepted sockets into XML-RPC calls to a service, for those whom the guard lets in."""

    def __init__(self, service: XmlRpcService, greeting: str, guard: Guard | None = None) -> None:
        super().__init__(self._handle, access_log=None, keepalive_timeout=75)
        self._service, self._greeting, self._guard = service, greeting, guard
        self._by_port: defaultdict[int, set[web.RequestHandler]] = defaultdict(set)
        self._busy: set[web.RequestHandler] = set()
        self._mute: set[web.RequestHandler] = set()

    async def dispatch(
        self, conn: socket.socket, relay: Callable[[socket.socket], Awaitable[None]] | None = None
    ) -> None:
        """Take a connection over, or hand it to ``relay`` if it is TCPROS; without, all is HTTP.

        In both protocols the client speaks first, and four bytes tell them apart: letters are an
        HTTP method, anything else the length of a connection header. They are only peeked at. One
        that ends before it has said anything is closed. Raises TimeoutError, OSError.
        """
        first = await peek(conn, 4)
        if first and (relay is None or speaks_http(first)):
            await self._serve(conn)
        elif len(first) < 4 or relay is None:
            conn.close()
        else:
            await relay(conn)

    def count(self, port: int) -> int:
        """How many connections are open that came in on a port."""
        return len(self._by_port[port])

    def close_port(self, port: int) -> None:
        """Let the connections that came in on a port end with the calls that they carry now."""
        for handler in list(self._by_port[port]):
            if handler in self._busy:
                handler.close()
            else:
                handler.force_close()

    async def close(self) -> None:
        """Close all connections."""
        await self.shutdown(STOP_TIMEOUT)

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Know a connection by the port that it came in on."""
        super().connection_made(handler, transport)
        self._by_port[_address(handler.sockname).port].add(handler)

    def connection_lost(
        self, handler: web.RequestHandler, exc: BaseException | None = None
    ) -> None:
        """Forget a connection."""
        super().connection_lost(handler, exc)
        self._by_port[_address(handler.sockname).port].discard(handler)

    async def _serve(self, conn: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        _, handler = await loop.connect_accepted_socket(self, sock=conn)
        self._mute.add(handler)
        loop.call_later(HEADER_TIMEOUT, self._close_mute, handler)

    def _close_mute(self, handler: web.RequestHandler) -> None:
        if handler in self._mute:
            self._mute.discard(handler)
            handler.force_close()

    async def _handle(self, request: web.BaseRequest) -> web.StreamResponse:
        self._mute.discard(request.protocol)
        self._busy.add(request.protocol)
        try:
            return await self._respond(request)
        finally:
            self._busy.discard(request.protocol)

    async def _respond(self, request: web.BaseRequest) -> web.StreamResponse:
        if request.method in ("GET", "HEAD"):
            return web.Response(text=self._greeting)
        if request.method != "POST":
            return web.Response(status=405, text="XML-RPC uses POST\n", headers={"Allow": "POST"})
        refused = await self._guard(_source(request)) if self._guard else None
        if refused:
            return _forbid(refused)
        body = await _body(request)
        if not isinstance(body, bytes):
            return body
        try:
            reply = await self._service(IncomingCall(request, body))
        except xmlrpc.XmlRpcError as error:
            reply = xmlrpc.dump_fault(error.code, f"rosproxy: {error}")
        except Unreachable as error:
            log.debug("no answer for %s: %s", request.remote, error)
            return _refuse(request)
        except Exception:
            log.exception("a call from %s failed in the proxy", request.remote)
            reply = xmlrpc.dump_fault(xmlrpc.SYSTEM_ERROR, "rosproxy: internal error, see its log")
        return _Reply(reply)


class _Reply(web.StreamResponse):
    """An XML-RPC document with status 200.

    Its header is written here: aiohttp takes about as long for one as reading a document takes.
    """

    def __init__(self, document: bytes) -> None:
        super().__init__()
        self._document = document
        self._lasts = False

    @property
    def keep_alive(self) -> bool:
        """Whether the connection serves another request."""
        return self._lasts

    async def prepare(self, request: web.BaseRequest) -> None:
        """Send it all. Raises ConnectionError."""
        self._lasts = request.keep_alive
        head = _head(request.version, self._lasts, len(self._document))
        for piece in pieces(head, self._document):
            await request.writer.write(piece)
        await request.writer.drain()

    async def write_eof(self, data: bytes = b"") -> None:
        """Nothing is left to send."""


def _head(version: HttpVersion, lasts: bool, size: int) -> bytes:
    """A reply's header; that the connection lasts is said where HTTP's version doesn't imply it."""
    lines = f"HTTP/{version.major}.{version.minor} 200 OK\r\nContent-Type: text/xml\r\n"
    if lasts != (version >= HttpVersion11):
        lines += f"Connection: {'keep-alive' if lasts else 'close'}\r\n"
    return f"{lines}Content-Length: {size}\r\n\r\n".encode()


@lru_cache(maxsize=1024)
def _address(found: Any) -> HostPort:
    return HostPort(plain_address(found[0]), found[1]) if found else HostPort("", 0)


def _source(request: web.BaseRequest) -> str:
    return _address(request.protocol.peername).host


def _forbid(text: str) -> web.StreamResponse:
    """The answer to somebody who is not let in; rospy shows the reason phrase, people the text."""
    response = web.Response(status=403, reason=text, text=f"{text}\n")
    response.force_close()
    return response


async def _body(request: web.BaseRequest) -> bytes | web.StreamResponse:
    """A request's body, or the response to one that can't be read."""
    try:
        if request.content.is_eof():  # it came together with the header
            return await read_bounded(request.content)
        async with asyncio.timeout(BODY_TIMEOUT):
            _invite(request)
            return await read_bounded(request.content)
    except TimeoutError:
        return web.Response(status=408, text=f"the body took over {BODY_TIMEOUT:g} s\n")
    except ValueError as error:
        return web.Response(status=413, text=f"{error}\n")
    except web.RequestPayloadError as error:
        return web.Response(status=400, text=f"{error}\n")
    except ConnectionResetError:
        return _refuse(request)


def _invite(request: web.BaseRequest) -> None:
    """Ask for the body, if the client waits to be asked."""
    waits = request.headers.get("Expect", "").lower() == "100-continue"
    if waits and request.version >= HttpVersion11 and request.transport is not None:
        request.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")


def _refuse(request: web.BaseRequest) -> web.StreamResponse:
    """Reset the connection: what a caller finds whose peer is gone; ROS's clients try again."""
    transport = request.transport
    if transport is not None:
        reset_on_close(transport.get_extra_info("socket"))
        transport.abort()
    return web.Response(status=503)
