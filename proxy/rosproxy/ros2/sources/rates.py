"""The allowance of each source for discovery.

Reading discovery costs a hundred times as much as passing on a datagram of user data, and an
announcement goes to all participants of the other side. So each source has an allowance, which
refills with time. The charge follows from the length of the datagrams that come from the source,
and of those that the proxy sends in consequence.

User data is not charged, with one exception: some user data at a port for both kinds (Cyclone DDS)
has to be parsed to be recognised. This is the case for encrypted or unknown submessages, and for an
unusual number of submessages.

A datagram beyond the allowance is dropped. Participants repeat discovery, and readers request
missing samples.
"""

from dataclasses import dataclass, field
from enum import IntEnum, auto

PER_SECOND = 10_000.0
"""The charge that a source may cause in a second."""
BURST = 50_000.0
"""The charge that a source may cause at once. With two peers, fifty participants at an address that
start together cause 10,000, and then some 1,200 a second."""
BYTES_PER_UNIT = 256
"""Bytes of a datagram for each unit of the charge. An announcement costs two or three units."""
MOST_SOURCES = 4096
"""Sources with an allowance. Beyond this number, the oldest allowance is forgotten, first those of
unproven sources."""


class Standing(IntEnum):
    """The kinds of sources.

    PROVEN: the address of a peer, or a proven address inside. PROVEN_OUTSIDE: another proven
    address outside. A single machine may have thousands of these. INSIDE and OUTSIDE: all other
    addresses.
    """

    PROVEN = auto()
    PROVEN_OUTSIDE = auto()
    INSIDE = auto()
    OUTSIDE = auto()


def cost(size: int) -> int:
    """The charge for a datagram of ``size`` bytes."""
    return 1 + size // BYTES_PER_UNIT


@dataclass(slots=True)
class _Allowance:
    """What is left of an allowance at the time ``since``, in seconds."""

    remaining: float
    since: float

    def refill(self, per_second: float, burst: float, now: float) -> float:
        """Refill the allowance up to ``now``, and return what is left."""
        passed = max(now - self.since, 0.0)
        self.remaining = min(self.remaining + passed * per_second, burst)
        self.since = now
        return self.remaining


@dataclass(slots=True)
class DiscoveryRates:
    """The allowance of each source, and a common allowance of all unproven sources of a side.

    A forger may use any number of sources, but these share one allowance. ``unproven_per_second``
    and ``unproven_burst`` are its rate and size. Such a source is forgotten before a proven one:
    otherwise a proven source could have its used allowance forgotten, and so get a new one.
    """

    per_second: float = PER_SECOND
    burst: float = BURST
    unproven_per_second: float = PER_SECOND
    unproven_burst: float = BURST
    _by_source: dict[str, _Allowance] = field(default_factory=dict)
    _unproven: dict[str, None] = field(default_factory=dict)
    """The sources that were unproven at the last datagram, the oldest first."""
    _of_unproven: dict[Standing, _Allowance] = field(init=False)

    def __post_init__(self) -> None:
        """Begin with full allowances."""
        sides = (Standing.INSIDE, Standing.OUTSIDE)
        self._of_unproven = {side: _Allowance(self.unproven_burst, 0.0) for side in sides}

    def take(
        self, source: str, size: int, now: float, standing: Standing = Standing.PROVEN
    ) -> bool:
        """Charge a source for a datagram of ``size`` bytes.

        Return False, without a charge, if the allowance of the source or its side is used up.
        """
        shared = self._of_unproven.get(standing)
        # Checked first, so that forged sources do not fill `_by_source`.
        if shared and shared.refill(self.unproven_per_second, self.unproven_burst, now) < 1.0:
            return False
        own = self._allowance(source, now)
        if own.refill(self.per_second, self.burst, now) < 1.0:
            return False
        own.remaining -= cost(size)
        self._unproven.pop(source, None)
        if shared:
            self._unproven[source] = None
            shared.remaining -= cost(size)
        return True

    def charge(self, source: str, total: int, standing: Standing = Standing.PROVEN) -> None:
        """Charge a source for datagrams in consequence. The allowance may become negative.

        ``total`` is in the units of `cost`.
        """
        if allowance := self._by_source.get(source):
            allowance.remaining -= total
        if standing in self._of_unproven:
            self._of_unproven[standing].remaining -= total

    def _allowance(self, source: str, now: float) -> _Allowance:
        allowance = self._by_source.get(source)
        if allowance is None:
            if len(self._by_source) >= MOST_SOURCES:
                oldest = next(iter(self._unproven or self._by_source))
                del self._by_source[oldest]
                self._unproven.pop(oldest, None)
            allowance = self._by_source[source] = _Allowance(self.burst, now)
        return allowance
