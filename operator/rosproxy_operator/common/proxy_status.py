"""What the operator reads from a proxy's ``/status``, for any engine.

The document itself is `rosproxy.admin.status_document`; it holds what ROS nodes say of themselves,
so no size in it is to be trusted.
"""

from collections.abc import Mapping

from rosproxy.admin.status_document import EndpointStatus, ParticipantStatus, ProxyStatus
from rosproxy.net.addresses import parse_host_port, plain_address

Leases = Mapping[str, tuple[int, ...]]
"""The ports of participants, in the order of their locators, by GUID prefix."""


def nodes_by_address(status: ProxyStatus) -> Mapping[str, tuple[EndpointStatus, ...]]:
    """A proxy's nodes by the address where they are; without those that it has given up."""
    nodes: dict[str, tuple[EndpointStatus, ...]] = {}
    for node in status.nodes:
        host_port = parse_host_port(node.address)
        if host_port is not None and not node.given_up:
            address = plain_address(host_port.host)
            nodes[address] = (*nodes.get(address, ()), node)
    return nodes


def participants_by_address(status: ProxyStatus) -> Mapping[str, tuple[ParticipantStatus, ...]]:
    """A proxy's participants of ROS 2 that are inside, by the address where they are."""
    participants: dict[str, tuple[ParticipantStatus, ...]] = {}
    for domain in status.domains:
        for participant in domain.inside:
            address = plain_address(participant.address)
            participants[address] = (*participants.get(address, ()), participant)
    return participants


def leases(status: ProxyStatus) -> Leases:
    """The ports of a proxy's participants inside."""
    participants = (p for group in participants_by_address(status).values() for p in group)
    return {p.guid_prefix: tuple(lease.port for lease in p.leases) for p in participants}


def inside_addresses(status: ProxyStatus) -> frozenset[str]:
    """The addresses where a proxy has nodes or participants.

    Nodes that the proxy has unregistered count, too: they may be silent, and come back. The proxy
    shows them as faults until it is told that their container is gone.
    """
    host_ports = (parse_host_port(node.address) for node in status.nodes if not node.has_ended)
    nodes = (plain_address(host_port.host) for host_port in host_ports if host_port is not None)
    return frozenset((*nodes, *participants_by_address(status)))
