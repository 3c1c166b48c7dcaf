"""An HTTP server for few and friendly callers, with few connections from each address."""

import asyncio
import contextlib
import socket
from collections.abc import Awaitable, Callable

from aiohttp import web

from rosproxy.net.sockets import end_if_stalled

SEND_BUFFER_BYTES = 64 * 1024
"""Bytes of a reply that the kernel buffers; Linux doubles the value (socket(7), SO_SNDBUF).

By default the kernel buffers up to 4 MB, even for a reader that takes nothing.
"""
IDLE_TIMEOUT_S = 75.0
"""Seconds in which the first request, and after a reply the next request, must arrive."""

Answer = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]


class BoundedServer(web.Server):
    """Answers requests on at most ``most`` connections from each address."""

    def __init__(self, answer: Answer, most: int) -> None:
        # Compressed bodies stay compressed: a small body could expand to a very large body.
        super().__init__(
            answer, access_log=None, keepalive_timeout=IDLE_TIMEOUT_S, auto_decompress=False
        )
        self.most = most

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Accept a connection; if the source has too many, end the oldest of the source."""
        sock = transport.get_extra_info("socket")
        end_if_stalled(sock)
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        source = _source(handler)
        same_source = [c for c in self.connections if _source(c) == source]
        open_connections = [c for c in same_source if c.transport is not None]
        # `connections` has closed connections until the next round of the event loop.
        if len(open_connections) >= self.most:
            oldest = open_connections[0]
            # After a mere close the kernel would keep bytes that the reader has not taken.
            if oldest.transport is not None:
                oldest.transport.abort()
            oldest.force_close()
        super().connection_made(handler, transport)


def _source(handler: web.RequestHandler) -> object:
    """The source address of a connection."""
    return handler.peername[0] if handler.peername else None
