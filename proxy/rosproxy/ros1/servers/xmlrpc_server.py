"""The HTTP server of XML-RPC: aiohttp reads requests, a service makes the replies.

What peers expect (ros_comm/utilities/xmlrpcpp, Python's xmlrpc.client): a Content-Length always,
no chunks, no compression, any path. Errors are XML-RPC faults with HTTP status 200.

What a service reads is bounded (`limits`), and what all servers hold together (`Context.buffered`);
over it a request is answered with HTTP 413 or 503. A long call that a service need not read passes
piece by piece (`long_calls`), as do long replies. Compressed requests are refused: ROS sends none.
A client that takes nothing of its reply is cut by the kernel (`sockets.end_if_stalled`).
"""

import asyncio
import logging
import socket
from collections import defaultdict
from collections.abc import Awaitable, Callable
from functools import lru_cache, partial
from typing import Any, TypeVar

import aiohttp
from aiohttp import web

from rosproxy.net.addresses import HostPort, parse_host_port, plain_address
from rosproxy.net.budget import Charge, OverBudget
from rosproxy.net.http_client import LongReply, TooLong, is_plain, read_bounded
from rosproxy.net.sockets import end_if_stalled, hang_up, peek
from rosproxy.ros1.clients.master_client import LOOP_HEADER, Unreachable
from rosproxy.ros1.context import MANY_VALUES, Context
from rosproxy.ros1.protocol.tcpros import speaks_http
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.limits import Limits
from rosproxy.ros1.servers.long_calls import LongCall, LongCalls
from rosproxy.ros1.servers.replies import DocumentReply, invite, refuse
from rosproxy.settings import MEBIBYTE
from rosproxy.telemetry.metrics import Metrics

log = logging.getLogger(__name__)

BODY_TIMEOUT = 60.0
"""Seconds in which a request's body must arrive."""
HEADER_TIMEOUT = 30.0
"""Seconds in which the header of a connection's first request must arrive."""
STOP_TIMEOUT = 0.5
"""Seconds that calls under way get to end when the server stops."""
READ_AHEAD = 64 * 1024
"""Bytes of a body that wait to be read, before the client has to wait."""
MOST_LINE = 4096
MOST_FIELDS = 64
"""Longest line of a request's header in bytes, and how many fields it has: ROS's have five."""
VALUE = 400
"""Bytes of memory that a value of a document takes while its call is answered."""

_Answer = TypeVar("_Answer")


class IncomingCall:
    """One XML-RPC request: its body, who sent it and where it arrived.

    ``charge`` is told how many bytes more the call takes in memory until it is answered; it raises
    OverBudget.
    """

    def __init__(self, request: web.BaseRequest, hold: Callable[[int], None]) -> None:
        protocol = request.protocol
        self.body = b""
        self.charge = hold
        self._request = request
        self.source = _source(request)
        self.local = _address(protocol.sockname)
        self.host_header = request.headers.get("Host", "")
        self.loop_id = request.headers.get(LOOP_HEADER, "")

    @property
    def path(self) -> str:
        """The path that is called, with what follows a question mark."""
        return self._request.path_qs

    def comes_from(self, instance: str) -> bool:
        """Whether a proxy itself made this call."""
        return self.loop_id.partition(" ")[0] == instance

    @property
    def gone(self) -> bool:
        """Whether the caller has closed the connection."""
        return self._request.transport is None

    @property
    def reached_locally(self) -> bool:
        """Whether the caller named the very address and port of this machine that it reached.

        So does a neighbour that was given the proxy's inside address; whoever comes through a
        published port names the host instead.
        """
        return parse_host_port(self.host_header) == self.local


XmlRpcService = Callable[[IncomingCall], Awaitable[bytes | LongReply]]
"""Makes the reply to a call. Raises XmlRpcError for a fault, Unreachable for a reset."""


Guard = Callable[[str], Awaitable[str | None]]
"""Why a source's calls are refused, in one line, before they are read; None if they are not."""


async def count_reply(
    metrics: Metrics, api: str, method: str, reply: Awaitable[_Answer]
) -> _Answer:
    """A forwarded call's reply, once it is counted whether there was one. Raises Unreachable."""
    try:
        answer = await reply
    except Unreachable:
        metrics.count(api, method, "unreachable")
        raise
    metrics.count(api, method, "answered")
    return answer


class HttpRefusal(Exception):
    """A request that is refused with an HTTP status; ``reason`` is a word for the metric."""

    def __init__(self, status: int, reason: str, text: str) -> None:
        super().__init__(text)
        self.status = status
        self.reason = reason


