"""A look at a Docker host: the engine, the labels of its containers, and where their masters are.

What is seen is data for the planner (`HostState`), and what the planner need not know: how
proxies are reached, and by which tokens. Labels are read here, once per look, since what
they say decides which masters' names are resolved.
"""

import asyncio
import logging
import secrets
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from rosproxy.net.addresses import HostPort
from rosproxy_operator.common.master_resolver import MasterResolver
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker import engine_json, host
from rosproxy_operator.docker.engine_client import DockerClient, Json
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.planner.labels.members import LabelReading, master_hosts, read_labels
from rosproxy_operator.docker.planner.model import (
    STARTED,
    THIS_HOST,
    Container,
    FlushContainer,
    HostState,
    LanRelayContainer,
    Network,
    OwnContainer,
    Proxy,
    RedirectContainer,
    Sandbox,
)
from rosproxy_operator.docker.planner.own_containers import forgery_reason, has_own_name
from rosproxy_operator.docker.planner.specs import (
    FORMER_TOKEN,
    ROLE_FLUSH,
    ROLE_LAN_RELAY,
    ROLE_PROXY,
    ROLE_REDIRECT,
    ROLE_SANDBOX,
    OwnLabels,
    admin_port,
    proxy_token,
    read_own,
)
from rosproxy_operator.docker.settings import PlanSettings

log = logging.getLogger(__name__)

