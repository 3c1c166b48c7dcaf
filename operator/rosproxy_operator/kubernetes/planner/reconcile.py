"""What is to be done for one RosProxy: its Service, and its proxy on each node.

Each function compares what is wanted of an object with what is there and yields the next action;
the rest follows with the looks after it. Only the fingerprint on an object says whether it is as it
ought to be. A pod that differs is deleted and made anew under the same name, but for its image,
which can be exchanged. `retries` keeps actions without effect from being repeated at once.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rosproxy.net.addresses import is_address
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateProxy,
    CreateService,
    DeleteProxy,
    DeleteService,
    SetImage,
)
from rosproxy_operator.kubernetes.planner.allocation import ClusterRanges
from rosproxy_operator.kubernetes.planner.manifests import (
    Site,
    Upstream,
    finds_again,
    fingerprint_of,
    image_of,
    proxy_pod,
    service,
)
from rosproxy_operator.kubernetes.planner.retries import Retries, Task
from rosproxy_operator.kubernetes.planner.settings import ClusterSettings
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.planner.view import View, serves
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    ClusterSnapshot,
    Name,
    ProxyPlace,
    ProxyPod,
    ProxyService,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import proxy_id, service_id
from rosproxy_operator.kubernetes.resources.values import host_problem

LOST_FOR = 10.0
"""Seconds for which a node must be missing before its proxies are deleted."""


@dataclass(frozen=True, slots=True)
class ClusterContext:
    """Everything that the steps of all RosProxies are made from."""

    view: View
    settings: ClusterSettings
    state: ClusterState
    ranges: ClusterRanges
    retries: Retries
    now: float

    @property
    def observed(self) -> ClusterSnapshot:
        """What is seen."""
        return self.view.observed

    def left(self, place: ProxyPlace) -> float:
        """The seconds until the grace of a proxy ends that no pod wants any more."""
        grace = self.view.rosproxies[place.of].spec.grace
        return grace - (self.now - self.state.absent.get(place, self.now))

    def lost(self, node: str) -> float:
        """The seconds until a node that is missing counts as gone."""
        return LOST_FOR - (self.now - self.state.lost.get(node, self.now))


def upstream(rosproxy: RosProxy, observed: ClusterSnapshot) -> tuple[Upstream | None, str]:
    """Where a RosProxy's master is, else what is wrong."""
    master = rosproxy.spec.master
    if master.service is None:
        return Upstream(master.uri, master.address), ""
    address, problem = observed.masters.get(master.service, ("", "is not known yet"))
    if problem:
        return None, f"spec.master.service: Service {master.service} {problem}"
    host = f"{master.service.name}.{master.service.namespace}.svc"
    return Upstream(f"http://{host}:{master.service_port}", address), ""


def advertise_host(rosproxy: RosProxy, node: ClusterNode) -> tuple[str, str]:
    """Under which name or address outside reaches a node, else what is wrong."""
    by_annotation = node.advertise_host
    if by_annotation:
        problem = host_problem(by_annotation)
        where = "its annotation rosproxy.io/advertise-host"
        return ("", f"{where}: {problem}") if problem else (by_annotation, "")
    wanted = rosproxy.spec.advertise.value
    found = node.addresses.get(wanted, "")
    if found:
        return found, ""
    there = ", ".join(sorted(node.addresses)) or "none at all"
    return "", (
        f"it has no address of type {wanted} (it has: {there}): set another "
        f"spec.advertise, or kubectl annotate node {node.name} rosproxy.io/advertise-host=HOST"
    )


