"""What the operator remembers from look to look. Losing it costs time, never correctness.

Each plan makes the next state out of the one before, in two steps: `learn` draws from what is seen
(which proxy is unwanted now, which node is gone, which has served where, which ports were refused),
before anything is decided; `decide` adds the ranges that were given. The other parts are those of
`departures` (addresses), `retries` (attempts) and `events` (reported), each made once as well.
"""

from collections.abc import Iterable, Iterator, Mapping

import msgspec
from msgspec.structs import replace

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.port_negotiation import (
    MOVED_FOR,
    RETRY_FOR,
    TAKEN_FOR,
    Move,
    after_move,
    is_moved,
    new_moves,
    overlap,
)
from rosproxy_operator.kubernetes.planner.cluster_view import View, has_ports, place_of, serves
from rosproxy_operator.kubernetes.planner.former_ports import FormerPorts, remember
from rosproxy_operator.kubernetes.planner.retries import RetryRecord, Task
from rosproxy_operator.kubernetes.resources.cluster import PodFailure
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Name,
    Pod,
    ProxyPlace,
    RosProxySpec,
)
from rosproxy_operator.kubernetes.status.findings import finding

TRIED_FOR = 60.0
"""Seconds for which it is told that a proxy got other ports than were tried first."""


class ClusterState(msgspec.Struct, frozen=True):
    """Times are in seconds of the operator's monotonic clock.

    ``begun`` is False until the first look. ``absent`` are proxies since when no pod wants them,
    ``lost`` nodes since when they are not listed any more. ``served`` is the range on which a
    proxy was last seen to serve, ``given`` the one that it is to have. ``refused`` is since when a
    proxy that has served does not get its ports back; ``taken`` are ports by node that were refused
    at last, and when; ``moved`` are the ranges that had to be left, ``tried`` those that could not
    be had in the first place. ``attempts`` are actions that have not shown an effect yet,
    ``reported`` problems that Events were made of. ``addresses`` are, by node, those that pods have
    or had, and when they were last seen to; ``strange``, by node and address, those that a proxy
    has named and that no pod was seen with, since when. ``former``: see `former_ports`.
    ``unselected`` are labelled pods that no RosProxy selects, since when.
    """

    begun: bool = False
    absent: Mapping[ProxyPlace, float] = {}
    lost: Mapping[str, float] = {}
    served: Mapping[ProxyPlace, PortRange] = {}
    given: Mapping[ProxyPlace, PortRange] = {}
    refused: Mapping[ProxyPlace, float] = {}
    taken: Mapping[tuple[str, int], float] = {}
    moved: Mapping[ProxyPlace, Move] = {}
    tried: Mapping[ProxyPlace, Move] = {}
    attempts: Mapping[Task, RetryRecord] = {}
    reported: Mapping[ClusterFinding, float] = {}
    addresses: Mapping[str, Mapping[str, float]] = {}
    strange: Mapping[tuple[str, str], float] = {}
    former: Mapping[ProxyPlace, FormerPorts] = {}
    unselected: Mapping[Name, float] = {}


def learn(view: View, state: ClusterState, now: float) -> ClusterState:
    """What follows from what is seen.

    A range that its proxy does not get is given up at once if it has never served, else after
    `RETRY_FOR` seconds, since its ports may only be slow to be let go: they count as taken then.
    """
    absent = view.proxies.keys() - view.wanted.keys()
    lost = {p.node for p in view.observed.proxies} - view.observed.nodes.keys()
    served = _served(view, state)
    waiting, refused = _refused(view, served, state.refused, now)
    taken = {port: at for port, at in state.taken.items() if now - at < TAKEN_FOR}
    return replace(
        state,
        begun=True,
        former=remember(view, state.former),
        absent={place: state.absent.get(place, now) for place in absent},
        lost={node: state.lost.get(node, now) for node in lost},
        served=served,
        given=_possible(view, state.given),
        refused=waiting,
        taken=taken | dict.fromkeys(refused, now),
        moved=_recent(view, state.moved, now - MOVED_FOR),
        tried=_recent(view, state.tried, now - TRIED_FOR),
        unselected={p.id: state.unselected.get(p.id, now) for p in view.observed.unselected_pods},
    )


