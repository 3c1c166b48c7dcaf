"""Which range of ports each proxy gets on its node.

A proxy's range is a promise: ROS nodes have registered at the master under its ports, so a proxy
keeps the range that it has, or had by the state or by its RosProxy's status, as long as that is
allowed and available. On each node proxies that have ports come first, then those that had some,
then those that want some; a hostPort is taken if any pod of the node has it, whoever owns the pod.
`state` says which ports were refused recently, and which proxies had to leave theirs.
"""

from collections.abc import Collection, Iterator

import msgspec

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.port_negotiation import (
    PortsExhausted,
    extended,
    is_free,
    negotiate,
    overlap,
    within,
)
from rosproxy_operator.common.ros2 import well_known_ports
from rosproxy_operator.kubernetes.planner.cluster_view import (
    View,
    abbreviated,
    group_by_key,
    has_ports,
    place_of,
    serves,
)
from rosproxy_operator.kubernetes.planner.state import ClusterState, host_ports_of
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Pod,
    ProxyPlace,
    RosProxySpec,
)
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, MASTER_PORT
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.findings import finding


class ClusterRanges(msgspec.Struct, frozen=True):
    """The range of each wanted proxy that can have one.

    ``published`` are the places whose port for the master in the cluster is free. ``exhausted``
    says for each other place why it has no range, ``findings`` what could not be had as asked for.
    """

    given: dict[ProxyPlace, PortRange] = {}
    published: set[ProxyPlace] = set()
    exhausted: dict[ProxyPlace, str] = {}
    findings: list[ClusterFinding] = []


def allocate(view: View, settings: ClusterSettings, state: ClusterState) -> ClusterRanges:
    """A range for each wanted proxy: the one that it has or had, else the first that is free.

    A proxy that has its ports keeps them, unless its RosProxy or the settings now forbid them.
    """
    ranges = ClusterRanges()
    places = group_by_key((place.node, place) for place in view.wanted)
    refused = group_by_key(state.taken)
    for node, wanted in sorted(places.items()):
        _Allocation(view, settings, state, wanted, {*refused.get(node, ())}, ranges).run()
    return ranges


