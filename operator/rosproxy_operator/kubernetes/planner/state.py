"""The state that the operator keeps from look to look. A lost state costs time, not correctness.

Each plan makes the next state from the last state, in two steps. `learn` updates the state from
the view: unwanted proxies, missing nodes, ranges on which proxies serve, refused ports. `decide`
adds the ranges of this plan. `departures`, `retries` and `events` fill in the other fields.
"""

from collections.abc import Iterable, Iterator, Mapping

import msgspec
from msgspec.structs import replace

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.port_ranges import (
    MOVE_REPORTED_S,
    REFUSED_PORT_AVOIDED_S,
    REFUSED_RANGE_KEPT_S,
    Move,
    advice_after_move,
    is_moved,
    new_moves,
    overlap,
)
from rosproxy_operator.common.problem import CONFLICT, Fault
from rosproxy_operator.kubernetes.planner.cluster_view import View, has_ports, place_of, serves
from rosproxy_operator.kubernetes.planner.former_ports import FormerPorts, remember
from rosproxy_operator.kubernetes.planner.pods.undiscovered import undiscovered
from rosproxy_operator.kubernetes.planner.retries import RetryRecord, Task
from rosproxy_operator.kubernetes.planner.unregistrations import Unregistration, recall
from rosproxy_operator.kubernetes.planner.zenoh_hubs import Apart, hubs_apart
from rosproxy_operator.kubernetes.resources.cluster import PodFailure
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Name,
    Pod,
    ProxyPlace,
    RosProxySpec,
)
from rosproxy_operator.kubernetes.status.findings import finding

TRIED_RANGE_REPORTED_S = 60.0
"""Seconds for which the status reports ports that a proxy has left before it served there."""


