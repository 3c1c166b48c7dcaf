"""Looking at the engine: from its JSON to what the core plans with."""

import asyncio
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from ipaddress import IPv4Network, ip_network

from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker import host
from rosproxy_operator.docker.client import DockerClient, Json
from rosproxy_operator.docker.details import PATIENCE, Details, Inspector
from rosproxy_operator.docker.planner.model import (
    Attachment,
    Container,
    Host,
    Network,
    Observed,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.settings import PlanSettings
from rosproxy_operator.docker.planner.specs import ROLE_SANDBOX, admin_port, read_own


@dataclass(frozen=True, slots=True)
class Way:
    """How a running proxy is reached: its admin endpoint, its token, and which run of it this is.

    ``run`` differs after each start of the container.
    """

    host: str
    port: int
    token: str
    run: str


@dataclass(frozen=True, slots=True)
class Look:
    """A Docker host at one moment, and what the core needs not know.

    ``ways`` and ``tokens`` are by the proxy's name; ways only of those that run. ``endpoints`` are
    the engine's ids of containers' connections, by container id and network: they change with each
    start. ``subnets`` are by network, ``addresses`` those of all containers. ``unsure`` are the
    names of own containers of which not everything is known yet, so that nothing can be done to
    them. ``at_host`` tells whether the controller is in the host's network namespace.
    """

    observed: Observed
    ways: Mapping[str, Way] = field(default_factory=dict)
    tokens: Mapping[str, str] = field(default_factory=dict)
    endpoints: Mapping[tuple[str, str], str] = field(default_factory=dict)
    subnets: Mapping[str, tuple[IPv4Network, ...]] = field(default_factory=dict)
    addresses: frozenset[str] = frozenset()
    unsure: frozenset[str] = frozenset()
    at_host: bool = False

    def strangers(self, listening: frozenset[int]) -> frozenset[int]:
        """Which of the ports that something listens on may be somebody else's.

        Not those of a sandbox that is just being started: the engine takes them one by one before
        it says that it runs. And none are known but at the host.
        """
        starting = (b for b in self.observed.sandboxes if b.container.name in self.unsure)
        taken = listening if self.at_host else frozenset()
        return taken - {port for box in starting for port in box.range.ports()}


def sandbox_of(proxy: Proxy, observed: Observed) -> Sandbox | None:
    """The sandbox in whose network namespace a proxy is; None if it is there no more."""
    home = proxy.container.network_mode.removeprefix("container:")
    return next((box for box in observed.sandboxes if box.container.id == home), None)


class Observer:
    """Looks at an engine."""

    def __init__(self, engine: DockerClient, settings: PlanSettings, inspector: Inspector) -> None:
        self._engine, self._settings, self._inspector = engine, settings, inspector

    async def look(self, patience: float = PATIENCE) -> Look:
        """What there is now. Raises EngineError.

        Containers whose inspection takes longer than ``patience`` seconds are left out until it is
        there, unless an older one is known.
        """
        listening = host.listening_ports()  # first: what the engine starts meanwhile is no stranger
        rows, networks, image = await asyncio.gather(
            in_thread(self._engine.containers),
            in_thread(self._engine.networks),
            in_thread(self._engine.image_id, self._settings.image),
        )
        # What is the controller's own is inspected at each look: a proxy's container has no network
        # by which to see that it was started anew, and the list is late to tell that one has ended.
        mine = [row["Id"] for row in rows if read_own(row.get("Labels") or {})]
        await self._inspector.update(rows, mine, patience)
        look = self._assemble(rows, networks, image)
        here = Host(host.ephemeral_ports(), look.strangers(listening))
        return replace(look, observed=replace(look.observed, host=here))

    def _assemble(self, rows: list[Json], networks: list[Json], image: str) -> Look:
        found = tuple(read_network(each) for each in networks)
        nothing = Host(host.USUAL_EPHEMERAL)
        observed = self._sort(rows, Observed((), found, (), nothing, image_id=image))
        own: list[Sandbox | Proxy] = [*observed.sandboxes, *observed.proxies]
        return Look(
            observed,
            ways={p.container.name: w for p in observed.proxies if (w := self._way(p, observed))},
            tokens={proxy.container.name: self._token(proxy) for proxy in observed.proxies},
            endpoints={key: end for row in rows for key, end in _endpoints(row)},
            subnets={each["Name"]: read_subnets(each) for each in networks},
            addresses=frozenset(
                end["IPAddress"] for row in rows for end in _networks(row).values() if end
            ),
            unsure=frozenset(o.container.name for o in own if not self._sure(o.container)),
            at_host=host.has_any(n.gateway for n in found if n.driver == "bridge"),
        )

    def _sure(self, container: Container) -> bool:
        """Whether the list and the inspection, which is newer, say the same."""
        details = self._inspector.get(container.id)
        if details is None or not self._inspector.fresh(container.id):
            return False
        return details.state == container.state

    def _sort(self, rows: Iterable[Json], empty: Observed) -> Observed:
        """The containers, into the controller's own and others."""
        containers, sandboxes, proxies = [], [], []
        for row in rows:
            own = read_own(row.get("Labels") or {})
            details = self._inspector.get(row["Id"])
            if own is None:
                if details is not None:
                    containers.append(read_container(row, details, empty.networks))
                continue
            container = read_container(row, details or Details(), empty.networks)
            if own.role == ROLE_SANDBOX:
                sandboxes.append(Sandbox(own.key, container, own.range, own.fingerprint))
            else:
                proxies.append(Proxy(own.key, container, own.range, own.fingerprint))
        return replace(
            empty,
            containers=tuple(containers),
            sandboxes=tuple(sandboxes),
            proxies=tuple(proxies),
        )

    def _way(self, proxy: Proxy, observed: Observed) -> Way | None:
        box = sandbox_of(proxy, observed)
        if box is None or proxy.container.state != "running" or box.container.state != "running":
            return None
        uplink = self._settings.uplink
        address = next((a.address for a in box.container.attachments if a.network == uplink), "")
        run = f"{proxy.container.id} {proxy.container.started_at}"
        return Way(address, admin_port(proxy.key), self._token(proxy), run) if address else None

    def _token(self, proxy: Proxy) -> str:
        details = self._inspector.get(proxy.container.id)
        return details.token if details else ""


def read_container(row: Json, details: Details, networks: Iterable[Network] = ()) -> Container:
    """A container from its row in the engine's list and its details."""
    mode = (row.get("HostConfig") or {}).get("NetworkMode") or ""
    names = {network.id: network.name for network in networks}
    return Container(
        id=row["Id"],
        name=_name(row),
        state=row["State"],
        labels=row.get("Labels") or {},
        network_mode=names.get(mode, "bridge" if mode == "default" else mode),
        attachments=tuple(
            _attachment(
                row,
                names.get(key, "bridge" if key == "default" else key),
                end or {},
                details.aliases.get(key),
            )
            for key, end in _networks(row).items()
        ),
        master_uri=details.master_uri,
        host_ports=details.host_ports | _public_ports(row),
        hostname=details.hostname,
        started_at=details.started_at,
    )


def read_network(row: Json) -> Network:
    """A network from the engine's list."""
    gateways = [config.get("Gateway") or "" for config in _ipam(row)]
    return Network(
        id=row["Id"],
        name=row["Name"],
        driver=row.get("Driver") or "",
        internal=bool(row.get("Internal")),
        gateway=next((gateway for gateway in gateways if gateway and ":" not in gateway), ""),
    )


def read_subnets(row: Json) -> tuple[IPv4Network, ...]:
    """The IPv4 subnets of a network in the engine's list."""
    subnets = [
        ip_network(config["Subnet"], strict=False) for config in _ipam(row) if config.get("Subnet")
    ]
    return tuple(subnet for subnet in subnets if isinstance(subnet, IPv4Network))


def _attachment(row: Json, network: str, end: Json, aliases: frozenset[str] | None) -> Attachment:
    own = {_name(row), row["Id"][:12]}
    return Attachment(
        network=network,
        address=end.get("IPAddress") or "",
        names=frozenset(own | (aliases or frozenset())),
        network_id=end.get("NetworkID") or "",
    )


def _endpoints(row: Json) -> list[tuple[tuple[str, str], str]]:
    return [
        ((row["Id"], name), (end or {}).get("EndpointID") or "")
        for name, end in _networks(row).items()
    ]


def _networks(row: Json) -> Json:
    return (row.get("NetworkSettings") or {}).get("Networks") or {}


def _name(row: Json) -> str:
    """The name; a container that is just being removed may have none any more."""
    names = [name.lstrip("/") for name in row.get("Names") or () if name.count("/") == 1]
    return str(names[0]) if names else str(row["Id"][:12])


def _public_ports(row: Json) -> frozenset[int]:
    return frozenset(
        port["PublicPort"]
        for port in row.get("Ports") or ()
        if port.get("PublicPort") and port.get("Type") == "tcp"
    )


def _ipam(row: Json) -> list[Json]:
    return (row.get("IPAM") or {}).get("Config") or []
