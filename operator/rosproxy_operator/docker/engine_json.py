"""Converts the engine's JSON to the planner's data. These functions do not call the engine.

The engine's list of containers has states, labels, addresses, networks, network modes and published
ports. Only an inspection of a container has the rest. Any empty field may be missing or null.
"""

from collections.abc import Iterable
from ipaddress import IPv4Network, ip_network
from itertools import islice
from typing import Any, TypedDict

import msgspec

from rosproxy.shared.uris import parse_slave_uri
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.common.ros2_variables import ROS2_VARIABLES
from rosproxy_operator.common.zenoh import OVERRIDE, SESSION_FILE, runs_router
from rosproxy_operator.docker.engine_client import Json
from rosproxy_operator.docker.planner.model import Attachment, Container, Network
from rosproxy_operator.docker.planner.own_containers import CreationFacts
from rosproxy_operator.docker.planner.specs import FORMER_TOKEN, MANAGED, SECRET

# Go's zero time, 0001-01-01T00:00:00Z.
_NEVER_STARTED = "0001-"
_VARIABLES = ROS2_VARIABLES | {
    *("ROS_VERSION", "ROS_DISTRO", "ROS_IP", "ROS_HOSTNAME"),
    *(OVERRIDE, SESSION_FILE),
}
"""Variables that show the ROS version of a container, and how its nodes find each other."""
_KEPT_VARIABLES = _VARIABLES | {"ROS_MASTER_URI", FORMER_TOKEN}
MOST_TEXT_CHARACTERS = 4096
"""Characters of a variable or an argument that the operator keeps; longer texts get an ellipsis.

An image may have megabytes of both, and the operator keeps these as long as the container exists.
"""
MOST_ARGUMENTS = 16
"""Arguments of a command that the operator keeps: the operator's containers have six at most."""


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
    ExtraHosts: list[str] | None
    # Other containers may have any values here: the operator only compares these fields with the
    # values of its own containers.
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
    """Return the fields of an inspection that the operator uses, with bounded texts.

    Raises msgspec.ValidationError.
    """
    document = dict(msgspec.convert(inspection, _Inspection))
    config = dict(dig(document, "Config") or {})
    variables = (text for text in config.get("Env") or () if _name(text) in _KEPT_VARIABLES)
    texts = {
        "Env": variables,
        "Entrypoint": islice(config.get("Entrypoint") or (), MOST_ARGUMENTS),
        "Cmd": islice(config.get("Cmd") or (), MOST_ARGUMENTS),
    }
    for key, items in texts.items():
        config[key] = [bounded(text, MOST_TEXT_CHARACTERS) for text in items]
    return {**document, "Config": config}


def _name(variable: str) -> str:
    return variable.partition("=")[0]


def dig(document: Any, *keys: str) -> Any:
    """Return the value under nested keys; None if a key is missing."""
    for key in keys:
        document = (document or {}).get(key)
    return document


def container_of(event: Json) -> str:
    """Return the id of the container in an event of a container or network; empty without one."""
    actor = event.get("Actor") or {}
    if event.get("Type") == "container":
        return str(actor.get("ID") or "")
    return str(dig(actor, "Attributes", "container") or "")


def environment(inspected: Json | None) -> dict[str, str]:
    """Return the environment variables of a container that `check_inspection` keeps."""
    return dict(text.partition("=")[::2] for text in dig(inspected, "Config", "Env") or ())


def endpoints(row: Json | None) -> dict[str, Json]:
    """Return a container's endpoints by network, from a row of the list or an inspection."""
    networks = dig(row, "NetworkSettings", "Networks") or {}
    return {name: endpoint or {} for name, endpoint in networks.items()}


def signature(row: Json) -> tuple[tuple[str, str], ...]:
    """Return a value that changes if the aliases of a container may have changed.

    The value has the networks and endpoint ids in the container's row of the list. For a container
    without a network of its own, the value is the state.
    """
    connections = sorted((name, e.get("EndpointID") or "") for name, e in endpoints(row).items())
    return tuple(connections) or (("", str(row.get("State"))),)


