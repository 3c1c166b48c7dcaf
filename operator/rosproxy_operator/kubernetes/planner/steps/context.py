"""What the steps of all RosProxies are made from, and what a proxy is to have on a node."""

import msgspec
from msgspec.structs import replace

from rosproxy.setting_kinds import hash_token
from rosproxy_operator.kubernetes.planner.allocation import ClusterRanges
from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.planner.manifests import STOPS_WITHIN, ProxySite
from rosproxy_operator.kubernetes.planner.retries import Retries
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.checks import host_problem
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    Obstacle,
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
    token_of,
)
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.refusal_fixes import OF_ANOTHER

LOST_FOR = 10.0
"""Seconds for which a node must be missing before its proxies are deleted."""
TORN_DOWN_WITHIN_S = STOPS_WITHIN + 3.0
"""Seconds in which a kubelet ends a pod that was deleted by force, and takes its hostPorts back.

If a new pod gets the same ports earlier, the former one's rules still come first. Datagrams that
go on coming to a port are then led to the former pod's address for good: the CNI plug-in portmap
deletes conntrack entries when a pod comes, and not when it goes (containernetworking/plugins 1277).
"""


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

    def seconds_until_torn_down(self, place: ProxyPlace) -> float:
        """The seconds until a proxy's former pod holds no UDP ports any more for certain."""
        since = self.observed.vanished.get(place)
        takes_udp = self.view.rosproxies[place.of].spec.takes_udp
        return 0.0 if since is None or not takes_udp else TORN_DOWN_WITHIN_S - (self.now - since)

    def seconds_until_lost(self, node: str) -> float:
        """The seconds until a node that is missing counts as gone."""
        return LOST_FOR - (self.now - self.state.lost.get(node, self.now))


def master_of(rosproxy: RosProxy, observed: ClusterSnapshot) -> tuple[MasterSpec | None, str]:
    """A RosProxy's master as its proxies are told it, else what is wrong; for ROS 2 it is empty."""
    master = rosproxy.spec.master
    if master.service is None:
        return master, ""
    address, problem = observed.masters.get(master.service, ("", "is not listed yet"))
    if problem:
        return None, f"spec.master.service: Service {master.service} {problem}"
    host = f"{master.service.name}.{master.service.namespace}.svc"
    return replace(master, uri=f"http://{host}:{master.service_port}", address=address), ""


def advertise_host(rosproxy: RosProxy, node: ClusterNode) -> tuple[str, str]:
    """Under which name or address outside reaches a node, else what is wrong."""
    if node.advertise_host:
        problem = host_problem(node.advertise_host)
        fix = "Give the name or address at which outside reaches the node"
        text = f"annotation rosproxy.io/advertise-host: {problem}. {fix}"
        return ("", text) if problem else (node.advertise_host, "")
    wanted_type = rosproxy.spec.advertise.value
    if address := node.addresses.get(wanted_type):
        return address, ""
    types = ", ".join(sorted(node.addresses)) or "none"
    return "", (
        f"has no address of type {wanted_type} (types of its addresses: {types}). Set another "
        f"spec.advertise, or run kubectl annotate node {node.name} rosproxy.io/advertise-host=HOST"
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
        text = "is not ready. Until the node is ready, the operator changes nothing there. Read"
        return Obstacle("NodeNotReady", f"{text} kubectl describe node {node.name}")
    master, problem = master_of(rosproxy, context.observed)
    if master is None:
        return Obstacle("MasterUnknown", problem)
    host, problem = advertise_host(rosproxy, node)
    if rosproxy.spec.ros2 and ":" in host:
        problem = f"advertised host {host} is an IPv6 address, and for ROS 2 a proxy uses IPv4 only"
        command = f"kubectl annotate node {node.name} rosproxy.io/advertise-host=ADDRESS"
        problem += f". Give an IPv4 address: run {command}"
    if problem:
        return Obstacle("NoAdvertiseHost", problem)
    if place in context.ranges.exhausted:
        return Obstacle("PortsExhausted", context.ranges.exhausted[place])
    name = proxy_id(place.of, place.node)
    if name in context.view.other_pod_names:
        text = f"a pod {name} exists already that {OF_ANOTHER}"
        return Obstacle("NameTaken", f"{text}. Delete that pod, or create it under another name")
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
    """The peers of a proxy: those that its RosProxy names, and the proxies on other nodes.

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
