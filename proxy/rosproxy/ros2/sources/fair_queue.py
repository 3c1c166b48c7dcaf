"""The queue of discovery, in an order that is fair to the sources.

Reading discovery takes long, and any machine on the network may send discovery. So datagrams wait,
and the source of which the proxy has read the fewest bytes goes first (start-time fair queueing;
Goyal, Vin, Cheng: SIGCOMM 1996). Forged sources cost nothing, and a single machine may have
thousands of addresses. So each of four groups of sources gets a quarter of the reading: peers and
proven sources inside, proven sources outside, other sources inside, and other sources outside.
"""

import heapq
from collections import OrderedDict, deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from rosproxy.ros2.sources.rates import Standing

MOST_BYTES_PER_SOURCE = 512 * 1024
"""Bytes of a source that may wait.

Participants repeat discovery that is late, so a much longer queue makes an overload worse. With
256 KiB and a hundred participants of Cyclone DDS at two addresses, discovery was lost that came
again only after 1.5 s. With 0.3 of a processor, the proxy then took 10 to 12 s instead of 7 to 8.
"""
MOST_BYTES_PER_STANDING = 3 * 1024 * 1024
"""Bytes of all sources with the same standing that may wait."""
MOST_PROVEN_SOURCES = 2048
"""Sources that may wait, for each of the two proven standings. The proxy reads a few thousand
datagrams in a second."""
MOST_UNPROVEN_SOURCES = 256
"""Sources that may wait, for each of the two other standings."""
MOST_SEARCHED = 256
"""Waiting sources among which each datagram may search the largest. With 256 sources a search takes
0.02 ms."""
OVERHEAD_BYTES = 256
"""Bytes that are added to the length of each datagram."""

Item = TypeVar("Item")


@dataclass(slots=True)
class Waiting(Generic[Item]):
    """An item that waits. For ``key``, see `FairQueue.put`.

    ``size`` is in bytes, and includes the overhead.
    """

    source: str
    item: Item
    size: int
    key: Hashable = None


