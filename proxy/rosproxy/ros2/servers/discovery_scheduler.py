"""Reads received discovery in small parts, one part in each round of the event loop.

User data and the admin endpoint come first. The sockets are read at once, and discovery waits in a
`DiscoveryQueue`. If no other discovery waits and the round has time left, discovery does not wait
either. Between two rounds the event loop serves all that is ready.
"""

import asyncio
import time
from collections.abc import Callable, Hashable, Sequence

from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.sources.fair_queue import OVERHEAD_BYTES, DiscoveryQueue
from rosproxy.ros2.sources.rates import Standing

SHORTEST_ROUND_S = 0.005
"""Seconds that a round may always take. Reading a datagram of the greatest length takes as long."""
LONGEST_ROUND_S = 0.02
"""Seconds that a round may take at most.

In between, a round may take as long as everything else since the last round. Shorter rounds would
leave no time to read what many sockets receive (receive livelock; Mogul, Ramakrishnan: TOCS 1997).
Longer rounds would delay user data and answers: an answer of the admin endpoint waits for several
rounds."""

Read = Callable[[], Sequence[Outgoing]]
"""Reads a datagram, sends the datagrams that follow from it, and returns these."""


class DiscoveryScheduler:
    """Reads datagrams in a fair order, until `close`. Needs a running event loop.

    ``clock`` tells the time in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._queue = DiscoveryQueue[Read]()
        self._loop = asyncio.get_running_loop()
        self._clock = clock
        self._round: asyncio.Handle | None = None
        self._ended = clock()
        """When the last round ended."""
        self._spent_s = 0.0
        """Seconds of this round in which datagrams have been read."""

    @property
    def is_behind(self) -> bool:
        """Whether a new datagram has to wait."""
        return bool(self._queue) or self._spent_s >= SHORTEST_ROUND_S

    def read(
        self, source: str, standing: Standing, size: int, read: Read, key: Hashable = None
    ) -> bool:
        """Read a datagram now if none waits, or else when the turn of the source comes.

        ``size`` is the length in bytes. While a datagram with a ``key`` waits, `replace` may
        replace it. Return False if the queue has no room for the datagram.
        """
        if self.is_behind:
            return self.put(source, standing, size, read, key)
        self._schedule()
        began = self._clock()
        read()
        self._spent_s += self._clock() - began
        return True

    def put(
        self, source: str, standing: Standing, size: int, read: Read, key: Hashable = None
    ) -> bool:
        """Let a datagram wait for the turn of the source. Return False if the queue has no room."""
        has_room = self._queue.put(source, standing, read, size, key)
        self._schedule()
        return has_room

    def replace(self, key: Hashable, read: Read) -> bool:
        """Replace the waiting datagram with a key. Return False if there is none."""
        return self._queue.replace(key, read)

    def close(self) -> None:
        """Stop reading, and drop the datagrams that wait."""
        if self._round:
            self._round.cancel()
        self._queue = DiscoveryQueue()

    def _schedule(self) -> None:
        """Schedule another round, unless a round is scheduled."""
        if self._round is None:
            self._round = self._loop.call_soon(self._begin_round)

    def _begin_round(self) -> None:
        self._round = None
        self._spent_s = 0.0
        began = self._clock()
        length = min(max(began - self._ended, SHORTEST_ROUND_S), LONGEST_ROUND_S)
        try:
            while self._spent_s < length and (waiting := self._queue.pop()):
                self._queue.charge(waiting.source, _size_of(waiting.item()))
                self._spent_s = self._clock() - began
        finally:
            self._ended = self._clock()
            if self._spent_s or self._queue:
                self._schedule()


def _size_of(sent: Sequence[Outgoing]) -> int:
    """The bytes of datagrams, with an overhead for each datagram."""
    return sum(len(out.datagram) + OVERHEAD_BYTES for out in sent)
