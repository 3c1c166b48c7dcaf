"""A look at a Docker host: the engine, the labels of its containers, and where their masters are.

What is seen is data for the planner (`HostState`); beside it stands what the planner needs not
know: how proxies are reached, and their tokens. Labels are read here, once per look, since what
they say decides which masters' names are resolved.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

from rosproxy.net.addresses import HostPort, is_address
from rosproxy_operator.common.resolver import THIS_HOST, MasterResolver
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker import host
from rosproxy_operator.docker.client import DockerClient, Json
from rosproxy_operator.docker.engine_json import Details, endpoints, read_container, read_network
from rosproxy_operator.docker.inspector import PATIENCE, Inspector
from rosproxy_operator.docker.planner.labels.members import LabelReading, master_hosts, read_labels
from rosproxy_operator.docker.planner.model import (
    STARTED,
    Container,
    HostState,
    Network,
    PlanSettings,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.specs import ROLE_SANDBOX, admin_port, read_own


@dataclass(frozen=True, slots=True)
class ProxyAccess:
    """How a running proxy is reached: its admin endpoint, its token, and which run of it this is.

    ``run`` differs after each start of the container.
    """

    admin: HostPort
    token: str
    run: str


@dataclass(frozen=True, slots=True)
class DockerSnapshot:
    """A Docker host at one moment.

    ``access`` and ``tokens`` are by the proxy's name; access only to those that run. ``masters``
    are the addresses of masters' hosts, empty where unknown. ``at_host`` tells whether the operator
    is in the host's network namespace.
    """

    state: HostState
    labels: LabelReading = field(default_factory=LabelReading)
    access: Mapping[str, ProxyAccess] = field(default_factory=dict)
    tokens: Mapping[str, str] = field(default_factory=dict)
    masters: Mapping[str, str] = field(default_factory=dict)
    at_host: bool = False


class DockerObserver:
    """Looks at an engine. ``late`` is called when an inspection ends after the look it was for."""

    def __init__(
        self,
        engine: DockerClient,
        settings: PlanSettings,
        masters: MasterResolver,
        late: Callable[[], None],
    ) -> None:
        self._engine, self._settings, self._masters = engine, settings, masters
        self._inspector = Inspector(engine, late)

    @property
    def waiting(self) -> bool:
        """Whether inspections are under way, whose end is going to be told."""
        return self._inspector.waiting

    async def look(self, patience: float = PATIENCE) -> DockerSnapshot:
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
        # What is the operator's own is inspected at each look: a proxy's container has no network
        # by which to see that it was started anew, and the list is late to tell that one has ended.
        mine = [row["Id"] for row in rows if read_own(row.get("Labels") or {})]
        await self._inspector.update(rows, mine, patience)
        state = self._read(rows, tuple(map(read_network, networks)), image)
        at_host = host.has_any(n.gateway for n in state.networks if n.driver == "bridge")
        taken = strangers(state, listening) if at_host else frozenset()
        state = replace(state, ephemeral=host.ephemeral_ports(), listening=taken)
        labels = read_labels(state, self._settings)
        masters = await self._resolve(state, master_hosts(labels, state))
        return DockerSnapshot(
            state=replace(
                state,
                unresolved=frozenset(name for name, address in masters.items() if not address),
                advertise=own_addresses(state, masters) if at_host else {},
            ),
            labels=labels,
            access={p.container.name: way for p in state.proxies if (way := self._way(p, state))},
            tokens={proxy.container.name: self._token(proxy) for proxy in state.proxies},
            masters=masters,
            at_host=at_host,
        )

    def _read(self, rows: list[Json], networks: tuple[Network, ...], image: str) -> HostState:
        """The containers, the operator's own apart from others."""
        containers, sandboxes, proxies = [], [], []
        for row in rows:
            own = read_own(row.get("Labels") or {})
            details = self._inspector.get(row["Id"])
            if own is None and details is None:
                continue
            container = read_container(row, details or Details(), networks)
            if own is None:
                containers.append(container)
            elif own.role == ROLE_SANDBOX:
                sandboxes.append(Sandbox(own.key, container, own.range, own.fingerprint))
            else:
                proxies.append(Proxy(own.key, container, own.range, own.fingerprint))
        every = [*(one.container for one in sandboxes), *(one.container for one in proxies)]
        return HostState(
            containers=tuple(containers),
            networks=networks,
            proxies=tuple(proxies),
            ephemeral=host.USUAL_EPHEMERAL,
            image_id=image,
            sandboxes=tuple(sandboxes),
            busy=frozenset(one.name for one in every if not self._sure(one)),
            addresses=frozenset(
                end["IPAddress"] for row in rows for end in endpoints(row).values() if end
            ),
        )

    def _sure(self, container: Container) -> bool:
        """Whether the list and the inspection, which is newer, say the same."""
        details = self._inspector.get(container.id)
        if details is None or not self._inspector.fresh(container.id):
            return False
        return details.state == container.state

    async def _resolve(self, state: HostState, hosts: Iterable[str]) -> dict[str, str]:
        """The addresses of masters' hosts, empty where unknown."""
        names = list(hosts)
        uplink = self._settings.uplink
        known = {name: found for name in names if (found := address_in(state, name, uplink))}
        never = [a.address for box in state.sandboxes for a in box.container.attachments]
        await self._masters.learn(names, known, never)
        return {name: self._masters.address(name) for name in names}

    def _way(self, proxy: Proxy, state: HostState) -> ProxyAccess | None:
        box = state.sandbox_of(proxy)
        if box is None or proxy.container.state != "running" or box.container.state != "running":
            return None
        uplink = self._settings.uplink
        address = next((a.address for a in box.container.attachments if a.network == uplink), "")
        run = f"{proxy.container.id} {proxy.container.started_at}"
        admin = HostPort(address, admin_port(proxy.key))
        return ProxyAccess(admin, self._token(proxy), run) if address else None

    def _token(self, proxy: Proxy) -> str:
        details = self._inspector.get(proxy.container.id)
        return details.token if details else ""


def strangers(state: HostState, listening: frozenset[int]) -> frozenset[int]:
    """Which of the host's ports on which something listens may be somebody else's.

    Not those of a sandbox that is just being started: the engine takes them one by one before it
    says that it runs.
    """
    starting = (box for box in state.sandboxes if box.container.name in state.busy)
    return listening - {port for box in starting for port in box.range.ports()}


def own_addresses(state: HostState, masters: Mapping[str, str]) -> dict[str, str]:
    """This host's address towards each master whose address is known."""
    gateways = {network.gateway for network in state.networks}
    towards = {
        name: host.own_address_towards(address, gateways)
        for name, address in masters.items()
        if address
    }
    return {name: own for name, own in towards.items() if own}


def address_in(state: HostState, name: str, uplink: str) -> str:
    """The address of a host's name that no name server has: this host, or a container."""
    if is_address(name):
        return ""
    if name == THIS_HOST:
        return next((n.gateway for n in state.networks if n.name == uplink), "")
    return next(
        (
            attachment.address
            for container in state.containers
            for attachment in container.attachments
            if container.state in STARTED
            and attachment.address
            and name in {known.lower() for known in attachment.names}
        ),
        "",
    )