class _Allocation:
    """The ranges of one node being given out, into ``ranges``."""

    def __init__(
        self,
        view: View,
        settings: ClusterSettings,
        state: ClusterState,
        wanted: tuple[ProxyPlace, ...],
        refused: set[int],
        ranges: ClusterRanges,
    ) -> None:
        self.view = view
        self.state = state
        self.ranges = ranges
        self.node = node = wanted[0].node
        self.rosproxies = {place: view.rosproxies[place.of] for place in wanted}
        self.proxies = view.proxies_by_node.get(node, ())
        self.strangers = view.other_pods_by_node.get(node, ())
        self.refused = refused
        self.kernel = {
            "NodePorts": settings.node_ports,
            "the nodes' ephemeral ports": settings.ephemeral,
        }

    def run(self) -> None:
        """Proxies that have ports come before those that had some, and these before the rest."""
        # In three rounds: nothing is given out anew before all is known that proxies keep.
        order = sorted(self.rosproxies, key=self._rank)
        for place in order:
            self._keep(place)
        for place in order:
            self._publish(place)
        for place in order:
            self._fill(place)

    def _rank(self, place: ProxyPlace) -> tuple[int, ProxyPlace]:
        proxy = self.view.current.get(place)
        ranks = (
            proxy is not None and serves(proxy),
            proxy is not None and has_ports(proxy),
            place in self.state.served,
            proxy is not None,
            self.rosproxies[place].former_ranges.get(self.node) is not None,
        )
        return ranks.index(True) if True in ranks else len(ranks), place

    def _keep(self, place: ProxyPlace) -> None:
        """Give a proxy the range that it has or had, if it can have it."""
        proxy = self.view.current.get(place)
        spec = self.rosproxies[place].spec
        reserved = self._reserved(place)
        kernel = [*self.kernel.values()]
        for ports in self._candidates(place):
            trimmed = PortRange(ports.first, min(ports.last, ports.first + spec.ports - 1))
            is_allowed = within(trimmed, spec.window) and is_free(trimmed, reserved, kernel)
            is_current = proxy is not None and has_ports(proxy) and proxy.range == ports
            if is_allowed and (is_current or self._is_available(place, trimmed)):
                self.ranges.given[place] = trimmed
                return

    def _candidates(self, place: ProxyPlace) -> Iterator[PortRange]:
        current = self.view.current.get(place)
        proxies = [p for p in self.proxies if place_of(p) == place]
        yield from (p.range for p in sorted(proxies, key=lambda p: p is not current))
        remembered = (
            self.state.given.get(place),
            self.state.served.get(place),
            self.rosproxies[place].former_ranges.get(self.node),
        )
        yield from filter(None, remembered)

    def _is_available(self, place: ProxyPlace, ports: PortRange) -> bool:
        """Whether a range that the proxy does not hold now is available.

        Pods that are about to end free their ports in time for a proxy that has served; other
        proxies' pods also for one that waits for its ports already. The ports of another proxy
        count if it has got them, or if its place is not given another range.
        """
        served = place in self.state.served
        is_waiting = served or self.view.current.get(place) is not None
        pods = [pod for pod in self._strangers(place) if not (served and pod.deleting)]
        for proxy in self.proxies:
            counts = has_ports(proxy) or place_of(proxy) not in self.view.wanted
            if counts and place_of(proxy) != place and not (is_waiting and proxy.pod.deleting):
                pods.append(proxy.pod)
        pod_ports = host_ports_of(pods, self.rosproxies[place].spec)
        return is_free(ports, pod_ports | self.refused, self._promised_to_others(place))

    def _publish(self, place: ProxyPlace) -> None:
        """Give a proxy its port for a master in the cluster, if it is to have one and can."""
        proxy = self.view.current.get(place)
        port = self.rosproxies[place].spec.master.publish
        if not port:
            return
        if proxy is None or not has_ports(proxy) or port not in proxy.pod.host_ports:
            holders = [str(p.id) for p in self._other_pods(place) if port in p.host_ports]
            promised = any(port in ports for ports in self._promised_to_others(place))
            if holders or promised or port in self.refused:
                holder = "another RosProxy, or a pod or program that ends soon, has"
                if holders:
                    holder = f"pod {abbreviated(holders)} has"
                text = (
                    f"the master is not published on port {port} of node {self.node}, since "
                    f"{holder} this port. Choose another spec.master.publish, or free the port"
                )
                self.ranges.findings.append(finding(self.rosproxies[place], "PortConflict", text))
                return
        self.ranges.published.add(place)

    def _fill(self, place: ProxyPlace) -> None:
        """Give a proxy more ports if it has too few, or a range if it has none."""
        spec = self.rosproxies[place].spec
        ranges = self.ranges.given
        pod_ports = host_ports_of(self._other_pods(place), spec)
        blocked = pod_ports | self.refused | self._reserved(place)
        excluded = [*self.kernel.values(), *self._promised_to_others(place)]
        if kept := ranges.get(place):
            ranges[place] = extended(kept, spec.ports, spec.window, blocked, excluded) or kept
            if len(ranges[place]) < spec.ports:
                missing = PortRange(kept.last + 1, kept.first + spec.ports - 1)
                text = (
                    f"the proxy on node {self.node} has only the {len(kept)} ports {kept}, "
                    f"although spec.ports is {spec.ports}: ports {missing} are not all free, or "
                    "not in spec.portWindow. Delete the pods that hold these ports, or move "
                    "spec.portWindow elsewhere, so that the proxy gets another range"
                )
                self.ranges.findings.append(finding(self.rosproxies[place], "PortsExhausted", text))
            return
        try:
            ranges[place] = self._new_range(spec, blocked, excluded)
        except PortsExhausted as error:
            self.ranges.exhausted[place] = self._exhaustion(place, error)

    def _new_range(
        self, spec: RosProxySpec, blocked: Collection[int], excluded: list[PortRange]
    ) -> PortRange:
        """A new range, if possible none that another RosProxy has had on this node."""
        former = filter(
            None, (r.former_ranges.get(self.node) for r in self.view.rosproxies.values())
        )
        try:
            return negotiate(spec.ports, spec.window, blocked, [*excluded, *former])
        except PortsExhausted:
            return negotiate(spec.ports, spec.window, blocked, excluded)

    def _exhaustion(self, place: ProxyPlace, error: PortsExhausted) -> str:
        """Why there are no ports, and what to do."""
        reasons = [
            f"{subject} {r}" for subject, r in self.kernel.items() if overlap(r, error.window)
        ]
        pods = self._other_pods(place)
        spec = self.rosproxies[place].spec
        holders = [
            str(pod.id) for pod in pods if any(p in error.window for p in pod.ports_of(spec))
        ]
        reasons += [f"ports of pods {abbreviated(holders)}"] if holders else []
        reason = ", ".join(reasons) or "ports that the node refused a short time ago"
        fix = f"Widen spec.portWindow ({error.window}), or lower spec.ports ({error.count})"
        fix += ", or delete one of these pods" if holders else ""
        return f"{error}. Not available: {reason}. {fix}"

    def _other_pods(self, place: ProxyPlace) -> list[Pod]:
        """All other pods that hold ports on the node."""
        proxy_pods = (p.pod for p in self.proxies if place_of(p) != place)
        return [*self._strangers(place), *proxy_pods]

    def _strangers(self, place: ProxyPlace) -> list[Pod]:
        """Pods that are no proxies, among them the LAN relays of other RosProxies."""
        # That of the same RosProxy holds the last port of the range: see `ProxySite.own_ports`.
        lan_relays = (
            lan_relay for lan_relay in self.view.observed.lan_relays if lan_relay.node == self.node
        )
        return [
            *self.strangers,
            *(lan_relay.pod for lan_relay in lan_relays if lan_relay.of != place.of),
        ]

    def _promised_to_others(self, place: ProxyPlace) -> Iterator[PortRange]:
        """The ports that other proxies on the node have been given so far."""
        for other_place in self.rosproxies.keys() - {place}:
            if other_place in self.ranges.given:
                yield self.ranges.given[other_place]
            if other_place in self.ranges.published:
                port = self.rosproxies[other_place].spec.master.publish
                yield PortRange(port, port)

    def _reserved(self, place: ProxyPlace) -> set[int]:
        # The proxy listens on these itself, and a hostPort is the container's port of that number.
        spec = self.rosproxies[place].spec
        ros2_ports = well_known_ports(spec.ros2.number) if spec.ros2 else frozenset[int]()
        return {MASTER_PORT, ADMIN_PORT, spec.master.publish, *ros2_ports}
