"""Fast ports: a second port for an endpoint's topics, from the part of the range that is spare.

An endpoint's fast port follows from its lease by arithmetic, so that a proxy which has lost all
memory gives every recovered endpoint the port that its subscribers are connected to. A fast port
is only an acceleration: it is given back before a node is refused a lease.
"""

from collections import ChainMap
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import chain
from typing import Protocol, TypeVar, cast

from rosproxy.leases.ports import PortPool, PortRange


class LeaseHolder(Protocol):
    """Who has a port that the kernel may forward, as the kernel plane needs it.

    An endpoint or stand-in of ROS 1 (`rosproxy.ros1.registry`), or a port of ROS 2
    (`rosproxy.ros2.ports.kernel_ports`), whose only port is its fast port as well.

    ``inside`` tells on which side its node is: who connects to it comes from the other one.
    """

    inside: bool

    fast_port: int | None
    fast_peers: Mapping[str, int]
    """How many connections the kernel forwards now, by the peer's address."""

    @property
    def port(self) -> int:
        """The lease."""

    @property
    def fast_connections(self) -> int:
        """How many connections the kernel forwards now."""

    @property
    def label(self) -> str:
        """How messages name it."""

    @property
    def address(self) -> str:
        """The IP address at which the proxy reaches the node."""

    @property
    def node_ports(self) -> Collection[int]:
        """The ports that the node itself has named: those of TCPROS, or that of a locator."""

    @property
    def trusted(self) -> bool:
        """Whether the node has been heard since the proxy started."""

    @property
    def is_down(self) -> bool:
        """Whether the node is known not to answer."""

    @property
    def caller_ids(self) -> list[str]:
        """The names of the nodes there; one, as a rule."""


_H = TypeVar("_H", bound=LeaseHolder)
_H_co = TypeVar("_H_co", bound=LeaseHolder, covariant=True)


class LeaseHolders(Protocol[_H_co]):
    """All endpoints, and the range that their ports are of."""

    @property
    def pool(self) -> PortPool:
        """The ports of the range."""

    @property
    def by_port(self) -> Mapping[int, _H_co]:
        """The endpoints by their leases."""

    def __iter__(self) -> Iterator[_H_co]:
        """All endpoints; safe against changes while iterating."""


class BothSides:
    """The endpoints inside and the stand-ins for nodes outside, which share no port."""

    def __init__(
        self, inside: LeaseHolders[LeaseHolder], outside: Mapping[int, LeaseHolder]
    ) -> None:
        self._inside = inside
        self._outside = outside

    @property
    def by_port(self) -> Mapping[int, LeaseHolder]:
        """All by their leases, or the ports that stand in for them."""
        views = (self._inside.by_port, self._outside)
        return ChainMap(*(cast(dict[int, LeaseHolder], view) for view in views))  # it is only read

    @property
    def pool(self) -> PortPool:
        """The ports of the range, which are for the endpoints inside."""
        return self._inside.pool

    def __iter__(self) -> Iterator[LeaseHolder]:
        """All; safe against changes while iterating."""
        return chain(self._inside, list(self._outside.values()))


def partner(ports: PortRange, port: int) -> int | None:
    """The port of a range that goes with another one; an odd last port has none.

    Of n ports the first n // 2 go with the next n // 2, so that leases, which are handed out from
    the first port on, meet fast ports as late as possible.
    """
    half = len(ports) // 2
    index = port - ports.first
    if not 0 <= index < 2 * half:
        return None
    return port + half if index < half else port - half


def claim(pool: PortPool, endpoint: LeaseHolder) -> bool:
    """Give an endpoint its fast port; False if that is not free. One that has it keeps it."""
    if endpoint.fast_port is not None:
        return True
    port = partner(pool.range, endpoint.port)
    if port is None or not pool.claim(port):
        return False
    endpoint.fast_port = port
    return True


def give_back(pool: PortPool, endpoint: LeaseHolder, blocked: bool = False) -> None:
    """Take an endpoint's fast port away; ``blocked``: another program holds that port."""
    if endpoint.fast_port is None:
        return
    if blocked:
        pool.block(endpoint.fast_port)
    pool.give_back(endpoint.fast_port)
    endpoint.fast_port = None


def least_used_holder(holders: Iterable[_H]) -> _H | None:
    """The holder that loses its fast port first when the range is short: with fewest connections.

    Those go on all the same: the kernel keeps forwarding what it has begun to forward.
    """
    candidates = [endpoint for endpoint in holders if endpoint.fast_port is not None]
    return min(candidates, key=lambda e: e.fast_connections, default=None)


def why_no_fast_port(pool: PortPool, endpoint: LeaseHolder) -> str:
    """Why an endpoint that could have a fast port has none."""
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
    """How many ports are left for nodes: those that are free, and fast ports."""
    return pool.free + fast_port_count(holders)
