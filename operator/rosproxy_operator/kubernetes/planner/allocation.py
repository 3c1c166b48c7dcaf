"""Which range of ports each proxy gets on its node.

A proxy's range is a promise: ROS nodes have registered at the master under its ports, so a proxy
keeps the range that it has, or had by the state or by its RosProxy's status, as long as that is
allowed and to be had. On each node who has ports comes first, then who had some, then who wants
some; a hostPort is taken if any pod of the node has it, whosever that is. `state` says which ports
were refused of late, and who had to leave his.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.allocation import (
    PortsExhausted,
    extended,
    is_free,
    negotiate,
    overlap,
    within,
)
from rosproxy_operator.kubernetes.planner.settings import ClusterSettings
from rosproxy_operator.kubernetes.planner.state import ClusterState, ports_held
from rosproxy_operator.kubernetes.planner.view import View, has_ports, place_of, serves, short
from rosproxy_operator.kubernetes.resources.model import ProxyPlace, ProxyPod
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, MASTER_PORT


@dataclass(frozen=True, slots=True)
class ClusterRanges:
    """The range of each wanted proxy that can have one.

    ``published`` are the places whose port for the master in the cluster is free. ``exhausted``
    says of the others why there is none, ``flaws`` what is not as asked for: reason and text.
    """

    given: Mapping[ProxyPlace, PortRange]
    published: frozenset[ProxyPlace]
    exhausted: Mapping[ProxyPlace, str]
    flaws: Mapping[ProxyPlace, tuple[tuple[str, str], ...]]


def allocate(view: View, settings: ClusterSettings, state: ClusterState) -> ClusterRanges:
    """A range for each wanted proxy: the one that it has or had, else the first that is free.

    A proxy that has its ports keeps them, unless its RosProxy or the settings now forbid them.
    """
    given: dict[ProxyPlace, PortRange] = {}
    published: set[ProxyPlace] = set()
    exhausted: dict[ProxyPlace, str] = {}
    flaws: dict[ProxyPlace, tuple[tuple[str, str], ...]] = {}
    for node in sorted({place.node for place in view.wanted}):
        one = _Allocation(view, settings, state, node)
        one.run()
        given |= one.given
        published |= one.published
        exhausted |= one.exhausted
        flaws |= {place: tuple(some) for place, some in one.flaws.items()}
    return ClusterRanges(given, frozenset(published), exhausted, flaws)


class _Allocation:
    """The ranges of one node being given out."""

    def __init__(
        self, view: View, settings: ClusterSettings, state: ClusterState, node: str
    ) -> None:
        self.view, self.settings, self.state, self.node = view, settings, state, node
        self.places = sorted(place for place in view.wanted if place.node == node)
        self.proxies = view.on(node)
        self.strangers = view.strangers.get(node, ())
        self.refused = {port for where, port in state.taken if where == node}
        self.given: dict[ProxyPlace, PortRange] = {}
        self.published: set[ProxyPlace] = set()
        self.exhausted: dict[ProxyPlace, str] = {}
        self.flaws: dict[ProxyPlace, list[tuple[str, str]]] = {}

    def run(self) -> None:
        """Who has ports comes before who had some, and that one before who wants some."""
        order = sorted(self.places, key=self._rank)
        for place in order:
            self._keep(place)
        for place in order:
            self._publish(place)
        for place in order:
            self._fill(place)

    def _rank(self, place: ProxyPlace) -> tuple[int, ProxyPlace]:
        proxy = self.view.current(place)
        ranks = (
            proxy is not None and serves(proxy),
            proxy is not None and has_ports(proxy),
            place in self.state.served,
            proxy is not None,
            self._former(place) is not None,
        )
        return ranks.index(True) if True in ranks else len(ranks), place

    def _keep(self, place: ProxyPlace) -> None:
        """Give a proxy the range that it has or had, if it can have it."""
        proxy = self.view.current(place)
        for ports in self._candidates(place):
            cut = PortRange(ports.first, min(ports.last, ports.first + self._count(place) - 1))
            holds = proxy is not None and has_ports(proxy) and proxy.range == ports
            if self._lawful(place, cut) and (holds or self._is_to_be_had(place, cut)):
                self.given[place] = cut
                return

    def _candidates(self, place: ProxyPlace) -> Iterator[PortRange]:
        current = self.view.current(place)
        there = [one for one in self.proxies if place_of(one) == place]
        yield from (one.range for one in sorted(there, key=lambda one: one is not current))
        known = (self.state.given.get(place), self.state.served.get(place), self._former(place))
        yield from (ports for ports in known if ports is not None)

    def _lawful(self, place: ProxyPlace, ports: PortRange) -> bool:
        window = self.view.rosproxies[place.of].spec.window
        return within(ports, window) and is_free(ports, self._reserved(place), self._kernel())

    def _is_to_be_had(self, place: ProxyPlace, ports: PortRange) -> bool:
        """Whether a range where nothing runs now can be had.

        Ports of pods that are about to end are let go in time for one that has served; those of
        the operator's own also for one that waits for them already.
        """
        served = place in self.state.served
        waits = served or self.view.current(place) is not None
        strangers = [pod for pod in self.strangers if not (served and pod.deleting)]
        others = [one for one in self._others(place) if self._is_fixed(one)]
        others = [one for one in others if not (waits and one.pod.deleting)]
        blocked = ports_held(strangers)
        held = [*_held(others), *self._given_to_others(place)]
        return is_free(ports, blocked | self.refused, held)

    def _is_fixed(self, proxy: ProxyPod) -> bool:
        """Whether others must heed a proxy's range, even if its place is given another one."""
        return has_ports(proxy) or place_of(proxy) not in self.view.wanted

    def _publish(self, place: ProxyPlace) -> None:
        port = self._wants_published(place)
        if not port:
            return
        proxy = self.view.current(place)
        if proxy is None or not has_ports(proxy) or port not in proxy.pod.host_ports:
            holders = [pod.id for pod in self.strangers if port in pod.host_ports]
            others = self._others(place)
            holders += [one.pod.id for one in others if port in one.pod.host_ports]
            given = [*self._given_to_others(place), *self._published_by_others(place)]
            if holders or port in self.refused or any(port in ports for ports in given):
                self._flaw(place, "PortConflict", _not_published(port, self.node, holders))
                return
        self.published.add(place)

    def _fill(self, place: ProxyPlace) -> None:
        """Give a proxy more ports if it has too few, or a range if it has none."""
        spec = self.view.rosproxies[place.of].spec
        blocked = ports_held(self.strangers) | self.refused | self._reserved(place)
        held = [*self._kernel(), *_held(self._others(place)), *self._given_to_others(place)]
        held += self._published_by_others(place)
        kept = self.given.get(place)
        if kept is not None:
            self.given[place] = extended(kept, spec.ports, spec.window, blocked, held) or kept
            if len(self.given[place]) < spec.ports:
                self._flaw(place, "PortsExhausted", _too_few(kept, spec.ports, self.node))
            return
        try:
            self.given[place] = self._found(place, blocked, held)
        except PortsExhausted as error:
            self.exhausted[place] = self._exhausted(place, error)

    def _found(
        self, place: ProxyPlace, blocked: Collection[int], held: list[PortRange]
    ) -> PortRange:
        """A new range, if possible none that another RosProxy has had here."""
        spec = self.view.rosproxies[place.of].spec
        had = [one.former.get(self.node) for one in self.view.rosproxies.values()]
        try:
            more = [ports for ports in had if ports is not None]
            return negotiate(spec.ports, spec.window, blocked, [*held, *more])
        except PortsExhausted:
            return negotiate(spec.ports, spec.window, blocked, held)

    def _others(self, place: ProxyPlace) -> list[ProxyPod]:
        return [one for one in self.proxies if place_of(one) != place]

    def _given_to_others(self, place: ProxyPlace) -> list[PortRange]:
        return [ports for other, ports in self.given.items() if other != place]

    def _published_by_others(self, place: ProxyPlace) -> list[PortRange]:
        ports = (self._wants_published(other) for other in self.published if other != place)
        return [PortRange(port, port) for port in ports]

    def _kernel(self) -> list[PortRange]:
        return [self.settings.node_ports, self.settings.ephemeral]

    def _reserved(self, place: ProxyPlace) -> set[int]:
        return {MASTER_PORT, ADMIN_PORT, self._wants_published(place)}

    def _wants_published(self, place: ProxyPlace) -> int:
        return self.view.rosproxies[place.of].spec.master.publish

    def _count(self, place: ProxyPlace) -> int:
        return self.view.rosproxies[place.of].spec.ports

    def _former(self, place: ProxyPlace) -> PortRange | None:
        return self.view.rosproxies[place.of].former.get(self.node)

    def _flaw(self, place: ProxyPlace, reason: str, text: str) -> None:
        self.flaws.setdefault(place, []).append((reason, text))

    def _exhausted(self, place: ProxyPlace, error: PortsExhausted) -> str:
        holders = {
            str(pod.id)
            for pod in (*self.strangers, *(one.pod for one in self._others(place)))
            if any(port in error.window for port in pod.host_ports)
        }
        kernel = (
            (f"NodePorts are {self.settings.node_ports}", self.settings.node_ports),
            (f"the nodes' ephemeral ports are {self.settings.ephemeral}", self.settings.ephemeral),
        )
        why = [text for text, ports in kernel if overlap(ports, error.window)]
        why += [f"others are held by {short(holders)}"] if holders else []
        by = ", ".join(why) or "the others were refused just now"
        return (
            f"{error}; {by}: enlarge spec.portWindow ({error.window}), lower spec.ports "
            f"({error.count}), or let one of those pods go"
        )


def _held(proxies: Iterable[ProxyPod]) -> list[PortRange]:
    """The ranges of proxies, and what else they hold."""
    found = []
    for one in proxies:
        more = sorted(port for port in one.pod.host_ports if port not in one.range)
        found += [one.range, *(PortRange(port, port) for port in more)]
    return found


def _not_published(port: int, node: str, holders: Iterable[object]) -> str:
    by = short(map(str, holders)) or "another RosProxy, or something that is about to end"
    return (
        f"the master in the cluster is not published on port {port} of node {node}, which is held "
        f"by {by}: choose another spec.master.publish, or let that go"
    )


def _too_few(kept: PortRange, count: int, node: str) -> str:
    more = PortRange(kept.last + 1, kept.first + count - 1)
    return (
        f"spec.ports is {count}, but the proxy on node {node} keeps its {len(kept)} at {kept}, "
        f"since {more} are not free or not in spec.portWindow: let the pods go that hold them, or "
        "move spec.portWindow away from there, so that all ports are given anew"
    )
