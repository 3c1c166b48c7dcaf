"""Accepts TLS connections for an HTTP server: a bounded number of all, and of each address.

A connection costs memory before the HTTP server hears of the connection: asyncio reserves 256 KiB
for each handshake (`asyncio.sslproto.SSLProtocol.max_size`). Every pod of a cluster reaches the
webhook. So connections are counted from the moment they are accepted.
"""

import asyncio
import socket
import ssl
from collections import Counter
from dataclasses import dataclass

from aiohttp import web

from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort
from rosproxy.net.tasks import Tasks

MOST_CONNECTIONS = 512
"""Connections at most: 140 MB. The operator has 512 MiB by default (the chart's values)."""
MOST_OF_SOURCE = 384
"""The same of one address. An API server waits for some 200 pods at the same time.

kube-apiserver: --max-mutating-requests-inflight is 200 by default.
"""
HANDSHAKE_TIMEOUT_S = 10.0
"""Seconds for a handshake. An API server waits 10 s for a webhook, and then admits the pod."""


@dataclass(slots=True, eq=False)
class _Connection:
    """A connection: the task of its handshake, or its transport once the handshake is over."""

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
    """Hands connections to ``server``, with TLS by ``context``; see `start`.

    A connection over the bound of its address takes the place of the oldest one of that address. A
    connection over the bound of all takes a place of the address with most connections.
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
        """Stop listening, and end handshakes. Other connections are the server's to end."""
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
            # Otherwise the task, its error and this frame keep the 256 KiB until the next garbage
            # collection.
            connection.handshake = None

    def _make_room(self, source: str) -> None:
        """End a connection if there are too many for one more of this source."""
        self._connections = [c for c in self._connections if c.is_open]
        counts = Counter(c.source for c in self._connections)
        if counts[source] < MOST_OF_SOURCE:
            if len(self._connections) < MOST_CONNECTIONS:
                return
            source = counts.most_common(1)[0][0]
        oldest = next(c for c in self._connections if c.source == source)
        oldest.end()
        self._connections.remove(oldest)
