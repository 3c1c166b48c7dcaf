"""From the engine's JSON to the planner's data: plain functions that ask the engine nothing.

The engine's list of containers has states, labels, addresses and networks; the rest only an
inspection of a container tells. Whatever the engine has nothing to say of may be missing or null.
"""

from collections.abc import Iterable
from ipaddress import IPv4Network, ip_network
from itertools import islice
from typing import Any, TypedDict

import msgspec

from rosproxy_operator.common.problem import bounded
from rosproxy_operator.common.ros2_variables import OF_ROS2
from rosproxy_operator.common.zenoh import OVERRIDE, SESSION_FILE, runs_router
from rosproxy_operator.docker.engine_client import Json
from rosproxy_operator.docker.planner.model import Attachment, Container, Network
from rosproxy_operator.docker.planner.own_containers import CreationFacts
from rosproxy_operator.docker.planner.specs import FORMER_TOKEN, MANAGED, SECRET

# Go's zero time, 0001-01-01T00:00:00Z.
_NEVER_STARTED = "0001-"
_VARIABLES = OF_ROS2 | {
    *("ROS_VERSION", "ROS_DISTRO", "ROS_IP", "ROS_HOSTNAME"),
    *(OVERRIDE, SESSION_FILE),
}
"""Variables that tell the version of ROS in a container, and how its nodes find each other."""
_KEPT_VARIABLES = _VARIABLES | {"ROS_MASTER_URI", FORMER_TOKEN}
LONGEST_TEXT = 4096
"""Characters that are kept of a variable or an argument; a longer one ends in an ellipsis.

An image can have megabytes of both, and they are kept as long as the container is there.
"""
MOST_ARGUMENTS = 16
"""Arguments that are kept of a command: those of the operator's own containers have two."""


class _State(TypedDict, total=False):
    Status: str | None
    StartedAt: str | None
    ExitCode: int | None


class _Config(TypedDict, total=False):
    Env: list[str] | None
    Hostname: str | None
    User: str | None
    Entrypoint: list[str] | None
    Cmd: list[str] | None


class _Binding(TypedDict, total=False):
    HostPort: str | None


class _HostConfig(TypedDict, total=False):
    PortBindings: dict[str, list[_Binding] | None] | None
    # Only compared with what the operator gives its own: whatever these are in other containers.
    NetworkMode: Any
    ReadonlyRootfs: Any
    CapAdd: list[str] | None
    CapDrop: Any
    SecurityOpt: Any
    Sysctls: dict[str, Any] | None
    Privileged: Any
    Binds: Any
    Mounts: Any
    VolumesFrom: Any
    Devices: Any
    DeviceRequests: Any
    GroupAdd: Any
    PidMode: Any
    IpcMode: Any
    UTSMode: Any
    UsernsMode: Any


class _Endpoint(TypedDict, total=False):
    Aliases: list[str] | None
    DNSNames: list[str] | None


class _NetworkSettings(TypedDict, total=False):
    Networks: dict[str, _Endpoint | None] | None


class _Inspection(TypedDict, total=False):
    Image: str | None
    State: _State | None
    Config: _Config | None
    HostConfig: _HostConfig | None
    NetworkSettings: _NetworkSettings | None


def check_inspection(inspection: object) -> Json:
    """What is read of an inspection, bounded. Raises msgspec.ValidationError for wrong types."""
    document = dict(msgspec.convert(inspection, _Inspection))
    config = dict(dig(document, "Config") or {})
    variables = (text for text in config.get("Env") or () if _name(text) in _KEPT_VARIABLES)
    texts = {
        "Env": variables,
        "Entrypoint": islice(config.get("Entrypoint") or (), MOST_ARGUMENTS),
        "Cmd": islice(config.get("Cmd") or (), MOST_ARGUMENTS),
    }
    for key, items in texts.items():
        config[key] = [bounded(text, LONGEST_TEXT) for text in items]
    return {**document, "Config": config}


def _name(variable: str) -> str:
    return variable.partition("=")[0]


def dig(document: Any, *keys: str) -> Any:
    """What is under these keys, each within the one before; None if one is missing."""
    for key in keys:
        document = (document or {}).get(key)
    return document


def container_of(event: Json) -> str:
    """The id of the container that an event is about, or whose network it is; empty if of none."""
    actor = event.get("Actor") or {}
    if event.get("Type") == "container":
        return str(actor.get("ID") or "")
    return str(dig(actor, "Attributes", "container") or "")


def environment(inspected: Json | None) -> dict[str, str]:
    """A container's variables, from its inspection."""
    return dict(text.partition("=")[::2] for text in dig(inspected, "Config", "Env") or ())


def endpoints(row: Json | None) -> dict[str, Json]:
    """A container's connections by network, from its row in the list or its inspection."""
    networks = dig(row, "NetworkSettings", "Networks") or {}
    return {name: endpoint or {} for name, endpoint in networks.items()}


def signature(row: Json) -> tuple[tuple[str, str], ...]:
    """What changes in a container's row of the list whenever its aliases may have changed.

    For one without a network of its own: its state.
    """
    connections = sorted((name, e.get("EndpointID") or "") for name, e in endpoints(row).items())
    return tuple(connections) or (("", str(row.get("State"))),)