PATIENCE = 0.1
"""Seconds that a look waits for inspections; later ones count from the next look on."""
FIRST_PATIENCE = 1.0
"""Seconds that an observer's first look waits, when nothing is inspected yet.

A proxy gets no name that a container has, and only inspections tell the aliases of containers.
"""
_KINDS: Mapping[str, type[OwnContainer]] = {
    ROLE_SANDBOX: Sandbox,
    ROLE_PROXY: Proxy,
    ROLE_LAN_RELAY: LanRelayContainer,
    ROLE_REDIRECT: RedirectContainer,
    ROLE_FLUSH: FlushContainer,
}
DOUBT = 1.0
"""Seconds for which a container is inspected with each look after something has happened to it."""
CHECK = 30.0
"""Seconds after which the operator's own containers are inspected, even without an event."""
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
    network namespace. ``new_secret`` is the secret for an uplink network that is made now.
    """

    state: HostState
    labels: LabelReading
    access: Mapping[str, ProxyAccess]
    at_host: bool
    new_secret: str = field(default="", repr=False)


class Inspector:
    """Inspections of containers, by id, each asked for once and kept.

    The engine's list answers in milliseconds whatever happens. An inspection waits until the
    container's start is over, which takes 26 s with 1000 ports to publish. Nothing that is read
    from it changes but the aliases, and those only with the endpoints, whose ids are in the list.

    The operator's own containers can be started anew without a trace in the list: a proxy's has no
    network of its own, and the list is late to tell that one has ended. The engine's events tell it
    (`mark_doubtful`), and those are inspected with each look for a moment; all of them once in a
    while, beside the look, in case an event was missed.

    One that can't be read is logged once, and treated as missing: it affects no other container.
    ``late`` is called when something new comes after a look.
    """

    def __init__(self, engine: DockerClient, late: Callable[[], None]) -> None:
        self._engine = engine
        self._late = late
        self._cached: dict[str, tuple[object, Json]] = {}
        self._asking: dict[str, asyncio.Task[bool]] = {}
        self._marks: dict[str, object] = {}
        self._unreadable: set[str] = set()
        self._turns = asyncio.Semaphore(MOST_INSPECTIONS)
        self._doubted: dict[str, float] = {}
        self._all_doubted = -DOUBT
        self._updated = time.monotonic()
        self._looks = 0
        self._doubtful_look: dict[str, int] = {}
        self._checked = time.monotonic()
        self._checking: set[str] = set()

    @property
    def waiting(self) -> bool:
        """Whether inspections are under way whose end may call ``late``."""
        return bool(self._asking.keys() - self._checking)

    def get(self, container: str) -> Json | None:
        """The last known inspection of a container; None if there is none yet."""
        return self._cached.get(container, (None, None))[1]

    def is_current(self, row: Json) -> bool:
        """Whether the list and the inspection of a container, which is newer, say the same."""
        mark, inspected = self._cached.get(row["Id"], (None, None))
        fresh = mark == self._marks[row["Id"]]
        return fresh and engine_json.dig(inspected, "State", "Status") == row["State"]

    def mark_doubtful(self, container: str | None) -> None:
        """Something has happened to a container; None: perhaps to any, with events missed."""
        if container is None:
            self._all_doubted = time.monotonic()
        else:
            self._doubted[container] = time.monotonic()

    async def update(self, rows: Iterable[Json], own: Mapping[str, str], patience: float) -> None:
        """Inspect what is new or has changed in the list; wait for it for so many seconds.

        ``own`` are those that may have been started anew without a trace in the list, by id, with
        what they are for. A doubt is good for one look at least, however late that is.
        """
        now = time.monotonic()
        since = min(now - DOUBT, self._updated)
        self._updated = now
        self._looks += 1
        self._doubted = {key: at for key, at in self._doubted.items() if at >= since}
        doubtful = own.keys() if self._all_doubted >= since else self._doubted.keys() & own.keys()
        self._marks = {row["Id"]: self._mark(row, own, doubtful) for row in rows}
        self._cached = {key: c for key, c in self._cached.items() if key in self._marks}
        self._doubtful_look = {
            key: look for key, look in self._doubtful_look.items() if key in self._marks
        }
        self._unreadable &= self._marks.keys()
        tasks = [
            self._ask(key, mark)
            for key, mark in self._marks.items()
            if self._cached.get(key, (None,))[0] != mark and key not in self._asking
        ]
        if tasks:
            _, pending = await asyncio.wait(tasks, timeout=patience)
            for task in pending:
                task.add_done_callback(lambda _: self._late())
        if self._checked < now - CHECK:
            self._checked = now
            self._check(key for key, role in own.items() if role != ROLE_REDIRECT)

    def _mark(self, row: Json, own: Collection[str], doubtful: Collection[str]) -> object:
        """The state that an inspection is of; if that changes, the container is inspected anew."""
        key = row["Id"]
        signature = engine_json.signature(row)
        if key not in own:
            return signature
        if key in doubtful:
            self._doubtful_look[key] = self._looks
        return row["State"], signature, self._doubtful_look.get(key)

    def _check(self, ids: Iterable[str]) -> None:
        """Inspect all of these beside the looks, and tell if something is new."""
        for key in ids:
            if key in self._marks and key not in self._asking:
                self._checking.add(key)
                self._ask(key, self._marks[key]).add_done_callback(self._after_check)

    def _after_check(self, task: asyncio.Task[bool]) -> None:
        if not task.cancelled() and task.result():
            self._late()

    def _ask(self, container: str, mark: object) -> asyncio.Task[bool]:
        task = asyncio.create_task(self._inspect(container, mark))
        self._asking[container] = task
        return task

    async def _inspect(self, container: str, mark: object) -> bool:
        """Inspect a container; whether the inspection differs from the last one."""
        previous = self.get(container)
        try:
            async with self._turns:
                inspected = await in_thread(self._engine.container, container)
            self._cached[container] = mark, engine_json.check_inspection(inspected)
            self._unreadable.discard(container)
        except EngineError as error:
            log.debug("inspecting %s: %s", container[:12], error)
        except msgspec.ValidationError as error:
            if container not in self._unreadable:
                text = "container %s: the data of docker inspect can't be read: %s"
                log.warning(text, container[:12], error)
            self._unreadable.add(container)
        finally:
            del self._asking[container]
            self._checking.discard(container)
        return self.get(container) != previous


class DockerObserver:
    """Looks at an engine. ``late`` is called when an inspection ends after the look it was for."""

    def __init__(
        self,
        engine: DockerClient,
        settings: PlanSettings,
        masters: MasterResolver,
        late: Callable[[], None],
    ) -> None:
        self._engine = engine
        self._settings = settings
        self._masters = masters
        self._inspector = Inspector(engine, late)
        self._fresh = secrets.token_hex(32)
        self._has_looked = False

    @property
    def waiting(self) -> bool:
        """Whether inspections are under way whose end may call ``late``."""
        return self._inspector.waiting

    def mark_doubtful(self, container: str | None) -> None:
        """The engine tells that something has happened to a container, by id; None: to any."""
        self._inspector.mark_doubtful(container)

    async def look(self, patience: float = PATIENCE) -> DockerSnapshot:
        """What there is now. Raises EngineError.

        Containers whose inspection takes longer than ``patience`` seconds are left out until it is
        there, unless an older one is known.
        """
        # First: ports that the engine opens meanwhile are not foreign.
        listening = host.listening_ports()
        bound = host.bound_udp_ports()
        rows, net_rows, image = await asyncio.gather(
            in_thread(self._engine.containers),
            in_thread(self._engine.networks),
            in_thread(self._engine.image_id, self._settings.proxy_image),
        )
        labelled = ((row["Id"], self._read_own(row)) for row in rows)
        own_roles = {key: own.role for key, own in labelled if own}
        least = 0.0 if self._has_looked else FIRST_PATIENCE
        await self._inspector.update(rows, own_roles, max(patience, least))
        self._has_looked = True
        networks = tuple(map(engine_json.read_network, net_rows))
        bridges = [n.gateway for n in networks if n.driver == "bridge" and n.gateway]
        # A bridge's gateway is an address of the host's own network namespace. In another one, the
        # ports on which something listens here say nothing of those of the host.
        at_host = any(map(host.has, bridges))
        state = self._read(rows, networks, image)
        if at_host:
            busy = [sandbox for sandbox in state.sandboxes if sandbox.container.name in state.busy]
            state = replace(
                state,
                listening=foreign_ports(busy, (), listening),
                listening_udp=foreign_ports(busy, state.lan_relays, bound),
                far=host.far_address(),
            )
        secret = self._settings.secret or engine_json.uplink_secret(net_rows, self._settings.uplink)
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
            access={p.container.name: a for p in state.proxies if (a := self._access(p, state))},
            at_host=at_host,
            new_secret=self._fresh,
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
    ) -> HostState:
        """The containers, the operator's own apart from others.

        One that only claims to be its own is like any other. One that is not inspected yet counts
        as own if its name is right: until it is known, nothing is done to it.
        """
        containers: list[Container] = []
        own_by_role: dict[str, list[Any]] = {role: [] for role in _KINDS}
        busy: set[str] = set()
        for row in rows:
            own = self._read_own(row)
            forged = ""
            inspected = self._inspector.get(row["Id"])
            if own is None and inspected is None:
                continue
            container = engine_json.read_container(row, inspected, networks)
            claimed = read_own(container.labels)
            if claimed and inspected is not None and row.get("Names"):
                making = engine_json.read_making(inspected)
                forged = forgery_reason(claimed, container.name, making, image)
            if own is None or forged:
                containers.append(replace(container, forged=forged))
                own = None
            else:
                own_container = _KINDS[own.role](own.key, container, own.range, own.fingerprint)
                own_by_role[own.role].append(own_container)
            if own and not self._inspector.is_current(row):
                busy.add(container.name)
        # Who shares the network of one that is not inspected yet is left out as long as that is.
        unread = {row["Id"] for row in rows if self._inspector.get(row["Id"]) is None}
        return HostState(
            containers=tuple(c for c in containers if c.network_container not in unread),
            networks=networks,
            proxies=tuple(own_by_role[ROLE_PROXY]),
            ephemeral=host.ephemeral_ports(),
            sandboxes=tuple(own_by_role[ROLE_SANDBOX]),
            lan_relays=tuple(own_by_role[ROLE_LAN_RELAY]),
            redirects=tuple(own_by_role[ROLE_REDIRECT]),
            flushes=tuple(own_by_role[ROLE_FLUSH]),
            busy=frozenset(busy),
            deletes_udp_entries=self._engine.deletes_udp_entries,
            addresses=_addresses(rows),
        )

    async def _resolve(self, state: HostState, names: Collection[str]) -> dict[str, str]:
        """The addresses of masters' hosts, empty where unknown."""
        uplink = self._settings.uplink
        local = {name: address for name in names if (address := address_in(state, name, uplink))}
        excluded = [a.address for sandbox in state.sandboxes for a in sandbox.container.attachments]
        await self._masters.learn(names, local, excluded)
        return {name: self._masters.address(name) for name in names}

    def _access(self, proxy: Proxy, state: HostState) -> ProxyAccess | None:
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


def _addresses(rows: Iterable[Json]) -> frozenset[str]:
    """The addresses of all containers in the engine's list."""
    endpoints = (endpoint for row in rows for endpoint in engine_json.endpoints(row).values())
    return frozenset(endpoint.get("IPAddress") or "" for endpoint in endpoints)


def foreign_ports(
    starting: Iterable[Sandbox], lan_relays: Iterable[LanRelayContainer], listening: frozenset[int]
) -> frozenset[int]:
    """Which of the host's ports on which something listens may belong to other programs.

    Not those of a sandbox that is just being started: the engine takes them one by one before it
    says that it runs. Nor those of the LAN relays.
    """
    own = {port for sandbox in starting for port in sandbox.range.ports()}
    return listening - own - {lan_relay.range.last for lan_relay in lan_relays}


def address_in(state: HostState, name: str, uplink: str) -> str:
    """The address of a host's name that no name server has: this host, or a container."""
    if name == THIS_HOST:
        return next((n.gateway for n in state.networks if n.name == uplink), "")
    for container in state.containers:
        for attachment in container.attachments if container.state in STARTED else ():
            if attachment.address and name in {n.lower() for n in attachment.names}:
                return attachment.address
    return ""
