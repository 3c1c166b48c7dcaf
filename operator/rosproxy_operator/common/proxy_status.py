"""What the operator makes of a proxy's ``/status``, for any engine.

The document itself is `rosproxy.admin.status_document`; it holds what ROS nodes say of themselves,
so no size in it is to be trusted.
"""

from collections.abc import Mapping

from rosproxy.admin.status_document import EndpointStatus, ParticipantStatus, ProxyStatus
from rosproxy.net.addresses import parse_host_port, plain_address

Leases = Mapping[str, tuple[int, ...]]
"""The ports of participants, in the order of their locators, by GUID prefix."""


def nodes_by_address(status: ProxyStatus) -> Mapping[str, tuple[EndpointStatus, ...]]:
    """A proxy's nodes by the address where they are; not those that it has given up already."""
    found: dict[str, tuple[EndpointStatus, ...]] = {}
    for node in status.nodes:
        where = parse_host_port(node.address)
        if where is not None and not node.given_up:
            address = plain_address(where.host)
            found[address] = (*found.get(address, ()), node)
    return found


def participants_by_address(status: ProxyStatus) -> Mapping[str, tuple[ParticipantStatus, ...]]:
    """A proxy's participants of ROS 2 that are inside, by the address where they are."""
    found: dict[str, tuple[ParticipantStatus, ...]] = {}
    for domain in status.domains:
        for one in domain.inside:
            address = plain_address(one.address)
            found[address] = (*found.get(address, ()), one)
    return found


def leases(status: ProxyStatus) -> Leases:
    """The ports of a proxy's participants inside."""
    every = (one for there in participants_by_address(status).values() for one in there)
    return {one.guid_prefix: tuple(lease.port for lease in one.leases) for one in every}


def inside_addresses(status: ProxyStatus) -> frozenset[str]:
    """The addresses where a proxy has nodes or participants."""
    return frozenset((*nodes_by_address(status), *participants_by_address(status)))
