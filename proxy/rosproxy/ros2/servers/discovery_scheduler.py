"""Reads received discovery in small parts, one part in each round of the event loop.

User data and the admin endpoint come first. The sockets are read at once, and discovery waits in a
`DiscoveryQueue`. If no other discovery waits and the round has bytes left, discovery does not wait
either. Between two rounds the event loop serves all that is ready.
"""

import asyncio
from collections.abc import Callable, Hashable, Sequence

from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.sources.fair_queue import OVERHEAD_BYTES, DiscoveryQueue
from rosproxy.ros2.sources.rates import Standing

ROUND_BYTES = 8 * 1024
"""Bytes that a round reads and sends. A round with a datagram of the greatest length takes 5 ms."""
LONGEST_ROUND_BYTES = 64 * 1024
"""Bytes of the longest round."""
BYTES_PER_RECEIVED = 512
"""Bytes of a round for each datagram since the last round, up to `LONGEST_ROUND_BYTES`.
Reading these bytes takes about as long as receiving a datagram. With rounds of constant length,
many sockets would leave no time to read what they receive (receive livelock; Mogul, Ramakrishnan:
TOCS 1997)."""

Read = Callable[[], Sequence[Outgoing]]
"""Reads a datagram, sends the datagrams that follow from it, and returns these."""


class DiscoveryScheduler:
    """Reads datagrams in a fair order, until `close`. Needs a running event loop."""

    def __init__(self) -> None:
        self._queue = DiscoveryQueue[Read]()
        self._loop = asyncio.get_running_loop()
        self._round: asyncio.Handle | None = None
        self._spent = 0
        """Bytes that this round has read and sent."""
        self._received = 0
        """Datagrams that have come since the start of this round."""

    @property
    def is_behind(self) -> bool:
        """Whether a new datagram has to wait."""
        return bool(self._queue) or self._spent >= ROUND_BYTES

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
        self._spent += size + OVERHEAD_BYTES + _size_of(read())
        return True

    def put(
        self, source: str, standing: Standing, size: int, read: Read, key: Hashable = None
    ) -> bool:
        """Let a datagram wait for the turn of the source. Return False if the queue has no room."""
        self._received += 1
        has_room = self._queue.put(source, standing, read, size, key)
        self._schedule()
        return has_room

    def replace(self, key: Hashable, read: Read) -> bool:
        """Replace the waiting datagram with a key. Return False if there is none."""
        self._received += 1
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
        self._spent = 0
        budget = max(ROUND_BYTES, min(self._received * BYTES_PER_RECEIVED, LONGEST_ROUND_BYTES))
        self._received = 0
        try:
            while self._spent < budget and (waiting := self._queue.pop()):
                sent_bytes = _size_of(waiting.item())
                self._queue.charge(waiting.source, sent_bytes)
                self._spent += waiting.size + sent_bytes
        finally:
            if self._spent or self._queue:
                self._schedule()


def _size_of(sent: Sequence[Outgoing]) -> int:
    """The bytes of datagrams, with an overhead for each datagram."""
    return sum(len(out.datagram) + OVERHEAD_BYTES for out in sent)
