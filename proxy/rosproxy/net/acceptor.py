"""Accepting connections on a listening socket, each served in a task of its own.

What a client sends is for the handler: it takes the socket over, and whatever ends the handler by
an exception closes the connection.
"""

import asyncio
import errno
import logging
import socket
from collections.abc import Awaitable, Callable
from functools import partial

from rosproxy.net.addresses import plain_address
from rosproxy.net.tasks import Tasks

log = logging.getLogger(__name__)

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
            if error.errno in (errno.EMFILE, errno.ENFILE):
                log.error("out of file descriptors: raise the limit (ulimit -n) of the proxy")
            # The socket would stay readable: look again later.
            self._loop.remove_reader(self.sock)
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
