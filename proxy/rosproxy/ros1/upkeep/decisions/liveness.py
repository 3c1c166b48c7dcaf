"""When to probe a node, when it counts as gone or moved, and when its port is free again.

An operator knows before any time-out that a container is gone or has moved. But its report may be
late, or concern an address that another container has by now. So the report is a hint, and the
proxy asks the node before the proxy acts.
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import Enum

from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.node_health import UNKNOWN_PIDS, ProbeResult
from rosproxy.shared.addresses import Network, is_address, is_inside, is_loopback

LONGEST_DIRECT_INTERVAL_S = 2.0
"""The longest time between probes, in seconds, of a node that registered directly."""
FORGET_AFTER_S = 3600.0
"""Seconds after which the proxy forgets a node that was unregistered while silent."""
NO_PATIENCE_S = 0.001
"""Seconds, less than between any two probes. Zero would mean that no node is unregistered."""


class AfterAnswer(Enum):
    """What the proxy has to do first after a node has answered."""

    VERIFY = "only the master has named the node: verify that this is the node"
    COME_BACK = "the node was unregistered meanwhile: register the node again"
    UNREGISTER_LEFT_OVER = "another process answers: unregister what the former process left"
    RECONCILE = "the node registered directly at the master: compare the registrations"
    NOTHING = "nothing has changed"


def after_answer(endpoint: Endpoint, pid: int | None) -> AfterAnswer:
    """What to do for an endpoint whose node has answered with a pid."""
    health = endpoint.health
    if not endpoint.trusted:
        return AfterAnswer.VERIFY
    if health.cleaned:
        return AfterAnswer.COME_BACK
    if health.pid not in (None, pid):
        return AfterAnswer.UNREGISTER_LEFT_OVER
    return AfterAnswer.RECONCILE if endpoint.has_registered_directly else AfterAnswer.NOTHING


def endpoints_to_check(
    endpoints: Iterable[Endpoint], now: float, interval: float
) -> list[Endpoint]:
    """The endpoints that may be due for a probe, or whose lease may end.

    The proxy goes through all endpoints several times a second. So the test is a single expression
    of attributes, for speed.
    """
    return [
        e
        for e in endpoints
        if (health := e.health).checked_at is None
        or now - health.checked_at >= interval
        or health.failures
        or health.cleaned
        or e.idle_since is not None
        or e.former_uris
        or not e.registrations
    ]


def may_use_kept_connection(endpoint: Endpoint) -> bool:
    """Whether to probe the node over a kept connection: an answer then has no consequences."""
    health = endpoint.health
    return (
        health.steady
        and endpoint.trusted
        and not (health.hangs_up or endpoint.has_registered_directly)
    )


def is_due(endpoint: Endpoint, now: float, interval: float) -> bool:
    """Whether to probe a node now; ``interval`` is that of idle nodes in seconds."""
    return endpoint.health.probe_due(
        now,
        min(interval, LONGEST_DIRECT_INTERVAL_S) if endpoint.has_registered_directly else interval,
    )


def is_to_be_unregistered(endpoint: Endpoint, now: float, after: float) -> bool:
    """Whether a node has been down for long enough: ``after`` seconds, or never if that is 0.

    A node that registered at the real master directly may have unregistered there as well, without
    effect. So the proxy unregisters such a node as soon as the node has ended.
    """
    if endpoint.has_registered_directly and endpoint.health.refused:
        after = min(after, NO_PATIENCE_S)
    return endpoint.health.cleanup_due(now, after)


def unused_lease_lifetime(endpoint: Endpoint, linger: float) -> float:
    """Seconds for which an unused lease lasts.

    These are ``linger`` seconds, but an hour for a node that was unregistered while silent, because
    this node may come back.
    """
    health = endpoint.health
    return FORGET_AFTER_S if health.cleaned and not (health.refused or health.has_ended) else linger


def dead_endpoints(answers: Mapping[Endpoint, ProbeResult], since: float) -> list[Endpoint]:
    """The endpoints at addresses that have gone, if the node does not answer.

    If a node answers, the address is in use again, or the report was late. A silent node stays if
    the node has registered at or after ``since``, or is registering. The reason: a restarted
    container has the old address, and a starting node may need some time to answer.
    """

    def is_spared(endpoint: Endpoint) -> bool:
        registrations = endpoint.registrations.values()
        return endpoint.pending > 0 or any(r.since >= since for r in registrations)

    return [
        endpoint
        for endpoint, probe in answers.items()
        if probe is ProbeResult.REFUSED or (probe is ProbeResult.SILENT and not is_spared(endpoint))
    ]


def new_addresses(
    endpoints: Iterable[Endpoint], moved: Mapping[str, str], networks: Sequence[Network]
) -> dict[Endpoint, str]:
    """The new addresses of endpoints that have moved to an address inside.

    ``moved`` maps old addresses to new addresses. Endpoints without a new address are left out.
    """
    moves = {e: moved.get(e.location.address, "") for e in endpoints}
    return {
        e: new for e, new in moves.items() if new != e.location.address and is_inside(new, networks)
    }


def moved_location(endpoint: Endpoint, address: str) -> NodeLocation:
    """The location of a node that has moved to another address.

    From now on neighbours reach the node through the proxy, even if its host name leads to the new
    address: rospy does not connect again to a URI that it knows.
    """
    host = endpoint.node.host
    previous = endpoint.location
    stale = is_address(host) and not is_loopback(host) and host != address
    return NodeLocation(address, named=False, confirmed=previous.confirmed, stale=stale)


def is_same_process(known_pid: int | None, pid: int | None, is_confirmed: bool | None) -> bool:
    """Whether the node that answers elsewhere with a pid is the node with a known pid.

    Each node that is alone in a container has the same pid. So the node also has to confirm its
    registrations. ``is_confirmed`` says whether it does. If that is unknown (None), the pid
    decides.
    """
    if pid is not None and known_pid not in UNKNOWN_PIDS and known_pid != pid:
        return False
    return known_pid == pid and pid is not None if is_confirmed is None else is_confirmed
