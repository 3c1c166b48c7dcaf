"""What is to be done for one RosProxy: its Service, and its proxy on each node.

Each function compares the object that is wanted with the one that exists and yields the next
action; the rest follows at later looks. Only the fingerprint on an object says whether it is as it
ought to be. A pod that differs is deleted and made anew under the same name, but for its image,
which can be exchanged. `retries` keeps actions without effect from being repeated at once.
"""

from collections import Counter
from collections.abc import Iterator

import msgspec
from msgspec.structs import replace

from rosproxy.net.addresses import is_address
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.setting_kinds import hash_token
from rosproxy_operator.common.port_negotiation import RETRY_FOR
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
from rosproxy_operator.kubernetes.planner.cluster_view import View, serves
from rosproxy_operator.kubernetes.planner.manifests import ProxySite
from rosproxy_operator.kubernetes.planner.retries import Retries, Task
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.checks import host_problem
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
from rosproxy_operator.kubernetes.resources.names import (
    proxy_id,
    relay_secret_of,
    service_id,
    token_of,
)
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
    sites: dict[ProxyPlace, ProxySite | Obstacle] = {}

    @property
    def observed(self) -> ClusterSnapshot:
        """What is seen."""
        return self.view.observed

    def cluster_ip(self, rosproxy: RosProxy) -> str:
        """The address of a RosProxy's Service; empty if it has none, or is another RosProxy's."""
        service = self.observed.services.get(rosproxy.id)
        return service.cluster_ip if service and service.owner == rosproxy.uid else ""

    def grace_left(self, place: ProxyPlace) -> float:
        """The seconds until the grace of a proxy ends that no pod wants any more."""
        grace = self.view.rosproxies[place.of].spec.grace
        return grace - (self.now - self.state.absent.get(place, self.now))

    def seconds_until_lost(self, node: str) -> float:
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
        subject = "its annotation rosproxy.io/advertise-host"
        return ("", f"{subject}: {problem}") if problem else (node.advertise_host, "")
    wanted_type = rosproxy.spec.advertise.value
    if address := node.addresses.get(wanted_type):
        return address, ""
    types = ", ".join(sorted(node.addresses)) or "none at all"
    return "", (
        f"it has no address of type {wanted_type} (it has: {types}): set another "
        f"spec.advertise, or kubectl annotate node {node.name} rosproxy.io/advertise-host=HOST"
    )


def site_of(context: ClusterContext, place: ProxyPlace) -> ProxySite | Obstacle:
    """The proxy that a place is to have where pods want one, or why it can't."""
    if place not in context.sites:
        context.sites[place] = _site_of(context, place)
    return context.sites[place]


def _site_of(context: ClusterContext, place: ProxyPlace) -> ProxySite | Obstacle:
    rosproxy = context.view.rosproxies[place.of]
    node = context.observed.nodes[place.node]
    if not node.ready:
        text = "is not ready: nothing is changed there until it is: kubectl describe node"
        return Obstacle("NodeNotReady", f"{text} {node.name}")
    master, problem = master_of(rosproxy, context.observed)
    if master is None:
        return Obstacle("MasterUnknown", problem)
    host, problem = advertise_host(rosproxy, node)
    if rosproxy.spec.ros2 and ":" in host:
        problem = f"its address {host} can't be advertised for ROS 2, which has IPv4 alone"
        problem += f": kubectl annotate node {node.name} rosproxy.io/advertise-host=ADDRESS"
    if problem:
        return Obstacle("NoAdvertiseHost", problem)
    if place in context.ranges.exhausted:
        return Obstacle("PortsExhausted", context.ranges.exhausted[place])
    name = proxy_id(place.of, place.node)
    if name in context.view.other_pod_names:
        text = "is there already, and is not the operator's: delete or rename it"
        return Obstacle("NameTaken", f"a pod called {name} {text}")
    publish = master.publish if place in context.ranges.published else 0
    token = token_of(context.observed.key, name, node.name)
    ports = context.ranges.given[place]
    published = replace(master, publish=publish)
    token_hash = hash_token(token) if token else ""
    return ProxySite(
        rosproxy,
        node,
        host,
        ports,
        published,
        token_hash,
        peers_of(context, place),
        relay_secret_of(context.observed.key, name, node.name),
    )


