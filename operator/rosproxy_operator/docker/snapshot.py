"""Looks at a Docker host: containers, networks, labels, and the addresses of the masters.

A look returns the planner's data (`HostState`), and what the planner does not need: the admin
endpoints and tokens of the proxies. Each look parses the labels a single time, here, because the
labels decide which names of masters the operator resolves.
"""

import asyncio
import logging
import secrets
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from rosproxy.shared.addresses import HostPort
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

INSPECTION_WAIT_S = 0.1
"""Seconds that a look waits for inspections. The next look uses results that come later."""
FIRST_INSPECTION_WAIT_S = 1.0
"""Seconds that the first look of an observer waits for inspections.

A proxy must not get an alias that is the name or alias of another container. Only inspections have
the aliases of containers.
"""
_KINDS: Mapping[str, type[OwnContainer]] = {
    ROLE_SANDBOX: Sandbox,
    ROLE_PROXY: Proxy,
    ROLE_LAN_RELAY: LanRelayContainer,
    ROLE_REDIRECT: RedirectContainer,
    ROLE_FLUSH: FlushContainer,
}
REINSPECTED_FOR_S = 1.0
"""Seconds after an event of an own container in which each look inspects this container again."""
CHECK_INTERVAL_S = 30.0
"""Least seconds between two checks of all own containers, in case an event was missed."""
MOST_INSPECTIONS = 16
"""The highest number of inspections at the same time."""


@dataclass(frozen=True, slots=True)
class ProxyAccess:
    """The admin endpoint and the token of a running proxy.

    ``run`` identifies this run: each start of the container has another value.
    """

    admin: HostPort
    token: str = field(repr=False)
    run: str


@dataclass(frozen=True, slots=True)
class DockerSnapshot:
    """A Docker host at one moment.

    ``access`` has the running proxies, by name. ``at_host``: the operator is in the host's network
    namespace. ``new_secret`` is the secret for an uplink network that the operator has yet to make.
    """

    state: HostState
    labels: LabelReading
    access: Mapping[str, ProxyAccess]
    at_host: bool
    new_secret: str = field(default="", repr=False)


