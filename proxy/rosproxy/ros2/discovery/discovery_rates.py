"""How much discovery one source may make: datagrams that are read, and those they lead to.

Reading discovery costs a hundred times what passing on a user's datagram does, and one announcement
goes on to everybody on the other side. So each source has an allowance of datagrams, in and out,
that fills up again with the time; a long one counts as several, since it takes as long to read.
What users send is not charged, also where it comes to a port for both, as that of Cyclone DDS: but
for what has to be read to tell, as it is encrypted, unknown, or of more submessages than is usual.
What is over it is dropped, as datagrams may be anywhere: discovery is repeated, and its readers
ask for what they lack.
"""

from dataclasses import dataclass, field

PER_SECOND, BURST = 5_000.0, 25_000.0
"""Datagrams of a source in a second, and at once. A host with fifty participants that all start at
once, beside a hundred others, makes some ten thousand."""
STEP = 256
"""Bytes that are read for one datagram's charge; most announcements are two or three."""
MOST_SOURCES = 4096
"""Sources that are remembered; of more, the one that has been heard first goes."""


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
        self._remaining[source] = (remaining - 1 - size // STEP if allowed else remaining), now
        return allowed

    def charge(self, source: str, count: int) -> None:
        """Charge a source with so many datagrams that its own have led to; it may go into debt."""
        if count and source in self._remaining:
            remaining, since = self._remaining[source]
            self._remaining[source] = remaining - count, since
