"""Chooses the range of ports of each proxy on a node.

A proxy keeps its present or former range as long as the RosProxy allows the range and the ports are
free. The state and the status of the RosProxy name former ranges. On each node, proxies that have
ports come first, then proxies that had ports, then new proxies. A hostPort is taken if any pod of
the node has the port, also a foreign pod. `state` says which ports were refused recently, and which
proxies had to leave a range. A new range has ports of stand-ins only if no other range is free,
because the NetworkPolicy opens a range to all sources.
"""

from collections.abc import Iterable, Iterator, Mapping

import msgspec

from rosproxy.shared.ports import STAND_IN_PORTS, PortRange
from rosproxy_operator.common.port_ranges import (
    FormerRange,
    PortsExhausted,
    RangeRequest,
    assign_ranges,
    gaps,
    is_free,
    kept_ranges,
    overlap,
    within,
)
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner import proxy_ports
from rosproxy_operator.kubernetes.planner.cluster_view import (
    View,
    abbreviated,
    group_by_key,
    has_ports,
    place_of,
    serves,
)
from rosproxy_operator.kubernetes.planner.state import ClusterState, host_ports_of
from rosproxy_operator.kubernetes.resources.cluster import ProxyPod
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Pod,
    ProxyPlace,
    RosProxySpec,
)
from rosproxy_operator.kubernetes.resources.names import ROUTERS
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.findings import finding


class ClusterRanges(msgspec.Struct, frozen=True):
    """The ranges of the wanted proxies.

    ``given`` has the range of each place that gets a range. ``exhausted`` gives the reason for each
    other place. ``published`` has the ports for a master in the cluster, where free. ``findings``
    report ranges that are too short, and masters that are not published. ``of_zenoh`` are the
    places of proxies for rmw_zenoh, whose range has no ports of the node.
    """

    given: dict[ProxyPlace, PortRange] = {}
    published: dict[ProxyPlace, PortRange] = {}
    exhausted: dict[ProxyPlace, Fault] = {}
    findings: list[ClusterFinding] = []
    of_zenoh: set[ProxyPlace] = set()

    @property
    def on_hosts(self) -> dict[ProxyPlace, PortRange]:
        """The ranges with ports of nodes: all but the ranges of proxies for rmw_zenoh."""
        return {place: r for place, r in self.given.items() if place not in self.of_zenoh}


def allocate(view: View, settings: ClusterSettings, state: ClusterState) -> ClusterRanges:
    """Return a range for each wanted proxy: the present or former range, else the first free range.

    All proxies for rmw_zenoh have the same range, which is not published.

    A proxy keeps the ports that it has, unless the RosProxy or the settings now forbid these ports.
    """
    ranges = ClusterRanges()
    kernel = {"NodePorts": settings.node_ports, "the nodes' ephemeral ports": settings.ephemeral}
    for place in view.wanted:
        if view.rosproxies[place.of].spec.zenoh:  # no hostPort, so no conflict
            ranges.given[place] = ROUTERS
            ranges.of_zenoh.add(place)
    places = group_by_key((p.node, p) for p in view.wanted if p not in ranges.given)
    refused = group_by_key(state.taken)
    for node, wanted in sorted(places.items()):
        _Node(view, state, kernel, node, {*refused.get(node, ())}, ranges).allocate(wanted)
    return ranges


