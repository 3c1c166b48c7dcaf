"""Fast ports: a second port for the topics of an endpoint, from the free part of the range.

The lease of an endpoint determines the fast port by arithmetic. So after a restart the proxy gives
each recovered endpoint the fast port to which its subscribers are connected. A fast port only makes
topics faster: before the proxy refuses a node a lease, another endpoint loses its fast port.
"""

from collections import ChainMap
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import chain
from typing import Protocol, TypeVar, cast

from rosproxy.shared.ports import PortPool, PortRange


class LeaseHolder(Protocol):
    """The holder of a port that the kernel may forward, as the kernel plane sees the holder.

    An endpoint or stand-in of ROS 1 (`rosproxy.ros1.registry`), or a port of ROS 2
    (`rosproxy.ros2.ports.kernel_ports`). For ROS 2, ``port`` and ``fast_port`` are the same port.

    ``inside``: True if the node is inside, and its peers connect from outside. False if the node is
    outside, and its peers connect from inside.
    """

    inside: bool

    fast_port: int | None
    fast_peers: Mapping[str, int]
    """The number of connections that the kernel forwards now, by the address of the peer."""

    @property
    def port(self) -> int:
        """The lease."""

    @property
    def fast_connections(self) -> int:
        """How many connections the kernel forwards now."""

    @property
    def label(self) -> str:
        """The name of the holder in messages."""

    @property
    def address(self) -> str:
        """The IP address at which the proxy reaches the node."""

    @property
    def node_ports(self) -> Collection[int]:
        """The ports that the node itself has announced: TCPROS ports, or the port of a locator."""

    @property
    def trusted(self) -> bool:
        """Whether the proxy knows the node from more than the data of the master."""

    @property
    def is_down(self) -> bool:
        """Whether the proxy has found that the node does not answer."""

    @property
    def caller_ids(self) -> list[str]:
        """The names of the nodes at the port; usually a single name."""


_H = TypeVar("_H", bound=LeaseHolder)
_H_co = TypeVar("_H_co", bound=LeaseHolder, covariant=True)


class LeaseHolders(Protocol[_H_co]):
    """All endpoints, and the pool of the range to which the ports of the endpoints belong."""

    @property
    def pool(self) -> PortPool:
        """The ports of the range."""

    @property
    def by_port(self) -> Mapping[int, _H_co]:
        """The endpoints by their leases."""

    def __iter__(self) -> Iterator[_H_co]:
        """All endpoints; safe against changes while iterating."""


class BothSides:
    """The endpoints inside and the stand-ins for nodes outside; no port belongs to both."""

    def __init__(
        self, inside: LeaseHolders[LeaseHolder], outside: Mapping[int, LeaseHolder]
    ) -> None:
        self._inside = inside
        self._outside = outside

    @property
    def by_port(self) -> Mapping[int, LeaseHolder]:
        """Endpoints by lease, and stand-ins by port."""
        views = (self._inside.by_port, self._outside)
        # ChainMap asks for mutable mappings; the type of the result is read-only.
        return ChainMap(*(cast(dict[int, LeaseHolder], view) for view in views))

    @property
    def pool(self) -> PortPool:
        """The ports of the range, from which only the endpoints inside get ports."""
        return self._inside.pool

    def __iter__(self) -> Iterator[LeaseHolder]:
        """All endpoints and stand-ins; safe against changes while iterating."""
        return chain(self._inside, list(self._outside.values()))


def partner(ports: PortRange, port: int) -> int | None:
    """The partner of a port: the fast port for a lease at the port.

    Of n ports, each of the first n // 2 has a partner in the next n // 2, and the reverse. None for
    the last port of an odd number of ports, and for a port outside the range. The proxy gives
    leases from the first port on, so leases need the ports of partners as late as possible.
    """
    half = len(ports) // 2
    index = port - ports.first
    if not 0 <= index < 2 * half:
        return None
    return port + half if index < half else port - half


def claim(pool: PortPool, endpoint: LeaseHolder) -> bool:
    """Give an endpoint the fast port of its lease; return whether the endpoint has a fast port.

    False if the lease has no partner, or if the partner is not free.
    """
    if endpoint.fast_port is not None:
        return True
    port = partner(pool.range, endpoint.port)
    if port is None or not pool.claim(port):
        return False
    endpoint.fast_port = port
    return True


def give_back(pool: PortPool, endpoint: LeaseHolder, blocked: bool = False) -> None:
    """Take the fast port of an endpoint away; ``blocked``: another program holds that port."""
    if endpoint.fast_port is None:
        return
    if blocked:
        pool.block(endpoint.fast_port)
    pool.give_back(endpoint.fast_port)
    endpoint.fast_port = None


def least_used_holder(holders: Iterable[_H]) -> _H | None:
    """The holder with the fewest connections, which loses its fast port first in a full range.

    None if no holder has a fast port. The connections of the holder stay: the kernel continues to
    forward open connections.
    """
    candidates = [endpoint for endpoint in holders if endpoint.fast_port is not None]
    return min(candidates, key=lambda e: e.fast_connections, default=None)


def why_no_fast_port(pool: PortPool, endpoint: LeaseHolder) -> str:
    """The reason why an endpoint has no fast port, although the kernel could forward for it."""
    port = partner(pool.range, endpoint.port)
    if port is None:
        return f"port {endpoint.port} has no second port in the range for a fast port"
    if pool.is_free(port):
        return "no subscriber has asked for a topic of the node lately"
    return f"the fast port of the node would be {port}, which is in use"


def fast_port_count(holders: Iterable[LeaseHolder]) -> int:
    """How many ports are fast ports now."""
    return sum(endpoint.fast_port is not None for endpoint in holders)


def ports_left(pool: PortPool, holders: Iterable[LeaseHolder]) -> int:
    """How many ports nodes can still get: free ports and fast ports."""
    return pool.free + fast_port_count(holders)