def obstacle(context: ClusterContext, place: ProxyPlace) -> tuple[str, str]:
    """What keeps the proxy of a place from being made or changed: reason and text, or nothing.

    The text is told with the node's name before it.
    """
    of, node = context.view.rosproxies[place.of], context.observed.nodes[place.node]
    if not node.ready:
        text = "is not ready: nothing is changed there until it is: kubectl describe node"
        return "NodeNotReady", f"{text} {node.name}"
    _, problem = upstream(of, context.observed)
    if problem:
        return "MasterUnknown", problem
    _, problem = advertise_host(of, node)
    if problem:
        return "NoAdvertiseHost", problem
    if place in context.ranges.exhausted:
        return "PortsExhausted", context.ranges.exhausted[place]
    name = proxy_id(place.of, place.node)
    own = {one.pod.uid for one in context.observed.proxies}
    if any(pod.id == name and pod.uid not in own for pod in context.observed.pods):
        text = "is there already, and is not the operator's: delete or rename it"
        return "NameTaken", f"a pod called {name} {text}"
    return "", ""


def service_of(observed: ClusterSnapshot, of: Name) -> ProxyService | None:
    """The Service of a RosProxy, whoever it was made for."""
    return next((one for one in observed.services.values() if one.of == of), None)


def reconcile_service(context: ClusterContext, of: RosProxy) -> Iterator[Action]:
    """The Service of a RosProxy, made if it is not there, made anew if it is not right."""
    there, name = service_of(context.observed, of.id), service_id(of.id)
    body = service(of, _cluster_ip(context, of))
    if there is None:
        if context.retries.ask(Task(of.id, "create", str(name))):
            yield CreateService(of.id, body)
    elif there.owner != of.uid or there.fingerprint != fingerprint_of(body):
        why = "it is that of a RosProxy that is gone"
        yield from delete_service(context, there, why if there.owner != of.uid else "made anew")


def delete_service(context: ClusterContext, there: ProxyService, why: str) -> Iterator[Action]:
    """Delete a Service, if that is not being done."""
    name = service_id(there.of)
    if not there.deleting and context.retries.ask(Task(there.of, "delete", str(name), there.uid)):
        yield DeleteService(there.of, name, there.uid, why)


def _cluster_ip(context: ClusterContext, of: RosProxy) -> str:
    """The address that pods of a RosProxy have been given already, if any."""
    wired = (parse_slave_uri(pod.wired) for pod in context.view.taken.get(of.id, ()))
    hosts = Counter(where.host for where in wired if where and is_address(where.host))
    common = min(hosts, key=lambda host: (-hosts[host], host), default="")
    return of.cluster_ip or common


def site_of(context: ClusterContext, place: ProxyPlace) -> Site | None:
    """The proxy that a place is to have; None if that can't be said."""
    of, node = context.view.rosproxies[place.of], context.observed.nodes[place.node]
    master, _ = upstream(of, context.observed)
    host, _ = advertise_host(of, node)
    ports = context.ranges.given.get(place)
    if master is None or not host or ports is None:
        return None
    publish = of.spec.master.publish if place in context.ranges.published else 0
    return Site(of, node, host, ports, master, publish)


def reconcile_proxy(context: ClusterContext, place: ProxyPlace) -> Iterator[Action]:
    """The next actions for a RosProxy's proxy on a node."""
    if place in context.view.wanted:
        if not obstacle(context, place)[0]:
            yield from _wanted(context, place)
        else:
            _note(context, place)
    elif _is_over(context, place):
        there = place.node in context.observed.nodes
        grace = f"{context.view.rosproxies[place.of].spec.grace:g}"
        why = f"no pod on node {place.node} wants it since {grace} s"
        for one in context.view.proxies[place]:
            yield from delete_proxy(context, one, why if there else "its node is gone", there)


def _is_over(context: ClusterContext, place: ProxyPlace) -> bool:
    node = context.observed.nodes.get(place.node)
    if node is None:
        return context.lost(place.node) <= 0
    return node.ready and not node.deleting and context.left(place) <= 0


