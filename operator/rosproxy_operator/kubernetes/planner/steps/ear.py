"""What is to be done for the ears of a RosProxy: how they are made, and when.

An ear is a pod in its node's own network: it hears the LAN's multicast there, and the proxy at the
last port of the proxy's range, which the ear holds. It has to know the proxy's address, so it is
made once the proxy's pod has one, and anew when that changes. It has no right but that network.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from rosproxy.net.addresses import HostPort
from rosproxy_operator.common.ros2 import EAR_COMMAND, ear_variables
from rosproxy_operator.kubernetes.planner.actions import Action, CreateEar, DeleteEar
from rosproxy_operator.kubernetes.planner.cluster_view import group_by_key
from rosproxy_operator.kubernetes.planner.manifests import (
    POD_SECURITY_CONTEXT,
    ProxySite,
    bound_to,
    fingerprint_of,
    fingerprinted,
    image_of,
    metadata,
    proxy_fingerprint,
)
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.reconcile import ClusterContext, site_of
from rosproxy_operator.kubernetes.resources.cluster import EarPod
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Json, ProxyPlace, RosProxy
from rosproxy_operator.kubernetes.resources.names import EAR, NODE, ear_id
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.findings import finding

_RESOURCES: Json = {"requests": {"cpu": "10m", "memory": "32Mi"}, "limits": {"memory": "128Mi"}}
"""An ear has 30 MiB and one thread."""


def ear_pod(site: ProxySite, ear: HostPort, proxy_address: str, settings: ClusterSettings) -> Json:
    """The pod of an ear that listens at ``ear``, for the proxy at ``proxy_address``."""
    rosproxy = site.rosproxy
    ros2 = site.rosproxy.spec.ros2
    annotations = {NODE: site.node.name}
    meta = metadata(rosproxy, ear_id(rosproxy.id, site.node.name), annotations, EAR)
    target = HostPort(proxy_address, site.ports.first)
    number = ros2.number if ros2 else 0
    variables = ear_variables(number, ear.host, ear, target, site.relay_secret)
    policy = rosproxy.spec.image_pull_policy or settings.image_pull_policy
    container: dict[str, Any] = {
        "name": EAR,
        "image": image_of(rosproxy, settings),
        **({"imagePullPolicy": policy} if policy else {}),
        "command": [*EAR_COMMAND],
        "env": [{"name": name, "value": value} for name, value in variables.items()],
        # The scheduler counts it; that of a pod in its node's network is a port of the node.
        "ports": [{"containerPort": ear.port, "hostPort": ear.port, "protocol": "UDP"}],
        "resources": dict(_RESOURCES),
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
    }
    spec = {
        **bound_to(site.node.name, rosproxy.spec),
        "hostNetwork": True,
        "terminationGracePeriodSeconds": 1,
        "securityContext": dict(POD_SECURITY_CONTEXT),
        "containers": [container],
    }
    return fingerprinted({"apiVersion": "v1", "kind": "Pod", "metadata": meta, "spec": spec})


def reconcile_ears(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """The next actions for the ears of a RosProxy.

    The ear of a proxy that is to be made anew stays until the new proxy has an address: the one
    that goes tells outside by it that its participants have ended.
    """
    places = {*context.view.places.get(rosproxy.id, ())}
    ears_by_node = group_by_key(
        (e.node, e) for e in context.observed.ears if e.owner == rosproxy.uid
    )
    for node_name in sorted({*ears_by_node, *(place.node for place in places)}):
        place = ProxyPlace(rosproxy.id, node_name)
        ears = ears_by_node.get(node_name, ())
        node = context.observed.nodes.get(node_name)
        if node is None or not node.ready:
            continue  # the garbage collector takes the pods of nodes that are gone
        if place not in places or not rosproxy.spec.multicast:
            yield from _delete_ears(context, ears, "no proxy needs it")
        else:
            yield from _ensure_ear(context, place, ears)


def ear_findings(context: ClusterContext, rosproxy: RosProxy) -> Iterator[ClusterFinding]:
    """Where a RosProxy's proxy can't have an ear though it ought to."""
    for place in context.view.places.get(rosproxy.id, ()) if rosproxy.spec.multicast else ():
        site = site_of(context, place) if place in context.view.wanted else None
        if isinstance(site, ProxySite) and site.ear is None:
            text = (
                f"node {place.node} has no IPv4 address of type InternalIP, so its LAN is not "
                "heard: name the hosts outside in spec.peers, and leave spec.multicast out"
            )
            yield finding(rosproxy, "NoLanAddress", text)


def _ensure_ear(
    context: ClusterContext, place: ProxyPlace, ears: tuple[EarPod, ...]
) -> Iterator[Action]:
    current = context.view.current.get(place)
    wanted = place in context.view.wanted
    site = site_of(context, place) if wanted else None
    address = current.pod.ip if current is not None and not current.pod.ended else ""
    if current is None or not isinstance(site, ProxySite) or site.ear is None or not address:
        return
    if current.fingerprint != proxy_fingerprint(site, context.settings):
        return
    body = ear_pod(site, site.ear, address, context.settings)
    expected = fingerprint_of(body)
    id = ear_id(place.of, place.node)
    outdated = [ear for ear in ears if ear.fingerprint != expected or ear.pod.ended]
    yield from _delete_ears(context, outdated, "made anew: its proxy or its settings have changed")
    if not ears and context.retries.is_due(Task(place.of, "create", id)):
        yield CreateEar(place.of, body)


def _delete_ears(context: ClusterContext, ears: Iterable[EarPod], why: str) -> Iterator[Action]:
    for ear in ears:
        task = Task(ear.of, "delete", ear.pod.id, ear.pod.uid)
        if not ear.pod.deleting and context.retries.is_due(task):
            yield DeleteEar(ear.of, ear.pod.id, ear.pod.uid, why)
