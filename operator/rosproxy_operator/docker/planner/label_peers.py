"""The peers in containers' labels: a proxy for ROS 2 takes a bounded number of all of them.

A proxy gets its peers in one variable, and Linux starts no program with a variable of 128 KiB
(MAX_ARG_STRLEN). Where the labels of a proxy's containers name too many, the labels with the most
peers are ignored: a container with many takes nothing from a container with few.
"""

from collections import defaultdict
from collections.abc import Collection
from dataclasses import replace

from rosproxy.settings import MOST_ZENOH_PEERS
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.readers import PEERS
from rosproxy_operator.docker.planner.model import ZENOH, Key, Member
from rosproxy_operator.docker.settings import PlanSettings

MOST_OF_PROXY = 256
"""Peers of one proxy that labels name: 66 KiB, as a host has 253 characters at most and a port."""


def with_bounded_peers(
    members: Collection[Member], settings: PlanSettings
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """The members, some without the peers of their labels, and the problems of these."""
    named: dict[Key, frozenset[str]] = defaultdict(frozenset)
    ignored: list[Member] = []
    # Containers that run come first: one that has exited only keeps its peers for a while.
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
            Problem(f"container {member.container.name}", _ignored(member.key), fatal=False)
            for member in ignored
            if member.container.alive
        ),
    )


def _most(key: Key) -> int:
    return MOST_ZENOH_PEERS if key == ZENOH else MOST_OF_PROXY


def _ignored(key: Key) -> str:
    """Why the peers of a container are ignored, and what to do."""
    common = "" if key == ZENOH else ", or start the operator with --ros2-peer for common peers"
    return (
        f"label {PEERS} is ignored: a proxy takes at most {_most(key)} peers from all labels of "
        f"its containers, and ignores the labels with the most peers. Name fewer peers{common}"
    )
