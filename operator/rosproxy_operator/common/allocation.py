"""Finding ports for a proxy, and when it leaves them: the same for every engine."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

from rosproxy.leases.ports import PortRange

RETRY_FOR = 20.0
"""Seconds for which a proxy that has served is tried again on its ports before it leaves them."""
TAKEN_FOR = 300.0
"""Seconds for which a port is avoided that the engine has refused."""
MOVED_FOR = 600.0
"""Seconds for which it is told that a proxy had to leave its range."""


@dataclass(frozen=True, slots=True)
class Move:
    """A proxy had to leave the range on which it had served."""

    ports: PortRange
    at: float


class PortsExhausted(Exception):
    """A window has not as many free ports in a row as were asked for.

    ``free`` counts its free ports, ``longest`` is the most that there are in a row.
    """

    def __init__(self, count: int, window: PortRange, free: int, longest: int) -> None:
        super().__init__(
            f"no {count} free ports in a row between {window.first} and {window.last}: "
            f"{free} of {len(window)} are free, {longest} at most in a row"
        )
        self.count = count
        self.window = window
        self.free = free
        self.longest = longest


def negotiate(
    count: int,
    window: PortRange,
    blocked: Collection[int],
    ranges: Iterable[PortRange] = (),
    prefer: PortRange | None = None,
) -> PortRange:
    """A range of free ports: the preferred one if it can be had, else the first that fits.

    Args:
        count: How many ports are needed, at least one.
        window: Where to look.
        blocked: Single ports that can't be had.
        ranges: Ranges that can't be had.
        prefer: Where the ports were before, if they were. It is taken whole even if it is longer
            than needed or outside the window, and made longer at its end if it is too short.

    Returns:
        Exactly ``count`` ports, unless ``prefer`` has more.

    Raises:
        PortsExhausted: The window has no such range.
    """
    held = tuple(ranges)
    if prefer is not None and is_free(prefer, blocked, held):
        kept = extended(prefer, count, window, blocked, held)
        if kept is not None:
            return kept
    gaps = list(_gaps(window, blocked, held))
    for gap in gaps:
        if len(gap) >= count:
            return PortRange(gap.first, gap.first + count - 1)
    lengths = [len(gap) for gap in gaps]
    raise PortsExhausted(count, window, sum(lengths), max(lengths, default=0))


def extended(
    ports: PortRange,
    count: int,
    window: PortRange,
    blocked: Collection[int],
    ranges: Iterable[PortRange] = (),
) -> PortRange | None:
    """The range with ports added at its end up to ``count``, if those are free and in the window.

    The range itself is taken for granted, and never made shorter.
    """
    if len(ports) >= count:
        return ports
    wanted = PortRange(ports.first, ports.first + count - 1)
    more = PortRange(ports.last + 1, wanted.last)
    return wanted if wanted.last <= window.last and is_free(more, blocked, ranges) else None


def is_free(ports: PortRange, blocked: Collection[int], ranges: Iterable[PortRange] = ()) -> bool:
    """Whether a range can be had."""
    if any(overlap(ports, held) for held in ranges):
        return False
    return not any(port in ports for port in blocked)


def overlap(one: PortRange, other: PortRange) -> bool:
    """Whether two ranges have a port in common."""
    return one.first <= other.last and other.first <= one.last


def within(inner: PortRange, outer: PortRange) -> bool:
    """Whether the outer range has all ports of the inner one."""
    return outer.first <= inner.first and inner.last <= outer.last


def _gaps(
    window: PortRange, blocked: Collection[int], ranges: Iterable[PortRange]
) -> Iterator[PortRange]:
    """The free stretches of a window, in order."""
    held = [(port, port) for port in blocked] + [(ports.first, ports.last) for ports in ranges]
    first = window.first
    for start, end in sorted(held):
        if start > window.last:
            break
        if start > first:
            yield PortRange(first, start - 1)
        first = max(first, end + 1)
    if first <= window.last:
        yield PortRange(first, window.last)
