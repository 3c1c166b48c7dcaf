"""Fast ports: a second port for an endpoint's topics, from the part of the range that is spare.

An endpoint's fast port follows from its lease by arithmetic, so that a proxy which has lost all
memory gives every recovered endpoint the port that its subscribers are connected to. A fast port
is only an acceleration: it is given back before a node is refused a lease.
"""

from rosproxy.leases.ports import PortRange
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.registry import Registry


def partner(ports: PortRange, port: int) -> int | None:
    """The port of a range that goes with another one; an odd last port has none.

    Of n ports the first n // 2 go with the next n // 2, so that leases, which are handed out from
    the first port on, meet fast ports as late as possible.
    """
    half = len(ports) // 2
    index = port - ports.first
    if not 0 <= index < 2 * half:
        return None
    return port + half if index < half else port - half


def claim(registry: Registry, endpoint: Endpoint) -> bool:
    """Give an endpoint its fast port; False if that is not free. One that has it keeps it."""
    if endpoint.fast_port is not None:
        return True
    port = partner(registry.pool.range, endpoint.port)
    if port is None or not registry.pool.claim(port):
        return False
    endpoint.fast_port = port
    return True


def give_back(registry: Registry, endpoint: Endpoint, blocked: bool = False) -> None:
    """Take an endpoint's fast port away; ``blocked``: another program holds that port."""
    if endpoint.fast_port is None:
        return
    if blocked:
        registry.pool.block(endpoint.fast_port)
    registry.pool.give_back(endpoint.fast_port)
    endpoint.fast_port = None


def to_give_back(registry: Registry) -> Endpoint | None:
    """Whose fast port goes first when the range is short: where the fewest connections are.

    Those go on all the same: the kernel keeps forwarding what it has begun to forward.
    """
    holders = [endpoint for endpoint in registry if endpoint.fast_port is not None]
    return min(holders, key=lambda e: e.fast_connections, default=None)


def why_none(registry: Registry, endpoint: Endpoint) -> str:
    """Why an endpoint that could have a fast port has none."""
    port = partner(registry.pool.range, endpoint.port)
    if port is None:
        return f"no port of the range goes with port {endpoint.port}"
    if registry.pool.is_free(port):
        return "nobody outside has asked for a topic of it lately"
    return f"port {port}, which goes with its port {endpoint.port}, is in use"


def held(registry: Registry) -> int:
    """How many ports are fast ports now."""
    return sum(endpoint.fast_port is not None for endpoint in registry)


def left(registry: Registry) -> int:
    """How many ports are left for nodes: those that are free, and fast ports."""
    return registry.pool.free + held(registry)
