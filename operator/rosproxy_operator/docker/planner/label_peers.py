"""The peers in containers' labels: a proxy for ROS 2 takes a bounded number of all of them.

A proxy gets its peers in one variable, and Linux starts no program with a variable of 128 KiB
(MAX_ARG_STRLEN). Where the labels of a proxy's containers name too many, the labels with the most
peers are ignored: a container with many takes nothing from a container with few.
"""

from collections import defaultdict
from collections.abc import Collection
from dataclasses import replace

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels.readers import PEERS
from rosproxy_operator.docker.planner.model import Key, Member
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
        peers = (named[member.key] | member.peers) - {*settings.ros2_peer}
        if len(peers) > MOST_OF_PROXY:
            ignored.append(member)
        else:
            named[member.key] = peers
    text = (
        f"label {PEERS} is ignored: a proxy takes at most {MOST_OF_PROXY} peers from all labels of "
        "its containers, and ignores the labels with the most peers. Name fewer peers, or start "
        "the operator with --ros2-peer for common peers"
    )
    return (
        tuple(replace(m, peers=frozenset()) if m in ignored else m for m in members),
        tuple(
            Problem(f"container {member.container.name}", text, fatal=False)
            for member in ignored
            if member.container.alive
        ),
    )
