"""An HTTP server for endpoints with few and friendly callers: a few connections of each address."""

import asyncio
import contextlib
import socket
from collections.abc import Awaitable, Callable

from aiohttp import web

from rosproxy.net.sockets import end_if_stalled

SEND_BUFFER = 64 * 1024
"""Bytes that the kernel keeps of a reply; Linux takes twice as many (socket(7), SO_SNDBUF).

By default it keeps up to 4 MB, whatever the reader takes.
"""
IDLE_TIMEOUT = 75.0
"""Seconds in which the next request must have arrived, the first one as well."""

Answer = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]


class BoundedServer(web.Server):
    """Answers requests on ``most`` connections from one address at most."""

    def __init__(self, answer: Answer, most: int) -> None:
        # Nothing is inflated: a small body may become a very large one.
        super().__init__(
            answer, access_log=None, keepalive_timeout=IDLE_TIMEOUT, auto_decompress=False
        )
        self.most = most

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Take a connection in, and end the oldest one of its source if that has too many."""
        sock = transport.get_extra_info("socket")
        end_if_stalled(sock)
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        source = _source(handler)
        same_source = [c for c in self.connections if _source(c) == source]
        open_connections = [c for c in same_source if c.transport is not None]
        if len(open_connections) >= self.most:  # those that end stay until the next turn
            oldest = open_connections[0]
            # Closing alone keeps what the reader has not taken until the kernel gives it up.
            if oldest.transport is not None:
                oldest.transport.abort()
            oldest.force_close()
        super().connection_made(handler, transport)


def _source(handler: web.RequestHandler) -> object:
    """The address that a connection comes from."""
    return handler.peername[0] if handler.peername else None
