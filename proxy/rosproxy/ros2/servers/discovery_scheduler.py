"""Reads the discovery that has come in, a little in each round of the event loop.

User data and the admin endpoint come first: sockets are read at once, and what is discovery waits
(`DiscoveryQueue`), unless no other discovery waits and the round has bytes left. Between two rounds
the event loop serves whatever else is ready.
"""

import asyncio
from collections.abc import Callable, Hashable, Sequence

from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.sources.fair_queue import OVERHEAD, DiscoveryQueue
from rosproxy.ros2.sources.rates import Standing

ROUND = 8 * 1024
"""Bytes that are read and sent in a round. The longest datagram has a round of its own, of 5 ms."""

LONGEST_ROUND = 64 * 1024
PER_RECEIVED = 512
"""Bytes of a round for each datagram that has come since the last one, up to `LONGEST_ROUND`. To
read so many takes about as long as to receive a datagram. With rounds of one length, a crowd of
sockets leaves no time to read what they receive (receive livelock; Mogul, Ramakrishnan: TOCS 1997).
"""

Read = Callable[[], Sequence[Outgoing]]
"""Reads a datagram, sends what follows from it, and returns that."""


class DiscoveryScheduler:
    """Reads datagrams in a fair order, until it is closed. Needs a running event loop."""

    def __init__(self) -> None:
        self._queue = DiscoveryQueue[Read]()
        self._loop = asyncio.get_running_loop()
        self._round: asyncio.Handle | None = None
        self._spent = 0
        """Bytes that were read and sent in this round."""
        self._received = 0
        """Datagrams that have come since this round."""

    @property
    def is_behind(self) -> bool:
        """Whether a datagram that comes now has to wait."""
        return bool(self._queue) or self._spent >= ROUND

    def read(
        self, source: str, standing: Standing, size: int, read: Read, key: Hashable = None
    ) -> bool:
        """Read a datagram of so many bytes now if none waits, or when the turn of its source comes.

        Return False if the datagram is lost. By its ``key`` it may be replaced while it waits.
        """
        if self.is_behind:
            return self.put(source, standing, size, read, key)
        self._schedule()
        self._spent += size + OVERHEAD + _size_of(read())
        return True

    def put(
        self, source: str, standing: Standing, size: int, read: Read, key: Hashable = None
    ) -> bool:
        """Have a datagram of so many bytes read when the turn of its source comes; see `read`."""
        self._received += 1
        has_room = self._queue.put(source, standing, read, size, key)
        self._schedule()
        return has_room

    def replace(self, key: Hashable, read: Read) -> bool:
        """Read another datagram instead of the one that waits with a key; False if none does."""
        self._received += 1
        return self._queue.replace(key, read)

    def close(self) -> None:
        """Read nothing more."""
        if self._round:
            self._round.cancel()
        self._queue = DiscoveryQueue()

    def _schedule(self) -> None:
        """Have another round begin, unless one is to begin already."""
        if self._round is None:
            self._round = self._loop.call_soon(self._begin_round)

    def _begin_round(self) -> None:
        self._round = None
        self._spent = 0
        budget = max(ROUND, min(self._received * PER_RECEIVED, LONGEST_ROUND))
        self._received = 0
        try:
            while self._spent < budget and (waiting := self._queue.pop()):
                led_to = _size_of(waiting.item())
                self._queue.charge(waiting.source, led_to)
                self._spent += waiting.size + led_to
        finally:
            if self._spent or self._queue:
                self._schedule()


def _size_of(sent: Sequence[Outgoing]) -> int:
    """The bytes that datagrams count for."""
    return sum(len(out.datagram) + OVERHEAD for out in sent)
