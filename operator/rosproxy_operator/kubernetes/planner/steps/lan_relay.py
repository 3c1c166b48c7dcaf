"""Plans the actions for the LAN relays of a RosProxy.

A LAN relay is a pod in the host's network, because it has to receive the multicast of the LAN. The
proxy reaches the LAN relay at the last port of the proxy's range. The operator creates the LAN
relay once the proxy's pod has an address. When this address, the image or the settings change, the
operator recreates the LAN relay. The LAN relay's only privilege is the host's network.
"""

from collections.abc import Iterable, Iterator

from rosproxy.shared.addresses import HostPort
from rosproxy_operator.common.problem import NO_LAN_ADDRESS, Fault
from rosproxy_operator.common.ros2 import LAN_RELAY_COMMAND, lan_relay_variables
from rosproxy_operator.kubernetes.planner.actions import Action, CreateHelper, DeleteHelper
from rosproxy_operator.kubernetes.planner.cluster_view import group_by_key
from rosproxy_operator.kubernetes.planner.manifests import (
    ProxySite,
    fingerprint_of,
    helper_pod,
    proxy_fingerprint,
)
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.context import ClusterContext, site_of
from rosproxy_operator.kubernetes.resources.cluster import HelperPod, ProxyPod
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Json, ProxyPlace, RosProxy
from rosproxy_operator.kubernetes.resources.names import LAN_RELAY, lan_relay_id
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.findings import finding

_RESOURCES: Json = {"requests": {"cpu": "10m", "memory": "32Mi"}, "limits": {"memory": "128Mi"}}
"""A LAN relay uses 30 MiB and a single thread."""


def lan_relay_pod(
    site: ProxySite, address: HostPort, proxy: ProxyPod, settings: ClusterSettings
) -> Json:
    """The pod of a LAN relay that listens at ``address`` and serves this proxy.

    The LAN relay gets the image that the proxy has now. The image in the settings of ``site`` may
    be a newer image, which the proxy gets after the check of that image.
    """
    ros2 = site.rosproxy.spec.ros2
    target = HostPort(proxy.pod.ip, site.ports.first)
    number = ros2.number if ros2 else 0
    variables = lan_relay_variables(number, address.host, address, target, site.relay_secret)
    container = {
        "name": LAN_RELAY,
        "image": proxy.image,
        "command": [*LAN_RELAY_COMMAND],
        "env": [{"name": name, "value": value} for name, value in variables.items()],
        # With the hostPort the scheduler keeps the port free of other pods. In the host's network
        # the containerPort has to be the same port.
        "ports": [{"containerPort": address.port, "hostPort": address.port, "protocol": "UDP"}],
        "resources": _RESOURCES,
    }
    id = lan_relay_id(site.rosproxy.id, site.node.name)
    return helper_pod(site, id, settings, container, {"hostNetwork": True})


def reconcile_lan_relays(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the next actions for the LAN relays of a RosProxy.

    While the operator recreates a proxy, the LAN relay stays until the new proxy has an address.
    The reason: the former proxy sends dispose messages to outside through the LAN relay.
    """
    places = {*context.view.places.get(rosproxy.id, ())}
    lan_relays_by_node = group_by_key(
        (relay.node, relay) for relay in context.observed.lan_relays if relay.owner == rosproxy.uid
    )
    for node_name in sorted({*lan_relays_by_node, *(place.node for place in places)}):
        place = ProxyPlace(rosproxy.id, node_name)
        lan_relays = lan_relays_by_node.get(node_name, ())
        node = context.observed.nodes.get(node_name)
        if node is None or not node.ready:
            # The cluster's garbage collector deletes the pods of a gone node. On a node that is not
            # ready, the operator changes nothing.
            continue
        if place not in places or not rosproxy.spec.multicast:
            yield from _delete_lan_relays(context, lan_relays, "no longer needed")
        else:
            yield from _reconcile_lan_relay(context, place, lan_relays)


def lan_relay_findings(context: ClusterContext, rosproxy: RosProxy) -> Iterator[ClusterFinding]:
    """Yield a finding for each node on which a proxy can't have its LAN relay."""
    for place in context.view.places.get(rosproxy.id, ()) if rosproxy.spec.multicast else ():
        # A proxy that no pod wants any more exists for a while, without a site.
        site = site_of(context, place) if place in context.view.wanted else None
        if isinstance(site, ProxySite) and site.lan_relay is None:
            text = (
                f"node {place.node} has no IPv4 address of type InternalIP, so its proxy has no "
                "LAN relay"
            )
            fix = "Name the hosts outside in spec.peers, and remove spec.multicast"
            yield finding(rosproxy, NO_LAN_ADDRESS, Fault(text, fix))


def _reconcile_lan_relay(
    context: ClusterContext, place: ProxyPlace, lan_relays: tuple[HelperPod, ...]
) -> Iterator[Action]:
    """Yield the next actions for the LAN relay of a place: delete outdated pods, or create one."""
    current = context.view.current.get(place)
    # A proxy that no pod wants any more has no site.
    site = site_of(context, place) if place in context.view.wanted else None
    proxy_ip = current.pod.ip if current is not None and not current.pod.ended else ""
    if current is None or not isinstance(site, ProxySite) or site.lan_relay is None or not proxy_ip:
        return
    if current.fingerprint != proxy_fingerprint(site, context.settings):
        return  # the operator will recreate this proxy
    body = lan_relay_pod(site, site.lan_relay, current, context.settings)
    expected = fingerprint_of(body)
    id = lan_relay_id(place.of, place.node)
    outdated = [
        lan_relay
        for lan_relay in lan_relays
        if lan_relay.fingerprint != expected or lan_relay.pod.ended
    ]
    yield from _delete_lan_relays(
        context, outdated, "replaced, since the proxy or the settings have changed"
    )
    if not lan_relays and context.retries.is_due(Task(place.of, "create", id)):
        yield CreateHelper(place.of, body, LAN_RELAY)


def _delete_lan_relays(
    context: ClusterContext, lan_relays: Iterable[HelperPod], why: str
) -> Iterator[Action]:
    for lan_relay in lan_relays:
        task = Task(lan_relay.of, "delete", lan_relay.pod.id, lan_relay.pod.uid)
        if not lan_relay.pod.deleting and context.retries.is_due(task):
            yield DeleteHelper(lan_relay.of, lan_relay.pod.id, lan_relay.pod.uid, why, LAN_RELAY)
