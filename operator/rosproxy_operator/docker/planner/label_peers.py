"""Bound the number of peers, and of links to other sites, that a proxy gets from labels.

A proxy for ROS 2 or rmw_zenoh gets all peers in one variable, and Linux starts no program with a
variable of 128 KiB (MAX_ARG_STRLEN). If the labels of a proxy's containers name too many peers, the
operator ignores the labels with the most peers. So a container with many peers takes nothing from
other containers. The same holds for links.
"""

from collections import defaultdict
from collections.abc import Callable, Collection
from dataclasses import replace

from rosproxy.shared.settings import MOST_ZENOH_LINKS, MOST_ZENOH_PEERS
from rosproxy_operator.common.problem import (
    TOO_MANY,
    Fault,
    Problem,
)
from rosproxy_operator.docker.planner.labels.readers import LINK, PEERS
from rosproxy_operator.docker.planner.model import Member
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Place

MOST_PEERS_OF_PROXY = 256
"""Most peers of a DDS proxy from labels, in 66 KiB: a host has 253 characters at most."""


def with_bounded_peers(
    members: Collection[Member], settings: PlanSettings
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """Return the members and the problems. Members with too many peers come back without peers.

    Peers of the operator's option --ros2-peer do not count.
    """

    def peers(member: Member) -> frozenset[str]:
        common = settings.ros2_peer if isinstance(member.place.graph, Domain) else ()
        return member.peers - frozenset(common)

    ignored = _ignored(members, peers, _most)
    return (
        tuple(replace(m, peers=frozenset()) if m in ignored else m for m in members),
        _problems(ignored, _ignored_peers),
    )


def with_bounded_links(
    members: Collection[Member], settings: PlanSettings
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """Return the members and the problems. Members with too many links come back without links.

    The proxy has the links of the operator's option --zenoh-link in any case.
    """

    def links(member: Member) -> frozenset[str]:
        return member.links - frozenset(settings.zenoh_link)

    ignored = _ignored(members, links, lambda _: MOST_ZENOH_LINKS - len({*settings.zenoh_link}))
    return (
        tuple(replace(m, links=frozenset()) if m in ignored else m for m in members),
        _problems(ignored, _ignored_links),
    )


def _ignored(
    members: Collection[Member],
    names: Callable[[Member], frozenset[str]],
    most: Callable[[Place], int],
) -> list[Member]:
    """Return the members with too many names for their proxy."""
    named: dict[Place, frozenset[str]] = defaultdict(frozenset)
    ignored: list[Member] = []
    # Living containers first: the names of an exited container count for the grace only (`desire`).
    order = sorted(members, key=lambda m: (not m.container.alive, len(names(m)), m.container.name))
    for member in order:
        together = named[member.place] | names(member)
        if len(together) > most(member.place):
            ignored.append(member)
        else:
            named[member.place] = together
    return ignored


def _problems(ignored: Collection[Member], fault: Callable[[Place], Fault]) -> tuple[Problem, ...]:
    return tuple(
        Problem(f"container {m.container.name}", *fault(m.place), fatal=False, reason=TOO_MANY)
        for m in ignored
        if m.container.alive
    )


def _most(place: Place) -> int:
    return MOST_ZENOH_PEERS if place == ZENOH else MOST_PEERS_OF_PROXY


def _ignored_peers(place: Place) -> Fault:
    """Return why the peers of a container are ignored, and the fix."""
    common = "" if place == ZENOH else ", or start the operator with --ros2-peer for common peers"
    return Fault(
        f"label {PEERS} is ignored: a proxy takes at most {_most(place)} peers from all labels of "
        "its containers, and ignores the labels with the most peers",
        f"Name fewer peers{common}",
    )


def _ignored_links(_: Place) -> Fault:
    """Return why the links of a container are ignored, and the fix."""
    return Fault(
        f"label {LINK} is ignored: a proxy has at most {MOST_ZENOH_LINKS} links, and ignores the "
        "labels with the most links",
        "Name fewer links",
    )
