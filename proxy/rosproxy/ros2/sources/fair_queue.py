"""Discovery that waits to be read, in an order that is fair to its sources.

Reading discovery takes long, and any neighbour may send it. So datagrams wait, and the source goes
first that has had least of the reading (start-time fair queueing; Goyal, Vin, Cheng: SIGCOMM 1996).
A forged source costs its sender nothing, and one machine may have thousands of addresses. So the
reading has four parts: for peers and proven sources inside, for proven sources outside, for other
sources inside, and for other sources outside.
"""

import heapq
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from rosproxy.ros2.sources.rates import Standing

MOST_OF_SOURCE = 256 * 1024
MOST_OF_ALL = 3 * 1024 * 1024
"""Bytes of one source that wait, and bytes that wait of one standing.

Participants repeat discovery that is late. So a longer queue of a source makes an overload worse:
with 1 MiB, a proxy with 0.3 of a processor read 100 participants of Cyclone DDS in 5 to 8 s instead
of 3 to 4 s. With 128 KiB, discovery is lost that only comes again after 2 s."""
MOST_KNOWN = 2048
MOST_UNKNOWN = 256
"""Sources of which datagrams wait, of proven and of any other standing. The proxy reads a few
thousand datagrams in a second."""
OVERHEAD = 256
"""Bytes that a datagram counts for beside its own."""

Item = TypeVar("Item")


@dataclass(slots=True)
class Waiting(Generic[Item]):
    """An item with its source, and the bytes that it counts for; ``key`` as in `FairQueue.put`."""

    source: str
    item: Item
    size: int
    key: Hashable = None


@dataclass(slots=True)
class FairQueue(Generic[Item]):
    """Items by source; the source whose share is used least goes first.

    A share is counted in bytes, as a point on a line: `_now` is where the item began that was taken
    last, and `_next` is where the next item of a source begins. A source that was silent begins
    at `_now`: silence saves nothing.
    """

    most_sources: int
    most_of_source: int = MOST_OF_SOURCE
    most_of_all: int = MOST_OF_ALL
    _waiting: dict[str, deque[Waiting[Item]]] = field(default_factory=dict)
    _replaceable: dict[Hashable, Waiting[Item]] = field(default_factory=dict)
    _sizes: dict[str, int] = field(default_factory=dict)
    _order: list[tuple[int, str]] = field(default_factory=list)
    _next: dict[str, int] = field(default_factory=dict)
    _now: int = 0
    _size: int = 0

    def __bool__(self) -> bool:
        """Whether an item waits."""
        return bool(self._waiting)

    def put(self, source: str, item: Item, size: int, key: Hashable = None) -> bool:
        """Add an item of so many bytes. Return False if there is no room for the item.

        An item with a ``key`` can be replaced while it waits (`replace`).
        """
        waiting = Waiting(source, item, size + OVERHEAD, key)
        if not self._has_room(waiting):
            return False
        if key is not None:
            self._replaceable[key] = waiting
        if source not in self._waiting:
            self._waiting[source] = deque()
            self._next[source] = max(self._now, self._next.get(source, 0))
            heapq.heappush(self._order, (self._next[source], source))
        self._waiting[source].append(waiting)
        self._count(source, waiting.size)
        return True

    def replace(self, key: Hashable, item: Item) -> bool:
        """Put an item in the place of the one that waits with a key; False if none does."""
        former = self._replaceable.get(key)
        if former is None:
            return False
        former.item = item
        return True

    def pop(self) -> Waiting[Item] | None:
        """Take the next item; None if no item waits."""
        while self._order:
            start, source = heapq.heappop(self._order)
            if start < self._next[source]:  # `charge` has moved the source back
                heapq.heappush(self._order, (self._next[source], source))
                continue
            self._now = start
            return self._take(source)
        return None

    def charge(self, source: str, size: int) -> None:
        """Count bytes that the last item of a source has led to as its own."""
        if source in self._next:
            self._next[source] += size

    def _take(self, source: str) -> Waiting[Item]:
        waiting = self._waiting[source].popleft()
        self._leave(waiting)
        self._next[source] += waiting.size
        if self._waiting[source]:
            heapq.heappush(self._order, (self._next[source], source))
        else:
            del self._waiting[source]
            self._forget_silent()
        return waiting

    def _has_room(self, waiting: Waiting[Item]) -> bool:
        """Whether an item fits; the source with most loses its last items to one with less."""
        source = waiting.source
        if source not in self._waiting and len(self._waiting) >= self.most_sources:
            return False
        size = self._sizes.get(source, 0) + waiting.size
        if size > self.most_of_source:
            return False
        while self._size + waiting.size > self.most_of_all:
            largest = max(self._sizes, key=self._sizes.__getitem__)
            # A source is never emptied here: its place in `_order` would be left.
            if self._sizes[largest] <= size or len(self._waiting[largest]) == 1:
                return False
            self._leave(self._waiting[largest].pop())
        return True

    def _leave(self, waiting: Waiting[Item]) -> None:
        """Count an item no longer."""
        self._count(waiting.source, -waiting.size)
        self._replaceable.pop(waiting.key, None)

    def _count(self, source: str, size: int) -> None:
        self._size += size
        self._sizes[source] = self._sizes.get(source, 0) + size
        if not self._sizes[source]:
            del self._sizes[source]

    def _forget_silent(self) -> None:
        """Forget how much silent sources have had, where that no longer holds them back."""
        if not self._waiting:
            self._next.clear()
        elif len(self._next) > 2 * self.most_sources:
            kept = self._waiting.keys() | {
                s for s, start in self._next.items() if start > self._now
            }
            self._next = {source: self._next[source] for source in kept}


class DiscoveryQueue(Generic[Item]):
    """Datagrams that wait, by the standing of their sources: each standing has the same share."""

    def __init__(self) -> None:
        self._queues = {
            standing: FairQueue[Item](
                MOST_KNOWN if standing in (Standing.PROVEN, Standing.STRANGER) else MOST_UNKNOWN,
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
        """Add a datagram of so many bytes; see `FairQueue.put`."""
        if not self._queues[standing]:
            busy = [self._used[other] for other, queue in self._queues.items() if queue]
            # A pause saves nothing.
            self._used[standing] = max(self._used[standing], min(busy, default=0))
        return self._queues[standing].put(source, item, size, key)

    def replace(self, key: Hashable, item: Item) -> bool:
        """Put a datagram in the place of the one that waits with a key; False if none does."""
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
        """Count bytes that the datagram taken last, of a source, has led to."""
        self._queues[self._last].charge(source, size)
        self._used[self._last] += size