class _Node(msgspec.Struct):
    """Chooses the ranges on a node, and stores the result in ``ranges``.

    ``kernel`` has the ranges that the node itself uses, by the words of messages. ``refused`` has
    the ports that the node refused a short time ago.
    """

    view: View
    state: ClusterState
    kernel: Mapping[str, PortRange]
    node: str
    refused: set[int]
    ranges: ClusterRanges

    @property
    def proxies(self) -> tuple[ProxyPod, ...]:
        """The proxies that hold ports on the node."""
        return self.view.proxies_by_node.get(self.node, ())

    def allocate(self, places: Iterable[ProxyPlace]) -> None:
        """Choose the ranges of these places.

        Proxies that have ports come first, then proxies that had ports, then new proxies.
        """
        requests = {
            (place, False): self._request(place) for place in sorted(places, key=self._rank)
        }
        published = {
            (place, True): self._master_request(place)
            for place, _ in requests
            if self.view.rosproxies[place.of].spec.master.publish
        }
        kept, unpublished = assign_ranges(published, kept_ranges(requests) | kept_ranges(published))
        given, exhausted = assign_ranges(requests, kept)
        self.ranges.findings.extend(self._unpublished(place) for place, _ in unpublished)
        for (place, is_master), ports in given.items():
            (self.ranges.published if is_master else self.ranges.given)[place] = ports
            if not is_master and len(ports) < requests[place, False].count:
                self.ranges.findings.append(self._too_short(place, ports))
        for (place, _), error in exhausted.items():
            self.ranges.exhausted[place] = self._exhaustion(place, error)

    def _rank(self, place: ProxyPlace) -> tuple[int, ProxyPlace]:
        """Return the key by which `allocate` sorts places."""
        proxy = self.view.current.get(place)
        has_had_ports = self.node in self.view.rosproxies[place.of].former_ranges
        present = (serves(proxy), has_ports(proxy)) if proxy else (False, False)
        ranks = (*present, place in self.state.served, proxy is not None, has_had_ports, True)
        return ranks.index(True), place

    def _request(self, place: ProxyPlace) -> RangeRequest:
        """Return the request of a proxy for a range, with the ports that are not available."""
        spec = self.view.rosproxies[place.of].spec
        reserved = proxy_ports.fixed_ports(spec) | {spec.master.publish}
        kernel = [*self.kernel.values()]
        most = spec.ports - 1
        ranges = [PortRange(r.first, min(r.last, r.first + most)) for r in self._past(place)]
        allowed = [r for r in ranges if within(r, spec.window) and is_free(r, reserved, kernel)]
        current = self.view.current.get(place)
        keeps_first = bool(allowed) and allowed[0] == ranges[0]
        is_held = current is not None and has_ports(current) and keeps_first
        taken = set[int]() if is_held else self._taken(place)
        # If possible, a new range is not the former range of another RosProxy on this node.
        others = (r.former_ranges.get(self.node) for r in self.view.rosproxies.values())
        return RangeRequest(
            spec.ports,
            spec.window,
            host_ports_of(self._other_pods(place), spec) | self.refused | reserved,
            kernel,
            held=allowed[0] if is_held else None,
            former=tuple(FormerRange(r, taken) for r in allowed),
            avoided=[*filter(None, others), *_avoided_stand_ins(spec)],
        )

    def _past(self, place: ProxyPlace) -> Iterator[PortRange]:
        """Yield the present and former ranges of a proxy, first the range of the present pod.

        The ports of a former proxy for rmw_zenoh are no range of the node.
        """
        current = self.view.current.get(place)
        proxies = [p for p in self.proxies if place_of(p) == place and not p.of_zenoh]
        known = (
            *(p.range for p in sorted(proxies, key=lambda p: p is not current)),
            self.state.given.get(place),
            self.state.served.get(place),
            self.view.rosproxies[place.of].former_ranges.get(self.node),
        )
        yield from (r for r in known if r is not None)

    def _taken(self, place: ProxyPlace) -> set[int]:
        """Return the ports that a proxy can't get back.

        A pod that is being deleted soon frees its ports. So these ports do not count for a proxy
        that has served. For a proxy that has a pod and waits, the ports of other proxies that are
        being deleted do not count either. The ports of another proxy count if that proxy has the
        ports, or if no proxy is wanted at its place.
        """
        served = place in self.state.served
        is_waiting = served or self.view.current.get(place) is not None
        pods = [pod for pod in self._non_proxy_pods(place) if not (served and pod.deleting)]
        for proxy in self.proxies:
            counts = has_ports(proxy) or place_of(proxy) not in self.view.wanted
            if counts and place_of(proxy) != place and not (is_waiting and proxy.pod.deleting):
                pods.append(proxy.pod)
        return host_ports_of(pods, self.view.rosproxies[place.of].spec) | self.refused

    def _master_request(self, place: ProxyPlace) -> RangeRequest:
        """Return the request for the port of a master in the cluster."""
        proxy = self.view.current.get(place)
        port = self.view.rosproxies[place.of].spec.master.publish
        ports = PortRange(port, port)
        is_held = proxy is not None and has_ports(proxy) and port in proxy.pod.host_ports
        blocked = {port for pod in self._other_pods(place) for port in pod.host_ports}
        return RangeRequest(1, ports, blocked | self.refused, held=ports if is_held else None)

    def _unpublished(self, place: ProxyPlace) -> ClusterFinding:
        """Return the finding that a master in the cluster is not published."""
        rosproxy = self.view.rosproxies[place.of]
        port = rosproxy.spec.master.publish
        pods = [str(pod.id) for pod in self._other_pods(place) if port in pod.host_ports]
        holder = "another RosProxy, or a pod or program that ends soon, has"
        if pods:
            holder = f"pod {abbreviated(pods)} has"
        text = (
            f"the master is not published on port {port} of node {self.node}, since {holder} this "
            "port"
        )
        fix = "Choose another spec.master.publish, or free the port"
        return finding(rosproxy, "PortConflict", Fault(text, fix))

    def _too_short(self, place: ProxyPlace, ports: PortRange) -> ClusterFinding:
        """Return the finding that a range is shorter than ``spec.ports``."""
        rosproxy = self.view.rosproxies[place.of]
        count = rosproxy.spec.ports
        missing = PortRange(ports.last + 1, ports.first + count - 1)
        text = (
            f"the proxy on node {self.node} has only the {len(ports)} ports {ports}, although "
            f"spec.ports is {count}: ports {missing} are not all free, or not in spec.portWindow"
        )
        fix = (
            "Delete the pods that hold these ports, or move spec.portWindow elsewhere, so that the "
            "proxy gets another range"
        )
        return finding(rosproxy, "PortsExhausted", Fault(text, fix))

    def _exhaustion(self, place: ProxyPlace, error: PortsExhausted) -> Fault:
        """Return why a proxy gets no range, and the fix."""
        window = error.window
        reasons = [f"{subject} {r}" for subject, r in self.kernel.items() if overlap(r, window)]
        pods = self._other_pods(place)
        spec = self.view.rosproxies[place.of].spec
        holders = [str(pod.id) for pod in pods if any(p in window for p in pod.ports_of(spec))]
        reasons += [f"ports of pods {abbreviated(holders)}"] if holders else []
        reason = ", ".join(reasons) or "ports that the node refused a short time ago"
        fix = f"Widen spec.portWindow ({window}), or lower spec.ports ({error.count})"
        fix += ", or delete one of these pods" if holders else ""
        return Fault(f"{error}. Not available: {reason}", fix)

    def _other_pods(self, place: ProxyPlace) -> list[Pod]:
        """Return all other pods that hold ports on the node."""
        proxy_pods = (p.pod for p in self.proxies if place_of(p) != place)
        return [*self._non_proxy_pods(place), *proxy_pods]

    def _non_proxy_pods(self, place: ProxyPlace) -> list[Pod]:
        """Return the node's pods that are not proxies, with the LAN relays of other RosProxies."""
        lan_relays = self.view.lan_relays_by_node.get(self.node, ())
        # The LAN relay of the same RosProxy holds the last port of the range (`steps.lan_relay`).
        others = (lan_relay.pod for lan_relay in lan_relays if lan_relay.of != place.of)
        return [*self.view.other_pods_by_node.get(self.node, ()), *others]


def _avoided_stand_ins(spec: RosProxySpec) -> list[PortRange]:
    """Return the ports of stand-ins that a new range avoids, if possible.

    The list is empty for a proxy without stand-ins. If all ranges of the window have such ports, no
    range is better, and the list is empty, too.
    """
    others = gaps(spec.window, (), [STAND_IN_PORTS])
    has_choice = any(len(ports) >= spec.ports for ports in others)
    return [STAND_IN_PORTS] if has_choice and proxy_ports.stand_in_protocols(spec) else []