class Inspector:
    """The inspections of containers, by container id. Inspects a container only after a change.

    The engine always lists containers within milliseconds. But the engine answers an inspection
    only when the start of the container is over: with 1000 published ports, this takes 26 s. Of an
    inspection, only the aliases change during a run, and only together with the endpoints. The list
    has the ids of the endpoints. So a changed id in the list shows that the inspector has to
    inspect the container again.

    The list does not show each restart of an own container. A proxy's container has no network
    endpoint, and the list shows the end of a container late. The engine's events report the restart
    (`note_event`). Then each look inspects this container for `REINSPECTED_FOR_S` seconds. An event
    may be missed. So a look that comes `CHECK_INTERVAL_S` seconds after the last check also starts
    a check: inspections of all own containers, for which this look does not wait. Redirects are
    not checked: a redirect's container has ended.

    The inspector logs an unreadable inspection once, and treats the inspection as missing. Other
    containers are not affected. The inspector calls ``on_late_result`` when an inspection ends
    after the look that started the inspection, or when a check finds a change.
    """

    def __init__(self, engine: DockerClient, on_late_result: Callable[[], None]) -> None:
        self._engine = engine
        self._on_late_result = on_late_result
        self._cached: dict[str, tuple[object, Json]] = {}
        self._inspecting: dict[str, asyncio.Task[bool]] = {}
        self._state_keys: dict[str, object] = {}
        self._unreadable: set[str] = set()
        self._turns = asyncio.Semaphore(MOST_INSPECTIONS)
        self._event_times: dict[str, float] = {}
        self._events_missed_at = -REINSPECTED_FOR_S
        self._last_update_at = time.monotonic()
        self._looks = 0
        self._event_looks: dict[str, int] = {}
        self._last_check_at = time.monotonic()
        self._checking: set[str] = set()

    @property
    def waiting(self) -> bool:
        """Whether inspections are under way, apart from checks."""
        return bool(self._inspecting.keys() - self._checking)

    def get(self, container: str) -> Json | None:
        """Return the last known inspection of a container, or None."""
        return self._cached.get(container, (None, None))[1]

    def is_current(self, row: Json) -> bool:
        """Whether the inspection belongs to this row of the list, and both have the same state."""
        state_key, inspected = self._cached.get(row["Id"], (None, None))
        fresh = state_key == self._state_keys[row["Id"]]
        return fresh and engine_json.dig(inspected, "State", "Status") == row["State"]

    def note_event(self, container: str | None) -> None:
        """Note an event about a container. None: events may be missing, of all containers."""
        if container is None:
            self._events_missed_at = time.monotonic()
        else:
            self._event_times[container] = time.monotonic()

    async def update(self, rows: Iterable[Json], own: Mapping[str, str], patience: float) -> None:
        """Inspect new and changed containers. Wait for the results for ``patience`` seconds.

        ``own`` gives the roles of the operator's own containers, by container id. An event counts
        at least for the next look, even if this look comes after `REINSPECTED_FOR_S` seconds.
        """
        now = time.monotonic()
        since = min(now - REINSPECTED_FOR_S, self._last_update_at)
        self._last_update_at = now
        self._looks += 1
        self._event_times = {key: at for key, at in self._event_times.items() if at >= since}
        with_event = (
            own.keys() if self._events_missed_at >= since else self._event_times.keys() & own.keys()
        )
        self._state_keys = {row["Id"]: self._state_key(row, own, with_event) for row in rows}
        self._cached = {key: c for key, c in self._cached.items() if key in self._state_keys}
        self._event_looks = {
            key: look for key, look in self._event_looks.items() if key in self._state_keys
        }
        self._unreadable &= self._state_keys.keys()
        tasks = [
            self._start_inspection(key, state_key)
            for key, state_key in self._state_keys.items()
            if self._cached.get(key, (None,))[0] != state_key and key not in self._inspecting
        ]
        if tasks:
            _, pending = await asyncio.wait(tasks, timeout=patience)
            for task in pending:
                task.add_done_callback(lambda _: self._on_late_result())
        if self._last_check_at < now - CHECK_INTERVAL_S:
            self._last_check_at = now
            self._check(key for key, role in own.items() if role != ROLE_REDIRECT)

    def _state_key(self, row: Json, own: Collection[str], with_event: Collection[str]) -> object:
        """Return a value that changes when the container has to be inspected again."""
        key = row["Id"]
        signature = engine_json.signature(row)
        if key not in own:
            return signature
        if key in with_event:
            self._event_looks[key] = self._looks
        return row["State"], signature, self._event_looks.get(key)

    def _check(self, ids: Iterable[str]) -> None:
        """Inspect containers without waiting. Call ``on_late_result`` for a changed inspection."""
        for key in ids:
            if key in self._state_keys and key not in self._inspecting:
                self._checking.add(key)
                self._start_inspection(key, self._state_keys[key]).add_done_callback(
                    self._after_check
                )

    def _after_check(self, task: asyncio.Task[bool]) -> None:
        if not task.cancelled() and task.result():
            self._on_late_result()

    def _start_inspection(self, container: str, state_key: object) -> asyncio.Task[bool]:
        task = asyncio.create_task(self._inspect(container, state_key))
        self._inspecting[container] = task
        return task

    async def _inspect(self, container: str, state_key: object) -> bool:
        """Inspect a container. Return whether the inspection differs from the last inspection."""
        previous = self.get(container)
        try:
            async with self._turns:
                inspected = await in_thread(self._engine.container, container)
            self._cached[container] = state_key, engine_json.check_inspection(inspected)
            self._unreadable.discard(container)
        except EngineError as error:
            log.debug("inspecting %s: %s", container[:12], error)
        except msgspec.ValidationError as error:
            if container not in self._unreadable:
                text = "container %s: the data of docker inspect can't be read: %s"
                log.warning(text, container[:12], error)
            self._unreadable.add(container)
        finally:
            del self._inspecting[container]
            self._checking.discard(container)
        return self.get(container) != previous


