"""The relays of a service that are open."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator

from rosproxy.relay import Relay

log = logging.getLogger(__name__)

STOP_TIMEOUT = 1.0
"""Seconds that relays get to end when a service stops."""


class OpenRelays:
    """Relays from their start to their end. Needs a running event loop to start one."""

    def __init__(self) -> None:
        self._open: set[Relay] = set()
        self._none = asyncio.Event()
        self._none.set()

    def __iter__(self) -> Iterator[Relay]:
        """All open relays; safe against changes while iterating."""
        return iter(list(self._open))

    def __len__(self) -> int:
        """How many there are."""
        return len(self._open)

    def start(self, relay: Relay, ended: Callable[[Relay], None]) -> None:
        """Start a relay; ``ended`` is called in the event loop when it has ended."""
        loop = asyncio.get_running_loop()
        self._open.add(relay)
        self._none.clear()
        relay.start(lambda done: _call_in(loop, lambda: self._finish(done, ended)))

    async def stop(self) -> None:
        """End all of them."""
        for relay in self:
            relay.end()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STOP_TIMEOUT):
                await self._none.wait()

    def _finish(self, relay: Relay, ended: Callable[[Relay], None]) -> None:
        self._open.discard(relay)
        if not self._open:
            self._none.set()
        ended(relay)


def _call_in(loop: asyncio.AbstractEventLoop, function: Callable[[], None]) -> None:
    """Run a function in the loop from a thread; not at all if the loop has ended."""
    try:
        loop.call_soon_threadsafe(function)
    except RuntimeError:
        log.debug("the event loop has ended before a relay")
