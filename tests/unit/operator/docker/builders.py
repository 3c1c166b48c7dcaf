"""Containers, networks and hosts for tests."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from msgspec import structs

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.labels.members import find_members, read_labels
from rosproxy_operator.docker.planner.model import (
    Attachment,
    Container,
    HostState,
    Member,
    Network,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.plan import DockerPlan, plan
from rosproxy_operator.docker.planner.specs import (
    own_labels,
    proxy_fingerprint,
    proxy_name,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Master, Place

ROBOT = "http://robot:11311"
HERE = "192.0.2.10"
PLACE = Place(Master(ROBOT), HERE)
RANGE = PortRange(11400, 11431)
SETTINGS = PlanSettings(advertise_host=HERE, port_window=PortRange(11400, 65535))
IMAGE = "sha256:1"
SECRET = "what tokens are made of"
EPHEMERAL = PortRange(32768, 60999)
UPLINK = Network("n0", "0-rosproxy", gateway="172.30.0.1")
APP = Network("n1", "app", gateway="172.18.0.1")
ENABLED = {"rosproxy.enable": "true", "rosproxy.master-uri": ROBOT}


def attachment(network: str = "app", *names: str, network_id: str = "") -> Attachment:
    return Attachment(network, "", frozenset(names), network_id)


def container(
    name: str = "talker",
    labels: Mapping[str, str] | None = None,
    networks: Iterable[str | Attachment] = ("app",),
    state: str = "running",
    env: str = "http://rosproxy:11311",
    mode: str = "",
    ports: Iterable[int] = (),
) -> Container:
    """A container, by default running, labelled and on the network ``app``."""
    attachments = tuple(attachment(n, name) if isinstance(n, str) else n for n in networks)
    return Container(
        id=f"id-{name}",
        name=name,
        state=state,
        labels=ENABLED if labels is None else labels,
        network_mode=mode or (attachments[0].network if attachments else ""),
        attachments=attachments,
        master_uri=env,
        host_ports=frozenset(ports),
    )


def sandbox(
    place: Place = PLACE,
    ports: PortRange = RANGE,
    networks: Iterable[str | Attachment] = ("app",),
    state: str = "running",
    name: str = "",
    settings: PlanSettings = SETTINGS,
    made: str = "",
    started_at: str = "2026-01-01T10:00:00.5Z",
) -> Sandbox:
    """A sandbox of the operator, by default running on the uplink and on ``app``."""
    name = name or sandbox_name(place)
    create = CreateSandbox(name, place, ports)
    made = made or sandbox_fingerprint(create, settings)
    aliases = ("rosproxy", place.master.host, proxy_name(place), name)
    attachments = [attachment(n, *aliases) if isinstance(n, str) else n for n in networks]
    own = container(
        name,
        own_labels(structs.replace(create, fingerprint=made)),
        [attachment(settings.uplink, name), *attachments],
        state,
        ports=ports.ports(),
    )
    return Sandbox(place, replace(own, started_at=started_at), ports, made)


def proxy(
    place: Place = PLACE,
    ports: PortRange = RANGE,
    state: str = "running",
    name: str = "",
    settings: PlanSettings = SETTINGS,
    image: str = IMAGE,
    made: str = "",
    sandbox_id: str = "",
    started_at: str = "2026-01-01T10:00:00.75Z",
) -> Proxy:
    """A proxy of the operator, by default running in the `sandbox` of the same place."""
    name = name or proxy_name(place)
    create = Create(name, place, ports, sandbox_name(place))
    made = made or proxy_fingerprint(create, settings, image, SECRET)
    mode = f"container:{sandbox_id or f'id-{sandbox_name(place)}'}"
    labels = own_labels(structs.replace(create, fingerprint=made))
    own = container(name, labels, [], state, mode=mode)
    return Proxy(place, replace(own, started_at=started_at), ports, made)


def both(**more: Any) -> dict[str, Any]:
    """A sandbox with a proxy, for `observed`. Words: place, ports, settings."""
    return {"sandboxes": [sandbox(**more)], "proxies": [proxy(**more)]}


def observed(
    *containers: Container,
    proxies: Iterable[Proxy] = (),
    sandboxes: Iterable[Sandbox] = (),
    networks: Iterable[Network] = (UPLINK, APP),
    listening: Iterable[int] = (),
    ephemeral: PortRange = EPHEMERAL,
    image: str = IMAGE,
    advertise: Mapping[str, str] | None = None,
    **more: Any,
) -> HostState:
    """A host with these containers."""
    return HostState(
        containers=containers,
        networks=tuple(networks),
        proxies=tuple(proxies),
        ephemeral=ephemeral,
        listening=frozenset(listening),
        image_id=image,
        advertise=advertise or {},
        sandboxes=tuple(sandboxes),
        **{"secret": SECRET, **more},
    )


def inspection(body: Mapping[str, Any], image: str = IMAGE, **more: Any) -> dict[str, Any]:
    """The engine's inspection of a container that was created with this body."""
    from_image = {"Entrypoint": ["rosproxy"], "Cmd": ["run"]}
    config = {key: body[key] for key in ("User", "Env", "Labels", *from_image) if key in body}
    host = {
        "Privileged": False,
        "Binds": None,
        "IpcMode": "private",
        "PidMode": "",
        "Devices": [],
        "CapAdd": None,
        "PortBindings": {},
        "Sysctls": None,
        "UsernsMode": "",
        **body["HostConfig"],
    }
    return {"Image": image, "Config": from_image | config, "HostConfig": host, **more}


def planned(
    state: HostState, settings: PlanSettings, memory: DockerMemory, now: float
) -> DockerPlan:
    """The plan for a host, after the labels are read."""
    return plan(state, read_labels(state, settings), settings, memory, now)


def read_members(
    state: HostState, settings: PlanSettings = SETTINGS
) -> tuple[tuple[Member, ...], list[Problem]]:
    """The containers that belong to proxies, and what is wrong with labels."""
    reading = read_labels(state, settings)
    members, problems = find_members(reading, state, settings)
    return members, [*reading.problems, *problems]
