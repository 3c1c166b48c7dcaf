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
from enum import IntEnum, auto

PER_SECOND = 10_000.0
BURST = 50_000.0
"""What a source may be charged in a second, and at once. Fifty participants at one address that
start at once are charged 10,000 with two peers, and some 1,200 a second from then on."""
STEP = 256
"""Bytes of a datagram for each unit of its charge. An announcement takes two or three."""
MOST_SOURCES = 4096
"""Sources that are remembered. Of more, the source is forgotten that was remembered first."""


class Standing(IntEnum):
    """What is known of a source.

    PROVEN: its address is a peer's, or lies inside and has proved to receive. STRANGER: its address
    is another one outside, and has proved to receive. One machine may have thousands of these.
    """

    PROVEN = auto()
    STRANGER = auto()
    INSIDE = auto()
    OUTSIDE = auto()


def cost(size: int) -> int:
    """What a datagram of so many bytes is charged."""
    return 1 + size // STEP


@dataclass(slots=True)
class _Allowance:
    """What is left of an allowance, and the time in seconds at which that was."""

    remaining: float
    since: float

    def refill(self, per_second: float, burst: float, now: float) -> float:
        """What is left now."""
        passed = max(now - self.since, 0.0)
        self.remaining = min(self.remaining + passed * per_second, burst)
        self.since = now
        return self.remaining


@dataclass(slots=True)
class DiscoveryRates:
    """The allowance of each source, and one for all unproven sources of a side together.

    A forger has as many sources as it likes; they share one allowance. ``unproven_per_second`` and
    ``unproven_burst`` are that one.
    """

    per_second: float = PER_SECOND
    burst: float = BURST
    unproven_per_second: float = PER_SECOND
    unproven_burst: float = BURST
    _by_source: dict[str, _Allowance] = field(default_factory=dict)
    _of_unproven: dict[Standing, _Allowance] = field(init=False)

    def __post_init__(self) -> None:
        """Nothing has been used yet."""
        sides = (Standing.INSIDE, Standing.OUTSIDE)
        self._of_unproven = {side: _Allowance(self.unproven_burst, 0.0) for side in sides}

    def take(
        self, source: str, size: int, now: float, standing: Standing = Standing.PROVEN
    ) -> bool:
        """Charge a source for a datagram of so many bytes. Return False if it may not be read."""
        shared = self._of_unproven.get(standing)
        # First: a forged source costs no place among those that are remembered.
        if shared and shared.refill(self.unproven_per_second, self.unproven_burst, now) < 1.0:
            return False
        own = self._allowance(source, now)
        if own.refill(self.per_second, self.burst, now) < 1.0:
            return False
        own.remaining -= cost(size)
        if shared:
            shared.remaining -= cost(size)
        return True

    def charge(self, source: str, total: int, standing: Standing = Standing.PROVEN) -> None:
        """Charge a source with what its datagrams have led to, as `cost`; it may go into debt."""
        if allowance := self._by_source.get(source):
            allowance.remaining -= total
        if standing in self._of_unproven:
            self._of_unproven[standing].remaining -= total

    def _allowance(self, source: str, now: float) -> _Allowance:
        allowance = self._by_source.get(source)
        if allowance is None:
            if len(self._by_source) >= MOST_SOURCES:
                del self._by_source[next(iter(self._by_source))]
            allowance = self._by_source[source] = _Allowance(self.burst, now)
        return allowance
