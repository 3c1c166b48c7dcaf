"""TCP sockets: bind, reserve, listen, accept, connect, peek, read and close.

All sockets are non-blocking and belong to the event loop. A reserved socket refuses connections,
and no other program can bind its port (`reserve`, `listen_on`). `rosproxy.ros1.leases` reserves the
ports of the range.
"""

import asyncio
import contextlib
import errno
import logging
import socket
import struct
from collections.abc import Awaitable, Callable
from functools import partial

from rosproxy.shared.addresses import HostPort, plain_address
from rosproxy.shared.connections.gate import Gate
from rosproxy.shared.tasks import Tasks

log = logging.getLogger(__name__)

MOST_BACKLOG = 1024
"""Most connections that wait to be accepted. The next client tries again after a second."""
ACCEPTS_PER_TURN = 64
"""Most connections that a socket accepts in a round of the event loop."""
CONNECT_TIMEOUT_S = 5.0
"""Seconds in which a peer must accept a connection."""
WRITE_TIMEOUT_S = 30.0
"""Seconds in which a reader must take some of the bytes that wait for the reader."""
SILENCE_TIMEOUT_S = 30.0
"""Seconds in which a client must send the expected bytes. Otherwise the connection ends."""

Handler = Callable[[socket.socket, str], Awaitable[None]]
"""Takes over an accepted socket. The second argument is the address of the peer."""

# struct linger (socket(7)): on, with a time of 0, so that close() sends a reset.
_LINGER_RESET = struct.pack("ii", 1, 0)


def bind(address: str, port: int) -> socket.socket:
    """A bound, non-blocking TCP socket that does not listen yet. Raises OSError."""
    family = _family(address)
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            # `::` accepts IPv4, too, with any value of net.ipv6.bindv6only (ipv6(7)).
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.bind((address, port))
    except OSError:
        sock.close()
        raise
    sock.setblocking(False)
    return sock


def reserve(address: str, port: int) -> socket.socket:
    """A bound socket that refuses connections; no other program can bind the port. Raises OSError.

    The socket needs SO_REUSEADDR: otherwise connections in TIME_WAIT, left by an earlier process,
    prevent the bind. But with SO_REUSEADDR, any number of sockets may bind the same port as long as
    no socket listens. So this function does more than bind:

    1. ``listen`` fails if another process has reserved the port meanwhile: Linux checks again.
    2. Without SO_REUSEADDR on this socket, no later socket can bind the port: Linux wants the
       option on both sockets.
    3. ``shutdown`` ends the listening. The socket stays bound.
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

    Accepted connections inherit SO_REUSEADDR, so that a later process can bind the port although
    such a connection still exists.
    """
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.listen(MOST_BACKLOG)


def listen(address: str, port: int) -> socket.socket:
    """A listening, non-blocking TCP socket. Raises OSError."""
    sock = bind(address, port)
    sock.listen(MOST_BACKLOG)
    return sock


class Acceptor:
    """Accepts connections on a listening socket until `close`; each connection has a task.

    The handler owns the connection. If the handler raises, the connection is closed. A ``gate``
    counts each connection until the handler ends. The acceptor resets a connection that the gate
    refuses.
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
        """Close the listening socket; accepted connections stay open."""
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
            # The socket stays readable, and the loop would call again at once: pause.
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
    """Close the connection of a cancelled task: a task cancelled before its start can't do so."""
    if task.cancelled():
        conn.close()


def _leave(gate: Gate, source: str, port: int, _: asyncio.Task[None]) -> None:
    gate.leave(source, port)


def begin_to_dial(target: HostPort) -> socket.socket:
    """Begin a non-blocking connection to an IP address and port. Raises OSError.

    Before the connection is established, ``send`` raises BlockingIOError, or the OSError of a
    connection that has failed.
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


async def dial(target: HostPort, within: float = CONNECT_TIMEOUT_S) -> socket.socket:
    """Connect to an IP address and port in ``within`` seconds. Raises OSError, TimeoutError."""
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
    """The first ``size`` bytes of a connection, which stay in the buffer; fewer at an early end.

    The kernel wakes the reader only once ``size`` bytes have arrived (SO_RCVLOWAT), even if the
    bytes arrive one by one. Raises TimeoutError after SILENCE_TIMEOUT_S, OSError.
    """
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, size)
    async with asyncio.timeout(SILENCE_TIMEOUT_S):
        await _readable(conn)
        first = conn.recv(size, socket.MSG_PEEK)
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, 1)
    return first


async def read_exactly(conn: socket.socket, size: int) -> bytes:
    """Read exactly ``size`` bytes. Raises EOFError if the connection ends earlier, OSError."""
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
    """Whether a non-blocking connection is broken, or closed by the peer with all bytes read."""
    try:
        return not conn.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return False
    except OSError:
        return True


def reset_on_close(sock: socket.socket) -> None:
    """Make the close of a socket send a reset (RST) instead of a FIN."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_RESET)


def hang_up(sock: socket.socket) -> None:
    """End a connection on which a task waits; the task then reads the end of the connection."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)


def end_if_stalled(sock: socket.socket, after: float = WRITE_TIMEOUT_S) -> None:
    """Have the kernel end a connection whose peer takes no bytes for ``after`` seconds.

    A slow reader keeps the connection (tcp(7), TCP_USER_TIMEOUT). Only the kernel notices a reply
    that stays in the send buffer after the event loop has written all bytes.
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
