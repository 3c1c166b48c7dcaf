"""Which range of ports each proxy gets on its node.

A proxy's range is a promise: ROS nodes have registered at the master under its ports, so a proxy
keeps the range that it has, or had by the state or by its RosProxy's status, as long as that is
allowed and to be had. On each node who has ports comes first, then who had some, then who wants
some; a hostPort is taken if any pod of the node has it, whosever that is. `state` says which ports
were refused of late, and who had to leave his.
"""

from collections.abc import Collection, Iterator

import msgspec

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.allocation import (
    PortsExhausted,
    extended,
    is_free,
    negotiate,
    overlap,
    within,
)
from rosproxy_operator.common.ros2 import well_known_ports
from rosproxy_operator.kubernetes.planner.state import ClusterState, ports_held
from rosproxy_operator.kubernetes.planner.view import (
    View,
    grouped,
    has_ports,
    place_of,
    serves,
    short,
)
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
    says of the others why there is none, ``findings`` what is not as asked for.
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
    places = grouped((place.node, place) for place in view.wanted)
    refused = grouped(state.taken)
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
        self.view, self.state, self.ranges = view, state, ranges
        self.node = node = wanted[0].node
        self.of = {one: view.rosproxies[one.of] for one in wanted}
        self.proxies = view.on.get(node, ())
        self.strangers = view.strangers.get(node, ())
        self.refused = refused
        self.kernel = {
            "NodePorts are": settings.node_ports,
            "the nodes' ephemeral ports are": settings.ephemeral,
        }

    def run(self) -> None:
        """Who has ports comes before who had some, and that one before who wants some."""
        order = sorted(self.of, key=self._rank)
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
            self.of[place].former.get(self.node) is not None,
        )
        return ranks.index(True) if True in ranks else len(ranks), place

    def _keep(self, place: ProxyPlace) -> None:
        """Give a proxy the range that it has or had, if it can have it."""
        proxy, spec = self.view.current.get(place), self.of[place].spec
        reserved, kernel = self._reserved(place), [*self.kernel.values()]
        for ports in self._candidates(place):
            cut = PortRange(ports.first, min(ports.last, ports.first + spec.ports - 1))
            lawful = within(cut, spec.window) and is_free(cut, reserved, kernel)
            holds = proxy is not None and has_ports(proxy) and proxy.range == ports
            if lawful and (holds or self._is_to_be_had(place, cut)):
                self.ranges.given[place] = cut
                return

    def _candidates(self, place: ProxyPlace) -> Iterator[PortRange]:
        current = self.view.current.get(place)
        there = [one for one in self.proxies if place_of(one) == place]
        yield from (one.range for one in sorted(there, key=lambda one: one is not current))
        known = (
            self.state.given.get(place),
            self.state.served.get(place),
            self.of[place].former.get(self.node),
        )
        yield from filter(None, known)

    def _is_to_be_had(self, place: ProxyPlace, ports: PortRange) -> bool:
        """Whether a range where nothing runs now can be had.

        Ports of pods that are about to end are let go in time for one that has served; those of
        the operator's own also for one that waits for them already. Others must be heeded if they
        have their ports, or if their place is not given another range.
        """
        served = place in self.state.served
        waits = served or self.view.current.get(place) is not None
        pods = [pod for pod in self._strangers(place) if not (served and pod.deleting)]
        for one in self.proxies:
            heeded = has_ports(one) or place_of(one) not in self.view.wanted
            if heeded and place_of(one) != place and not (waits and one.pod.deleting):
                pods.append(one.pod)
        held = ports_held(pods, self.of[place].spec)
        return is_free(ports, held | self.refused, self._promised_to_others(place))

    def _publish(self, place: ProxyPlace) -> None:
        """Give a proxy its port for a master in the cluster, if it is to have one and can."""
        proxy, port = self.view.current.get(place), self.of[place].spec.master.publish
        if not port:
            return
        if proxy is None or not has_ports(proxy) or port not in proxy.pod.host_ports:
            holders = [str(p.id) for p in self._pods_of_others(place) if port in p.host_ports]
            promised = any(port in ports for ports in self._promised_to_others(place))
            if holders or promised or port in self.refused:
                by = short(holders) or "another RosProxy, or something that is about to end"
                text = (
                    f"the master in the cluster is not published on port {port} of node "
                    f"{self.node}, which is held by {by}: choose another spec.master.publish, or "
                    "let that go"
                )
                self.ranges.findings.append(finding(self.of[place], "PortConflict", text))
                return
        self.ranges.published.add(place)

    def _fill(self, place: ProxyPlace) -> None:
        """Give a proxy more ports if it has too few, or a range if it has none."""
        spec, given = self.of[place].spec, self.ranges.given
        others = ports_held(self._pods_of_others(place), spec)
        blocked = others | self.refused | self._reserved(place)
        held = [*self.kernel.values(), *self._promised_to_others(place)]
        if kept := given.get(place):
            given[place] = extended(kept, spec.ports, spec.window, blocked, held) or kept
            if len(given[place]) < spec.ports:
                more = PortRange(kept.last + 1, kept.first + spec.ports - 1)
                text = (
                    f"spec.ports is {spec.ports}, but the proxy on node {self.node} keeps its "
                    f"{len(kept)} at {kept}, since {more} are not free or not in spec.portWindow: "
                    "let the pods go that hold them, or move spec.portWindow away from there, so "
                    "that all ports are given anew"
                )
                self.ranges.findings.append(finding(self.of[place], "PortsExhausted", text))
            return
        try:
            given[place] = self._found(spec, blocked, held)
        except PortsExhausted as error:
            self.ranges.exhausted[place] = self._exhausted(place, error)

    def _found(
        self, spec: RosProxySpec, blocked: Collection[int], held: list[PortRange]
    ) -> PortRange:
        """A new range, if possible none that another RosProxy has had here."""
        had = filter(None, (one.former.get(self.node) for one in self.view.rosproxies.values()))
        try:
            return negotiate(spec.ports, spec.window, blocked, [*held, *had])
        except PortsExhausted:
            return negotiate(spec.ports, spec.window, blocked, held)

    def _exhausted(self, place: ProxyPlace, error: PortsExhausted) -> str:
        """Why there are no ports, and what to do."""
        why = [
            f"{what} {ports}" for what, ports in self.kernel.items() if overlap(ports, error.window)
        ]
        pods = self._pods_of_others(place)
        spec = self.of[place].spec
        holders = [
            str(pod.id) for pod in pods if any(p in error.window for p in pod.ports_of(spec))
        ]
        why += [f"others are held by {short(holders)}"] if holders else []
        by = ", ".join(why) or "the others were refused just now"
        return (
            f"{error}; {by}: enlarge spec.portWindow ({error.window}), lower spec.ports "
            f"({error.count}), or let one of those pods go"
        )

    def _pods_of_others(self, place: ProxyPlace) -> list[Pod]:
        """All other pods that hold ports on the node."""
        own = (one.pod for one in self.proxies if place_of(one) != place)
        return [*self._strangers(place), *own]

    def _strangers(self, place: ProxyPlace) -> list[Pod]:
        """Pods that are no proxies; the ears of others are among them."""
        ears = (one for one in self.view.observed.ears if one.on == self.node)
        return [*self.strangers, *(one.pod for one in ears if one.of != place.of)]

    def _promised_to_others(self, place: ProxyPlace) -> Iterator[PortRange]:
        """What other proxies on the node have been given by now."""
        for other in self.of.keys() - {place}:
            if other in self.ranges.given:
                yield self.ranges.given[other]
            if other in self.ranges.published:
                port = self.of[other].spec.master.publish
                yield PortRange(port, port)

    def _reserved(self, place: ProxyPlace) -> set[int]:
        spec = self.of[place].spec
        known = well_known_ports(spec.ros2.number) if spec.ros2 else frozenset[int]()
        return {MASTER_PORT, ADMIN_PORT, spec.master.publish, *known}
