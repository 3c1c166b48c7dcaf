"""What is to be done for one RosProxy: its Service, and its proxy on each node.

Each function compares what is wanted of an object with what is there and yields the next action;
the rest follows with the looks after it. Only the fingerprint on an object says whether it is as it
ought to be. A pod that differs is deleted and made anew under the same name, but for its image,
which can be exchanged. `retries` keeps actions without effect from being repeated at once.
"""

from collections import Counter
from collections.abc import Iterator

import msgspec
from msgspec.structs import replace

from rosproxy.net.addresses import is_address
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.settings import hash_token
from rosproxy_operator.common.allocation import RETRY_FOR
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateProxy,
    CreateService,
    DeleteProxy,
    DeleteService,
    SetImage,
)
from rosproxy_operator.kubernetes.planner.allocation import ClusterRanges
from rosproxy_operator.kubernetes.planner.manifests import Site
from rosproxy_operator.kubernetes.planner.retries import Retries, Task
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.planner.view import View, serves
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    Obstacle,
    ProxyPod,
    ProxyService,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    MasterSpec,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import proxy_id, service_id, token_of
from rosproxy_operator.kubernetes.resources.values import host_problem
from rosproxy_operator.kubernetes.settings import ClusterSettings

LOST_FOR = 10.0
"""Seconds for which a node must be missing before its proxies are deleted."""
IN_TURN = 1.0
"""Seconds after which it is looked again whether the next proxy can be made anew."""


class ClusterContext(msgspec.Struct, frozen=True):
    """Everything that the steps of all RosProxies are made from.

    ``sites`` are those that have been worked out already: each is asked for several times.
    """

    view: View
    settings: ClusterSettings
    state: ClusterState
    ranges: ClusterRanges
    retries: Retries
    now: float
    sites: dict[ProxyPlace, Site | Obstacle] = {}

    @property
    def observed(self) -> ClusterSnapshot:
        """What is seen."""
        return self.view.observed

    def cluster_ip(self, of: RosProxy) -> str:
        """The address of a RosProxy's Service; empty if it has none, or is that of another one."""
        there = self.observed.services.get(of.id)
        return there.cluster_ip if there and there.owner == of.uid else ""

    def left(self, place: ProxyPlace) -> float:
        """The seconds until the grace of a proxy ends that no pod wants any more."""
        grace = self.view.rosproxies[place.of].spec.grace
        return grace - (self.now - self.state.absent.get(place, self.now))

    def lost(self, node: str) -> float:
        """The seconds until a node that is missing counts as gone."""
        return LOST_FOR - (self.now - self.state.lost.get(node, self.now))


def master_of(rosproxy: RosProxy, observed: ClusterSnapshot) -> tuple[MasterSpec | None, str]:
    """A RosProxy's master as its proxies are told it, else what is wrong; for ROS 2 it is empty."""
    master = rosproxy.spec.master
    if master.service is None:
        return master, ""
    address, problem = observed.masters.get(master.service, ("", "is not known yet"))
    if problem:
        return None, f"spec.master.service: Service {master.service} {problem}"
    host = f"{master.service.name}.{master.service.namespace}.svc"
    return replace(master, uri=f"http://{host}:{master.service_port}", address=address), ""


def advertise_host(rosproxy: RosProxy, node: ClusterNode) -> tuple[str, str]:
    """Under which name or address outside reaches a node, else what is wrong."""
    if node.advertise_host:
        problem = host_problem(node.advertise_host)
        where = "its annotation rosproxy.io/advertise-host"
        return ("", f"{where}: {problem}") if problem else (node.advertise_host, "")
    wanted = rosproxy.spec.advertise.value
    if found := node.addresses.get(wanted):
        return found, ""
    there = ", ".join(sorted(node.addresses)) or "none at all"
    return "", (
        f"it has no address of type {wanted} (it has: {there}): set another "
        f"spec.advertise, or kubectl annotate node {node.name} rosproxy.io/advertise-host=HOST"
    )


def site_of(context: ClusterContext, place: ProxyPlace) -> Site | Obstacle:
    """The proxy that a place is to have where pods want one, or why it can't."""
    if place not in context.sites:
        context.sites[place] = _site_of(context, place)
    return context.sites[place]


