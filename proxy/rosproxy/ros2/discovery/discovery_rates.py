"""How much discovery one source may make: the datagrams that are read and those they lead to.

Reading discovery costs a hundred times what passing on a user's datagram does, and an announcement
goes on to all participants of the other side. So each source has an allowance that fills up again
with time. Datagrams are charged by their length, those of the source and those that they lead to.
User data is not charged, also where it comes to a port for both, as that of Cyclone DDS. The proxy
has to read some of it to tell: encrypted or unknown submessages, or more of them than is usual.
A datagram over the allowance is lost. Participants repeat discovery, and readers ask for what they
lack.
"""

from dataclasses import dataclass, field

PER_SECOND = 10_000.0
BURST = 50_000.0
"""What a source may be charged in a second, and at once. Fifty participants at one address that
start at once are charged 10,000 with two peers, and some 1,200 a second from then on."""
STEP = 256
"""Bytes of a datagram for each unit of its charge. An announcement takes two or three."""
MOST_SOURCES = 4096
"""Sources that are remembered; of more, the one that has been heard first goes."""


def cost(size: int) -> int:
    """What a datagram of so many bytes is charged."""
    return 1 + size // STEP


@dataclass(slots=True)
class DiscoveryRates:
    """What is left of each source's allowance, and the time at which that was."""

    per_second: float = PER_SECOND
    burst: float = BURST
    _remaining: dict[str, tuple[float, float]] = field(default_factory=dict)

    def take(self, source: str, size: int, now: float) -> bool:
        """Whether a datagram of a source, of so many bytes, may be read; it is charged then."""
        remaining, since = self._remaining.get(source, (self.burst, now))
        remaining = min(remaining + max(now - since, 0.0) * self.per_second, self.burst)
        allowed = remaining >= 1.0
        if source not in self._remaining and len(self._remaining) >= MOST_SOURCES:
            del self._remaining[next(iter(self._remaining))]
        self._remaining[source] = (remaining - cost(size) if allowed else remaining), now
        return allowed

    def charge(self, source: str, total: int) -> None:
        """Charge a source with what its datagrams have led to, as `cost`; it may go into debt."""
        if total and source in self._remaining:
            remaining, since = self._remaining[source]
            self._remaining[source] = remaining - total, since
