"""What the operator makes of a proxy's ``/status``, for any engine.

The document itself is `rosproxy.admin.status_document`; it holds what ROS nodes say of themselves,
so no size in it is to be trusted.
"""

from collections.abc import Mapping

from rosproxy.admin.status_document import EndpointStatus, ProxyStatus
from rosproxy.net.addresses import parse_host_port, plain_address


def nodes_by_address(status: ProxyStatus) -> Mapping[str, tuple[EndpointStatus, ...]]:
    """A proxy's nodes by the address where they are; not those that it has given up already."""
    found: dict[str, tuple[EndpointStatus, ...]] = {}
    for node in status.nodes:
        where = parse_host_port(node.address)
        if where is not None and not node.given_up:
            address = plain_address(where.host)
            found[address] = (*found.get(address, ()), node)
    return found
