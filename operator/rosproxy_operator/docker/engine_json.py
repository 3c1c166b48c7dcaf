"""From the engine's JSON to what is planned with: plain functions, no questions asked.

The engine's list of containers has states, labels, addresses and networks. What only an
inspection of a container tells is `Details`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network, ip_network
from typing import Any

from rosproxy_operator.docker.planner.model import Attachment, Container, Network
from rosproxy_operator.docker.planner.specs import TOKEN_VARIABLE

Json = dict[str, Any]
_NEVER = "0001-"


@dataclass(frozen=True, slots=True)
class Details:
    """Of a container: ``host_ports`` it asks for, ``aliases`` by network, ``token`` if ours.

    ``state`` is in the engine's words, ``started_at`` empty if it was never started.
    """

    master_uri: str = ""
    hostname: str = ""
    host_ports: frozenset[int] = frozenset()
    aliases: Mapping[str, frozenset[str]] = field(default_factory=dict)
    token: str = ""
    state: str = ""
    started_at: str = ""


def read_details(inspected: Json) -> Details:
    """The details in what the engine tells of a container."""
    config = inspected.get("Config") or {}
    variables = dict(text.partition("=")[::2] for text in config.get("Env") or ())
    state = inspected.get("State") or {}
    started = state.get("StartedAt") or ""
    return Details(
        master_uri=variables.get("ROS_MASTER_URI", ""),
        hostname=config.get("Hostname") or "",
        host_ports=bound_ports((inspected.get("HostConfig") or {}).get("PortBindings")),
        aliases={name: _aliases(endpoint) for name, endpoint in endpoints(inspected).items()},
        token=variables.get(TOKEN_VARIABLE, ""),
        state=state.get("Status") or "",
        started_at="" if started.startswith(_NEVER) else started,
    )


def bound_ports(bindings: Json | None) -> frozenset[int]:
    """The TCP ports of the host that port bindings name; all of a range, of which one is chosen."""
    return frozenset(
        port
        for key, wanted in (bindings or {}).items()
        if key.endswith("/tcp") or "/" not in key
        for binding in wanted or ()
        for port in _host_ports(binding.get("HostPort") or "")
    )


def endpoints(row: Json) -> dict[str, Json]:
    """A container's connections by network, from its row in the list or its inspection."""
    found = (row.get("NetworkSettings") or {}).get("Networks") or {}
    return {name: endpoint or {} for name, endpoint in found.items()}


def signature(row: Json) -> tuple[tuple[str, str], ...]:
    """What of a container's row in the list changes whenever its aliases may have changed."""
    return tuple(
        sorted((name, end.get("EndpointID") or "") for name, end in endpoints(row).items())
    )


def read_container(row: Json, details: Details, networks: Iterable[Network] = ()) -> Container:
    """A container from its row in the engine's list and its details."""
    names = {network.id: network.name for network in networks} | {"default": "bridge"}
    mode = (row.get("HostConfig") or {}).get("NetworkMode") or ""
    own = {_name(row), row["Id"][:12]}
    return Container(
        id=row["Id"],
        name=_name(row),
        state=row["State"],
        labels=row.get("Labels") or {},
        network_mode=names.get(mode, mode),
        attachments=tuple(
            Attachment(
                network=names.get(key, key),
                address=end.get("IPAddress") or "",
                names=frozenset(own | details.aliases.get(key, frozenset())),
                network_id=end.get("NetworkID") or "",
                endpoint=end.get("EndpointID") or "",
            )
            for key, end in endpoints(row).items()
        ),
        master_uri=details.master_uri,
        host_ports=details.host_ports | _public_ports(row),
        hostname=details.hostname,
        started_at=details.started_at,
    )


def read_network(row: Json) -> Network:
    """A network from the engine's list."""
    configs = (row.get("IPAM") or {}).get("Config") or []
    gateways = [config.get("Gateway") or "" for config in configs]
    subnets = [ip_network(each["Subnet"], strict=False) for each in configs if each.get("Subnet")]
    return Network(
        id=row["Id"],
        name=row["Name"],
        driver=row.get("Driver") or "",
        internal=bool(row.get("Internal")),
        gateway=next((gateway for gateway in gateways if gateway and ":" not in gateway), ""),
        subnets=tuple(subnet for subnet in subnets if isinstance(subnet, IPv4Network)),
    )


def _aliases(endpoint: Json) -> frozenset[str]:
    """All names of an endpoint: engines since 25 list the container's own under DNSNames."""
    return frozenset(endpoint.get("Aliases") or ()) | frozenset(endpoint.get("DNSNames") or ())


def _host_ports(text: str) -> range:
    """``8000``, ``8000-8010``; none for an empty text or 0, which let the engine choose."""
    first, _, last = text.partition("-")
    if not first.isdecimal() or not (last or first).isdecimal() or int(first) == 0:
        return range(0)
    return range(int(first), int(last or first) + 1)


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
