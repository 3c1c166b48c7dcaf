"""The input of the steps of a plan, and the site of a proxy: what the proxy needs on a node."""

from collections import Counter
from collections.abc import Iterator

import msgspec
from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.setting_kinds import hash_token
from rosproxy.shared.settings import MOST_ZENOH_HUBS
from rosproxy_operator.common.problem import EXHAUSTED, MASTER_UNKNOWN, NO_ADVERTISE_HOST, Fault
from rosproxy_operator.kubernetes.planner.allocation import ClusterRanges
from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.planner.manifests import TERMINATION_GRACE_S, ProxySite
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
    OUTSIDE_SERVICE_PORT,
    hub_address,
    proxy_id,
    relay_secret_of,
    token_of,
)
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.refusal_fixes import NOT_OURS

NODE_GONE_AFTER_S = 10.0
"""Seconds that a node must be missing before the operator deletes the node's proxies."""
TORN_DOWN_WITHIN_S = TERMINATION_GRACE_S + 3.0
"""Seconds in which a kubelet ends a pod that was deleted by force, and removes its hostPort rules.

If a new pod gets the same ports earlier, the rules of the former pod still come first. A steady
stream of datagrams to a port then goes to the address of the former pod for good. The reason: the
CNI plug-in portmap deletes conntrack entries when a pod starts, and not when a pod ends
(containernetworking/plugins 1277).
"""


class ClusterContext(msgspec.Struct, frozen=True):
    """The input of the steps of all RosProxies.

    ``now`` is in seconds of the operator's monotonic clock. ``sites`` is a cache of `site_of`, and
    ``others`` of `_others_of`.
    """

    view: View
    settings: ClusterSettings
    state: ClusterState
    ranges: ClusterRanges
    retries: Retries
    now: float
    sites: dict[ProxyPlace, ProxySite | Obstacle] = {}
    others: dict[ProxyPlace, tuple[str, ...]] = {}

    @property
    def observed(self) -> ClusterSnapshot:
        """The snapshot of the cluster."""
        return self.view.observed

    def cluster_ip(self, rosproxy: RosProxy) -> str:
        """The address of a RosProxy's Service; empty without a Service of this RosProxy.

        A Service of a deleted RosProxy of the same name does not count.
        """
        service = self.observed.services.get(rosproxy.id)
        return service.cluster_ip if service and service.owner == rosproxy.uid else ""

    def grace_left(self, place: ProxyPlace) -> float:
        """The seconds that are left of ``spec.grace`` for a proxy that no pod wants any more."""
        grace = self.view.rosproxies[place.of].spec.grace
        return grace - (self.now - self.state.absent.get(place, self.now))

    def seconds_until_torn_down(self, place: ProxyPlace) -> float:
        """The seconds until a proxy's former pod is sure to hold no UDP ports; 0 or less: now."""
        since = self.observed.vanished.get(place)
        takes_udp = self.view.rosproxies[place.of].spec.takes_udp
        return 0.0 if since is None or not takes_udp else TORN_DOWN_WITHIN_S - (self.now - since)

    def seconds_until_lost(self, node: str) -> float:
        """The seconds until a missing node counts as gone; 0 or less: now."""
        return NODE_GONE_AFTER_S - (self.now - self.state.lost.get(node, self.now))


def master_of(
    rosproxy: RosProxy, observed: ClusterSnapshot
) -> tuple[MasterSpec | None, Fault | None]:
    """Return the master for the proxies of a RosProxy, or None and the fault.

    For a Service, the URI has the Service's DNS name. Without ROS 1 the master is empty.
    """
    master = rosproxy.spec.master
    if master.service is None:
        return master, None
    address, fault = observed.masters.get(master.service, ("", Fault("is not listed yet")))
    if fault:
        text = f"spec.master.service: Service {master.service} {fault.text}"
        return None, Fault(text, fault.fix)
    host = f"{master.service.name}.{master.service.namespace}.svc"
    return replace(master, uri=f"http://{host}:{master.service_port}", address=address), None


def advertise_host(rosproxy: RosProxy, node: ClusterNode) -> tuple[str, Fault | None]:
    """Return the host name or address at which outside reaches a node, or "" and the fault.

    There is neither for rmw_zenoh: outside connects to no proxy.
    """
    if rosproxy.spec.zenoh:
        return "", None
    if node.advertise_host:
        problem = host_problem(node.advertise_host)
        fix = "Give the name or address at which outside reaches the node"
        fault = Fault(f"annotation rosproxy.io/advertise-host: {problem}", fix)
        return ("", fault) if problem else (node.advertise_host, None)
    wanted_type = rosproxy.spec.advertise.value
    if address := node.addresses.get(wanted_type):
        return address, None
    types = ", ".join(sorted(node.addresses)) or "none"
    return "", Fault(
        f"has no address of type {wanted_type} (types of its addresses: {types})",
        "Set another spec.advertise, or run kubectl annotate node "
        f"{node.name} rosproxy.io/advertise-host=HOST",
    )


def outside_address(context: ClusterContext, rosproxy: RosProxy) -> HostPort | None:
    """The address at which outside reaches the proxies for rmw_zenoh; None: no address yet.

    A port of the nodes leads to the proxies from all nodes. The address is that of the first node
    with a proxy: the external address, or else the internal one.
    """
    service = context.observed.outside_services.get(rosproxy.id)
    listen = rosproxy.spec.zenoh.listen if rosproxy.spec.zenoh else None
    if service is None or listen is None or service.owner != rosproxy.uid:
        return None
    if listen.type == "LoadBalancer":
        return HostPort(service.balancer, OUTSIDE_SERVICE_PORT) if service.balancer else None
    names = sorted(place.node for place in context.view.places.get(rosproxy.id, ()))
    nodes = filter(None, map(context.observed.nodes.get, names))
    addresses = (n.addresses.get("ExternalIP") or n.addresses.get("InternalIP") for n in nodes)
    ports = (HostPort(address, service.node_port) for address in addresses if address)
    return next(ports, None) if service.node_port else None