def peers_of(context: ClusterContext, place: ProxyPlace) -> tuple[str, ...]:
    """Whom a proxy tells of its participants: peers that its RosProxy names, and its other proxies.

    The other proxies are found at the first port of their range.
    """
    rosproxy = context.view.rosproxies[place.of]
    nodes = context.observed.nodes
    if rosproxy.spec.ros2 is None:
        return ()
    peers = set(rosproxy.spec.ros2.peers)
    for other_place in context.view.places.get(place.of, ()):
        ports = context.ranges.given.get(other_place)
        if other_place != place and ports is not None and other_place.node in nodes:
            host, problem = advertise_host(rosproxy, nodes[other_place.node])
            if not problem and ":" not in host:
                peers.add(f"{host}:{ports.first}")
    return tuple(sorted(peers))


def peers(context: ClusterContext) -> dict[str, tuple[str, ...]]:
    """What the proxies for ROS 2 are told of their peers, by the uid of their pod."""
    return {
        proxy.pod.uid: peers_of(context, place)
        for place, proxy in context.view.current.items()
        if context.view.rosproxies[place.of].spec.ros2
    }


def reconcile_service(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """The Service of a RosProxy, made if it is not there, made anew if it is not right."""
    pods = context.view.selected_pods.get(rosproxy.id, ())
    wired = (master.host for pod in pods if (master := parse_slave_uri(pod.wired_master_uri)))
    static_peers = (pod.static_peers for pod in pods if not pod.wired_master_uri)
    hosts = Counter(host for host in (*wired, *static_peers) if is_address(host))
    # The address that its pods have been given already, if any.
    common = min(hosts, key=lambda host: (-hosts[host], host), default="")
    body = manifests.service(rosproxy, rosproxy.cluster_ip or common)
    service = context.observed.services.get(rosproxy.id)
    if service is None:
        if context.retries.is_due(Task(rosproxy.id, "create", service_id(rosproxy.id))):
            yield CreateService(rosproxy.id, body)
    elif service.owner != rosproxy.uid:
        yield from _delete_service(context, service, "it belongs to a RosProxy that is gone")
    elif service.fingerprint != manifests.fingerprint_of(body):
        yield from _delete_service(
            context, service, "made anew: its RosProxy or the operator has changed"
        )


def _delete_service(context: ClusterContext, service: ProxyService, why: str) -> Iterator[Action]:
    """Delete a Service, unless it is being deleted already."""
    name = service_id(service.of)
    if not service.deleting and context.retries.is_due(
        Task(service.of, "delete", name, service.uid)
    ):
        yield DeleteService(service.of, name, service.uid, why)


def reconcile_proxies(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """The next actions for a RosProxy's proxies.

    Proxies that are made anew for another setting alone, on the same ports and with the same
    master, are so one after the other: a proxy waits until the others run again. If they can't be
    made any more, for example by a new rule of the cluster, the remaining ones go on.
    """
    places = context.view.places.get(rosproxy.id, ())
    busy = any(_is_starting(context, place) for place in places)
    for place in places:
        actions = [*_reconcile_proxy(context, place, busy)]
        wanted = place in context.view.wanted
        busy = busy or (wanted and any(isinstance(action, DeleteProxy) for action in actions))
        yield from actions


def _is_starting(context: ClusterContext, place: ProxyPlace) -> bool:
    """Whether a proxy is wanted that can be had, and does not run yet."""
    current = context.view.current.get(place)
    if place not in context.view.wanted or isinstance(site_of(context, place), Obstacle):
        return False
    return current is None or not (serves(current) or current.stuck)


def _reconcile_proxy(context: ClusterContext, place: ProxyPlace, busy: bool) -> Iterator[Action]:
    """The next actions for a proxy on a node; ``busy`` if another proxy is to come first."""
    node = context.observed.nodes.get(place.node)
    proxies = context.view.proxies.get(place, ())
    if place in context.view.wanted:
        site = site_of(context, place)
        if isinstance(site, Obstacle):
            _note_creation(context, place)
        else:
            yield from _ensure(context, place, site, busy)
    elif node is None:
        for proxy in proxies if context.seconds_until_lost(place.node) <= 0 else ():
            yield from _delete_pod(context, proxy, "its node is gone")
    elif node.ready and not node.deleting and context.grace_left(place) <= 0:
        grace = context.view.rosproxies[place.of].spec.grace
        for proxy in proxies:
            why = f"no pod on node {place.node} has needed it for {grace:g} s"
            yield from _delete_pod(context, proxy, why, retire=True)


def _ensure(
    context: ClusterContext, place: ProxyPlace, site: ProxySite, busy: bool
) -> Iterator[Action]:
    """The next action for a proxy that is wanted, and can be had as the site says."""
    name = proxy_id(place.of, place.node)
    current = context.view.current.get(place)
    misplaced = [p for p in context.view.proxies.get(place, ()) if p.pod.id != name]
    if misplaced:
        for proxy in misplaced:
            yield from _delete_pod(context, proxy, "its name is not that of this node's proxy")
    elif name in context.view.names:
        _note_creation(context, place)
        if current is not None:  # else its pod is about to go
            yield from _update(context, current, site, busy)
    elif context.retries.is_due(_creation(place)):
        yield CreateProxy(place.of, manifests.proxy_pod(site, context.settings))


def _update(
    context: ClusterContext, proxy: ProxyPod, site: ProxySite, busy: bool
) -> Iterator[Action]:
    image = manifests.image_of(site.rosproxy, context.settings)
    fingerprint = manifests.proxy_fingerprint(site, context.settings)
    task = Task(proxy.of, "image", proxy.pod.id, f"{proxy.pod.uid} {image}")
    if proxy.pod.ended:
        yield from _delete_pod(context, proxy, f"it has ended: {proxy.message or proxy.pod.phase}")
    elif proxy.fingerprint != fingerprint:
        # If the next proxy can't find these nodes at the master, this one unregisters them. A range
        # with the same first port has grown or shrunk at its end: what is left of it is the same.
        moved = proxy.range.first != site.ports.first
        lost = moved or not manifests.keeps_registrations(proxy.fingerprint, fingerprint)
        diff = "its RosProxy, its node or the operator's options have changed"
        if proxy.range != site.ports:
            diff = f"its ports are to be {site.ports} instead of {proxy.range}"
        elif busy and serves(proxy) and not lost:
            context.retries.look_again_in(IN_TURN)
            return
        yield from _delete_pod(context, proxy, f"made anew: {diff}", retire=serves(proxy) and lost)
    elif proxy.image != image and context.retries.is_due(task):
        yield SetImage(proxy.of, proxy.pod.id, proxy.pod.uid, image)


def _delete_pod(
    context: ClusterContext, proxy: ProxyPod, why: str, retire: bool = False
) -> Iterator[Action]:
    """Delete a proxy's pod, unless it is being deleted already.

    One that is to be retired may be so: the garbage collector is quick.
    """
    node = context.observed.nodes.get(proxy.node)
    runs = serves(proxy) and node is not None and node.ready
    useful = not proxy.pod.deleting or (retire and runs)
    if useful and context.retries.is_due(Task(proxy.of, "delete", proxy.pod.id, proxy.pod.uid)):
        yield DeleteProxy(proxy.of, proxy.pod.id, proxy.pod.uid, why, retire)


def _note_creation(context: ClusterContext, place: ProxyPlace) -> None:
    """Keep count of how often a proxy was made, as long as it is not well."""
    current = context.view.current.get(place)
    if current is None or not serves(current):
        context.retries.note_effect(_creation(place))


def _creation(place: ProxyPlace) -> Task:
    return Task(place.of, "create", proxy_id(place.of, place.node))


def reconcile_orphans(context: ClusterContext) -> Iterator[Action]:
    """Delete what belongs to RosProxies that are gone. The API server may come first."""
    for proxy in context.view.orphans:
        # Where another RosProxy of this name takes over, it finds their nodes at the master.
        takes_over = proxy.of in context.view.rosproxies
        yield from _delete_pod(context, proxy, "its RosProxy is gone", retire=not takes_over)
    unusable = {r.uid for r in context.observed.unusable.values()}
    for service in context.observed.services.values():
        if service.of not in context.view.rosproxies and service.owner not in unusable:
            yield from _delete_service(context, service, "its RosProxy is gone")


def ends(context: ClusterContext) -> Iterator[float]:
    """In how many seconds each period ends whose end no event tells."""
    ready = {name for name, node in context.observed.nodes.items() if node.ready}
    yield from (context.grace_left(place) for place in context.state.absent if place.node in ready)
    yield from map(context.seconds_until_lost, context.state.lost)
    yield from (at + RETRY_FOR - context.now for at in context.state.refused.values())
