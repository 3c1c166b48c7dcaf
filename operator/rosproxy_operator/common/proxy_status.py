"""What the operator reads from a proxy's ``/status``, for any engine.

The document itself is `rosproxy.admin.status_document`. It holds what ROS nodes say of themselves,
and the proxy may be in hostile hands. So no size in it is to be trusted, and nothing that another
proxy refuses gets to that proxy.
"""

from collections import defaultdict
from collections.abc import Mapping
from itertools import islice

from rosproxy.admin.requests import is_guid_prefix
from rosproxy.admin.status_document import EndpointStatus, ParticipantStatus, ProxyStatus
from rosproxy.net.addresses import parse_host_port, plain_address

Leases = Mapping[str, tuple[int, ...]]
"""The ports of participants, in the order of their locators, by GUID prefix."""
MOST_LEASED = 512
"""Participants whose ports are kept: a proxy has as many inside (docs/reference/limits.md)."""
MOST_PORTS = 16
"""Ports that are kept of one participant: it has no more."""
_LAST_PORT = 65535


def nodes_by_address(status: ProxyStatus) -> Mapping[str, tuple[EndpointStatus, ...]]:
    """A proxy's nodes by the address where they are; without those that it has given up."""
    nodes: defaultdict[str, list[EndpointStatus]] = defaultdict(list)
    for node in status.nodes:
        host_port = parse_host_port(node.address)
        if host_port is not None and not node.given_up:
            nodes[plain_address(host_port.host)].append(node)
    return {address: tuple(group) for address, group in nodes.items()}


def participants_by_address(status: ProxyStatus) -> Mapping[str, tuple[ParticipantStatus, ...]]:
    """A proxy's participants of ROS 2 that are inside, by the address where they are."""
    participants: defaultdict[str, list[ParticipantStatus]] = defaultdict(list)
    for domain in status.domains:
        for participant in domain.inside:
            participants[plain_address(participant.address)].append(participant)
    return {address: tuple(group) for address, group in participants.items()}


def leases(status: ProxyStatus) -> Leases:
    """The ports of a proxy's participants inside, as the next proxy takes them."""
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
        for participant in islice(readable, MOST_LEASED)
    }


def inside_addresses(status: ProxyStatus) -> frozenset[str]:
    """The addresses where a proxy has nodes or participants.

    Nodes that the proxy has unregistered count, too: they may be silent, and come back. The proxy
    shows them as faults until it is told that their container is gone.
    """
    host_ports = (parse_host_port(node.address) for node in status.nodes if not node.has_ended)
    nodes = (plain_address(host_port.host) for host_port in host_ports if host_port is not None)
    return frozenset((*nodes, *participants_by_address(status)))