class ClusterState(msgspec.Struct, frozen=True):
    """The state. Times are in seconds of the operator's monotonic clock.

    - ``begun``: False until the first look.
    - ``absent``: the time since when no pod wants the proxy of a place.
    - ``lost``: the time since when a node with proxies is missing.
    - ``served``: the range on which the proxy of a place last served.
    - ``given``: the range that the operator gave the proxy of a place.
    - ``refused``: the time since when a proxy that has served waits to get its ports back.
    - ``taken``: by node and port, the time of the last refusal of a port.
    - ``moved``: ranges that proxies left after they had served.
    - ``tried``: ranges that proxies left before they had served.
    - ``attempts``: the records of `Retries`.
    - ``reported``: the findings that became Events, and when.
    - ``addresses``: by node and address, the time when a look last saw a pod with this address.
    - ``strange``: by node and address, the time since when a proxy reports this address, although
      no look has seen a pod with it.
    - ``former``: see `former_ports`.
    - ``unregistered``: see `unregistrations`.
    - ``unselected``: the time since when no RosProxy selects a labelled pod.
    - ``undiscovered``: the time since when a running pod has no participants.
    - ``apart``: see `zenoh_hubs.hubs_apart`.
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
    unregistered: Mapping[ProxyPlace, Unregistration] = {}
    unselected: Mapping[Name, float] = {}
    undiscovered: Mapping[Name, float] = {}
    apart: Apart = {}


def learn(view: View, state: ClusterState, now: float) -> ClusterState:
    """Return the state after a look at the view.

    If the scheduler or the kubelet refuses the range of a proxy, the ports count as taken, so that
    the proxy gets another range. This happens at once if the proxy has never served on the range.
    Otherwise the operator waits `REFUSED_RANGE_KEPT_S` seconds: a former pod may be slow to free
    the ports.
    """
    absent = view.proxies.keys() - view.wanted.keys()
    lost = {p.node for p in view.observed.proxies} - view.observed.nodes.keys()
    served = _served(view, state)
    waiting, refused = _refused(view, served, state.refused, now)
    taken = {port: at for port, at in state.taken.items() if now - at < REFUSED_PORT_AVOIDED_S}
    return replace(
        state,
        begun=True,
        former=remember(view, state.former),
        unregistered=recall(view, state.unregistered),
        absent={place: state.absent.get(place, now) for place in absent},
        lost={node: state.lost.get(node, now) for node in lost},
        served=served,
        given=_possible(view, state.given),
        refused=waiting,
        taken=taken | dict.fromkeys(refused, now),
        moved=_recent(view, state.moved, now - MOVE_REPORTED_S),
        tried=_recent(view, state.tried, now - TRIED_RANGE_REPORTED_S),
        unselected={p.id: state.unselected.get(p.id, now) for p in view.observed.unselected_pods},
        undiscovered={
            pod.id: state.undiscovered.get(pod.id, now)
            for pod, _ in undiscovered(view, state.undiscovered)
        },
        apart=hubs_apart(view, state.apart, now),
    )


def decide(state: ClusterState, ranges: Mapping[ProxyPlace, PortRange], now: float) -> ClusterState:
    """Return the state with the ``ranges`` of this plan, and with the proxies that had to move."""
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
    """Yield a finding for each proxy that recently had to leave its ports."""
    for moved, has_served in ((state.moved, True), (state.tried, False)):
        for place, move in sorted(moved.items()):
            rosproxy = view.rosproxies[place.of]
            if place in ranges and is_moved(move.ports, ranges[place]):
                why = "the old ports are not free. Nothing needs to be done"
                fix = ""
                if has_served:
                    why = "the old ports are taken, or the RosProxy no longer allows them"
                    fix = advice_after_move(rosproxy.spec.ros1, rosproxy.spec.ros2 is not None)
                change = f"has left ports {move.ports} for {ranges[place]}"
                text = f"the proxy on node {place.node} {change}, since {why}"
                yield finding(rosproxy, CONFLICT, Fault(text, fix))


def _served(view: View, state: ClusterState) -> dict[ProxyPlace, PortRange]:
    """The range of the node on which each proxy last served.

    Only the first look reads the ranges in the statuses: later, the state is newer than a status.
    """
    served = dict(state.served)
    if not state.begun:
        for name, rosproxy in view.rosproxies.items():
            served |= {
                ProxyPlace(name, node): ports for node, ports in rosproxy.former_ranges.items()
            }
    proxies = (p for p in view.observed.proxies if serves(p) and not p.of_zenoh)
    served |= {place_of(p): p.range for p in proxies}
    return _possible(view, served)


def _possible(view: View, ranges: Mapping[ProxyPlace, PortRange]) -> dict[ProxyPlace, PortRange]:
    """The ranges of places whose RosProxy and node exist."""
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
    """Return the time since when each proxy waits for its ports, and the refused ports by node.

    While a proxy that is being deleted still holds the ports, a refusal does not count.
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
        if (
            former is not None
            and overlap(former, proxy.range)
            and now - began < REFUSED_RANGE_KEPT_S
        ):
            waiting[place] = began
            continue
        other_pods = (p.pod for p in neighbours if place_of(p) != place)
        spec = view.rosproxies[place.of].spec
        pod_ports = host_ports_of((*view.other_pods_by_node.get(proxy.node, ()), *other_pods), spec)
        # If the operator sees pods that hold some of the ports, only the ports of pods are avoided.
        # Otherwise the operator can't know which port is taken, and avoids the whole range.
        conflicts = pod_ports & proxy.pod.every_port
        avoided = pod_ports.intersection(proxy.range.ports()) if conflicts else proxy.range.ports()
        taken |= {(proxy.node, port) for port in avoided}
    return waiting, taken


def _is_waiting(view: View, place: ProxyPlace) -> bool:
    """Whether the proxy of a place is wanted, but does not have its ports yet."""
    proxy = view.current.get(place)
    return place in view.wanted and (proxy is None or not has_ports(proxy))


def host_ports_of(pods: Iterable[Pod], spec: RosProxySpec) -> set[int]:
    """The hostPorts of pods that a proxy with this spec can't have."""
    return {port for pod in pods for port in pod.ports_of(spec)}
