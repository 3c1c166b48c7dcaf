"""Bound the number of peers that a proxy for ROS 2 or rmw_zenoh gets from labels.

A proxy gets all peers in one variable, and Linux starts no program with a variable of 128 KiB
(MAX_ARG_STRLEN). If the labels of a proxy's containers name too many peers, the operator ignores
the labels with the most peers. So a container with many peers takes nothing from other containers.
"""

from collections import defaultdict
from collections.abc import Collection
from dataclasses import replace

from rosproxy.settings import MOST_ZENOH_PEERS
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.readers import PEERS
from rosproxy_operator.docker.planner.model import ZENOH, Key, Member
from rosproxy_operator.docker.settings import PlanSettings

MOST_PEERS_OF_PROXY = 256
"""Most peers of a DDS proxy from labels, in 66 KiB: a host has 253 characters at most."""


def with_bounded_peers(
    members: Collection[Member], settings: PlanSettings
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """Return the members and the problems. Members with too many peers come back without peers.

    Peers of the operator's option --ros2-peer do not count.
    """
    named: dict[Key, frozenset[str]] = defaultdict(frozenset)
    ignored: list[Member] = []
    # Living containers first: the peers of an exited container count for the grace only (`desire`).
    order = sorted(members, key=lambda m: (not m.container.alive, len(m.peers), m.container.name))
    for member in order:
        peers = named[member.key] | member.peers
        peers -= frozenset(settings.ros2_peer if member.key.is_ros2 else ())
        if len(peers) > _most(member.key):
            ignored.append(member)
        else:
            named[member.key] = peers
    return (
        tuple(replace(m, peers=frozenset()) if m in ignored else m for m in members),
        tuple(
            Problem(f"container {member.container.name}", _ignored_text(member.key), fatal=False)
            for member in ignored
            if member.container.alive
        ),
    )


def _most(key: Key) -> int:
    return MOST_ZENOH_PEERS if key == ZENOH else MOST_PEERS_OF_PROXY


def _ignored_text(key: Key) -> str:
    """Return why the peers of a container are ignored, and the fix."""
    common = "" if key == ZENOH else ", or start the operator with --ros2-peer for common peers"
    return (
        f"label {PEERS} is ignored: a proxy takes at most {_most(key)} peers from all labels of "
        f"its containers, and ignores the labels with the most peers. Name fewer peers{common}"
    )
