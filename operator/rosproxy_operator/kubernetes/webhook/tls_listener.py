"""Accepts TLS connections for an HTTP server: a bounded number in all, and from each address.

A connection takes memory before the HTTP server knows the connection: asyncio reserves 256 KiB for
each handshake (`asyncio.sslproto.SSLProtocol.max_size`). Every pod of a cluster reaches the
webhook. So the listener counts a connection as soon as the listener accepts the connection.
"""

import asyncio
import socket
import ssl
from collections import Counter
from dataclasses import dataclass

from aiohttp import web

from rosproxy.shared.addresses import HostPort, subnet
from rosproxy.shared.connections import sockets
from rosproxy.shared.tasks import Tasks

MOST_CONNECTIONS = 512
"""Connections at most: 140 MB. The operator has 512 MiB by default (the chart's values)."""
MOST_OF_SOURCE = 384
"""Connections of an address at most. An API server waits for some 200 pods at the same time.

kube-apiserver: --max-mutating-requests-inflight is 200 by default.
"""
HANDSHAKE_TIMEOUT_S = 10.0
"""Seconds for a handshake.

An API server waits 10 s for a webhook by default, and 5 s with the chart (timeoutSeconds).
"""


@dataclass(slots=True, eq=False)
class _Connection:
    """A connection: first with the task of the handshake, then with the transport."""

    source: str
    handshake: asyncio.Task[None] | None
    transport: asyncio.BaseTransport | None = None

    @property
    def is_open(self) -> bool:
        if self.transport is None:
            return self.handshake is not None
        return not self.transport.is_closing()

    def end(self) -> None:
        if isinstance(self.transport, asyncio.WriteTransport):
            self.transport.abort()
        elif self.handshake is not None:
            self.handshake.cancel()


class TlsListener:
    """Hands connections to ``server``, with TLS by ``context``; `start` begins to listen.

    If an address has too many connections, a new connection ends the oldest connection of this
    address. If all addresses together have too many, a new connection ends the oldest connection
    of the address, or IPv6 network (/64), with most connections.
    """

    def __init__(self, server: web.Server, context: ssl.SSLContext) -> None:
        self._server = server
        self._context = context
        self._tasks = Tasks()
        self._connections: list[_Connection] = []
        self._acceptor: sockets.Acceptor | None = None

    def start(self, bind: HostPort) -> None:
        """Listen. Raises OSError."""
        listener = sockets.listen(bind.host, bind.port)
        self._acceptor = sockets.Acceptor(self._tasks, listener, self._serve)

    async def close(self) -> None:
        """Stop listening, and end handshakes. The server ends established connections."""
        if self._acceptor is not None:
            self._acceptor.close()
        await self._tasks.cancel()

    async def _serve(self, sock: socket.socket, source: str) -> None:
        self._make_room(source)
        connection = _Connection(source, asyncio.current_task())
        self._connections.append(connection)
        loop = asyncio.get_running_loop()
        try:
            connection.transport, _ = await loop.connect_accepted_socket(
                self._server, sock, ssl=self._context, ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S
            )
        finally:
            # Break the cycle of task, error and frame. Else the 256 KiB stay until the next garbage
            # collection.
            connection.handshake = None

    def _make_room(self, source: str) -> None:
        """End a connection if a further connection of this source would exceed a bound."""
        self._connections = [c for c in self._connections if c.is_open]
        of_source = [c for c in self._connections if c.source == source]
        if len(of_source) >= MOST_OF_SOURCE:
            oldest = of_source[0]
        elif len(self._connections) >= MOST_CONNECTIONS:
            networks = Counter(subnet(c.source) for c in self._connections)
            largest = networks.most_common(1)[0][0]
            oldest = next(c for c in self._connections if subnet(c.source) == largest)
        else:
            return
        oldest.end()
        self._connections.remove(oldest)
