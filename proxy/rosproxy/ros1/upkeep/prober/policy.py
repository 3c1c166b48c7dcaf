"""When a node is probed, when it counts as gone for good, and when its port is free again."""

from rosproxy.ros1.registry.endpoint import Endpoint

DIRECT_INTERVAL = 2.0
"""Seconds between probes, at most, of a node that registered around the proxy."""
FORGET_AFTER = 3600.0
"""Seconds after which a node that was cleaned up while it was silent is forgotten."""
NO_PATIENCE = 0.001
"""Seconds: less than between any two probes. Zero would mean that nothing is ever cleaned up."""


def is_due(endpoint: Endpoint, now: float, interval: float) -> bool:
    """Whether it is time to probe a node; ``interval`` is that of idle nodes in seconds."""
    if endpoint.direct:
        interval = min(interval, DIRECT_INTERVAL)
    return endpoint.health.due(now, interval)


def is_to_be_unregistered(endpoint: Endpoint, now: float, after: float) -> bool:
    """Whether a node has been down for long enough (``after`` seconds; 0: never).

    One that registered around the proxy has unregistered there as well, to no effect; so it
    keeps nothing once it has ended.
    """
    if endpoint.direct and endpoint.health.refused:
        after = min(after, NO_PATIENCE)
    return endpoint.health.clean_up(now, after)


def is_unused(endpoint: Endpoint) -> bool:
    """Whether nobody needs an endpoint's port, so that the lease may end."""
    if endpoint.connected or endpoint.pending:
        return False
    return endpoint.idle or endpoint.health.cleaned


def lease_lasts(endpoint: Endpoint, linger: float) -> float:
    """Seconds for which an unused lease lasts; a node that was just silent may come back."""
    health = endpoint.health
    return FORGET_AFTER if health.cleaned and not (health.refused or health.over) else linger
