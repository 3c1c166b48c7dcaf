"""The open relays of a server."""

import asyncio
import contextlib
import logging
import selectors
import socket
from collections.abc import Callable, Iterator

from rosproxy.forwarding.relay import Relay

log = logging.getLogger(__name__)

STOP_TIMEOUT_S = 1.0
"""Seconds in which the relays may end when the server stops."""
STARTS_PER_TURN = 64
"""Most threads that start in a round of the event loop, if many subscribers leave at once."""


class OpenRelays:
    """The set of open relays. `start` needs a running event loop."""

    def __init__(self) -> None:
        self._open: set[Relay] = set()
        self._quiet_sockets: _QuietSockets | None = None
        self._none_open = asyncio.Event()
        self._none_open.set()

    def __iter__(self) -> Iterator[Relay]:
        """All open relays; safe against changes while iterating."""
        return iter(list(self._open))

    def __len__(self) -> int:
        """How many relays are open."""
        return len(self._open)

    def start(self, relay: Relay, ended: Callable[[Relay], None]) -> None:
        """Start a relay. After its end, ``ended`` is called in the event loop."""
        loop = asyncio.get_running_loop()
        if self._quiet_sockets is None:
            self._quiet_sockets = _QuietSockets(loop)
        self._open.add(relay)
        self._none_open.clear()

        def finished(ended_relay: Relay) -> None:
            try:
                loop.call_soon_threadsafe(self._finish, ended_relay, ended)
            except RuntimeError:
                log.debug("a relay ended after the event loop")

        relay.start(finished, self._quiet_sockets.when_readable)

    async def stop(self) -> None:
        """End all relays, and wait for STOP_TIMEOUT_S at most."""
        for relay in self:
            relay.end()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STOP_TIMEOUT_S):
                await self._none_open.wait()
        if self._quiet_sockets is not None:
            self._quiet_sockets.close()
            self._quiet_sockets = None

    def _finish(self, relay: Relay, ended: Callable[[Relay], None]) -> None:
        self._open.discard(relay)
        if not self._open:
            self._none_open.set()
        ended(relay)


class _QuietSockets:
    """Sockets of silent clients, and the function to call when a client sends or leaves.

    The event loop watches a single epoll descriptor for all sockets. libuv makes watched sockets
    non-blocking, but relays need blocking sockets.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._selector = selectors.DefaultSelector()
        loop.add_reader(self._selector.fileno(), self._look)

    def when_readable(self, sock: socket.socket, function: Callable[[], object]) -> None:
        self._selector.register(sock, selectors.EVENT_READ, function)

    def close(self) -> None:
        self._loop.remove_reader(self._selector.fileno())
        self._selector.close()

    def _look(self) -> None:
        # The other sockets stay readable, so the loop calls this function again.
        for key, _ in self._selector.select(0)[:STARTS_PER_TURN]:
            self._selector.unregister(key.fileobj)
            key.data()