class DockerObserver:
    """Looks at an engine. ``on_late_result`` is called as by the `Inspector`."""

    def __init__(
        self,
        engine: DockerClient,
        settings: PlanSettings,
        masters: MasterResolver,
        on_late_result: Callable[[], None],
    ) -> None:
        self._engine = engine
        self._settings = settings
        self._masters = masters
        self._inspector = Inspector(engine, on_late_result)
        self._new_secret = secrets.token_hex(32)
        self._has_looked = False

    @property
    def waiting(self) -> bool:
        """Whether inspections are under way, apart from checks."""
        return self._inspector.waiting

    def note_event(self, container: str | None) -> None:
        """Note an event of the engine about a container id. None: events may be missing."""
        self._inspector.note_event(container)

    async def look(self, patience: float = INSPECTION_WAIT_S) -> DockerSnapshot:
        """Return the state of the host now. Raises EngineError.

        Containers of users are missing in the result until the operator has inspected them. A look
        waits ``patience`` seconds for inspections, the first at least `FIRST_INSPECTION_WAIT_S`.
        """
        # Ports first: a port that the engine opens later does not look like another program's.
        listening = host.listening_ports()
        bound = host.bound_udp_ports()
        rows, net_rows, image = await asyncio.gather(
            in_thread(self._engine.containers),
            in_thread(self._engine.networks),
            in_thread(self._engine.image_id, self._settings.proxy_image),
        )
        labelled = ((row["Id"], self._read_own(row)) for row in rows)
        own_roles = {key: own.role for key, own in labelled if own}
        least = 0.0 if self._has_looked else FIRST_INSPECTION_WAIT_S
        await self._inspector.update(rows, own_roles, max(patience, least))
        self._has_looked = True
        networks = tuple(map(engine_json.read_network, net_rows))
        bridges = [n.gateway for n in networks if n.driver == "bridge" and n.gateway]
        # The gateway of a bridge is an address in the host's network namespace. In any other
        # namespace, the ports that listen here are not the ports of the host.
        at_host = any(map(host.is_own_address, bridges))
        state = self._read(rows, networks, image)
        if at_host:
            busy = [sandbox for sandbox in state.sandboxes if sandbox.container.name in state.busy]
            state = replace(
                state,
                listening=foreign_ports(busy, (), listening),
                listening_udp=foreign_ports(busy, state.lan_relays, bound),
                default_route_address=host.default_route_address(),
            )
        secret = self._settings.secret or engine_json.uplink_secret(net_rows, self._settings.uplink)
        state = replace(state, image_id=image, secret=secret or self._new_secret)
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
            new_secret=self._new_secret,
        )

    def _read_own(self, row: Json) -> OwnLabels | None:
        """Return the operator's labels; None if the labels or the name are not the operator's."""
        own = read_own(row.get("Labels") or {})
        nameless = not row.get("Names")  # the engine is removing the container
        return own if own and (nameless or has_own_name(own, engine_json.name_of(row))) else None

    def _read(
        self,
        rows: list[Json],
        networks: tuple[Network, ...],
        image: str,
    ) -> HostState:
        """Return the state of the host, with the operator's own containers apart.

        A container with forged labels of the operator counts as a container of a user. Without an
        inspection, a container with the operator's labels and the right name counts as the
        operator's own. The operator does nothing to this container until the inspection is there
        (``busy``).
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
                creation = engine_json.read_making(inspected)
                forged = forgery_reason(claimed, container.name, creation, image)
            if own is None or forged:
                containers.append(replace(container, forged=forged))
                own = None
            else:
                own_container = _KINDS[own.role](own.place, container, own.range, own.fingerprint)
                own_by_role[own.role].append(own_container)
            if own and not self._inspector.is_current(row):
                busy.add(container.name)
        # Also leave out each container that shares the network of a container without inspection.
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
        """Return the address of each master's host, by name; empty if unknown."""
        uplink = self._settings.uplink
        local = {name: address for name in names if (address := address_in(state, name, uplink))}
        excluded = [a.address for sandbox in state.sandboxes for a in sandbox.container.attachments]
        await self._masters.learn(names, local, excluded)
        return {name: self._masters.address(name) for name in names}

    def _access(self, proxy: Proxy, state: HostState) -> ProxyAccess | None:
        sandbox = state.sandbox_of(proxy)
        if sandbox is None or {proxy.container.state, sandbox.container.state} != {"running"}:
            return None
        uplink = self._settings.uplink
        address = next(
            (a.address for a in sandbox.container.attachments if a.network == uplink), ""
        )
        run = f"{proxy.container.id} {proxy.container.started_at}"
        admin = HostPort(address, admin_port(proxy.place))
        variables = engine_json.environment(self._inspector.get(proxy.container.id))
        token = variables.get(FORMER_TOKEN) or proxy_token(proxy.place, state.secret)
        return ProxyAccess(admin, token, run) if address else None


def _addresses(rows: Iterable[Json]) -> frozenset[str]:
    """Return the addresses of all containers in the engine's list."""
    endpoints = (endpoint for row in rows for endpoint in engine_json.endpoints(row).values())
    return frozenset(endpoint.get("IPAddress") or "" for endpoint in endpoints)


def foreign_ports(
    busy: Iterable[Sandbox], lan_relays: Iterable[LanRelayContainer], listening: frozenset[int]
) -> frozenset[int]:
    """Return the listening ports of the host that may belong to other programs.

    The ports of LAN relays and of ``busy`` sandboxes, which may be starting, are left out. The
    engine opens a sandbox's ports one after the other before the engine reports the sandbox as
    running. The ports of all other sandboxes stay in the result: the planner knows these ports by
    the sandboxes.
    """
    own = {port for sandbox in busy for port in sandbox.range.ports()}
    return listening - own - {lan_relay.range.last for lan_relay in lan_relays}


def address_in(state: HostState, name: str, uplink: str) -> str:
    """Return the address of this host (`THIS_HOST`) or of a running container with a name.

    ``name`` is in lower case. Empty without such a container. This host's address is the gateway of
    the network ``uplink``. For names that the name servers do not know.
    """
    if name == THIS_HOST:
        return next((n.gateway for n in state.networks if n.name == uplink), "")
    for container in state.containers:
        for attachment in container.attachments if container.state in STARTED else ():
            if attachment.address and name in {n.lower() for n in attachment.names}:
                return attachment.address
    return ""
