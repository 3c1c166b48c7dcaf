"""Fast ports: a second port for an endpoint's topics, from the part of the range that is spare.

An endpoint's fast port follows from its lease by arithmetic, so that a proxy which has lost all
memory gives every recovered endpoint the port that its subscribers are connected to. A fast port
is only an acceleration: it is given back before a node is refused a lease.
"""

from collections.abc import Iterable
from typing import Protocol, TypeVar

from rosproxy.leases.ports import PortPool, PortRange


class Holder(Protocol):
    """An endpoint as its ports need it."""

    fast_port: int | None

    @property
    def port(self) -> int:
        """The lease."""

    @property
    def fast_connections(self) -> int:
        """How many connections the kernel forwards now."""

    @property
    def label(self) -> str:
        """How messages name it."""


_H = TypeVar("_H", bound=Holder)


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


def claim(pool: PortPool, endpoint: Holder) -> bool:
    """Give an endpoint its fast port; False if that is not free. One that has it keeps it."""
    if endpoint.fast_port is not None:
        return True
    port = partner(pool.range, endpoint.port)
    if port is None or not pool.claim(port):
        return False
    endpoint.fast_port = port
    return True


def give_back(pool: PortPool, endpoint: Holder, blocked: bool = False) -> None:
    """Take an endpoint's fast port away; ``blocked``: another program holds that port."""
    if endpoint.fast_port is None:
        return
    if blocked:
        pool.block(endpoint.fast_port)
    pool.give_back(endpoint.fast_port)
    endpoint.fast_port = None


def to_give_back(holders: Iterable[_H]) -> _H | None:
    """Whose fast port goes first when the range is short: where the fewest connections are.

    Those go on all the same: the kernel keeps forwarding what it has begun to forward.
    """
    found = [endpoint for endpoint in holders if endpoint.fast_port is not None]
    return min(found, key=lambda e: e.fast_connections, default=None)


def why_none(pool: PortPool, endpoint: Holder) -> str:
    """Why an endpoint that could have a fast port has none."""
    port = partner(pool.range, endpoint.port)
    if port is None:
        return f"no port of the range goes with port {endpoint.port}"
    if pool.is_free(port):
        return "nobody outside has asked for a topic of it lately"
    return f"port {port}, which goes with its port {endpoint.port}, is in use"


def held(holders: Iterable[Holder]) -> int:
    """How many ports are fast ports now."""
    return sum(endpoint.fast_port is not None for endpoint in holders)


def left(pool: PortPool, holders: Iterable[Holder]) -> int:
    """How many ports are left for nodes: those that are free, and fast ports."""
    return pool.free + held(holders)
