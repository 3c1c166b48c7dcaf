"""The server of XML-RPC: `rosproxy.net.http_server` reads requests, a service makes the replies.

Peers (ros_comm/utilities/xmlrpcpp, Python's xmlrpc.client) expect a Content-Length in every reply,
no chunks and no compression, and may call any path. Errors are XML-RPC faults with HTTP status 200.

Each document that a service reads is bounded (`limits`), and so is the sum of all documents in
memory (`Context.buffered`). Beyond a bound the server answers with HTTP 413 or 503. A long call
that a service need not read passes piece by piece (`long_calls`), and so do long replies. The
server refuses compressed requests, because ROS sends none. If a client reads nothing of its reply,
the kernel cuts the connection (`sockets.end_if_stalled`).
"""

import asyncio
import logging
import socket
from collections import defaultdict
from collections.abc import Awaitable, Callable
from functools import partial
from typing import TypeVar

from aiohttp import ClientError

from rosproxy.net.http_client import LongReply
from rosproxy.net.http_server import (
    BadBody,
    HttpConnection,
    HttpReply,
    HttpRequest,
    HttpServer,
    text_reply,
)
from rosproxy.net.time_limits import TimeLimit, TimeLimits
from rosproxy.ros1.clients.master_client import LOOP_HEADER, Unreachable
from rosproxy.ros1.context import MANY_VALUES, Context
from rosproxy.ros1.protocol.tcpros import speaks_http
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import passing
from rosproxy.ros1.protocol.xmlrpc.limits import Limits
from rosproxy.ros1.servers.long_calls import LongCall, LongCalls
from rosproxy.shared.addresses import parse_host_port
from rosproxy.shared.connections.budget import Charge, OverBudget
from rosproxy.shared.connections.sockets import end_if_stalled, hang_up, peek
from rosproxy.shared.http.bodies import TooLong, is_plain, read_bounded
from rosproxy.shared.settings import MEBIBYTE
from rosproxy.telemetry.metrics import Metrics

log = logging.getLogger(__name__)

BODY_TIMEOUT_S = 60.0
"""Seconds within which the body of a request must arrive."""
HEADER_TIMEOUT_S = 30.0
"""Seconds within which the header of the first request of a connection must arrive."""
STOP_TIMEOUT_S = 0.5
"""Seconds that calls under way have to end when the server stops."""
VALUE_BYTES = 400
"""Bytes of memory for each value of a document while the call is being answered."""

_Answer = TypeVar("_Answer")


class IncomingCall:
    """An XML-RPC request: the body, the source, and the address where it arrived.

    ``charge`` takes the number of further bytes that the call needs in memory until the answer.
    Raises OverBudget.
    """

    def __init__(self, request: HttpRequest, charge: Callable[[int], None]) -> None:
        self.body = b""
        self.charge = charge
        self._request = request
        self.source = request.connection.source.host
        self.local = request.connection.local
        self.host_header = request.headers.get("Host", "")
        self.loop_id = request.headers.get(LOOP_HEADER, "")

    @property
    def path(self) -> str:
        """The path of the request, with the query."""
        return self._request.path

    def comes_from(self, instance: str) -> bool:
        """Whether the proxy ``instance`` itself made this call."""
        return self.loop_id.partition(" ")[0] == instance

    @property
    def gone(self) -> bool:
        """Whether the caller has closed the connection."""
        return self._request.connection.gone

    @property
    def reached_locally(self) -> bool:
        """Whether the Host header names the local address and port of the connection.

        A neighbour that has the inside address of the proxy names this address. A caller that comes
        through a published port names the host instead.
        """
        return parse_host_port(self.host_header) == self.local


XmlRpcService = Callable[[IncomingCall], Awaitable[bytes | LongReply]]
"""Makes the reply to a call. Raises XmlRpcError for a fault, Unreachable for a reset."""


Guard = Callable[[str], Awaitable[str | None]]
"""Why the server refuses a source, in one line, before it reads a body; None to accept."""


async def count_reply(
    metrics: Metrics, api: str, method: str, reply: Awaitable[_Answer]
) -> _Answer:
    """Wait for the reply to a forwarded call, and count the result. Raises Unreachable."""
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


