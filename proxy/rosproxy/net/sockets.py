"""TCP sockets: bound, listening, accepted, connected, looked into and closed.

Everything here is non-blocking and belongs to one event loop. A reserved socket refuses connections
and keeps its port from everybody else until it listens (`reserve`, `listen_on`); `leases` builds on
that.
"""

import asyncio
import contextlib
import errno
import logging
import socket
import struct
from collections.abc import Awaitable, Callable
from functools import partial

from rosproxy.net.addresses import HostPort, plain_address
from rosproxy.net.gate import Gate
from rosproxy.net.tasks import Tasks

log = logging.getLogger(__name__)

BACKLOG = 1024
"""Connections that wait to be accepted: the client of one more waits a second and tries again."""
ACCEPTS_PER_TURN = 64
CONNECT_TIMEOUT = 5.0
"""Seconds that a peer has to accept a connection."""
WRITE_TIMEOUT = 30.0
"""Seconds in which a reader has to take something of what is waiting for it."""
SILENCE_TIMEOUT = 30.0
"""Seconds in which a client has to send what is waited for before its connection is closed."""

Handler = Callable[[socket.socket, str], Awaitable[None]]
"""Takes over an accepted socket; the second argument is the peer's address."""

# struct linger (socket(7)): on, with a time of 0, for which close() sends a reset.
_LINGER_RESET = struct.pack("ii", 1, 0)


def bind(address: str, port: int) -> socket.socket:
    """A bound, non-blocking TCP socket that does not listen yet. Raises OSError."""
    family = _family(address)
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            # `::` is for IPv4, too, whatever net.ipv6.bindv6only says (ipv6(7)).
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.bind((address, port))
    except OSError:
        sock.close()
        raise
    sock.setblocking(False)
    return sock