def delete_proxy(
    context: ClusterContext, one: ProxyPod, why: str, retire: bool = False
) -> Iterator[Action]:
    """Delete a proxy, if that is not being done.

    One that is to be retired may be on its way already: the garbage collector is quick.
    """
    task = Task(one.of, "delete", str(one.pod.id), one.pod.uid)
    node = context.observed.nodes.get(one.on)
    runs = serves(one) and node is not None and node.ready
    useful = not one.pod.deleting or (retire and runs)
    if useful and context.retries.ask(task):
        yield DeleteProxy(one.of, one.pod.id, one.pod.uid, why, retire)


def _wanted(context: ClusterContext, place: ProxyPlace) -> Iterator[Action]:
    site, name = site_of(context, place), proxy_id(place.of, place.node)
    misplaced = context.view.misplaced(place)
    if site is None or misplaced:
        for one in misplaced:
            yield from delete_proxy(context, one, "a proxy is not called so (any more)")
        return
    current = context.view.current(place)
    if current is not None:
        yield from _tended(context, place, current, site)
    elif any(one.pod.id == name for one in context.observed.proxies):
        _note(context, place)  # it is about to go
    elif context.retries.ask(_creation(place)):
        yield CreateProxy(place.of, place.node, proxy_pod(site, context.settings))


def _tended(
    context: ClusterContext, place: ProxyPlace, one: ProxyPod, site: Site
) -> Iterator[Action]:
    _note(context, place)
    image = image_of(site.rosproxy, context.settings)
    if one.pod.ended:
        yield from delete_proxy(context, one, f"it has ended: {one.message or one.pod.phase}")
    elif one.fingerprint != (print_ := fingerprint_of(proxy_pod(site, context.settings))):
        moved = one.range.first != site.ports.first
        lost = serves(one) and (moved or not finds_again(one.fingerprint, print_))
        yield from delete_proxy(context, one, _change(one, site), retire=lost)
    elif one.image != image:
        task = Task(place.of, "image", str(one.pod.id), f"{one.pod.uid} {image}")
        if context.retries.ask(task):
            yield SetImage(place.of, one.pod.id, one.pod.uid, image)


def _note(context: ClusterContext, place: ProxyPlace) -> None:
    """Keep count of how often a proxy was made, as long as it is not well."""
    current = context.view.current(place)
    if current is None or not serves(current):
        context.retries.effect(_creation(place))


def _creation(place: ProxyPlace) -> Task:
    return Task(place.of, "create", str(proxy_id(place.of, place.node)))


def _change(one: ProxyPod, site: Site) -> str:
    if one.range != site.ports:
        return f"made anew: its ports are to be {site.ports} instead of {one.range}"
    return "made anew: its RosProxy, its node or the operator's options have changed"


def reconcile_orphans(context: ClusterContext) -> Iterator[Action]:
    """Delete what belongs to RosProxies that are gone. The API server may come first."""
    for one in context.view.orphans:
        # Where another RosProxy of this name takes over, it finds their nodes at the master.
        takes_over = one.of in context.view.rosproxies
        yield from delete_proxy(context, one, "its RosProxy is gone", retire=not takes_over)
    unusable = {one.uid for one in context.observed.unusable.values()}
    for there in context.observed.services.values():
        if there.of not in context.view.rosproxies and there.owner not in unusable:
            yield from delete_service(context, there, "its RosProxy is gone")


def ends(context: ClusterContext) -> Iterator[float]:
    """In how many seconds something comes to its end that no event tells."""
    for place in context.state.absent:
        node = context.observed.nodes.get(place.node)
        if place.of in context.view.rosproxies and node is not None and node.ready:
            left = context.left(place)
            if left > 0:
                yield left
    lost = map(context.lost, context.state.lost)
    yield from (left for left in lost if left > 0)


def nodes_by_rosproxy(context: ClusterContext) -> Mapping[Name, tuple[str, ...]]:
    """The nodes that the status of each RosProxy names."""
    found: dict[Name, set[str]] = {
        of: set(one.former) for of, one in context.view.rosproxies.items()
    }
    for place in context.view.places():
        found[place.of].add(place.node)
    return {of: tuple(sorted(nodes & set(context.observed.nodes))) for of, nodes in found.items()}
