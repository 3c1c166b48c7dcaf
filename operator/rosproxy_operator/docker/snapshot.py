"""A look at a Docker host: the engine, the labels of its containers, and where their masters are.

What is seen is data for the planner (`HostState`); beside it stands what the planner needs not
know: how proxies are reached, and by which tokens. Labels are read here, once per look, since what
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
from rosproxy_operator.common.resolver import THIS_HOST, MasterResolver
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker import engine_json, host
from rosproxy_operator.docker.client import DockerClient, Json
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.planner.labels.members import LabelReading, master_hosts, read_labels
from rosproxy_operator.docker.planner.model import (
    STARTED,
    Container,
    EarContainer,
    HostState,
    Network,
    OwnContainer,
    PlanSettings,
    Proxy,
    RedirectContainer,
    Sandbox,
)
from rosproxy_operator.docker.planner.own import gives_away, has_own_name
from rosproxy_operator.docker.planner.specs import (
    FORMER_TOKEN,
    ROLE_EAR,
    ROLE_PROXY,
    ROLE_REDIRECT,
    ROLE_SANDBOX,
    OwnLabels,
    admin_port,
    proxy_token,
    read_own,
)

log = logging.getLogger(__name__)

PATIENCE = 0.1
"""Seconds that a look waits for inspections; later ones count from the next look on."""
_KINDS: Mapping[str, type[OwnContainer]] = {
    ROLE_SANDBOX: Sandbox,
    ROLE_PROXY: Proxy,
    ROLE_EAR: EarContainer,
    ROLE_REDIRECT: RedirectContainer,
}
DOUBT = 1.0
"""Seconds for which a container is inspected with each look after something has happened to it."""
CHECK = 30.0
"""Seconds after which the operator's own containers are inspected whatever was heard."""
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

    The operator's own containers can be started anew without a trace in the list: a proxy's has no
    network of its own, and the list is late to tell that one has ended. The engine's events tell
    it (`doubt`), and those are inspected with each look for a moment; all of them once in a while,
    beside the look, in case an event was missed.

    One that can't be read is told in the log, once, and is as good as none: it harms no other
    container. ``late`` is called when something new comes after a look.
    """

    def __init__(self, engine: DockerClient, late: Callable[[], None]) -> None:
        self._engine, self._late = engine, late
        self._known: dict[str, tuple[object, Json]] = {}
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
        """Whether inspections are under way, which are going to be told."""
        return bool(self._asking.keys() - self._checking)

    def get(self, container: str) -> Json | None:
        """The last known inspection of a container; None if there is none yet."""
        return self._known.get(container, (None, None))[1]

    def sure(self, row: Json) -> bool:
        """Whether the list and the inspection of a container, which is newer, say the same."""
        mark, inspected = self._known.get(row["Id"], (None, None))
        fresh = mark == self._marks[row["Id"]]
        return fresh and engine_json.dig(inspected, "State", "Status") == row["State"]

    def doubt(self, container: str | None) -> None:
        """Something has happened to a container; None: perhaps to any, unheard."""
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
        since, self._updated = min(now - DOUBT, self._updated), now
        self._looks += 1
        self._doubted = {key: at for key, at in self._doubted.items() if at >= since}
        doubtful = own.keys() if self._all_doubted >= since else self._doubted.keys() & own.keys()
        self._marks = {row["Id"]: self._mark(row, own, doubtful) for row in rows}
        self._known = {key: known for key, known in self._known.items() if key in self._marks}
        self._doubtful_look = {
            key: look for key, look in self._doubtful_look.items() if key in self._marks
        }
        self._unreadable &= self._marks.keys()
        asked = [
            self._ask(key, mark)
            for key, mark in self._marks.items()
            if self._known.get(key, (None,))[0] != mark and key not in self._asking
        ]
        if asked:
            _, late = await asyncio.wait(asked, timeout=patience)
            for task in late:
                task.add_done_callback(lambda _: self._late())
        if self._checked < now - CHECK:
            self._checked = now
            self._check(key for key, role in own.items() if role != ROLE_REDIRECT)

    def _mark(self, row: Json, own: Collection[str], doubtful: Collection[str]) -> object:
        """What an inspection is for; it is asked for anew when that changes."""
        key, seen = row["Id"], engine_json.signature(row)
        if key not in own:
            return seen
        if key in doubtful:
            self._doubtful_look[key] = self._looks
        return row["State"], seen, self._doubtful_look.get(key)

    def _check(self, those: Iterable[str]) -> None:
        """Inspect all of these beside the looks, and tell if something is new."""
        for key in those:
            if key in self._marks and key not in self._asking:
                self._checking.add(key)
                self._ask(key, self._marks[key]).add_done_callback(self._checked_one)

    def _checked_one(self, done: asyncio.Task[bool]) -> None:
        if not done.cancelled() and done.result():
            self._late()

    def _ask(self, container: str, mark: object) -> asyncio.Task[bool]:
        task = asyncio.create_task(self._inspect(container, mark))
        self._asking[container] = task
        return task

    async def _inspect(self, container: str, mark: object) -> bool:
        """Inspect it; whether it is not as it was known."""
        before = self.get(container)
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
            self._checking.discard(container)
        return self.get(container) != before


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

    def doubt(self, container: str | None) -> None:
        """The engine tells that something has happened to a container, by id; None: to any."""
        self._inspector.doubt(container)

    async def look(self, patience: float = PATIENCE) -> DockerSnapshot:
        """What there is now. Raises EngineError.

        Containers whose inspection takes longer than ``patience`` seconds are left out until it is
        there, unless an older one is known.
        """
        # First: what the engine starts meanwhile is no stranger.
        listening, bound = host.listening_ports(), host.bound_udp_ports()
        rows, found, image = await asyncio.gather(
            in_thread(self._engine.containers),
            in_thread(self._engine.networks),
            in_thread(self._engine.image_id, self._settings.proxy_image),
        )
        every = ((row["Id"], self._read_own(row)) for row in rows)
        mine = {key: own.role for key, own in every if own}
        await self._inspector.update(rows, mine, patience)
        networks = tuple(map(engine_json.read_network, found))
        bridges = [n.gateway for n in networks if n.driver == "bridge" and n.gateway]
        at_host = any(map(host.has, bridges))
        state = self._read(rows, networks, image)
        if at_host:
            busy = [box for box in state.sandboxes if box.container.name in state.busy]
            state = replace(
                state,
                listening=strangers(busy, (), listening),
                listening_udp=strangers(busy, state.ears, bound),
                far=host.far_address(),
            )
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
    ) -> HostState:
        """The containers, the operator's own apart from others.

        One that only claims to be its own is like any other. One that is not inspected yet counts
        as own if its name is right: until it is known, nothing is done to it.
        """
        containers: list[Container] = []
        own_ones: dict[str, list[Any]] = {role: [] for role in _KINDS}
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
            else:
                made = _KINDS[own.role](own.key, container, own.range, own.fingerprint)
                own_ones[own.role].append(made)
            if own and not self._inspector.sure(row):
                busy.add(container.name)
        return HostState(
            containers=tuple(containers),
            networks=networks,
            proxies=tuple(own_ones[ROLE_PROXY]),
            ephemeral=host.ephemeral_ports(),
            sandboxes=tuple(own_ones[ROLE_SANDBOX]),
            ears=tuple(own_ones[ROLE_EAR]),
            redirects=tuple(own_ones[ROLE_REDIRECT]),
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
    starting: Iterable[Sandbox], ears: Iterable[EarContainer], listening: frozenset[int]
) -> frozenset[int]:
    """Which of the host's ports on which something listens may be somebody else's.

    Not those of a sandbox that is just being started: the engine takes them one by one before it
    says that it runs. Nor those of the ears.
    """
    own = {port for box in starting for port in box.range.ports()}
    return listening - own - {ear.range.last for ear in ears}


def address_in(state: HostState, name: str, uplink: str) -> str:
    """The address of a host's name that no name server has: this host, or a container."""
    if name == THIS_HOST:
        return next((n.gateway for n in state.networks if n.name == uplink), "")
    for container in state.containers:
        for place in container.attachments if container.state in STARTED else ():
            if place.address and name in {known.lower() for known in place.names}:
                return place.address
    return ""