def reserve(address: str, port: int) -> socket.socket:
    """A bound socket that refuses connections, and whose port nobody else can bind. Raises OSError.

    A socket that is only bound does not keep others out. It needs SO_REUSEADDR, or connections that
    linger from a former process would be in its way; but with that option any number of sockets may
    be bound to one port, as long as none listens. Linux asks both sockets for the option when the
    second one is bound, so it is taken off once the port is had. Whether it is had shows when the
    socket listens, since Linux then looks again who has the port. After ``shutdown`` the socket
    listens no more and is still bound.
    """
    sock = bind(address, port)
    try:
        sock.listen(1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        sock.shutdown(socket.SHUT_RDWR)
    except OSError:
        sock.close()
        raise
    return sock


def listen_on(sock: socket.socket) -> None:
    """Let a reserved socket listen. Raises OSError.

    Its connections are to keep nobody from binding the port later, so they get SO_REUSEADDR.
    """
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.listen(BACKLOG)


def listen(address: str, port: int) -> socket.socket:
    """A listening, non-blocking TCP socket. Raises OSError."""
    sock = bind(address, port)
    sock.listen(BACKLOG)
    return sock


class Acceptor:
    """Accepts on a listening socket until it is closed; each connection has a task of its own.

    The handler takes it over; an exception that ends the handler closes it. With a ``gate``, one
    too many is reset, and each is counted until the handler has ended.
    """

    def __init__(
        self, tasks: Tasks, sock: socket.socket, handler: Handler, gate: Gate | None = None
    ) -> None:
        self._tasks = tasks
        self._sock = sock
        self._handler = handler
        self._gate = gate
        self._port = sock.getsockname()[1]
        self._loop = asyncio.get_running_loop()
        self._pause: asyncio.TimerHandle | None = None
        self._listen()

    def close(self) -> None:
        """Stop accepting, and close the socket; connections stay."""
        self._loop.remove_reader(self._sock)
        if self._pause is not None:
            self._pause.cancel()
        self._sock.close()

    def _listen(self) -> None:
        self._loop.add_reader(self._sock, self._accept)

    def _accept(self) -> None:
        try:
            for _ in range(ACCEPTS_PER_TURN):
                conn, peer = self._sock.accept()
                conn.setblocking(False)
                source = plain_address(peer[0])
                if self._gate is not None and not self._gate.admits(source, self._port):
                    reset_on_close(conn)
                    conn.close()
                    continue
                task = self._tasks.spawn(self._serve(conn, source), f"connection from {source}")
                task.add_done_callback(partial(_close_if_cancelled, conn))
                if self._gate is not None:
                    self._gate.enter(source, self._port)
                    task.add_done_callback(partial(_leave, self._gate, source, self._port))
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                log.error("out of file descriptors: raise the limit (ulimit -n) of the proxy")
            # The socket would stay readable: look again later.
            self._loop.remove_reader(self._sock)
            self._pause = self._loop.call_later(0.1, self._listen)

    async def _serve(self, conn: socket.socket, peer: str) -> None:
        try:
            conn.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            await self._handler(conn, peer)
        except (OSError, EOFError, TimeoutError) as error:
            log.debug("connection from %s ended: %s", peer, error)
            conn.close()
        except BaseException:
            conn.close()
            raise


def _close_if_cancelled(conn: socket.socket, task: asyncio.Task[None]) -> None:
    """A task that is cancelled before it has begun never gets to close its connection."""
    if task.cancelled():
        conn.close()


def _leave(gate: Gate, source: str, port: int, _: asyncio.Task[None]) -> None:
    gate.leave(source, port)


def begin_to_dial(target: HostPort) -> socket.socket:
    """A non-blocking connection to an IP address and port, under way. Raises OSError.

    What is sent before it is made raises BlockingIOError, or what has become of it.
    """
    sock = socket.socket(_family(target.host), socket.SOCK_STREAM)
    sock.setblocking(False)
    try:
        with contextlib.suppress(BlockingIOError):
            sock.connect((target.host, target.port))
    except BaseException:
        sock.close()
        raise
    return sock


async def dial(target: HostPort, within: float = CONNECT_TIMEOUT) -> socket.socket:
    """A non-blocking connection to an IP address and port. Raises OSError, TimeoutError."""
    sock = socket.socket(_family(target.host), socket.SOCK_STREAM)
    sock.setblocking(False)
    try:
        async with asyncio.timeout(within):
            await asyncio.get_running_loop().sock_connect(sock, (target.host, target.port))
    except BaseException:
        sock.close()
        raise
    return sock


async def peek(conn: socket.socket, size: int) -> bytes:
    """The first bytes of a connection, left where they are; fewer if it ends before.

    The kernel wakes the reader only at that many bytes (SO_RCVLOWAT), however small the slices in
    which they come. Raises TimeoutError after SILENCE_TIMEOUT, OSError.
    """
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, size)
    async with asyncio.timeout(SILENCE_TIMEOUT):
        await _readable(conn)
        first = conn.recv(size, socket.MSG_PEEK)
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, 1)
    return first


async def read_exactly(conn: socket.socket, size: int) -> bytes:
    """So many bytes, taken off a connection. Raises EOFError if it ends before, OSError."""
    loop = asyncio.get_running_loop()
    chunks = []
    while size:
        chunk = await loop.sock_recv(conn, min(size, 65536))
        if not chunk:
            raise EOFError("the connection ended too early")
        chunks.append(chunk)
        size -= len(chunk)
    return b"".join(chunks)


def has_ended(conn: socket.socket) -> bool:
    """Whether the peer of a non-blocking connection has closed it and nothing is left to read."""
    try:
        return not conn.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return False
    except OSError:
        return True


def reset_on_close(sock: socket.socket) -> None:
    """Make closing a socket send a reset instead of an orderly end."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_RESET)


def hang_up(sock: socket.socket) -> None:
    """End a connection that somebody waits for: it then reads as ended."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)


def end_if_stalled(sock: socket.socket, after: float = WRITE_TIMEOUT) -> None:
    """Have the kernel end a connection whose peer takes nothing of what it is sent, for so long.

    One that reads slowly is left alone (tcp(7), TCP_USER_TIMEOUT). After the event loop has
    written a reply nobody else sees that it never leaves.
    """
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(after * 1000))


def _family(address: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in address else socket.AF_INET


async def _readable(conn: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    ready = asyncio.Event()
    loop.add_reader(conn, ready.set)
    try:
        await ready.wait()
    finally:
        loop.remove_reader(conn)