def decide(state: ClusterState, ranges: Mapping[ProxyPlace, PortRange], now: float) -> ClusterState:
    """The state with the ranges that are given, and with the proxies that had to leave theirs."""
    moved = new_moves(state.served, ranges, now)
    tried = {place: ports for place, ports in state.given.items() if place not in state.served}
    return replace(
        state,
        given={**state.given, **ranges},
        served={place: ports for place, ports in state.served.items() if place not in moved},
        moved={**state.moved, **moved},
        tried={**state.tried, **new_moves(tried, ranges, now)},
    )


def moves(
    view: View, state: ClusterState, ranges: Mapping[ProxyPlace, PortRange]
) -> Iterator[ClusterFinding]:
    """Which proxies have had to leave which ports."""
    for moved, has_served in ((state.moved, True), (state.tried, False)):
        for place, move in sorted(moved.items()):
            if place in ranges and is_moved(move.ports, ranges[place]):
                rosproxy = view.rosproxies[place.of]
                why = "the old ports are not free. Nothing needs to be done"
                if has_served:
                    lost = after_move(rosproxy.spec.ros1, rosproxy.spec.ros2 is not None)
                    why = f"the old ports are taken, or the RosProxy no longer allows them. {lost}"
                change = f"has left ports {move.ports} for {ranges[place]}"
                text = f"the proxy on node {place.node} {change}, since {why}"
                yield finding(rosproxy, "PortConflict", text)


def _served(view: View, state: ClusterState) -> dict[ProxyPlace, PortRange]:
    """Where each proxy has served; what the status says is believed only once, at the start."""
    served = dict(state.served)
    if not state.begun:
        for name, rosproxy in view.rosproxies.items():
            served |= {
                ProxyPlace(name, node): ports for node, ports in rosproxy.former_ranges.items()
            }
    served |= {place_of(p): p.range for p in view.observed.proxies if serves(p)}
    return _possible(view, served)


def _possible(view: View, ranges: Mapping[ProxyPlace, PortRange]) -> dict[ProxyPlace, PortRange]:
    """The ranges whose RosProxy and whose node exist."""
    rosproxies = view.rosproxies
    nodes = view.observed.nodes
    return {p: ports for p, ports in ranges.items() if p.of in rosproxies and p.node in nodes}


def _recent(view: View, moves: Mapping[ProxyPlace, Move], since: float) -> dict[ProxyPlace, Move]:
    return {p: move for p, move in moves.items() if move.at > since and p in view.wanted}


def _refused(
    view: View,
    served: Mapping[ProxyPlace, PortRange],
    since: Mapping[ProxyPlace, float],
    now: float,
) -> tuple[dict[ProxyPlace, float], set[tuple[str, int]]]:
    """Which proxies wait for their ports since when, and the ports by node that no proxy gets.

    A proxy has only to wait while another one that is being deleted still holds its ports.
    """
    waiting = {place: at for place, at in since.items() if _is_waiting(view, place)}
    taken: set[tuple[str, int]] = set()
    for proxy in view.observed.proxies:
        place = place_of(proxy)
        neighbours = view.proxies_by_node.get(proxy.node, ())
        ends_soon = any(p.pod.deleting and overlap(p.range, proxy.range) for p in neighbours)
        is_stuck = proxy.stuck is PodFailure.PORTS and not proxy.pod.deleting
        if not is_stuck or place not in view.wanted or ends_soon:
            continue
        former = served.get(place)
        began = waiting.pop(place, now)
        if former is not None and overlap(former, proxy.range) and now - began < RETRY_FOR:
            waiting[place] = began
            continue
        other_pods = (p.pod for p in neighbours if place_of(p) != place)
        spec = view.rosproxies[place.of].spec
        pod_ports = host_ports_of((*view.other_pods_by_node.get(proxy.node, ()), *other_pods), spec)
        # If the pods that hold them are seen, only their ports are avoided, else the whole range.
        conflicts = pod_ports & proxy.pod.every_port
        avoided = pod_ports.intersection(proxy.range.ports()) if conflicts else proxy.range.ports()
        taken |= {(proxy.node, port) for port in avoided}
    return waiting, taken


def _is_waiting(view: View, place: ProxyPlace) -> bool:
    """Whether the proxy of a place is wanted, but has not got its ports yet."""
    proxy = view.current.get(place)
    return place in view.wanted and (proxy is None or not has_ports(proxy))


def host_ports_of(pods: Iterable[Pod], spec: RosProxySpec) -> set[int]:
    """The hostPorts of pods that a RosProxy can't have."""
    return {port for pod in pods for port in pod.ports_of(spec)}
