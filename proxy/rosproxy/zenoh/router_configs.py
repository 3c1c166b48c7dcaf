"""The configurations of the proxy's routers: a router for each container, and the hub.

A router never passes data between two peers of this router: zenoh expects such peers to reach each
other directly. rmw_zenoh makes each node a peer that listens on loopback. So nodes of the same
container reach each other, and nodes of two containers do not. With a router for each container,
two containers are peers of two routers, and routers pass data on to each other. The hub is linked
to all these routers, and to routers outside.

The values come from rmw_zenohd (rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5).
Exceptions are the addresses, the bound of sessions, and the delay for scouting, which is off.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
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


def router_configs(
    bind: str, ports: PortRange, listen: int | None, peers: Sequence[HostPort]
) -> list[RouterConfig]:
    """A router for each port, in order, and the hub as the last.

    ``listen`` is the port of the hub for outside, ``peers`` are routers that the hub dials.
    """
    containers = [HostPort(bind, port) for port in ports.ports()]
    # The hub dials the other routers, so without ``listen`` the hub has no port.
    dialed = [HostPort(_LOOPBACK.get(bind, bind), port) for port in ports.ports()]
    hub_ports = [] if listen is None else [HostPort(bind, listen)]
    routers = [_config([container], []) for container in containers]
    return [*routers, _config(hub_ports, [*dialed, *peers])]


def _config(listen: Sequence[HostPort], connect: Sequence[HostPort]) -> RouterConfig:
    endpoints = {
        "listen/endpoints": [f"tcp/{address}" for address in listen],
        "connect/endpoints": [f"tcp/{address}" for address in connect],
    }
    return {key: json.dumps(value) for key, value in (_COMMON | endpoints).items()}
