"""Which endpoints it concerns that containers are gone or have other addresses.

An operator knows it before any time-out can tell, but its events may be late, or about an address
that another container has by now. So each is a hint, and the node itself is asked before anything
is done.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence

from rosproxy.net.addresses import Network, is_address, is_inside, is_loopback
from rosproxy.ros1.registry.endpoint import Endpoint, Place
from rosproxy.ros1.registry.health import UNKNOWN_PID, ProbeResult
from rosproxy.ros1.upkeep.recovery.policy import confirmed_by


def at(endpoints: Iterable[Endpoint], addresses: Collection[str]) -> list[Endpoint]:
    """The endpoints at some addresses."""
    return [endpoint for endpoint in endpoints if endpoint.place.address in addresses]


def dead(answers: Mapping[Endpoint, ProbeResult], since: float) -> list[Endpoint]:
    """Those of the endpoints at addresses that are gone whose node does not answer.

    Where one answers, the address is in use again, or the event was late. One that is silent but
    has registered ``since`` then is spared: a container that is restarted has its address
    again, and a node that is just starting may take its time.
    """
    return [
        endpoint
        for endpoint, probe in answers.items()
        if probe is ProbeResult.REFUSED
        or (probe is ProbeResult.SILENT and not _registered_since(endpoint, since))
    ]


def _registered_since(endpoint: Endpoint, since: float) -> bool:
    held = endpoint.registrations.values()
    return endpoint.pending > 0 or any(one.since >= since for one in held)


def movable(
    endpoints: Iterable[Endpoint], moved: Mapping[str, str], networks: Sequence[Network]
) -> dict[Endpoint, str]:
    """The endpoints at addresses that have changed, with their new one, if that is inside."""
    candidates = {e: moved[e.place.address] for e in endpoints if e.place.address in moved}
    return {
        endpoint: new
        for endpoint, new in candidates.items()
        if new != endpoint.place.address and is_inside(new, networks)
    }


def new_place(endpoint: Endpoint, address: str) -> Place:
    """Where a node is that has moved to another address.

    Neighbours are sent through the proxy from now on, even if the node's host name leads there:
    to a URI that they know already, rospy doesn't connect again.
    """
    host, before = endpoint.node.host, endpoint.place
    stale = is_address(host) and not is_loopback(host) and host != address
    return Place(address, named=False, confirmed=before.confirmed, stale=stale)


def is_same_process(endpoint: Endpoint, pid: int | None, topics: set[str]) -> bool:
    """Whether the node that answers elsewhere, with a pid and topics, is that of an endpoint.

    In a container of its own every node has the same pid, so the topics must fit as well.
    """
    known = endpoint.health.pid
    if pid is None or (known not in UNKNOWN_PID and known != pid):
        return False
    return confirmed_by(endpoint, topics) if endpoint.topics else known == pid
