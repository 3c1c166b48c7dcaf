"""Chooses the range of ports of each proxy, for all engines.

A proxy should keep its range: ROS nodes are registered at the master under the ports of the range.
So `kept_ranges` gives each proxy its present range, or a former range that is free. Then
`assign_ranges` gives ranges to the other proxies, and more ports to proxies with too few. The
caller, the operator of an engine, passes the ports that are not free.
"""

from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeVar

from rosproxy.shared.ports import PortRange

LAST_PORT = 65535
REFUSED_RANGE_KEPT_S = 20.0
"""Seconds for which a proxy that has served keeps a range whose ports the engine refuses.

After that time the proxy gets another range.
"""
REFUSED_PORT_AVOIDED_S = 300.0
"""Seconds for which the operator avoids a port that the engine has refused."""
MOVE_REPORTED_S = 600.0
"""Seconds for which the operator reports that a proxy had to leave its range."""
LOCAL_PORTS = (PortRange(1024, 11000), PortRange(32768, 60999))
"""Ranges for the outgoing connections of a proxy, best first (net.ipv4.ip_local_port_range)."""
_UNPRIVILEGED_PORTS = PortRange(1024, LAST_PORT)
ProxyKey = TypeVar("ProxyKey", bound=Hashable)
"""The key of a proxy, unique in an engine."""


@dataclass(frozen=True, slots=True)
class Move:
    """A proxy had to leave the range ``ports``, on which it had served, at the time ``at``."""

    ports: PortRange
    at: float


@dataclass(frozen=True, slots=True)
class FormerRange:
    """A range that a proxy had, or that the operator has planned for the proxy.

    The proxy gets the range if the range has no port of ``blocked``, and none of ``ranges``.
    """

    ports: PortRange
    blocked: Collection[int]
    ranges: Collection[PortRange] = ()


@dataclass(frozen=True, slots=True)
class RangeRequest:
    """The ports that a proxy needs on the host: ``count`` consecutive ports of ``window``.

    ``held`` is the range that the proxy has now and keeps. Without ``held``, the proxy keeps the
    first range of ``former`` that is free. New ports are never in:

    - ``blocked``: single ports.
    - ``ranges``: whole ranges.
    - ``growing``: ranges of other proxies, which may get longer.

    A new range has no port of ``avoided``, and leaves room to grow: the new range and the
    ``growing`` ranges can each become ``room`` times as long without overlapping the others. If
    there is no such range, both conditions are dropped.
    """

    count: int
    window: PortRange
    blocked: Collection[int]
    ranges: Collection[PortRange] = ()
    held: PortRange | None = None
    former: tuple[FormerRange, ...] = ()
    growing: Collection[PortRange] = ()
    avoided: Collection[PortRange] = ()
    room: int = 1


def advice_after_move(ros1: bool, ros2: bool) -> str:
    """Return what happens to the nodes of a proxy that had to leave its range, and what to do.

    Nodes of ROS 1 have to register again. Participants of ROS 2 rediscover each other, if the
    operator knows the participants' former ports.
    """
    texts = {
        "Restart the nodes that registered on the old ports: outside can't reach these nodes": ros1,
        "Outside discovers the ROS 2 participants again. Restart the participants that outside has "
        "not discovered after a minute": ros2,
    }
    return ". ".join(text for text, applies in texts.items() if applies)


class PortsExhausted(Exception):
    """A window does not have ``count`` consecutive free ports.

    ``free`` has the lengths of the free stretches in the window.
    """

    def __init__(self, count: int, window: PortRange, free: Collection[int]) -> None:
        super().__init__(
            f"no {count} free ports in a row between {window.first} and {window.last}: "
            f"{sum(free)} of {len(window)} are free, the longest free stretch has "
            f"{max(free, default=0)}"
        )
        self.count = count
        self.window = window


def kept_ranges(requests: Mapping[ProxyKey, RangeRequest]) -> dict[ProxyKey, PortRange]:
    """Return the ranges that the proxies of a host keep. Earlier requests have priority."""
    given: dict[ProxyKey, PortRange] = {}
    for proxy, request in requests.items():
        possible = (
            former.ports
            for former in request.former
            if is_free(former.ports, former.blocked, [*former.ranges, *given.values()])
        )
        if ports := request.held or next(possible, None):
            given[proxy] = ports
    return given


