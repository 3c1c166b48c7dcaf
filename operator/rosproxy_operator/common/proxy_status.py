"""Reads facts for the operator from the ``/status`` of a proxy, for all engines.

The document is `rosproxy.shared.documents.status_document`. ROS nodes choose many texts in the
document, and an attacker may control the proxy. So the operator bounds all sizes, and drops values
that the next proxy would refuse.
"""

from collections import defaultdict
from collections.abc import Mapping
from itertools import islice

from rosproxy.shared.addresses import parse_host_port, plain_address
from rosproxy.shared.documents.requests import is_guid_prefix
from rosproxy.shared.documents.status_document import (
    EndpointStatus,
    ParticipantStatus,
    ProxyStatus,
    ZenohNodeStatus,
)

Leases = Mapping[str, tuple[int, ...]]
"""The ports of participants by GUID prefix, in the order of the participant's locators."""
MOST_PARTICIPANTS = 512
"""The most participants whose ports the operator keeps.

A proxy has no more participants inside (docs/reference/limits.md).
"""
MOST_PORTS = 16
"""The most ports of a participant that the operator keeps. A proxy maps no more ports."""
_LAST_PORT = 65535


def nodes_by_address(status: ProxyStatus) -> Mapping[str, tuple[EndpointStatus, ...]]:
    """Return the nodes of a proxy by IP address, except the nodes that the proxy has given up."""
    nodes: defaultdict[str, list[EndpointStatus]] = defaultdict(list)
    for node in status.nodes:
        host_port = parse_host_port(node.address)
        if host_port is not None and not node.given_up:
            nodes[plain_address(host_port.host)].append(node)
    return {address: tuple(group) for address, group in nodes.items()}


def participants_by_address(status: ProxyStatus) -> Mapping[str, tuple[ParticipantStatus, ...]]:
    """Return the participants inside of a proxy by IP address."""
    participants: defaultdict[str, list[ParticipantStatus]] = defaultdict(list)
    for domain in status.domains:
        for participant in domain.inside:
            participants[plain_address(participant.address)].append(participant)
    return {address: tuple(group) for address, group in participants.items()}


def nodes_inside(status: ProxyStatus) -> tuple[ZenohNodeStatus, ...]:
    """Return the nodes of rmw_zenoh at the ports of a proxy for containers or pods."""
    nodes = status.zenoh.nodes if status.zenoh else ()
    return tuple(node for node in nodes if node.port is not None)


def leases(status: ProxyStatus) -> Leases:
    """Return the ports of a proxy's participants inside, for the next proxy."""
    readable = (
        participant
        for domain in status.domains
        for participant in domain.inside
        if is_guid_prefix(participant.guid_prefix)
    )
    return {
        participant.guid_prefix: tuple(
            lease.port for lease in participant.leases[:MOST_PORTS] if lease.port <= _LAST_PORT
        )
        for participant in islice(readable, MOST_PARTICIPANTS)
    }


def inside_addresses(status: ProxyStatus) -> frozenset[str]:
    """Return the addresses where a proxy has nodes or participants inside.

    Nodes that the proxy has unregistered count, too, because a silent node may come back. The proxy
    shows such a node as a fault until the operator reports that the container has gone.
    """
    host_ports = (parse_host_port(node.address) for node in status.nodes if not node.has_ended)
    nodes = (plain_address(host_port.host) for host_port in host_ports if host_port is not None)
    return frozenset((*nodes, *participants_by_address(status)))