class XmlRpcServer(web.Server):
    """Turns accepted sockets into XML-RPC calls to a service, for those whom the guard lets in.

    ``limits`` are those of calls that the service reads; ``long_calls`` take those that it need not
    read; without, all are read.
    """

    def __init__(
        self,
        context: Context,
        service: XmlRpcService,
        greeting: str,
        limits: Limits,
        long_calls: LongCalls | None = None,
        guard: Guard | None = None,
    ) -> None:
        super().__init__(
            self._handle,
            access_log=None,
            keepalive_timeout=75,
            auto_decompress=False,
            read_bufsize=READ_AHEAD,
            max_line_size=MOST_LINE,
            max_field_size=MOST_LINE,
            max_headers=MOST_FIELDS,
        )
        self._context = context
        self._service = service
        self._greeting = greeting
        self._limits = limits
        self._long_calls = long_calls
        self._guard = guard
        self._by_port: defaultdict[int, set[web.RequestHandler]] = defaultdict(set)
        self._busy: set[web.RequestHandler] = set()
        self._mute: dict[web.RequestHandler, Callable[[], None]] = {}

    async def dispatch(
        self,
        conn: socket.socket,
        peer: str,
        relay: Callable[[socket.socket], Awaitable[None]] | None = None,
    ) -> None:
        """Take a connection over, or hand it to ``relay`` if it is TCPROS; without, all is HTTP.

        In both protocols the client speaks first, and four bytes tell them apart: letters are an
        HTTP method, anything else the length of a connection header. They are only peeked at. One
        that ends before it has said anything is closed. Raises TimeoutError, OSError.
        """
        with self._context.gate.waiting(peer, partial(hang_up, conn)):
            first = await peek(conn, 4)
        if first and (relay is None or speaks_http(first)):
            end_if_stalled(conn)
            await asyncio.get_running_loop().connect_accepted_socket(self, sock=conn)
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
        """Know a connection by the port that it came in on, and wait for its first request."""
        super().connection_made(handler, transport)
        port = _address(handler.sockname).port
        source = _address(handler.peername).host
        self._by_port[port].add(handler)
        self._context.gate.enter(source, port)  # the acceptor counts until `dispatch` has ended
        self._mute[handler] = self._context.gate.wait(source, handler.force_close)
        asyncio.get_running_loop().call_later(HEADER_TIMEOUT, self._close_mute, handler)

    def connection_lost(
        self, handler: web.RequestHandler, exc: BaseException | None = None
    ) -> None:
        """Forget a connection."""
        super().connection_lost(handler, exc)
        self._mute.pop(handler, _nothing)()
        port = _address(handler.sockname).port
        if handler in self._by_port[port]:
            self._by_port[port].discard(handler)
            self._context.gate.leave(_address(handler.peername).host, port)

    def _close_mute(self, handler: web.RequestHandler) -> None:
        if handler in self._mute:
            self._mute.pop(handler)()
            handler.force_close()

    async def _handle(self, request: web.BaseRequest) -> web.StreamResponse:
        self._mute.pop(request.protocol, _nothing)()
        self._busy.add(request.protocol)
        try:
            return await self._respond(request)
        finally:
            self._busy.discard(request.protocol)

    async def _respond(self, request: web.BaseRequest) -> web.StreamResponse:
        if request.method in ("GET", "HEAD"):  # never forwarded: roscpp's server hangs on a GET
            return web.Response(text=self._greeting)
        if request.method != "POST":
            return web.Response(status=405, text="XML-RPC uses POST\n", headers={"Allow": "POST"})
        source = _source(request)
        denial = await self._guard(source) if self._guard else None
        if denial:
            return _forbid(denial)
        try:
            with Charge(self._context.buffered, source) as charge:
                return await self._answer(request, IncomingCall(request, charge.add))
        except HttpRefusal as refusal:
            status = refusal.status
            reason = refusal.reason
            text = str(refusal)
        except OverBudget as error:
            status = 503
            reason = "over_budget"
            text = str(error)
        self._context.refusals.note(reason, source, text)
        return web.Response(status=status, text=f"rosproxy: {text}\n")

    async def _answer(self, request: web.BaseRequest, call: IncomingCall) -> web.StreamResponse:
        """Read a call, and send the reply. Raises HttpRefusal, OverBudget."""
        try:
            answer = await self._read(request, call)
            reply = await (answer or self._service(call))
        except xmlrpc.XmlRpcError as error:
            reply = xmlrpc.dump_fault(error.code, f"rosproxy: {error}")
        except (ConnectionResetError, Unreachable) as error:
            log.debug("no answer for %s: %s", request.remote, error)
            return refuse(request)
        except (HttpRefusal, OverBudget):
            raise
        except web.RequestPayloadError as error:
            return web.Response(status=400, text=f"{error}\n")
        except Exception:
            log.exception("a call from %s failed in the proxy", request.remote)
            reply = xmlrpc.dump_fault(
                xmlrpc.SYSTEM_ERROR, "rosproxy: internal error, see the proxy's log"
            )
        if isinstance(reply, LongReply):
            return await self._send_long(request, call, reply)
        if len(reply) > passing.SHORT:
            call.charge(len(reply))
        return await _send(request, DocumentReply(reply))

    async def _read(
        self, request: web.BaseRequest, call: IncomingCall
    ) -> Awaitable[bytes | LongReply] | None:
        """Read a call's body; the answer to one that passes, of which only the head is read.

        Raises HttpRefusal, OverBudget.
        """
        if not is_plain(request.headers):
            text = "the request is compressed; send the request without compression"
            raise HttpRefusal(415, "compressed", text)
        try:
            size = request.content_length or 0
            if size <= passing.SHORT and request.content.is_eof():  # it came with the header
                await self._take_in(call, request.content.read_nowait())
                return self._pass_unread(request, call)
            async with asyncio.timeout(BODY_TIMEOUT):
                invite(request)
                if size > passing.SHORT and self._long_calls is not None:
                    long_call = await self._read_head(request, call, size, self._long_calls)
                    if long_call is not None:
                        return self._pass_on(self._long_calls, call, long_call)
                if size > self._limits.size:
                    raise TooLong(self._limits.size)
                await self._read_rest(request, call)
        except TimeoutError:
            text = f"the body took over {BODY_TIMEOUT:g} s"
            raise HttpRefusal(408, "slow_body", text) from None
        except TooLong as error:
            raise HttpRefusal(413, "long_body", str(error)) from None
        return self._pass_unread(request, call)

    def _pass_unread(
        self, request: web.BaseRequest, call: IncomingCall
    ) -> Awaitable[bytes | LongReply] | None:
        """The answer to a whole call with more elements than are read, if it need not be read."""
        service = self._long_calls
        limits = self._limits
        if service is None or not xmlrpc.exceeds_elements(call.body, limits):
            return None
        method = passing.method_of(call.body)
        watch = service.watch(method, limits.size + 1) if method else None  # as one too long
        if method is None or watch is None:
            return None
        long_call = LongCall(method, len(call.body), call.body, request.content, watch)
        return self._pass_on(service, call, long_call)

    async def _read_head(
        self, request: web.BaseRequest, call: IncomingCall, size: int, service: LongCalls
    ) -> LongCall | None:
        """Read so much of a long body that its method is known; the call if it passes.

        Raises TooLong, OverBudget.
        """
        while len(call.body) < passing.HEAD and not request.content.at_eof():
            chunk = await request.content.readany()
            call.charge(len(chunk))
            call.body += chunk
        method = passing.method_of(call.body)
        watch = service.watch(method, size) if method else None
        if method is None or watch is None:
            return None
        longest = self._context.settings.max_body * MEBIBYTE
        if size > longest:
            raise TooLong(longest)
        return LongCall(method, size, call.body, request.content, watch)

    async def _read_rest(self, request: web.BaseRequest, call: IncomingCall) -> None:
        rest = await read_bounded(request.content, self._limits.size - len(call.body), call.charge)
        await self._take_in(call, call.body + rest, len(call.body) + len(rest))

    async def _take_in(self, call: IncomingCall, body: bytes, charged: int = 0) -> None:
        """Take in a whole body, of which ``charged`` bytes are held already. Raises TooLong."""
        if len(body) > self._limits.size:
            raise TooLong(self._limits.size)
        call.body = body
        values = body.count(b"<value")
        call.charge(len(body) - charged + VALUE * values)
        if values > MANY_VALUES:
            await self._context.yield_to_others()

    async def _pass_on(
        self, service: LongCalls, call: IncomingCall, long_call: LongCall
    ) -> bytes | LongReply:
        with Charge(self._context.unread_calls, call.source) as charge:
            charge.add(1)
            return await service.pass_on(call, long_call)

    async def _send_long(
        self, request: web.BaseRequest, call: IncomingCall, reply: LongReply
    ) -> web.StreamResponse:
        """Send a reply on, piece by piece. Raises OverBudget."""
        response = DocumentReply(b"", reply.size)
        try:
            with Charge(self._context.unread_calls, call.source) as charge:
                charge.add(1)
                await response.prepare(request)
                async for piece in reply.pieces():
                    await request.writer.write(piece)
        except (OSError, aiohttp.ClientError) as error:  # a time-out is one of the former
            log.debug("a long reply for %s was cut: %s", request.remote, error)
            return refuse(request)
        finally:
            reply.close()
        return response


def _nothing() -> None:
    pass


@lru_cache(maxsize=1024)
def _address(sockname: Any) -> HostPort:
    return HostPort(plain_address(sockname[0]), sockname[1]) if sockname else HostPort("", 0)


def _source(request: web.BaseRequest) -> str:
    return _address(request.protocol.peername).host


def _forbid(text: str) -> web.StreamResponse:
    """The answer to somebody who is not let in; rospy shows the reason phrase, people the text."""
    response = web.Response(status=403, reason=text, text=f"{text}\n")
    response.force_close()
    return response


async def _send(request: web.BaseRequest, response: DocumentReply) -> DocumentReply:
    """Send a reply; that nobody is there any more the server sees for itself."""
    try:
        await response.prepare(request)
    except ConnectionError as error:
        log.debug("the caller %s has closed the connection: %s", request.remote, error)
    return response
