"""The place of a proxy: the graph of the nodes, and the address at which outside reaches the nodes.

The place identifies a proxy on a host. A container with ROS 1 and ROS 2 has two proxies, since the
containers of a master and of a domain may differ.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_slave_uri


@dataclass(frozen=True, slots=True)
class Master:
    """The graph of a ROS 1 master. ``uri`` is a URI as in ROS_MASTER_URI."""

    uri: str
    ros: ClassVar[Literal["1"]] = "1"

    def __str__(self) -> str:
        return f"master {self.uri}"

    @property
    def host_port(self) -> HostPort:
        """The host and port of the master. Raises ValueError if the URI has no host and port."""
        host_port = parse_slave_uri(self.uri)
        if host_port is None:
            raise ValueError(f"{self.uri!r} is no master's URI")
        return host_port

    @property
    def host(self) -> str:
        """The host of the master. Raises ValueError as `host_port` does."""
        return self.host_port.host

    @property
    def port(self) -> int:
        """The port of the master. Raises ValueError as `host_port` does."""
        return self.host_port.port


@dataclass(frozen=True, slots=True)
class Domain:
    """The graph of a ROS 2 domain with DDS. ``number`` is from 0 to 232."""

    number: int
    ros: ClassVar[Literal["2"]] = "2"

    def __str__(self) -> str:
        return f"ROS 2 domain {self.number}"


@dataclass(frozen=True, slots=True)
class ZenohNetwork:
    """The graph of all nodes with rmw_zenoh. Zenoh itself keeps the ROS 2 domains apart."""

    ros: ClassVar[Literal["zenoh"]] = "zenoh"

    def __str__(self) -> str:
        return "zenoh network"


Graph = Master | Domain | ZenohNetwork
"""A graph of nodes.

``ros`` is the value of the proxy's option ``--ros``. The text of a graph has the words of messages.
"""


@dataclass(frozen=True, slots=True)
class Place:
    """The graph that a proxy serves, and the address of the host that the proxy advertises.

    The advertised host is empty for `ZENOH`, whose proxy publishes no port, and in requests of
    labels while the host is unknown.
    """

    graph: Graph
    advertise_host: str

    def __lt__(self, other: "Place") -> bool:
        return self._order < other._order

    @property
    def master(self) -> Master:
        """The graph of a ROS 1 master. Raises ValueError for a graph without a master."""
        if not isinstance(self.graph, Master):
            raise ValueError(f"the {self.graph} has no master")
        return self.graph

    @property
    def _order(self) -> tuple[str, str, int]:
        uri = self.graph.uri if isinstance(self.graph, Master) else ""
        number = self.graph.number if isinstance(self.graph, Domain) else 0
        return uri, self.advertise_host, number


ZENOH = Place(ZenohNetwork(), "")
"""The place of the proxy for rmw_zenoh."""