def assign_ranges(
    requests: Mapping[ProxyKey, RangeRequest], kept: Mapping[ProxyKey, PortRange]
) -> tuple[dict[ProxyKey, PortRange], dict[ProxyKey, PortsExhausted]]:
    """Return the range of each proxy, and the `PortsExhausted` of each proxy without a range.

    ``kept`` are the ranges of `kept_ranges`. A range that is too short gets more ports at its end,
    if all of these ports are free and in the window.
    """
    given = dict(kept)
    exhausted: dict[ProxyKey, PortsExhausted] = {}
    for proxy, request in requests.items():
        growing = [*request.growing, *(ports for other, ports in given.items() if other != proxy)]
        try:
            if ports := given.get(proxy):
                given[proxy] = _extended(ports, request, growing)
            else:
                given[proxy] = _new_range(request, growing)
        except PortsExhausted as error:
            exhausted[proxy] = error
    return given, exhausted


def _extended(ports: PortRange, request: RangeRequest, growing: Iterable[PortRange]) -> PortRange:
    """Return the range with more ports at its end if possible, else the unchanged range."""
    wanted = PortRange(ports.first, ports.first + request.count - 1)
    added = PortRange(ports.last + 1, wanted.last)
    is_possible = ports.last < wanted.last <= request.window.last
    ranges = [*request.ranges, *growing]
    return wanted if is_possible and is_free(added, request.blocked, ranges) else ports


def _new_range(request: RangeRequest, growing: Collection[PortRange]) -> PortRange:
    """Return the first range that meets all conditions, else the first free range.

    Raises PortsExhausted.
    """
    more = request.room - 1
    widened = [PortRange(r.first, min(r.last + more * len(r), LAST_PORT)) for r in growing]
    preferred = [*request.ranges, *request.avoided, *widened]
    try:
        roomy = first_free_range(
            request.room * request.count, request.window, request.blocked, preferred
        )
    except PortsExhausted:
        return first_free_range(
            request.count, request.window, request.blocked, [*request.ranges, *growing]
        )
    return PortRange(roomy.first, roomy.first + request.count - 1)


def new_moves(
    former: Mapping[ProxyKey, PortRange], given: Mapping[ProxyKey, PortRange], now: float
) -> dict[ProxyKey, Move]:
    """Return the moves of the proxies that leave their ranges, at the time ``now``."""
    return {
        proxy: Move(ports, now)
        for proxy, ports in former.items()
        if proxy in given and is_moved(ports, given[proxy])
    }


def is_moved(former: PortRange, ports: PortRange) -> bool:
    """Whether the first port differs. A range that grows or shrinks at its end does not move."""
    return former.first != ports.first


def first_free_range(
    count: int, window: PortRange, blocked: Collection[int], ranges: Iterable[PortRange] = ()
) -> PortRange:
    """Return the first ``count`` consecutive free ports of a window.

    ``blocked`` are single ports that are not free, ``ranges`` whole ranges. Raises PortsExhausted.
    """
    free = list(gaps(window, blocked, ranges))
    for gap in free:
        if len(gap) >= count:
            return PortRange(gap.first, gap.first + count - 1)
    raise PortsExhausted(count, window, [len(gap) for gap in free])


def is_free(ports: PortRange, blocked: Collection[int], ranges: Iterable[PortRange] = ()) -> bool:
    """Whether a range has no blocked port, and none of another range."""
    return not (any(overlap(ports, r) for r in ranges) or any(p in ports for p in blocked))


def overlap(ports: PortRange, other_ports: PortRange) -> bool:
    """Whether two ranges have a port in common."""
    return ports.first <= other_ports.last and other_ports.first <= ports.last


def local_ports(
    listening: Collection[PortRange], stand_ins: Collection[PortRange] = ()
) -> PortRange:
    """Return the ports for outgoing connections of a proxy that listens on the ``listening`` ports.

    The result is the first range of `LOCAL_PORTS` without ports of ``listening``; this range may
    have ports of ``stand_ins``. If there is none, the result is the longest range without ports of
    ``listening`` and of ``stand_ins``. So no connection takes a port of the proxy's range before a
    node needs the port.
    """
    free = gaps(_UNPRIVILEGED_PORTS, (), [*listening, *stand_ins])
    longest = max(free, key=len, default=LOCAL_PORTS[0])
    return first_fitting(LOCAL_PORTS, listening) or longest


def first_fitting(ranges: Iterable[PortRange], used: Collection[PortRange]) -> PortRange | None:
    """Return the first range without ports of ``used``."""
    return next((ports for ports in ranges if is_free(ports, (), used)), None)


def within(inner: PortRange, outer: PortRange) -> bool:
    """Whether ``outer`` has all ports of ``inner``."""
    return outer.first <= inner.first and inner.last <= outer.last


def gaps(
    window: PortRange, blocked: Collection[int], ranges: Iterable[PortRange]
) -> Iterator[PortRange]:
    """Yield the stretches of a window without blocked ports and other ranges, in order."""
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
