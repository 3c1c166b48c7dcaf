"""Finding ports for a proxy, and when it leaves them: the same for every engine."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

from rosproxy.leases.ports import PortRange

LAST_PORT = 65535
RETRY_FOR = 20.0
"""Seconds for which a proxy that has served is tried again on its ports before it leaves them."""
TAKEN_FOR = 300.0
"""Seconds for which a port is avoided that the engine has refused."""
MOVED_FOR = 600.0
"""Seconds for which it is reported that a proxy had to leave its range."""


@dataclass(frozen=True, slots=True)
class Move:
    """A proxy had to leave the range on which it had served."""

    ports: PortRange
    at: float


def after_move(ros1: bool, ros2: bool) -> str:
    """What happens to nodes behind a proxy that had to leave its range, and what to do.

    ROS 1's nodes have to register anew. Participants of ROS 2 meet anew by themselves, if the
    operator has seen what ports they had.
    """
    effects = []
    if ros1:
        text = "Restart the nodes that registered on the old ports: outside can't reach them"
        effects.append(text)
    if ros2:
        text = (
            "Outside discovers the ROS 2 participants again. Restart the participants that outside "
            "has not discovered after a minute"
        )
        effects.append(text)
    return ". ".join(effects)


class PortsExhausted(Exception):
    """A window has not as many free ports in a row as were asked for.

    ``free`` are the lengths of its free stretches.
    """

    def __init__(self, count: int, window: PortRange, free: Collection[int]) -> None:
        super().__init__(
            f"no {count} free ports in a row between {window.first} and {window.last}: "
            f"{sum(free)} of {len(window)} are free, {max(free, default=0)} at most in a row"
        )
        self.count = count
        self.window = window


def negotiate(
    count: int, window: PortRange, blocked: Collection[int], ranges: Iterable[PortRange] = ()
) -> PortRange:
    """The first ``count`` consecutive free ports of a window.

    ``blocked`` are single ports that are not free, ``ranges`` whole ranges. Raises PortsExhausted.
    """
    gaps = list(_gaps(window, blocked, ranges))
    for gap in gaps:
        if len(gap) >= count:
            return PortRange(gap.first, gap.first + count - 1)
    raise PortsExhausted(count, window, [len(gap) for gap in gaps])


def negotiate_with_room(
    count: int,
    window: PortRange,
    blocked: Collection[int],
    growing: Iterable[PortRange],
    fixed: Iterable[PortRange] = (),
) -> PortRange:
    """Ports as `negotiate`, where possible with room for the range and its neighbours to double.

    ``growing`` are the ranges of other proxies, which may get longer, ``fixed`` other ranges.
    """
    growing = [*growing]
    fixed = [*fixed]
    doubled = [PortRange(ports.first, min(ports.last + len(ports), LAST_PORT)) for ports in growing]
    try:
        roomy = negotiate(2 * count, window, blocked, [*doubled, *fixed])
    except PortsExhausted:
        return negotiate(count, window, blocked, [*growing, *fixed])
    return PortRange(roomy.first, roomy.first + count - 1)


def extended(
    ports: PortRange,
    count: int,
    window: PortRange,
    blocked: Collection[int],
    ranges: Iterable[PortRange] = (),
) -> PortRange | None:
    """The range with ports added at its end up to ``count``, if those are free and in the window.

    The range itself is not checked, and never made shorter.
    """
    if len(ports) >= count:
        return ports
    wanted = PortRange(ports.first, ports.first + count - 1)
    added = PortRange(ports.last + 1, wanted.last)
    return wanted if wanted.last <= window.last and is_free(added, blocked, ranges) else None


def is_free(ports: PortRange, blocked: Collection[int], ranges: Iterable[PortRange] = ()) -> bool:
    """Whether a range has no blocked port, and none of another range."""
    return not (any(overlap(ports, r) for r in ranges) or any(p in ports for p in blocked))


def overlap(ports: PortRange, other_ports: PortRange) -> bool:
    """Whether two ranges have a port in common."""
    return ports.first <= other_ports.last and other_ports.first <= ports.last


def within(inner: PortRange, outer: PortRange) -> bool:
    """Whether the outer range has all ports of the inner one."""
    return outer.first <= inner.first and inner.last <= outer.last


def _gaps(
    window: PortRange, blocked: Collection[int], ranges: Iterable[PortRange]
) -> Iterator[PortRange]:
    """The free stretches of a window, in order."""
    intervals = [(port, port) for port in blocked] + [(ports.first, ports.last) for ports in ranges]
    first = window.first
    for start, end in sorted(intervals):
        if start > window.last:
            break
        if start > first:
            yield PortRange(first, start - 1)
        first = max(first, end + 1)
    if first <= window.last:
        yield PortRange(first, window.last)
