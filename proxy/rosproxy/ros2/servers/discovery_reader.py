"""Reads the discovery that has come in, a little in each round of the event loop.

User data and the admin endpoint come first: sockets are read at once, and what is discovery waits
(`DiscoveryQueue`). Between two rounds the event loop serves whatever else is ready.
"""

import asyncio
from collections.abc import Callable, Sequence

from rosproxy.ros2.discovery.discovery_rates import Standing
from rosproxy.ros2.discovery.domain_settings import Outgoing
from rosproxy.ros2.discovery.fair_queue import OVERHEAD, DiscoveryQueue

ROUND = 8 * 1024
"""Bytes that are read and sent in a round. The longest datagram has a round of its own, of 5 ms."""

Read = Callable[[], Sequence[Outgoing]]
"""Reads a datagram, sends what follows from it, and returns that."""


class DiscoveryReader:
    """Reads datagrams in a fair order, until it is closed. Needs a running event loop."""

    def __init__(self) -> None:
        self._queue = DiscoveryQueue[Read]()
        self._loop = asyncio.get_running_loop()
        self._round: asyncio.Handle | None = None

    def put(self, source: str, standing: Standing, size: int, read: Read) -> bool:
        """Have a datagram of so many bytes read when the turn of its source comes.

        Return False if it is lost.
        """
        has_room = self._queue.put(source, standing, read, size)
        self._schedule()
        return has_room

    def close(self) -> None:
        """Read nothing more."""
        if self._round:
            self._round.cancel()
        self._queue = DiscoveryQueue()

    def _schedule(self) -> None:
        if self._round is None and self._queue:
            self._round = self._loop.call_soon(self._read_some)

    def _read_some(self) -> None:
        self._round = None
        try:
            spent = 0
            while spent < ROUND and (waiting := self._queue.pop()):
                sent = waiting.item()
                led_to = sum(len(out.datagram) + OVERHEAD for out in sent)
                self._queue.charge(waiting.source, led_to)
                spent += waiting.size + led_to
        finally:
            self._schedule()
