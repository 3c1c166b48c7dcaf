"""The demo's players: which nodes there are, and how each process is set up."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from rosproxy.demo.layout import Layout, Place

RATE = 20
"""Messages a second that each talker publishes."""


@dataclass(frozen=True)
class Role:
    """What one node does: `side` and `node` make up its name, the rest is optional."""

    side: str
    node: str
    publish: str | None = None
    subscribe: str | None = None
    serve: str | None = None

    @property
    def name(self) -> str:
        """The node's ROS name."""
        return f"/{self.side}/{self.node}"


FROM_INSIDE, FROM_OUTSIDE = "/from_inside", "/from_outside"
ADD_INSIDE, ADD_OUTSIDE = "/inside/add_two_ints", "/outside/add_two_ints"

INSIDE_TALKER = Role("inside", "talker", publish=FROM_INSIDE)
INSIDE_LISTENER = Role("inside", "listener", subscribe=FROM_OUTSIDE)
INSIDE_ADDER = Role("inside", "adder", serve=ADD_INSIDE)
OUTSIDE_TALKER = Role("outside", "talker", publish=FROM_OUTSIDE)
OUTSIDE_LISTENER = Role("outside", "listener", subscribe=FROM_INSIDE)
OUTSIDE_ADDER = Role("outside", "adder", serve=ADD_OUTSIDE)

INSIDE = (INSIDE_TALKER, INSIDE_LISTENER, INSIDE_ADDER)
OUTSIDE = (OUTSIDE_TALKER, OUTSIDE_LISTENER, OUTSIDE_ADDER)


def place_of(role: Role, layout: Layout) -> Place:
    """Return where a node lives."""
    return layout.outside if role.side == "outside" else layout.inside[role.node]


def node_config(role: Role, layout: Layout, master_uri: str) -> dict[str, Any]:
    """Return the set-up of a node's process."""
    place = place_of(role, layout)
    return {
        "role": "node",
        "name": role.name,
        "master": master_uri,
        "rate": RATE,
        "publish": role.publish,
        "subscribe": role.subscribe,
        "serve": role.serve,
        **asdict(place),
    }


def master_config(layout: Layout) -> dict[str, Any]:
    """Return the set-up of the master's process, which lives outside."""
    return {"role": "master", **asdict(layout.outside)}


@dataclass(frozen=True)
class ProxyPorts:
    """The ports of the proxy: one for the master, one for its admin endpoint, and the range."""

    first: int
    leases: int = 8

    @property
    def master(self) -> int:
        """Where inside nodes find their master."""
        return self.first

    @property
    def admin(self) -> int:
        """Where the proxy tells whether it is ready."""
        return self.first + 1

    @property
    def range(self) -> str:
        """The ports that stand for inside nodes."""
        return f"{self.first + 2}-{self.first + 1 + self.leases}"

    @property
    def count(self) -> int:
        """How many ports that are in all."""
        return self.leases + 2


def proxy_options(layout: Layout, ports: ProxyPorts, master_uri: str) -> list[str]:
    """Return the command line of the proxy."""
    return [
        f"--master-uri={master_uri}",
        f"--advertise-host={layout.host}",
        "--data-plane=splice",
        f"--master-port={ports.master}",
        f"--port-range={ports.range}",
        f"--admin-bind=127.0.0.1:{ports.admin}",
        f"--inside-network={layout.inside_network}",
    ]