def _site_of(context: ClusterContext, place: ProxyPlace) -> Site | Obstacle:
    of, node = context.view.rosproxies[place.of], context.observed.nodes[place.node]
    if not node.ready:
        text = "is not ready: nothing is changed there until it is: kubectl describe node"
        return Obstacle("NodeNotReady", f"{text} {node.name}")
    master, problem = master_of(of, context.observed)
    if master is None:
        return Obstacle("MasterUnknown", problem)
    host, problem = advertise_host(of, node)
    if of.spec.ros2 and ":" in host:
        problem = f"its address {host} can't be advertised for ROS 2, which has IPv4 alone"
        problem += f": kubectl annotate node {node.name} rosproxy.io/advertise-host=ADDRESS"
    if problem:
        return Obstacle("NoAdvertiseHost", problem)
    if place in context.ranges.exhausted:
        return Obstacle("PortsExhausted", context.ranges.exhausted[place])
    name = proxy_id(place.of, place.node)
    if name in context.view.others:
        text = "is there already, and is not the operator's: delete or rename it"
        return Obstacle("NameTaken", f"a pod called {name} {text}")
    publish = master.publish if place in context.ranges.published else 0
    token = token_of(context.observed.key, name, node.name)
    ports, told = context.ranges.given[place], replace(master, publish=publish)
    hashed = hash_token(token) if token else ""
    return Site(of, node, host, ports, told, hashed, peers_of(context, place))


def peers_of(context: ClusterContext, place: ProxyPlace) -> tuple[str, ...]:
    """Whom a proxy tells of its participants: whom its RosProxy names, and its other proxies.

    Those are found at the first port of their range.
    """
    of, nodes = context.view.rosproxies[place.of], context.observed.nodes
    if of.spec.ros2 is None:
        return ()
    peers = set(of.spec.ros2.peers)
    for other in context.view.places.get(place.of, ()):
        ports = context.ranges.given.get(other)
        if other != place and ports is not None and other.node in nodes:
            host, problem = advertise_host(of, nodes[other.node])
            if not problem and ":" not in host:
                peers.add(f"{host}:{ports.first}")
    return tuple(sorted(peers))


def peers(context: ClusterContext) -> dict[str, tuple[str, ...]]:
    """What the proxies for ROS 2 are told of their peers, by the uid of their pod."""
    return {
        one.pod.uid: peers_of(context, place)
        for place, one in context.view.current.items()
        if context.view.rosproxies[place.of].spec.ros2
    }


def reconcile_service(context: ClusterContext, of: RosProxy) -> Iterator[Action]:
    """The Service of a RosProxy, made if it is not there, made anew if it is not right."""
    pods = context.view.taken.get(of.id, ())
    wired = (where.host for pod in pods if (where := parse_slave_uri(pod.wired)))
    told = (pod.static_peers for pod in pods if not pod.wired)
    hosts = Counter(host for host in (*wired, *told) if is_address(host))
    # The address that its pods have been given already, if any.
    common = min(hosts, key=lambda host: (-hosts[host], host), default="")
    body = manifests.service(of, of.cluster_ip or common)
    there = context.observed.services.get(of.id)
    if there is None:
        if context.retries.ask(Task(of.id, "create", service_id(of.id))):
            yield CreateService(of.id, body)
    elif there.owner != of.uid:
        yield from _delete_service(context, there, "it is that of a RosProxy that is gone")
    elif there.fingerprint != manifests.fingerprint_of(body):
        yield from _delete_service(context, there, "made anew")


def _delete_service(context: ClusterContext, there: ProxyService, why: str) -> Iterator[Action]:
    """Delete a Service, if that is not being done."""
    name = service_id(there.of)
    if not there.deleting and context.retries.ask(Task(there.of, "delete", name, there.uid)):
        yield DeleteService(there.of, name, there.uid, why)


def reconcile_proxies(context: ClusterContext, of: RosProxy) -> Iterator[Action]:
    """The next actions for a RosProxy's proxies.

    What is made anew for another setting alone, on the same ports and with the same master, is so
    one after the other: a proxy waits until the others are there again. If they can't be made any
    more, by a new rule of the cluster for one, those that are left go on.
    """
    places = context.view.places.get(of.id, ())
    busy = any(_comes(context, place) for place in places)
    for place in places:
        actions = [*_reconcile_proxy(context, place, busy)]
        wanted = place in context.view.wanted
        busy = busy or (wanted and any(isinstance(one, DeleteProxy) for one in actions))
        yield from actions


def _comes(context: ClusterContext, place: ProxyPlace) -> bool:
    """Whether a proxy is wanted that can be had, and does not run yet."""
    current = context.view.current.get(place)
    if place not in context.view.wanted or isinstance(site_of(context, place), Obstacle):
        return False
    return current is None or not (serves(current) or current.stuck)


