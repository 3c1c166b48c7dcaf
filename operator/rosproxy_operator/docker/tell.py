"""What a proxy is to be told of the containers on its networks."""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network, ip_address
from typing import Any

from rosproxy.core.uris import is_address, parse_host_port
from rosproxy_operator.core.fingerprint import master
from rosproxy_operator.core.model import STARTED, Container, Proxy, Wish
from rosproxy_operator.docker.observe import Look, sandbox_of

AGAIN = (0.0, 1.0, 3.0, 10.0)
"""Seconds after a container's arrival at which its proxy is told: nodes take time to register."""
_SHARED = "container:"
_HOST_NAME = re.compile(r"[\w.-]{1,253}", re.ASCII)
"""What a node can call its host in a URI; aliases may be anything."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A labelled container on a network of its proxy, since one start of it (``endpoint``)."""

    container: str
    network: str
    address: str
    endpoint: str
    names: frozenset[str] = field(compare=False)


@dataclass(frozen=True, slots=True)
class Facts:
    """What one look says to one proxy.

    ``addresses`` are those of running containers on its networks, by container id and network;
    ``taken`` those of all containers and gateways. ``subnets`` are those of its networks.
    ``master_address`` is empty if there is nothing to be told.
    """

    master_address: str = ""
    addresses: Mapping[tuple[str, str], str] = field(default_factory=dict)
    taken: frozenset[str] = frozenset()
    subnets: tuple[IPv4Network, ...] = ()
    arrivals: frozenset[Arrival] = frozenset()


def facts(look: Look, proxy: Proxy, wishes: Iterable[Wish], master_address: str) -> Facts:
    """What a look says to a proxy. ``wishes`` are those of all containers."""
    observed = look.observed
    box = sandbox_of(proxy, observed)
    joined = {a.network for a in box.container.attachments if a.address} if box else set()
    by_id = {container.id: container for container in observed.containers}
    mine = [by_id[w.id] for w in wishes if w.key == proxy.key and w.id in by_id]
    gateways = {network.gateway for network in observed.networks}
    return Facts(
        master_address="" if is_address(master(proxy.key).host) else master_address,
        addresses={
            (container.id, a.network): a.address
            for container in observed.containers
            for a in container.attachments
            if a.network in joined and a.address and container.state in STARTED
        },
        taken=look.addresses | gateways,
        subnets=tuple(subnet for name in joined for subnet in look.subnets.get(name, ())),
        arrivals=frozenset(
            arrival for container in mine for arrival in _arrivals(look, container, by_id, joined)
        ),
    )


def gone(
    status: Mapping[str, Any], taken: Collection[str], subnets: Collection[IPv4Network]
) -> list[str]:
    """The addresses of a proxy's nodes that no container has any more.

    ``taken`` are those of all containers and gateways, ``subnets`` those of the networks that the
    proxy is on or was on: other addresses are none of the engine's.
    """
    found = set()
    for node in status.get("nodes", ()):
        where = parse_host_port(str(node.get("address", "")))
        if where and where.host not in taken and _inside(where.host, subnets):
            found.add(where.host)
    return sorted(found)


def moved(before: Mapping[tuple[str, str], str], known: Facts) -> dict[str, str]:
    """Old address to new one of the containers whose address on a network has changed.

    An old address that another container has now is left out: what is there is the other's.
    """
    now = known.addresses
    return {
        before[place]: now[place]
        for place in now
        if place in before and before[place] != now[place] and before[place] not in now.values()
    }


def _arrivals(
    look: Look, container: Container, by_id: Mapping[str, Container], joined: set[str]
) -> list[Arrival]:
    """A container's places; of one that shares another's network, the other's."""
    host = by_id.get(container.network_mode.removeprefix(_SHARED), container)
    if container.state not in STARTED or host.state not in STARTED:
        return []
    own = {container.name, container.hostname, container.id[:12], host.hostname}
    return [
        Arrival(
            container.id,
            a.network,
            a.address,
            look.endpoints.get((host.id, a.network), ""),
            frozenset(name for name in a.names | own if _HOST_NAME.fullmatch(name)),
        )
        for a in host.attachments
        if a.network in joined and a.address
    ]


def _inside(host: str, subnets: Iterable[IPv4Network]) -> bool:
    try:
        address = ip_address(host)
    except ValueError:
        return False
    return any(address in subnet for subnet in subnets)
