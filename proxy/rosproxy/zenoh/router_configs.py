"""The configurations of the proxy's routers: for each container, for outside, and the hub.

A router never passes data between two peers of this router: zenoh expects such peers to reach each
other directly. rmw_zenoh makes each node a peer that listens on loopback. So nodes of the same
container reach each other, and nodes of two containers do not. With a router for each container,
two containers are peers of two routers, and routers pass data on to each other. The hub is linked
to all these routers, and to routers outside. The hub dials the routers of containers by sockets in
a directory. So the access control of such a router distinguishes the hub from nodes. Laptops and
routers of other sites that connect to the proxy have one more router of this kind.

Links to other sites have a router of their own, which dials the hub (`rosproxy.zenoh.link_router`).

The values come from rmw_zenohd (rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5).
Exceptions are the addresses, the bounds of sessions and messages, the queue for declarations, and
the delay for scouting, which is off.
"""

import base64
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import Credentials
from rosproxy.zenoh.access_control import HUB_PROTOCOL, NODE_PROTOCOL
from rosproxy.zenoh.protocol.report import MOST_SESSIONS

NO_FILE_LIMIT = -1
"""`resource.RLIM_INFINITY`, the number of open files of a process without a limit."""
LEASE_MS = 10_000
"""Time without a packet after which the other end of a link counts the link as lost, for example if
a robot changes its address. Until then, a router refuses the hub a second session."""
SPARE_FILES = 64
"""Open files that the router process needs besides those of its routers."""
FILES_OF_ROUTER = 6
"""Open files of a router without sessions: the ports, and the link with the hub."""
LEAST_FILES_FOR_SESSIONS = 4
"""Open files for the sessions of each router, with which a router is of use."""
MAX_SESSIONS = "transport/unicast/max_sessions"
MAX_MESSAGE_BYTES = 128 * 2**20
"""A router keeps the fragments of a message in memory until the message is complete, and drops a
longer message. zenoh's default of 1 GiB is more than the memory of most containers. So one message
could end the routers of all containers.
"""
KEEP_ALIVES = 4
"""Packets within the lease on a link without messages."""
LEASE = MappingProxyType(
    {"transport/link/tx/keep_alive": KEEP_ALIVES, "transport/link/tx/lease": LEASE_MS}
)
RouterConfig = Mapping[str, str]
"""Values as JSON, by the keys of zenoh's configuration."""
_TLS = "tls"
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
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    "transport/link/tx/keep_alive": 2,
    "transport/link/tx/lease": 60_000,
    # Buffers of 64 KiB. All routers share the threads of one process. With two, the default of
    # zenoh, a burst of declarations can block all these threads for some seconds.
    "transport/link/tx/queue/size/control": 16,
    "transport/shared_memory/enabled": False,
    "transport/unicast/accept_timeout": 60_000,
    "transport/unicast/open_timeout": 60_000,
}