class XmlRpcServer(HttpServer):
    """Turns accepted sockets into XML-RPC calls to a service, if the guard accepts the source.

    ``limits`` apply to calls that the service reads. ``long_calls`` takes the calls that the
    service need not read. Without ``long_calls``, the service reads all calls.
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
        super().__init__()
        self._context = context
        self._service = service
        self._greeting = greeting
        self._limits = limits
        self._long_calls = long_calls
        self._guard = guard
        self._time_limits = TimeLimits()
        self._by_port: defaultdict[int, set[HttpConnection]] = defaultdict(set)
        self._mute: dict[HttpConnection, Callable[[], None]] = {}
        """Connections without a first request, each with the function that ends the gate's wait and
        the timer."""

    async def dispatch(
        self,
        conn: socket.socket,
        peer: str,
        relay: Callable[[socket.socket], Awaitable[None]] | None = None,
    ) -> None:
        """Serve a connection as HTTP, or give it to ``relay`` if it is TCPROS. No ``relay``: HTTP.

        In both protocols the client sends first, and the first four bytes decide: letters are an
        HTTP method, other bytes the length of a connection header. The server only peeks at these
        bytes. A connection that ends before the fourth byte is closed; without ``relay``, one that
        ends before the first byte. Raises TimeoutError, OSError.
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
        """The number of open connections that arrived at a port."""
        return len(self._by_port[port])

    def close_port(self, port: int) -> None:
        """End the connections that arrived at a port, busy connections after the current call."""
        for connection in list(self._by_port[port]):
            if connection.busy:
                connection.close()
            else:
                connection.force_close()

    async def close(self) -> None:
        """Close all connections."""
        await self.shutdown(STOP_TIMEOUT_S)

    def connection_made(self, connection: HttpConnection) -> None:
        """Record a connection by the port where it arrived, and wait for the first request."""
        super().connection_made(connection)
        port = connection.local.port
        source = connection.source.host
        self._by_port[port].add(connection)
        self._context.gate.enter(source, port)  # the acceptor counts until `dispatch` has ended
        spoke = self._context.gate.note_waiting(source, connection.force_close)
        timer = asyncio.get_running_loop().call_later(HEADER_TIMEOUT_S, connection.force_close)

        def end_wait() -> None:
            spoke()
            timer.cancel()  # a timer would keep the connection in memory after its end

        self._mute[connection] = end_wait

    def connection_lost(self, connection: HttpConnection) -> None:
        """Forget a connection."""
        super().connection_lost(connection)
        if end_wait := self._mute.pop(connection, None):
            end_wait()
        port = connection.local.port
        if connection in self._by_port[port]:
            self._by_port[port].discard(connection)
            self._context.gate.leave(connection.source.host, port)

    async def answer(self, request: HttpRequest) -> None:
        """Answer a request. Raises ConnectionError."""
        if end_wait := self._mute.pop(request.connection, None):
            end_wait()
        reply = await self._reply(request)
        if reply is not None:
            await request.send(reply)

    async def _reply(self, request: HttpRequest) -> HttpReply | None:
        """The reply to a request; None if the reply was sent, or if the connection was reset."""
        if request.method in ("GET", "HEAD"):  # never forwarded: roscpp's server hangs on a GET
            return text_reply(self._greeting)
        if request.method != "POST":
            return text_reply("XML-RPC uses POST\n", 405, lines="Allow: POST\r\n")
        source = request.connection.source.host
        denial = await self._guard(source) if self._guard else None
        if denial:  # rospy shows the reason phrase, other tools show the text
            return text_reply(f"{denial}\n", 403, denial, lasts=False)
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
        return text_reply(f"rosproxy: {text}\n", status)

    async def _answer(self, request: HttpRequest, call: IncomingCall) -> HttpReply | None:
        """Read a call, and send the answer; return a reply only for a malformed HTTP body.

        Raises HttpRefusal, OverBudget, ConnectionError.
        """
        try:
            answer = await self._read(request, call)
            reply = await (answer or self._service(call))
        except xmlrpc.XmlRpcError as error:
            reply = xmlrpc.dump_fault(error.code, f"rosproxy: {error}")
        except (ConnectionResetError, Unreachable) as error:
            log.debug("no answer for %s: %s", call.source, error)
            request.reset()
            return None
        except (HttpRefusal, OverBudget):
            raise
        except BadBody as error:
            return text_reply(f"{error}\n", 400)
        except Exception:
            log.exception("a call from %s failed in the proxy", call.source)
            reply = xmlrpc.dump_fault(
                xmlrpc.SYSTEM_ERROR, "rosproxy: internal error, see the proxy's log"
            )
        if isinstance(reply, LongReply):
            await self._send_long(request, call, reply)
            return None
        if len(reply) > passing.SHORT_BYTES:
            call.charge(len(reply))
        await request.send(HttpReply(reply))  # here, because the charge ends with this method
        return None

    async def _read(
        self, request: HttpRequest, call: IncomingCall
    ) -> Awaitable[bytes | LongReply] | None:
        """Read the body of a call. If the call passes unread, read only the head.

        Returns:
            The answer to a call that passes unread; None if the service has to read the call.

        Raises HttpRefusal, OverBudget.
        """
        if not is_plain(request.headers):
            text = "the request is compressed; send the request without compression"
            raise HttpRefusal(415, "compressed", text)
        try:
            size = request.content_length or 0
            if size <= passing.SHORT_BYTES and request.content.is_eof():  # arrived with the header
                await self._take_in(call, request.content.read_nowait())
                return self._pass_unread(request, call)
            with TimeLimit(self._time_limits, BODY_TIMEOUT_S):
                request.send_continue()
                if size > passing.SHORT_BYTES and self._long_calls is not None:
                    long_call = await self._read_head(request, call, size, self._long_calls)
                    if long_call is not None:
                        return self._pass_on(self._long_calls, call, long_call)
                if size > self._limits.size:
                    raise TooLong(self._limits.size)
                await self._read_rest(request, call)
        except TimeoutError:
            text = f"the body took over {BODY_TIMEOUT_S:g} s"
            raise HttpRefusal(408, "slow_body", text) from None
        except TooLong as error:
            raise HttpRefusal(413, "long_body", str(error)) from None
        return self._pass_unread(request, call)

    def _pass_unread(
        self, request: HttpRequest, call: IncomingCall
    ) -> Awaitable[bytes | LongReply] | None:
        """The answer to a call with too many elements to read, if the service need not read it."""
        service = self._long_calls
        limits = self._limits
        if service is None or not xmlrpc.exceeds_elements(call.body, limits):
            return None
        method = passing.method_of(call.body)
        watch = service.watch(method, limits.size + 1) if method else None  # like a long body
        if method is None or watch is None:
            return None
        long_call = LongCall(method, len(call.body), call.body, request.content, watch)
        return self._pass_on(service, call, long_call)

    async def _read_head(
        self, request: HttpRequest, call: IncomingCall, size: int, service: LongCalls
    ) -> LongCall | None:
        """Read the head of a long body, up to the method; the call if it passes, otherwise None.

        Raises TooLong, OverBudget.
        """
        while len(call.body) < passing.HEAD_BYTES and not request.content.at_eof():
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

    async def _read_rest(self, request: HttpRequest, call: IncomingCall) -> None:
        rest = await read_bounded(request.content, self._limits.size - len(call.body), call.charge)
        await self._take_in(call, call.body + rest, len(call.body) + len(rest))

    async def _take_in(self, call: IncomingCall, body: bytes, charged: int = 0) -> None:
        """Store a whole body, of which ``charged`` bytes are charged already.

        Raises TooLong, OverBudget.
        """
        if len(body) > self._limits.size:
            raise TooLong(self._limits.size)
        call.body = body
        values = body.count(b"<value")
        call.charge(len(body) - charged + VALUE_BYTES * values)
        if values > MANY_VALUES:
            await self._context.yield_to_others()

    async def _pass_on(
        self, service: LongCalls, call: IncomingCall, long_call: LongCall
    ) -> bytes | LongReply:
        with Charge(self._context.unread_calls, call.source) as charge:
            charge.add(1)
            return await service.pass_on(call, long_call)

    async def _send_long(self, request: HttpRequest, call: IncomingCall, reply: LongReply) -> None:
        """Forward a reply piece by piece. Raises OverBudget."""
        try:
            with Charge(self._context.unread_calls, call.source) as charge:
                charge.add(1)
                await request.begin(reply.size)
                async for piece in reply.pieces():
                    await request.write(piece)
        except (OSError, ClientError) as error:  # a TimeoutError is an OSError
            log.debug("a long reply for %s was cut: %s", call.source, error)
            request.reset()
        finally:
            reply.close()
