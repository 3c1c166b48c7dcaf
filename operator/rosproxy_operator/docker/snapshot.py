"""A look at a Docker host: the engine, the labels of its containers, and where their masters are.

What is seen is data for the planner (`HostState`); beside it stands what the planner needs not
know: how proxies are reached, and by which tokens. Labels are read here, once per look, since what
they say decides which masters' names are resolved.
"""

import asyncio
import logging
import secrets
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

import msgspec

from rosproxy.net.addresses import HostPort
from rosproxy_operator.common.resolver import THIS_HOST, MasterResolver
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker import engine_json, host
from rosproxy_operator.docker.client import DockerClient, Json
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.planner.labels.members import LabelReading, master_hosts, read_labels
from rosproxy_operator.docker.planner.model import (
    STARTED,
    HostState,
    Network,
    PlanSettings,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.own import gives_away, has_own_name
from rosproxy_operator.docker.planner.specs import (
    FORMER_TOKEN,
    ROLE_SANDBOX,
    OwnLabels,
    admin_port,
    proxy_token,
    read_own,
)

log = logging.getLogger(__name__)

PATIENCE = 0.1
"""Seconds that a look waits for inspections; later ones count from the next look on."""
MOST_INSPECTIONS = 16
"""Inspections that are under way at once."""


@dataclass(frozen=True, slots=True)
class ProxyAccess:
    """How a running proxy is reached: its admin endpoint, its token, and which run of it this is.

    ``run`` differs after each start of the container.
    """

    admin: HostPort
    token: str = field(repr=False)
    run: str


@dataclass(frozen=True, slots=True)
class DockerSnapshot:
    """A Docker host at one moment.

    ``access`` to those proxies that run is by name. ``at_host``: the operator is in the host's
    network namespace. ``fresh`` is the secret for an uplink network that is made now.
    """

    state: HostState
    labels: LabelReading
    access: Mapping[str, ProxyAccess]
    at_host: bool
    fresh: str = field(default="", repr=False)


class Inspector:
    """Inspections of containers, by id, each asked for once and kept.

    The engine's list answers in milliseconds whatever happens. An inspection waits until the
    container's start is over, which takes 26 s with 1000 ports to publish. Nothing that is read
    from it changes but the aliases, and those only with the endpoints, whose ids are in the list.
    One that can't be read is told in the log, once, and is as good as none: it harms no other
    container. ``late`` is called when some come after a look.
    """

    def __init__(self, engine: DockerClient, late: Callable[[], None]) -> None:
        self._engine, self._late = engine, late
        self._known: dict[str, tuple[object, Json]] = {}
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._marks: dict[str, object] = {}
        self._unreadable: set[str] = set()
        self._turns = asyncio.Semaphore(MOST_INSPECTIONS)

    @property
    def waiting(self) -> bool:
        """Whether inspections are under way, which are going to be told."""
        return bool(self._asking)

    def get(self, container: str) -> Json | None:
        """The last known inspection of a container; None if there is none yet."""
        return self._known.get(container, (None, None))[1]

    def sure(self, row: Json) -> bool:
        """Whether the list and the inspection of a container, which is newer, say the same."""
        mark, inspected = self._known.get(row["Id"], (None, None))
        fresh = mark == self._marks[row["Id"]]
        return fresh and engine_json.dig(inspected, "State", "Status") == row["State"]

    async def update(self, rows: Iterable[Json], always: Collection[str], patience: float) -> None:
        """Inspect what is new or has changed in the list; wait for it for so many seconds.

        ``always`` are the ids of those that may have been started anew without a trace in the list.
        """
        self._marks = {
            row["Id"]: object() if row["Id"] in always else engine_json.signature(row)
            for row in rows
        }
        self._known = {key: known for key, known in self._known.items() if key in self._marks}
        self._unreadable &= self._marks.keys()
        asked = []
        for key, mark in self._marks.items():
            if key not in self._asking and self._known.get(key, (None,))[0] != mark:
                self._asking[key] = asyncio.create_task(self._inspect(key, mark))
                asked.append(self._asking[key])
        if asked:
            _, late = await asyncio.wait(asked, timeout=patience)
            for task in late:
                task.add_done_callback(lambda _: self._late())

    async def _inspect(self, container: str, mark: object) -> None:
        try:
            async with self._turns:
                inspected = await in_thread(self._engine.container, container)
            self._known[container] = mark, engine_json.check_inspection(inspected)
            self._unreadable.discard(container)
        except EngineError as error:
            log.debug("inspecting %s: %s", container[:12], error)
        except msgspec.ValidationError as error:
            if container not in self._unreadable:
                log.warning("what the engine tells of %s can't be read: %s", container[:12], error)
            self._unreadable.add(container)
        finally:
            del self._asking[container]


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
        self._fresh = secrets.token_hex(32)

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
        rows, found, image = await asyncio.gather(
            in_thread(self._engine.containers),
            in_thread(self._engine.networks),
            in_thread(self._engine.image_id, self._settings.proxy_image),
        )
        # What is the operator's own is inspected at each look: a proxy's container has no network
        # by which to see that it was started anew, and the list is late to tell that one has ended.
        mine = [row["Id"] for row in rows if self._read_own(row)]
        await self._inspector.update(rows, mine, patience)
        networks = tuple(map(engine_json.read_network, found))
        bridges = [n.gateway for n in networks if n.driver == "bridge" and n.gateway]
        at_host = any(map(host.has, bridges))
        state = self._read(rows, networks, image, listening if at_host else frozenset())
        secret = self._settings.secret or engine_json.uplink_secret(found, self._settings.uplink)
        state = replace(state, image_id=image, secret=secret or self._fresh)
        labels = read_labels(state, self._settings)
        masters = await self._resolve(state, master_hosts(labels, state))
        gateways = {network.gateway for network in networks}
        advertise = {
            name: own
            for name, address in masters.items()
            if at_host and address and (own := host.own_address_towards(address, gateways))
        }
        return DockerSnapshot(
            state=replace(state, masters=masters, advertise=advertise),
            labels=labels,
            access={p.container.name: way for p in state.proxies if (way := self._way(p, state))},
            at_host=at_host,
            fresh=self._fresh,
        )

    def _read_own(self, row: Json) -> OwnLabels | None:
        """What the labels of a container say that may be the operator's own, by its name."""
        own = read_own(row.get("Labels") or {})
        nameless = not row.get("Names")  # it is just being removed
        return own if own and (nameless or has_own_name(own, engine_json.name_of(row))) else None

    def _read(
        self,
        rows: list[Json],
        networks: tuple[Network, ...],
        image: str,
        listening: frozenset[int],
    ) -> HostState:
        """The containers, the operator's own apart from others.

        One that only claims to be its own is like any other. One that is not inspected yet counts
        as own if its name is right: until it is known, nothing is done to it.
        """
        containers, sandboxes, proxies = [], [], []
        busy: set[str] = set()
        for row in rows:
            own, forged = self._read_own(row), ""
            inspected = self._inspector.get(row["Id"])
            if own is None and inspected is None:
                continue
            container = engine_json.read_container(row, inspected, networks)
            claimed = read_own(container.labels)
            if claimed and inspected is not None and row.get("Names"):
                making = engine_json.read_making(inspected)
                forged = gives_away(claimed, container.name, making, image)
            if own is None or forged:
                containers.append(replace(container, forged=forged))
                own = None
            elif own.role == ROLE_SANDBOX:
                sandboxes.append(Sandbox(own.key, container, own.range, own.fingerprint))
            else:
                proxies.append(Proxy(own.key, container, own.range, own.fingerprint))
            if own and not self._inspector.sure(row):
                busy.add(container.name)
        return HostState(
            containers=tuple(containers),
            networks=networks,
            proxies=tuple(proxies),
            ephemeral=host.ephemeral_ports(),
            listening=strangers(sandboxes, busy, listening),
            sandboxes=tuple(sandboxes),
            busy=frozenset(busy),
            addresses=frozenset(
                end.get("IPAddress") or ""
                for row in rows
                for end in engine_json.endpoints(row).values()
            ),
        )

    async def _resolve(self, state: HostState, names: Collection[str]) -> dict[str, str]:
        """The addresses of masters' hosts, empty where unknown."""
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
        variables = engine_json.environment(self._inspector.get(proxy.container.id))
        token = variables.get(FORMER_TOKEN) or proxy_token(proxy.key, state.secret)
        return ProxyAccess(admin, token, run) if address else None


def strangers(
    sandboxes: Iterable[Sandbox], busy: Collection[str], listening: frozenset[int]
) -> frozenset[int]:
    """Which of the host's ports on which something listens may be somebody else's.

    Not those of a sandbox that is just being started: the engine takes them one by one before it
    says that it runs.
    """
    starting = (box for box in sandboxes if box.container.name in busy)
    return listening - {port for box in starting for port in box.range.ports()}


def address_in(state: HostState, name: str, uplink: str) -> str:
    """The address of a host's name that no name server has: this host, or a container."""
    if name == THIS_HOST:
        return next((n.gateway for n in state.networks if n.name == uplink), "")
    for container in state.containers:
        for place in container.attachments if container.state in STARTED else ():
            if place.address and name in {known.lower() for known in place.names}:
                return place.address
    return ""