@dataclass(frozen=True, slots=True)
class RouterPlan:
    """Where the routers listen, and what they dial.

    ``listen`` is the port of the router for outside, ``peers`` are routers that the hub dials.
    ``hub_listen`` is the port of the hub for the hubs of other proxies, ``hubs`` are such hubs.
    With ``certificate``, the hubs use TLS, and each proves itself to the other.
    ``directory`` has the sockets by which the hub dials the other routers of the proxy. If empty,
    the hub dials by TCP, and the routers can have no access control. ``files``: the files that the
    router process may open. Another ``opening`` opens anew the routers that dial: the hub and the
    router of the links to other sites.
    """

    bind: str
    ports: PortRange
    listen: int | None
    peers: Sequence[HostPort]
    directory: str = ""
    hub_listen: int | None = None
    hubs: Sequence[HostPort] = ()
    certificate: Credentials | None = None
    files: int = NO_FILE_LIMIT
    opening: int = 0

    @property
    def all_ports(self) -> list[int]:
        """The ports for containers, and the port for outside."""
        return [*self.ports.ports(), *([] if self.listen is None else [self.listen])]

    @property
    def hub_socket(self) -> str:
        """The endpoint at which the hub waits for the router of the links to other sites."""
        return f"{HUB_PROTOCOL}/{self.directory}/hub"

    def configs(
        self, access: Mapping[int, object], links: RouterConfig | None = None
    ) -> list[RouterConfig]:
        """The configurations of a router for each of `all_ports`, in order, and then of the hub.

        ``access`` has the access control of routers by port. ``links`` is the configuration of the
        router of the links to other sites, which gets the place before the hub. Raises ValueError
        if there is access control or such a router, but no directory, or if the router process may
        open too few files.
        """
        if (access or links) and not self.directory:
            raise ValueError("access control and links need a directory for sockets")
        routers = [
            router_config(
                [_tcp(HostPort(self.bind, port)), *self._socket(port)],
                [],
                _access(access.get(port)),
            )
            for port in self.all_ports
        ]
        dialing = [*([links] if links else []), self._hub(bool(links))]
        opening = {"metadata": json.dumps({"opening": self.opening})}
        every = [*routers, *({**config, **opening} for config in dialing)]
        return [*_bounded(every, self.files)]

    def _hub(self, has_links: bool) -> RouterConfig:
        """The configuration of the hub.

        The hub dials the other routers. So without ``hub_listen``, others reach no port of the hub.
        """
        hub_ports = [] if self.hub_listen is None else [HostPort(self.bind, self.hub_listen)]
        listen = [self.hub_endpoint(address) for address in hub_ports]
        listen += [self.hub_socket] if has_links else []
        dialed = [self.dialed_at(port) for port in self.all_ports]
        dialed += [_tcp(peer) for peer in self.peers if peer not in self.hubs]
        dialed += map(self.hub_endpoint, self.hubs)
        tls = tls_values(self.certificate) if self.certificate else {}
        return router_config(listen, dialed, tls | LEASE)

    def hub_endpoint(self, address: HostPort) -> str:
        """The endpoint of a hub at an address."""
        return f"{_TLS if self.certificate else NODE_PROTOCOL}/{address}"

    def dialed_at(self, port: int) -> str:
        """The endpoint at which the hub dials the router of a port."""
        at_port = _tcp(HostPort(_LOOPBACK.get(self.bind, self.bind), port))
        return next(iter(self._socket(port)), at_port)

    def _socket(self, port: int) -> list[str]:
        return [f"{HUB_PROTOCOL}/{self.directory}/{port}"] if self.directory else []


def _bounded(configs: Sequence[RouterConfig], files: int) -> Iterator[RouterConfig]:
    """Yield the configurations with bounds of sessions. Raises ValueError for too few files.

    All routers share the open files of a process. With these bounds, sessions of one container
    leave the files that other containers need. A connection without a session also takes a file.
    """
    dialed = [len(json.loads(config["connect/endpoints"])) for config in configs]
    needed = SPARE_FILES + sum(dialed) + FILES_OF_ROUTER * len(configs)
    each = (files - needed) // len(configs)
    if files == NO_FILE_LIMIT:
        each = 2 * MOST_SESSIONS
    if each < LEAST_FILES_FOR_SESSIONS:
        needed += LEAST_FILES_FOR_SESSIONS * len(configs)
        raise ValueError(f"needs {needed} open files, and this process may have {files}")
    opening = min(max(each // 4, each - MOST_SESSIONS), MOST_SESSIONS)
    most = min(each - opening, MOST_SESSIONS)
    for config, own in zip(configs, dialed, strict=True):
        bounds = {MAX_SESSIONS: most + own, "transport/unicast/accept_pending": opening}
        yield {**config, **{key: json.dumps(value) for key, value in bounds.items()}}


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


def tls_values(credentials: Credentials) -> dict[str, object]:
    """The values with which a router proves itself, and demands the same of others.

    zenoh's user names and passwords do not serve: a router with a password of its own refuses to
    dial a router without (zenoh-transport, ext/auth/usrpwd.rs, ``recv_init_ack``). The hub also
    dials such routers. With TLS, only the links of hubs and of sites need a proof.
    """
    values: dict[str, object] = {"enable_mtls": True, "verify_name_on_connect": True}
    values["root_ca_certificate_base64"] = _base64(credentials.ca)
    for side in ("listen", "connect"):
        values[f"{side}_private_key_base64"] = _base64(credentials.key)
        values[f"{side}_certificate_base64"] = _base64(credentials.certificate)
    return {f"transport/link/tls/{key}": value for key, value in values.items()}


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
