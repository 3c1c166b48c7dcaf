"""What the kernel plane needs to know of an endpoint; `rosproxy.ros1.registry` has them."""

from collections.abc import Collection, Iterator, Mapping
from typing import Protocol

from rosproxy.leases.fast_ports import Holder
from rosproxy.leases.ports import PortPool


class ForwardedEndpoint(Holder, Protocol):
    """A node that holds a lease, and maybe a fast port."""

    fast_peers: Mapping[str, int]
    """How many connections the kernel forwards now, by the peer's address."""

    @property
    def address(self) -> str:
        """The IP address at which the proxy reaches the node."""

    @property
    def tcpros_ports(self) -> Collection[int]:
        """The TCPROS ports that the node itself has named."""

    @property
    def answers(self) -> bool:
        """Whether the node is known to be there."""

    @property
    def trusted(self) -> bool:
        """Whether the node has been heard since the proxy started."""

    @property
    def is_down(self) -> bool:
        """Whether the node is known not to answer."""

    @property
    def caller_ids(self) -> list[str]:
        """The names of the nodes there; one, as a rule."""


class ForwardedEndpoints(Protocol):
    """All endpoints, and the range that their ports are of."""

    @property
    def pool(self) -> PortPool:
        """The ports of the range."""

    @property
    def by_port(self) -> Mapping[int, ForwardedEndpoint]:
        """The endpoints by their leases."""

    def __iter__(self) -> Iterator[ForwardedEndpoint]:
        """All endpoints."""