def read_making(inspected: Json | None) -> CreationFacts:
    """Return the facts of a container's creation, from an inspection."""
    argvs = (dig(inspected, "Config", key) or () for key in ("Entrypoint", "Cmd"))
    return CreationFacts(
        image=dig(inspected, "Image") or "",
        user=dig(inspected, "Config", "User") or "",
        command=tuple(argument for argv in argvs for argument in argv),
        host=dig(inspected, "HostConfig") or {},
    )


def uplink_secret(rows: Iterable[Json], uplink: str) -> str:
    """Return the secret of the uplink network, from the list of networks; empty without network.

    The secret is in a label of the network: containers can't read this label. If a user created the
    network without the label, the secret is the network's id, which has 256 random bits. The id is
    weaker: each inspection of a container on the network shows this id.
    """
    network = next((row for row in rows if row.get("Name") == uplink), None)
    return str(dig(network, "Labels", SECRET) or network["Id"]) if network else ""


def name_of(row: Json) -> str:
    """Return a container's name, from a row of the list."""
    # During the removal, a container may have no name. A second slash marks the name of a link.
    names = [name.lstrip("/") for name in row.get("Names") or () if name.count("/") == 1]
    return str(names[0] if names else row["Id"][:12])


def read_container(
    row: Json, inspected: Json | None, networks: Iterable[Network] = ()
) -> Container:
    """Return a container, from a row of the engine's list and an inspection, if there is any."""
    # ``NetworkMode`` is the network of the creation call, by name or id. Without a network in that
    # call, it is "default", with newer engines "bridge" (moby: container_routes.go).
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
        master_entry=_hosts_entry(inspected, variables.get("ROS_MASTER_URI", "")),
        variables={name: text for name, text in variables.items() if name in _VARIABLES},
        host_ports=_requested_ports(inspected, "tcp") | _public_ports(row, "tcp"),
        udp_ports=_requested_ports(inspected, "udp") | _public_ports(row, "udp"),
        hostname=dig(inspected, "Config", "Hostname") or "",
        started_at="" if started.startswith(_NEVER_STARTED) else started,
        exit_code=dig(inspected, "State", "ExitCode") or 0,
        is_zenoh_router=runs_router(read_making(inspected).command),
    )


def _hosts_entry(inspected: Json | None, master_uri: str) -> str:
    """Return what the engine writes into /etc/hosts for the host of a ROS_MASTER_URI.

    This is an address or ``host-gateway``; empty without an entry. The separator of an entry is a
    colon or, since Docker 25, an equals sign (moby: opts/hosts.go).
    """
    target = parse_slave_uri(master_uri.strip())
    for entry in dig(inspected, "HostConfig", "ExtraHosts") or ():
        name, _, address = entry.replace("=", ":", 1).partition(":")
        if target and name.lower() == target.host.lower():
            return str(bounded(address, MOST_TEXT_CHARACTERS))
    return ""


def read_network(row: Json) -> Network:
    """Return a network, from a row of the engine's list. Subnets and gateway are IPv4 only."""
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
        # Engines before API 1.48 have no EnableIPv4: each network has IPv4.
        dual_stack=row.get("EnableIPv6") is True and row.get("EnableIPv4") is not False,
    )


def _aliases(endpoint: Json) -> list[str]:
    """Return all names of an endpoint. Since Docker 25, DNSNames has the container's names."""
    return [*(endpoint.get("Aliases") or ()), *(endpoint.get("DNSNames") or ())]


def _requested_ports(inspected: Json | None, protocol: str) -> frozenset[int]:
    """Return the host ports that a container requests. A range counts with all ports."""
    return frozenset(
        port
        for key, bindings in (dig(inspected, "HostConfig", "PortBindings") or {}).items()
        if (key.partition("/")[2] or "tcp") == protocol
        for binding in bindings or ()
        for port in _host_ports(binding.get("HostPort") or "")
    )


def _host_ports(text: str) -> range:
    """Parse ``8000`` or ``8000-8010``. No ports for empty or 0: the engine chooses the port."""
    first, _, last = text.partition("-")
    if not first.isdecimal() or not (last or first).isdecimal() or int(first) == 0:
        return range(0)
    return range(int(first), int(last or first) + 1)


def _public_ports(row: Json, protocol: str) -> frozenset[int]:
    """Return the host ports that the engine has published for a container."""
    return frozenset(
        port["PublicPort"]
        for port in row.get("Ports") or ()
        if port.get("PublicPort") and port.get("Type") == protocol
    )
