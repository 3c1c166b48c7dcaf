"""Accepting connections, and telling XML-RPC from TCPROS by the first four bytes.

Clients speak first in both protocols. The bytes are only peeked at, so that the socket can be
handed on untouched.
"""

import asyncio
import errno
import logging
import socket
from collections.abc import Awaitable, Callable
from functools import partial

from rosproxy.net.addresses import plain_address
from rosproxy.net.tasks import Tasks
from rosproxy.ros1.protocol.tcpros import header_length

log = logging.getLogger(__name__)

FIRST_BYTES_TIMEOUT = 30.0
"""Seconds that a connection may stay silent before it is closed."""

ACCEPTS_PER_TURN = 64

Handler = Callable[[socket.socket, str], Awaitable[None]]
"""Takes over an accepted socket; the second argument is the peer's address."""


class Acceptor:
    """Accepts on one listening socket until it is stopped."""

    def __init__(self, tasks: Tasks, sock: socket.socket, handler: Handler) -> None:
        self.sock = sock
        self._tasks, self._handler = tasks, handler
        self._loop = asyncio.get_running_loop()
        self._pause: asyncio.TimerHandle | None = None
        self._listen()

    def stop(self) -> None:
        """Stop accepting; the socket stays open."""
        self._loop.remove_reader(self.sock)
        if self._pause is not None:
            self._pause.cancel()

    def _listen(self) -> None:
        self._loop.add_reader(self.sock, self._accept)

    def _accept(self) -> None:
        try:
            for _ in range(ACCEPTS_PER_TURN):
                conn, peer = self.sock.accept()
                conn.setblocking(False)
                source = plain_address(peer[0])
                task = self._tasks.spawn(self._serve(conn, source), f"connection from {source}")
                task.add_done_callback(partial(_close_if_cancelled, conn))
        except BlockingIOError:
            return
        except OSError as error:
            self._wait(error)

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

    def _wait(self, error: OSError) -> None:
        """Without a file descriptor left the socket would stay readable: look again later."""
        if error.errno in (errno.EMFILE, errno.ENFILE):
            log.error("out of file descriptors: raise the limit (ulimit -n) of the proxy")
        self._loop.remove_reader(self.sock)
        self._pause = self._loop.call_later(0.1, self._listen)


def _close_if_cancelled(conn: socket.socket, task: asyncio.Task[None]) -> None:
    """A task that is cancelled before it has begun never gets to close its connection."""
    if task.cancelled():
        conn.close()


async def first_bytes(conn: socket.socket) -> bytes:
    """Peek at the first four bytes; fewer if the connection ends before.

    The kernel wakes the reader only at four bytes (SO_RCVLOWAT), however small the slices in
    which they come. Raises TimeoutError, OSError.
    """
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, 4)
    async with asyncio.timeout(FIRST_BYTES_TIMEOUT):
        await _readable(conn)
        first = conn.recv(4, socket.MSG_PEEK)
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, 1)
    return first


async def read_header(conn: socket.socket) -> bytes:
    """Take a TCPROS connection header off the socket: its four bytes of length and its body.

    Raises HeaderError if it is too long, EOFError, TimeoutError, OSError.
    """
    async with asyncio.timeout(FIRST_BYTES_TIMEOUT):
        first = await _exactly(conn, 4)
        return first + await _exactly(conn, header_length(first))


async def _readable(conn: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    ready = asyncio.Event()
    loop.add_reader(conn, ready.set)
    try:
        await ready.wait()
    finally:
        loop.remove_reader(conn)


async def _exactly(conn: socket.socket, size: int) -> bytes:
    loop, parts = asyncio.get_running_loop(), []
    while size:
        part = await loop.sock_recv(conn, min(size, 65536))
        if not part:
            raise EOFError("the connection ended inside its header")
        parts.append(part)
        size -= len(part)
    return b"".join(parts)
