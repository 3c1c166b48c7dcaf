"""When a node is probed, when it counts as gone or moved, and when its port is free again.

An operator knows that a container is gone or has moved before any time-out can tell, but its
events may be late, or about an address that another container has by now. So each is a hint, and
the node itself is asked before anything is done.
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import Enum

from rosproxy.net.addresses import Network, is_address, is_inside, is_loopback
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.node_health import UNKNOWN_PID, ProbeResult

DIRECT_INTERVAL = 2.0
"""Seconds between probes, at most, of a node that registered around the proxy."""
FORGET_AFTER = 3600.0
"""Seconds after which a node that was cleaned up while it was silent is forgotten."""
NO_PATIENCE = 0.001
"""Seconds: less than between any two probes. Zero would mean that nothing is ever cleaned up."""


class AfterAnswer(Enum):
    """What is due first once a node has answered."""

    VERIFY = "only the master has named the node: verify that this is the node"
    COME_BACK = "the node was unregistered meanwhile: register the node again"
    UNREGISTER_LEFT_OVER = "another process answers: unregister what the former process left"
    RECONCILE = "the node registered directly at the master: compare the registrations"
    NOTHING = "nothing has changed"


def after_answer(endpoint: Endpoint, pid: int | None) -> AfterAnswer:
    """What is due for an endpoint whose node has answered with a pid."""
    health = endpoint.health
    if not endpoint.trusted:
        return AfterAnswer.VERIFY
    if health.cleaned:
        return AfterAnswer.COME_BACK
    if health.pid not in (None, pid):
        return AfterAnswer.UNREGISTER_LEFT_OVER
    return AfterAnswer.RECONCILE if endpoint.has_registered_directly else AfterAnswer.NOTHING


def to_look_at(endpoints: Iterable[Endpoint], now: float, interval: float) -> list[Endpoint]:
    """Those that may be due, or whose lease may end.

    All are gone through several times a second: so it is a single expression, of attributes alone.
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


def may_be_kept(endpoint: Endpoint) -> bool:
    """Whether a node may be asked over a connection that is kept: nothing follows if it answers."""
    health = endpoint.health
    return (
        health.steady
        and endpoint.trusted
        and not (health.hangs_up or endpoint.has_registered_directly)
    )


def is_due(endpoint: Endpoint, now: float, interval: float) -> bool:
    """Whether it is time to probe a node; ``interval`` is that of idle nodes in seconds."""
    return endpoint.health.due(
        now, min(interval, DIRECT_INTERVAL) if endpoint.has_registered_directly else interval
    )


def is_to_be_unregistered(endpoint: Endpoint, now: float, after: float) -> bool:
    """Whether a node has been down for long enough (``after`` seconds; 0: never).

    One that registered around the proxy has unregistered there as well, to no effect; so it
    keeps nothing once it has ended.
    """
    if endpoint.has_registered_directly and endpoint.health.refused:
        after = min(after, NO_PATIENCE)
    return endpoint.health.clean_up(now, after)


def lease_lasts(endpoint: Endpoint, linger: float) -> float:
    """Seconds for which an unused lease lasts; a node that was just silent may come back."""
    health = endpoint.health
    return FORGET_AFTER if health.cleaned and not (health.refused or health.has_ended) else linger


def dead_endpoints(answers: Mapping[Endpoint, ProbeResult], since: float) -> list[Endpoint]:
    """Those of the endpoints at addresses that are gone whose node does not answer.

    Where one answers, the address is in use again, or the event was late. One that is silent but
    has registered ``since`` then is spared: a container that is restarted has its address
    again, and a node that is just starting may take its time.
    """

    def is_spared(endpoint: Endpoint) -> bool:
        registrations = endpoint.registrations.values()
        return endpoint.pending > 0 or any(r.since >= since for r in registrations)

    return [
        endpoint
        for endpoint, probe in answers.items()
        if probe is ProbeResult.REFUSED or (probe is ProbeResult.SILENT and not is_spared(endpoint))
    ]


def movable(
    endpoints: Iterable[Endpoint], moved: Mapping[str, str], networks: Sequence[Network]
) -> dict[Endpoint, str]:
    """The endpoints at addresses that have changed, with their new one, if that is inside."""
    moves = {e: moved.get(e.location.address, "") for e in endpoints}
    return {
        e: new for e, new in moves.items() if new != e.location.address and is_inside(new, networks)
    }


def moved_location(endpoint: Endpoint, address: str) -> NodeLocation:
    """Where a node is that has moved to another address.

    Neighbours are sent through the proxy from now on, even if the node's host name leads there:
    to a URI that they know already, rospy doesn't connect again.
    """
    host = endpoint.node.host
    previous = endpoint.location
    stale = is_address(host) and not is_loopback(host) and host != address
    return NodeLocation(address, named=False, confirmed=previous.confirmed, stale=stale)


def is_same_process(known_pid: int | None, pid: int | None, borne_out: bool | None) -> bool:
    """Whether the node that answers elsewhere with a pid is one with a known pid.

    In a container of its own every node has the same pid, so the node has to bear out as well what
    it has registered; if that can't be told (None), the pid alone decides.
    """
    if pid is not None and known_pid not in UNKNOWN_PID and known_pid != pid:
        return False
    return known_pid == pid and pid is not None if borne_out is None else borne_out