def read_making(inspected: Json | None) -> CreationFacts:
    """How a container was made, from its inspection."""
    argvs = (dig(inspected, "Config", key) or () for key in ("Entrypoint", "Cmd"))
    return CreationFacts(
        image=dig(inspected, "Image") or "",
        user=dig(inspected, "Config", "User") or "",
        command=tuple(argument for argv in argvs for argument in argv),
        host=dig(inspected, "HostConfig") or {},
    )


def uplink_secret(rows: Iterable[Json], uplink: str) -> str:
    """The secret that the uplink network has, from the list of networks; empty if it is not there.

    Labels of a network come from whoever made it, and no container can read them. A network that
    somebody made without one has at least an id of 256 random bits, which no container knows
    either; but it shows wherever a container on that network is inspected.
    """
    network = next((row for row in rows if row.get("Name") == uplink), None)
    return str(dig(network, "Labels", SECRET) or network["Id"]) if network else ""


def name_of(row: Json) -> str:
    """A container's name, from its row in the list."""
    # One that is just being removed may have no name any more; one with a slash is a link's.
    names = [name.lstrip("/") for name in row.get("Names") or () if name.count("/") == 1]
    return str(names[0] if names else row["Id"][:12])


def read_container(
    row: Json, inspected: Json | None, networks: Iterable[Network] = ()
) -> Container:
    """A container from its row in the engine's list and its inspection, if there is one."""
    # Engines tell a network by its id where the container was created so, and by "default" where it
    # was created without one; newer engines store "bridge" instead (moby: container_routes.go).
    network_names = {network.id: network.name for network in networks} | {"default": "bridge"}
    mode = dig(row, "HostConfig", "NetworkMode") or ""
    name = name_of(row)
    short_id = row["Id"][:12]
    aliases = {key: _aliases(endpoint) for key, endpoint in endpoints(inspected).items()}
    started = dig(inspected, "State", "StartedAt") or ""
    variables = environment(inspected)
    return Container(
        id=row["Id"],
        name=name,
        state=row["State"],
        labels=row.get("Labels") or {},
        network_mode=network_names.get(mode, mode),
        attachments=tuple(
            Attachment(
                network=network_names.get(key, key),
                address=endpoint.get("IPAddress") or "",
                names=frozenset({name, short_id, *aliases.get(key, ())}),
                network_id=endpoint.get("NetworkID") or "",
                endpoint=endpoint.get("EndpointID") or "",
            )
            for key, endpoint in endpoints(row).items()
        ),
        master_uri=variables.get("ROS_MASTER_URI", ""),
        variables={name: text for name, text in variables.items() if name in _VARIABLES},
        host_ports=_bound_ports(inspected, "tcp") | _public_ports(row, "tcp"),
        udp_ports=_bound_ports(inspected, "udp") | _public_ports(row, "udp"),
        hostname=dig(inspected, "Config", "Hostname") or "",
        started_at="" if started.startswith(_NEVER_STARTED) else started,
        exit_code=dig(inspected, "State", "ExitCode") or 0,
        is_zenoh_router=runs_router(read_making(inspected).command),
    )


def read_network(row: Json) -> Network:
    """A network from the engine's list."""
    configs = dig(row, "IPAM", "Config") or []
    gateways = [config.get("Gateway") or "" for config in configs]
    subnets = [ip_network(c["Subnet"], strict=False) for c in configs if c.get("Subnet")]
    return Network(
        id=row["Id"],
        name=row["Name"],
        driver=row.get("Driver") or "",
        internal=bool(row.get("Internal")),
        gateway=next((gateway for gateway in gateways if gateway and ":" not in gateway), ""),
        subnets=tuple(subnet for subnet in subnets if isinstance(subnet, IPv4Network)),
        made_by_operator=dig(row, "Labels", MANAGED) == "true",
    )


def _aliases(endpoint: Json) -> list[str]:
    """All names of an endpoint: engines since 25 list the container's own under DNSNames."""
    return [*(endpoint.get("Aliases") or ()), *(endpoint.get("DNSNames") or ())]


def _bound_ports(inspected: Json | None, protocol: str) -> frozenset[int]:
    """The ports of the host that it asks for; all of a range, of which one is chosen."""
    return frozenset(
        port
        for key, bindings in (dig(inspected, "HostConfig", "PortBindings") or {}).items()
        if (key.partition("/")[2] or "tcp") == protocol
        for binding in bindings or ()
        for port in _host_ports(binding.get("HostPort") or "")
    )


def _host_ports(text: str) -> range:
    """``8000``, ``8000-8010``; none for an empty text or 0, which let the engine choose."""
    first, _, last = text.partition("-")
    if not first.isdecimal() or not (last or first).isdecimal() or int(first) == 0:
        return range(0)
    return range(int(first), int(last or first) + 1)


def _public_ports(row: Json, protocol: str) -> frozenset[int]:
    """The ports of the host that the engine has given it."""
    return frozenset(
        port["PublicPort"]
        for port in row.get("Ports") or ()
        if port.get("PublicPort") and port.get("Type") == protocol
    )