def _reconcile_proxy(context: ClusterContext, place: ProxyPlace, busy: bool) -> Iterator[Action]:
    """The next actions for a proxy on a node; ``busy`` if another one is to come first."""
    node, proxies = context.observed.nodes.get(place.node), context.view.proxies.get(place, ())
    if place in context.view.wanted:
        site = site_of(context, place)
        if isinstance(site, Obstacle):
            _note(context, place)
        else:
            yield from _wanted(context, place, site, busy)
    elif node is None:
        for one in proxies if context.lost(place.node) <= 0 else ():
            yield from _delete_proxy(context, one, "its node is gone")
    elif node.ready and not node.deleting and context.left(place) <= 0:
        grace = context.view.rosproxies[place.of].spec.grace
        for one in proxies:
            why = f"no pod on node {place.node} wants it since {grace:g} s"
            yield from _delete_proxy(context, one, why, retire=True)


def _wanted(context: ClusterContext, place: ProxyPlace, site: Site, busy: bool) -> Iterator[Action]:
    """The next action for a proxy that is wanted, and can be had as the site says."""
    name, current = proxy_id(place.of, place.node), context.view.current.get(place)
    misplaced = [one for one in context.view.proxies.get(place, ()) if one.pod.id != name]
    if misplaced:
        for one in misplaced:
            yield from _delete_proxy(context, one, "a proxy is not called so (any more)")
    elif name in context.view.names:
        _note(context, place)
        if current is not None:  # else it is about to go
            yield from _tended(context, current, site, busy)
    elif context.retries.ask(_creation(place)):
        yield CreateProxy(place.of, manifests.proxy_pod(site, context.settings))


def _tended(context: ClusterContext, one: ProxyPod, site: Site, busy: bool) -> Iterator[Action]:
    image = manifests.image_of(site.rosproxy, context.settings)
    fingerprint = manifests.proxy_fingerprint(site, context.settings)
    task = Task(one.of, "image", one.pod.id, f"{one.pod.uid} {image}")
    if one.pod.ended:
        yield from _delete_proxy(context, one, f"it has ended: {one.message or one.pod.phase}")
    elif one.fingerprint != fingerprint:
        moved = one.range.first != site.ports.first
        lost = moved or not manifests.finds_again(one.fingerprint, fingerprint)
        what = "its RosProxy, its node or the operator's options have changed"
        if one.range != site.ports:
            what = f"its ports are to be {site.ports} instead of {one.range}"
        elif busy and serves(one) and not lost:
            context.retries.later(IN_TURN)
            return
        yield from _delete_proxy(context, one, f"made anew: {what}", retire=serves(one) and lost)
    elif one.image != image and context.retries.ask(task):
        yield SetImage(one.of, one.pod.id, one.pod.uid, image)


def _delete_proxy(
    context: ClusterContext, one: ProxyPod, why: str, retire: bool = False
) -> Iterator[Action]:
    """Delete a proxy, if that is not being done.

    One that is to be retired may be on its way already: the garbage collector is quick.
    """
    node = context.observed.nodes.get(one.on)
    runs = serves(one) and node is not None and node.ready
    useful = not one.pod.deleting or (retire and runs)
    if useful and context.retries.ask(Task(one.of, "delete", one.pod.id, one.pod.uid)):
        yield DeleteProxy(one.of, one.pod.id, one.pod.uid, why, retire)


def _note(context: ClusterContext, place: ProxyPlace) -> None:
    """Keep count of how often a proxy was made, as long as it is not well."""
    current = context.view.current.get(place)
    if current is None or not serves(current):
        context.retries.effect(_creation(place))


def _creation(place: ProxyPlace) -> Task:
    return Task(place.of, "create", proxy_id(place.of, place.node))


def reconcile_orphans(context: ClusterContext) -> Iterator[Action]:
    """Delete what belongs to RosProxies that are gone. The API server may come first."""
    for one in context.view.orphans:
        # Where another RosProxy of this name takes over, it finds their nodes at the master.
        takes_over = one.of in context.view.rosproxies
        yield from _delete_proxy(context, one, "its RosProxy is gone", retire=not takes_over)
    unusable = {one.uid for one in context.observed.unusable.values()}
    for there in context.observed.services.values():
        if there.of not in context.view.rosproxies and there.owner not in unusable:
            yield from _delete_service(context, there, "its RosProxy is gone")


def ends(context: ClusterContext) -> Iterator[float]:
    """In how many seconds something comes to its end that no event tells."""
    ready = {name for name, node in context.observed.nodes.items() if node.ready}
    yield from (context.left(place) for place in context.state.absent if place.node in ready)
    yield from map(context.lost, context.state.lost)
    yield from (at + RETRY_FOR - context.now for at in context.state.refused.values())
