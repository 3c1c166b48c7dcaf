"""An HTTP server for few and friendly callers, with few connections from each address."""

import asyncio
import contextlib
import socket
from collections import Counter
from collections.abc import Awaitable, Callable

from aiohttp import web

from rosproxy.shared.addresses import plain_address, subnet
from rosproxy.shared.connections.sockets import end_if_stalled

SEND_BUFFER_BYTES = 64 * 1024
"""Bytes of a reply that the kernel buffers; Linux doubles the value (socket(7), SO_SNDBUF).

By default the kernel buffers up to 4 MB, even for a reader that takes nothing.
"""
IDLE_TIMEOUT_S = 75.0
"""Seconds in which the first request, and after a reply the next request, must arrive."""

MOST_IN_ALL = 512
"""Connections from all addresses together. A machine may have any number of addresses."""

Answer = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]


class BoundedServer(web.Server):
    """Answers requests on at most ``most`` connections from each address, and MOST_IN_ALL in all.

    For a further connection, the oldest connection of the address ends, or the oldest connection of
    the address with the most connections, in the IPv6 network (/64) with the most. If several
    addresses have the most, connections without a request under way end first: an operator holds a
    connection, and waits for changes.
    """

    def __init__(self, answer: Answer, most: int) -> None:
        # Compressed bodies stay compressed: a small body could expand to a very large body.
        super().__init__(
            self._answer, access_log=None, keepalive_timeout=IDLE_TIMEOUT_S, auto_decompress=False
        )
        self.most = most
        self._make_reply = answer
        self._busy = set[web.RequestHandler]()
        """The connections with a request under way."""
        self._by_source: dict[str, dict[web.RequestHandler, None]] = {}
        """The connections of each source, oldest first."""

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Accept a connection; if there are too many, end another."""
        sock = transport.get_extra_info("socket")
        end_if_stalled(sock)
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        source = _source(handler)
        if len(self._by_source.get(source, ())) >= self.most:
            self._end(next(iter(self._by_source[source])))
        elif sum(map(len, self._by_source.values())) >= MOST_IN_ALL:
            self._end(self._least_useful())
        self._by_source.setdefault(source, {})[handler] = None
        super().connection_made(handler, transport)

    def connection_lost(
        self, handler: web.RequestHandler, exc: BaseException | None = None
    ) -> None:
        """Forget a connection."""
        self._forget(handler)
        super().connection_lost(handler, exc)

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        self._busy.add(request.protocol)
        try:
            return await self._make_reply(request)
        finally:
            self._busy.discard(request.protocol)

    def _least_useful(self) -> web.RequestHandler:
        """The connection that ends if there are MOST_IN_ALL."""
        networks = Counter[str]()
        for address, connections in self._by_source.items():
            networks[subnet(address)] += len(connections)
        most_of_network = max(networks.values())
        of_largest = [
            connections
            for address, connections in self._by_source.items()
            if networks[subnet(address)] == most_of_network
        ]
        most = max(map(len, of_largest))
        crowd = [c for connections in of_largest if len(connections) == most for c in connections]
        return next((c for c in crowd if c not in self._busy), crowd[0])

    def _end(self, handler: web.RequestHandler) -> None:
        self._forget(handler)
        # After a mere close the kernel would keep bytes that the reader has not taken.
        if handler.transport is not None:
            handler.transport.abort()
        handler.force_close()

    def _forget(self, handler: web.RequestHandler) -> None:
        source = _source(handler)
        same_source = self._by_source.get(source, {})
        same_source.pop(handler, None)
        if not same_source:
            self._by_source.pop(source, None)


def _source(handler: web.RequestHandler) -> str:
    """The source address of a connection."""
    return plain_address(handler.peername[0]) if handler.peername else ""