def site_of(context: ClusterContext, place: ProxyPlace) -> ProxySite | Obstacle:
    """Return the site of a wanted proxy, or the obstacle to this proxy.

    The place has to be in ``context.view.wanted``.
    """
    if place not in context.sites:
        context.sites[place] = _site_of(context, place)
    return context.sites[place]


def _site_of(context: ClusterContext, place: ProxyPlace) -> ProxySite | Obstacle:
    rosproxy = context.view.rosproxies[place.of]
    node = context.observed.nodes[place.node]
    if not node.ready:
        text = "is not ready. Until the node is ready, the operator changes nothing there"
        return Obstacle("NodeNotReady", text, f"Read kubectl describe node {node.name}")
    master, fault = master_of(rosproxy, context.observed)
    if master is None:
        return Obstacle(MASTER_UNKNOWN, *fault or Fault(""))
    host, fault = advertise_host(rosproxy, node)
    if rosproxy.spec.ros2 and ":" in host:
        fault = Fault(
            f"advertised host {host} is an IPv6 address, but the operator starts proxies for ROS 2 "
            "with IPv4 only",
            "Give an IPv4 address: run kubectl annotate node "
            f"{node.name} rosproxy.io/advertise-host=ADDRESS",
        )
    if fault:
        return Obstacle(NO_ADVERTISE_HOST, *fault)
    if place in context.ranges.exhausted:
        return Obstacle(EXHAUSTED, *context.ranges.exhausted[place])
    name = proxy_id(place.of, place.node)
    if name in context.view.other_pod_names:
        text = f"a pod {name} exists already that {NOT_OURS}"
        return Obstacle("NameTaken", text, "Delete that pod, or create it under another name")
    publish = master.publish if place in context.ranges.published else 0
    token = token_of(context.observed.key, name, node.name)
    ports = context.ranges.given[place]
    published = replace(master, publish=publish)
    token_hash = hash_token(token) if token else ""
    relay_secret = relay_secret_of(context.observed.key, name, node.name)
    return ProxySite(
        rosproxy,
        node,
        host,
        ports,
        published,
        token_hash,
        relay_secret=relay_secret,
        hub_certificate=context.observed.hub_certificates.get(place.of, ""),
    )


def peers_of(context: ClusterContext, place: ProxyPlace) -> tuple[str, ...]:
    """The ROS 2 peers of a proxy, sorted: the peers of the RosProxy, and proxies on other nodes.

    A proxy on another node is a peer at the first port of that proxy's range. A proxy with an IPv6
    advertised host is no peer, because proxies use only IPv4 for ROS 2.
    """
    return _others_of(context, place) if context.view.rosproxies[place.of].spec.ros2 else ()


def hubs_of(context: ClusterContext, place: ProxyPlace) -> tuple[str, ...]:
    """The hubs of other nodes that a proxy for rmw_zenoh dials, sorted.

    A hub beyond the bound is dialed by no hub, and dials the hubs within the bound itself.
    """
    is_hub = context.view.rosproxies[place.of].spec.zenoh is not None
    return _others_of(context, place)[:MOST_ZENOH_HUBS] if is_hub else ()


def peers(context: ClusterContext) -> dict[str, tuple[str, ...]]:
    """The peers of each proxy for ROS 2, by the uid of the proxy's pod."""
    return {
        proxy.pod.uid: peers_of(context, place)
        for place, proxy in context.view.current.items()
        if context.view.rosproxies[place.of].spec.ros2
    }


def _others_of(context: ClusterContext, place: ProxyPlace) -> tuple[str, ...]:
    """The peers of the RosProxy, and the addresses of the RosProxy's other proxies; sorted."""
    if place not in context.others:
        context.others.update(_others(context, context.view.rosproxies[place.of]))
    return context.others[place]


def _others(
    context: ClusterContext, rosproxy: RosProxy
) -> Iterator[tuple[ProxyPlace, tuple[str, ...]]]:
    """Yield the addresses for each place of a RosProxy: see `_others_of`.

    All lists together grow with the square of the nodes. So each list is a copy of one sorted list,
    without the proxy's own address.
    """
    places = context.view.places[rosproxy.id]
    addresses = {place: _address_of(context, rosproxy, place) for place in places}
    named = rosproxy.spec.ros2.peers if rosproxy.spec.ros2 else ()
    counts = Counter(filter(None, (*named, *addresses.values())))
    everyone = tuple(sorted(counts))
    # An address that the RosProxy names, or that another proxy has as well, stays.
    positions = {address: at for at, address in enumerate(everyone) if counts[address] == 1}
    for place, address in addresses.items():
        at = positions.get(address, len(everyone))
        yield place, everyone[:at] + everyone[at + 1 :]


def _address_of(context: ClusterContext, rosproxy: RosProxy, place: ProxyPlace) -> str:
    """The address at which other proxies of the RosProxy reach a proxy; empty without one."""
    node = context.observed.nodes.get(place.node)
    if node is None:
        return ""
    if rosproxy.spec.zenoh:
        return str(hub_address(place.of, place.node))
    ports = context.ranges.given.get(place)
    host, _ = advertise_host(rosproxy, node)
    return f"{host}:{ports.first}" if ports and host and ":" not in host else ""
