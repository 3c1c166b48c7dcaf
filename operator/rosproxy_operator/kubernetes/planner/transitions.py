"""What is remembered after a look at the cluster."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.allocation import within
from rosproxy_operator.common.moves import MOVED_FOR, TAKEN_FOR, Move
from rosproxy_operator.kubernetes.planner.model import Finding
from rosproxy_operator.kubernetes.planner.state import Memory, Place
from rosproxy_operator.kubernetes.planner.view import View, finding, place_of, serves

TRIED_FOR = 60.0
"""Seconds for which it is told that a proxy got other ports than were tried first."""


def looked(view: View, memory: Memory, now: float) -> Memory:
    """What is remembered of what is seen, before anything is decided."""
    absent = (place for place in sorted(view.proxies) if place not in view.wanted)
    nodes = {one.on for one in view.observed.proxies}
    lost = (node for node in sorted(nodes) if node not in view.observed.nodes)
    moved = {place: move for place, move in memory.moved.items() if now - move.at < MOVED_FOR}
    tried = {place: move for place, move in memory.tried.items() if now - move.at < TRIED_FOR}
    return replace(
        memory,
        begun=True,
        absent={place: memory.absent.get(place, now) for place in absent},
        lost={node: memory.lost.get(node, now) for node in lost},
        served=_served(view, memory),
        given={place: ports for place, ports in memory.given.items() if _may_be(view, place)},
        taken={port: at for port, at in memory.taken.items() if now - at < TAKEN_FOR},
        moved={place: move for place, move in moved.items() if place in view.wanted},
        tried={place: move for place, move in tried.items() if place in view.wanted},
    )


def _served(view: View, memory: Memory) -> dict[Place, PortRange]:
    """Where each proxy has served; what the status says is believed only once, at the start."""
    served = dict(memory.served)
    if not memory.begun:
        for of, rosproxy in view.rosproxies.items():
            served |= {Place(of, node): ports for node, ports in rosproxy.former.items()}
    served |= {place_of(one): one.range for one in view.observed.proxies if serves(one)}
    return {place: ports for place, ports in served.items() if _may_be(view, place)}


def _may_be(view: View, place: Place) -> bool:
    return place.of in view.rosproxies and place.node in view.observed.nodes


def given(memory: Memory, ranges: Mapping[Place, PortRange], now: float) -> Memory:
    """The memory with the ranges that are given, and with who had to leave which."""
    served = {place: ports for place, ports in memory.served.items() if place in ranges}
    tried = {p: ports for p, ports in memory.given.items() if p in ranges and p not in served}
    left = _left(served, ranges, now)
    return replace(
        memory,
        given={**memory.given, **ranges},
        served={place: ports for place, ports in memory.served.items() if place not in left},
        moved={**memory.moved, **left},
        tried={**memory.tried, **_left(tried, ranges, now)},
    )


def _left(
    before: Mapping[Place, PortRange], ranges: Mapping[Place, PortRange], now: float
) -> dict[Place, Move]:
    return {
        place: Move(ports, now)
        for place, ports in before.items()
        if not _is_kept(ports, ranges[place])
    }


def _is_kept(before: PortRange, ports: PortRange) -> bool:
    """Whether ports were at most added or taken off."""
    return within(before, ports) or within(ports, before)


def moves(view: View, memory: Memory, ranges: Mapping[Place, PortRange]) -> Iterator[Finding]:
    """Tell who has had to leave which ports."""
    told = ((memory.moved, _MOVED), (memory.tried, _TRIED))
    for moved, why in told:
        for place, move in sorted(moved.items()):
            ports = ranges.get(place)
            if ports is not None and not _is_kept(move.ports, ports):
                text = f"the proxy on node {place.node} has left ports {move.ports} for {ports}"
                yield finding(view.rosproxies[place.of], "PortConflict", f"{text}, {why}")


_MOVED = (
    "since something else has taken them or the RosProxy forbids them now: nodes that had "
    "registered under the old ones can't be reached until they register anew: restart their pods"
)
_TRIED = "since they could not be had: nothing needs to be done"
