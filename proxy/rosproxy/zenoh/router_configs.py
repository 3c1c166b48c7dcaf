"""The configurations of the proxy's routers: a router for each container, and the hub.

A router never passes data between two peers of this router: zenoh expects such peers to reach each
other directly. rmw_zenoh makes each node a peer that listens on loopback. So nodes of the same
container reach each other, and nodes of two containers do not. With a router for each container,
two containers are peers of two routers, and routers pass data on to each other. The hub is linked
to all these routers, and to routers outside. The hub dials the routers of containers by sockets in
a directory. So the access control of such a router distinguishes the hub from nodes.

Links to other sites have a router of their own, which dials the hub (`rosproxy.zenoh.link_router`).

The values come from rmw_zenohd (rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5).
Exceptions are the addresses, the bound of sessions, and the delay for scouting, which is off.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.zenoh.policy.access_control import HUB_PROTOCOL, NODE_PROTOCOL
from rosproxy.zenoh.protocol.report import MOST_SESSIONS

RouterConfig = Mapping[str, str]
"""Values as JSON, by the keys of zenoh's configuration."""
_LOOPBACK = {"0.0.0.0": "127.0.0.1", "::": "::1"}
_COMMON: dict[str, Any] = {
    "mode": "router",
    "adminspace/enabled": True,
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "queries_default_timeout": 600_000,
    "routing/router/peers_failover_brokering": False,
    # zenoh waits this long (ms) for answers to scouting, also when scouting is off.
    "scouting/delay": 1,
    "scouting/multicast/enabled": False,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "scouting/gossip/autoconnect": {"router": [], "peer": ["router", "peer"]},
    "timestamping/enabled": True,
    "transport/link/tx/keep_alive": 2,
    "transport/link/tx/lease": 60_000,
    "transport/shared_memory/enabled": False,
    "transport/unicast/accept_pending": MOST_SESSIONS,
    "transport/unicast/accept_timeout": 60_000,
    "transport/unicast/max_sessions": MOST_SESSIONS,
    "transport/unicast/open_timeout": 60_000,
}


@dataclass(frozen=True, slots=True)
class RouterPlan:
    """Where the routers listen, and what they dial.

    ``listen`` is the port of the hub for outside, ``peers`` are routers that the hub dials.
    ``directory`` has the sockets by which the hub dials the routers of containers. If empty, the
    hub dials by TCP, and the routers can have no access control.
    """

    bind: str
    ports: PortRange
    listen: int | None
    peers: Sequence[HostPort]
    directory: str = ""

    @property
    def hub_socket(self) -> str:
        """The endpoint at which the hub waits for the router of the links to other sites."""
        return f"{HUB_PROTOCOL}/{self.directory}/hub"

    def configs(
        self, access: Mapping[int, object], links: RouterConfig | None = None
    ) -> list[RouterConfig]:
        """The configurations of a router for each port, in order, and of the hub as the last.

        ``access`` has the access control of routers by port. ``links`` is the configuration of the
        router of the links to other sites, which gets the place before the hub. Raises ValueError
        if there is access control or such a router, but no directory.
        """
        if (access or links) and not self.directory:
            raise ValueError("access control and links need a directory for sockets")
        routers = [
            router_config(
                [_tcp(HostPort(self.bind, port)), *self._socket(port)],
                [],
                _access(access.get(port)),
            )
            for port in self.ports.ports()
        ]
        # The hub dials the other routers. So without ``listen``, others reach no port of the hub.
        hub_ports = [] if self.listen is None else [_tcp(HostPort(self.bind, self.listen))]
        hub_ports += [self.hub_socket] if links else []
        host = _LOOPBACK.get(self.bind, self.bind)
        dialed = [
            endpoint
            for port in self.ports.ports()
            for endpoint in self._socket(port) or [_tcp(HostPort(host, port))]
        ]
        hub = router_config(hub_ports, [*dialed, *map(_tcp, self.peers)])
        return [*routers, *([links] if links else []), hub]

    def _socket(self, port: int) -> list[str]:
        return [f"{HUB_PROTOCOL}/{self.directory}/{port}"] if self.directory else []


def _tcp(address: HostPort) -> str:
    return f"{NODE_PROTOCOL}/{address}"


def _access(access: object) -> dict[str, object]:
    return {"access_control": access} if access else {}


def router_config(
    listen: Iterable[str],
    connect: Iterable[str],
    other: Mapping[str, object] = MappingProxyType({}),
) -> RouterConfig:
    """The configuration of a router; ``other`` has further values by zenoh's keys."""
    own = {"listen/endpoints": [*listen], "connect/endpoints": [*connect], **other}
    return {key: json.dumps(value) for key, value in (_COMMON | own).items()}
