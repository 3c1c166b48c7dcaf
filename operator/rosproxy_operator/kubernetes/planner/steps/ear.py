"""What is to be done for the ears of a RosProxy: how they are made, and when.

An ear is a pod in its node's own network: it hears the LAN's multicast there, and the proxy at the
last port of the proxy's range, which the ear holds. It has to know the proxy's address, so it is
made once the proxy's pod has one, and anew when that is another. It has no right but that network.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from rosproxy.net.addresses import HostPort
from rosproxy_operator.common.ros2 import EAR_COMMAND, ear_variables
from rosproxy_operator.kubernetes.planner.actions import Action, CreateEar, DeleteEar
from rosproxy_operator.kubernetes.planner.manifests import (
    NOBODY,
    Site,
    bound_to,
    fingerprint_of,
    fingerprinted,
    image_of,
    metadata,
)
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.reconcile import ClusterContext, site_of
from rosproxy_operator.kubernetes.planner.view import grouped
from rosproxy_operator.kubernetes.resources.cluster import EarPod
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Json, ProxyPlace, RosProxy
from rosproxy_operator.kubernetes.resources.names import EAR, NODE, ear_id
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.findings import finding

_RESOURCES: Json = {"requests": {"cpu": "10m", "memory": "32Mi"}, "limits": {"memory": "128Mi"}}
"""An ear has 30 MiB and one thread."""


def ear_pod(site: Site, ear: HostPort, proxy: str, settings: ClusterSettings) -> Json:
    """The pod of an ear that listens at ``ear``, for the proxy whose pod has an address."""
    of, ros2 = site.rosproxy, site.rosproxy.spec.ros2
    notes = {NODE: site.node.name}
    meta = metadata(of, ear_id(of.id, site.node.name), notes, EAR)
    to = HostPort(proxy, site.ports.first)
    variables = ear_variables(ros2.number if ros2 else 0, ear.host, ear, to)
    policy = of.spec.image_pull_policy or settings.image_pull_policy
    container: dict[str, Any] = {
        "name": EAR,
        "image": image_of(of, settings),
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
        **bound_to(site.node.name, of.spec),
        "hostNetwork": True,
        "terminationGracePeriodSeconds": 1,
        "securityContext": dict(NOBODY),
        "containers": [container],
    }
    return fingerprinted({"apiVersion": "v1", "kind": "Pod", "metadata": meta, "spec": spec})


def reconcile_ears(context: ClusterContext, of: RosProxy) -> Iterator[Action]:
    """The next actions for the ears of a RosProxy.

    That of a proxy which is just being made anew stays, until the proxy has another address.
    """
    places = {*context.view.places.get(of.id, ())}
    there = grouped((one.on, one) for one in context.observed.ears if one.owner == of.uid)
    for on in sorted({*there, *(place.node for place in places)}):
        place = ProxyPlace(of.id, on)
        found, node = there.get(on, ()), context.observed.nodes.get(on)
        if node is None or not node.ready:
            continue  # the garbage collector takes the pods of nodes that are gone
        if place not in places or not of.spec.multicast:
            yield from _deleted(context, found, "no proxy needs it")
        else:
            yield from _wanted(context, place, found)


def ear_findings(context: ClusterContext, of: RosProxy) -> Iterator[ClusterFinding]:
    """Where a RosProxy's proxy can't have an ear though it ought to."""
    for place in context.view.places.get(of.id, ()) if of.spec.multicast else ():
        site = site_of(context, place) if place in context.view.wanted else None
        if isinstance(site, Site) and site.ear is None:
            text = (
                f"node {place.node} has no IPv4 address of type InternalIP, so its LAN is not "
                "heard: name who is outside in spec.peers, and take spec.multicast off"
            )
            yield finding(of, "NoLanAddress", text)


def _wanted(
    context: ClusterContext, place: ProxyPlace, found: tuple[EarPod, ...]
) -> Iterator[Action]:
    current, wanted = context.view.current.get(place), place in context.view.wanted
    site = site_of(context, place) if wanted else None
    address = current.pod.ip if current is not None and not current.pod.ended else ""
    if not isinstance(site, Site) or site.ear is None or not address:
        return
    body = ear_pod(site, site.ear, address, context.settings)
    expected, id = fingerprint_of(body), ear_id(place.of, place.node)
    wrong = [one for one in found if one.fingerprint != expected or one.pod.ended]
    yield from _deleted(context, wrong, "made anew: its proxy or its settings have changed")
    if not found and context.retries.ask(Task(place.of, "create", id)):
        yield CreateEar(place.of, body)


def _deleted(context: ClusterContext, ears: Iterable[EarPod], why: str) -> Iterator[Action]:
    for one in ears:
        task = Task(one.of, "delete", one.pod.id, one.pod.uid)
        if not one.pod.deleting and context.retries.ask(task):
            yield DeleteEar(one.of, one.pod.id, one.pod.uid, why)