@dataclass(slots=True)
class FairQueue(Generic[Item]):
    """Items by source. The source with the smallest used share goes first.

    A share is a number of bytes on a line: `_next` is the start of the next item of each source,
    and `_now` the used share of a source that always has an item. A source that was silent starts
    at `_now`, so silence saves nothing. `_now` grows with all bytes taken: a source that comes back
    waits for a round at most, although new sources may come all the time.

    The queue remembers the shares of as many silent sources as may wait. All others have been
    silent for about a round, so these shares no longer matter.
    """

    most_sources: int
    most_bytes_per_source: int = MOST_BYTES_PER_SOURCE
    most_bytes: int = MOST_BYTES_PER_STANDING
    _waiting: dict[str, deque[Waiting[Item]]] = field(default_factory=dict)
    _replaceable: dict[Hashable, Waiting[Item]] = field(default_factory=dict)
    _sizes: dict[str, int] = field(default_factory=dict)
    _order: list[tuple[float, int, str]] = field(default_factory=list)
    _arrivals: int = 0
    _next: dict[str, float] = field(default_factory=dict)
    _silent: OrderedDict[str, None] = field(default_factory=OrderedDict)
    _now: float = 0.0
    _size: int = 0

    def __bool__(self) -> bool:
        """Whether an item waits."""
        return bool(self._waiting)

    def put(self, source: str, item: Item, size: int, key: Hashable = None) -> bool:
        """Add an item of ``size`` bytes. Return False if the queue has no room.

        While an item with a ``key`` waits, `replace` may replace it.
        """
        waiting = Waiting(source, item, size + OVERHEAD_BYTES, key)
        if not self._make_room(waiting):
            return False
        if key is not None:
            self._replaceable[key] = waiting
        if source not in self._waiting:
            self._waiting[source] = deque()
            self._silent.pop(source, None)
            self._next[source] = max(self._now, self._next.get(source, 0.0))
            self._line_up(source)
        self._waiting[source].append(waiting)
        self._count(source, waiting.size)
        return True

    def replace(self, key: Hashable, item: Item) -> bool:
        """Replace the waiting item with a key. Return False if there is none."""
        former = self._replaceable.get(key)
        if former is None:
            return False
        former.item = item
        return True

    def pop(self) -> Waiting[Item] | None:
        """Take the next item; None if no item waits."""
        while self._order:
            start, _, source = heapq.heappop(self._order)
            if start < self._next[source]:  # `charge` has moved the source back
                self._line_up(source)
                continue
            self._now = max(self._now, start)
            return self._take(source)
        return None

    def charge(self, source: str, size: int) -> None:
        """Add bytes to the used share of a source."""
        if source in self._next:
            self._next[source] += size
            # In fractions: more sources may wait than a datagram has bytes.
            self._now += size / max(len(self._waiting), 1)

    def _line_up(self, source: str) -> None:
        """Give a source its place in the order. Of equal shares, the first to arrive goes first."""
        self._arrivals += 1
        heapq.heappush(self._order, (self._next[source], self._arrivals, source))

    def _take(self, source: str) -> Waiting[Item]:
        waiting = self._waiting[source].popleft()
        self._leave(waiting)
        self.charge(source, waiting.size)
        if self._waiting[source]:
            self._line_up(source)
        else:
            del self._waiting[source]
            self._silent[source] = None
            self._forget_silent()
        return waiting

    def _make_room(self, waiting: Waiting[Item]) -> bool:
        """Return whether an item fits. If necessary, drop the last items of the largest source.

        Only an item of a smaller source makes the largest source lose items. If more than
        `MOST_SEARCHED` sources wait, the smaller source must also have less than a fair share.
        """
        source = waiting.source
        if source not in self._waiting and len(self._waiting) >= self.most_sources:
            return False
        size = self._sizes.get(source, 0) + waiting.size
        if size > self.most_bytes_per_source:
            return False
        # In an overload with many sources, most items end here, before the search.
        is_full = self._size + waiting.size > self.most_bytes
        exceeds_share = size * len(self._waiting) > self.most_bytes
        if is_full and exceeds_share and len(self._waiting) > MOST_SEARCHED:
            return False
        while self._size + waiting.size > self.most_bytes:
            largest = max(self._sizes, key=self._sizes.__getitem__)
            # Leave an item of each source, because `_order` has an entry for the source.
            if self._sizes[largest] <= size or len(self._waiting[largest]) == 1:
                return False
            self._leave(self._waiting[largest].pop())
        return True

    def _leave(self, waiting: Waiting[Item]) -> None:
        """Remove an item from the counts and keys."""
        self._count(waiting.source, -waiting.size)
        self._replaceable.pop(waiting.key, None)

    def _count(self, source: str, size: int) -> None:
        self._size += size
        self._sizes[source] = self._sizes.get(source, 0) + size
        if not self._sizes[source]:
            del self._sizes[source]

    def _forget_silent(self) -> None:
        """Forget the used shares of silent sources, if these no longer matter."""
        if not self._waiting:
            self._next.clear()
            self._silent.clear()
        elif len(self._silent) > self.most_sources:
            longest_silent, _ = self._silent.popitem(last=False)
            del self._next[longest_silent]


class DiscoveryQueue(Generic[Item]):
    """Datagrams that wait, by the standing of the source. All standings have the same share."""

    def __init__(self) -> None:
        self._queues = {
            standing: FairQueue[Item](
                MOST_PROVEN_SOURCES
                if standing in (Standing.PROVEN, Standing.PROVEN_OUTSIDE)
                else MOST_UNPROVEN_SOURCES,
            )
            for standing in Standing
        }
        self._used = dict.fromkeys(Standing, 0)
        self._last = Standing.PROVEN

    def __bool__(self) -> bool:
        """Whether a datagram waits."""
        return any(self._queues.values())

    def put(
        self, source: str, standing: Standing, item: Item, size: int, key: Hashable = None
    ) -> bool:
        """Add a datagram; see `FairQueue.put`."""
        if not self._queues[standing]:
            busy = [self._used[other] for other, queue in self._queues.items() if queue]
            if busy:
                # Silence saves nothing, as in `FairQueue`.
                self._used[standing] = max(self._used[standing], min(busy))
            else:
                # No standing had to wait for what another one has used alone.
                self._used = dict.fromkeys(Standing, 0)
        return self._queues[standing].put(source, item, size, key)

    def replace(self, key: Hashable, item: Item) -> bool:
        """Replace the waiting datagram with a key. Return False if there is none."""
        return any(queue.replace(key, item) for queue in self._queues.values())

    def pop(self) -> Waiting[Item] | None:
        """Take the next datagram; None if no datagram waits."""
        busy = [standing for standing, queue in self._queues.items() if queue]
        if not busy:
            return None
        self._last = min(busy, key=self._used.__getitem__)
        waiting = self._queues[self._last].pop()
        self._used[self._last] += waiting.size if waiting else 0
        return waiting

    def charge(self, source: str, size: int) -> None:
        """Charge a source for datagrams in consequence of the datagram that was taken last."""
        self._queues[self._last].charge(source, size)
        self._used[self._last] += size
