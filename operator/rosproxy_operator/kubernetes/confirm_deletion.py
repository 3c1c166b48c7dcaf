"""Checks, before a deletion or eviction, that the facts behind the decision still hold.

Watches may lag. So the operator first reads the RosProxy from the API server's store. For a proxy
or a pod beside a proxy, the operator also reads the node and the pods there; for an eviction, the
pod. If any of these objects differs from the snapshot, the operator deletes nothing: the watch will
deliver the change, and the next look decides. Then the operator deletes the pod only in the
version just read (uid, resourceVersion).

If the RosProxy is gone, the operator does not check the node and the pods there: the garbage
collector already deletes pods, so the pods keep changing.
"""

from collections.abc import Iterable

from rosproxy_operator.kubernetes.api.api_client import Api
from rosproxy_operator.kubernetes.planner.actions import (
    DeleteHelper,
    DeleteProxy,
    Deletion,
    EvictPod,
)
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.checks import submap, text_at
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import InvalidRosProxy, Json, Name, Pod, RosProxy
from rosproxy_operator.kubernetes.resources.names import PLURAL
from rosproxy_operator.kubernetes.resources.records import pod_record, rosproxy_record


class StateChanged(Exception):
    """The facts behind a deletion have changed. The message names the object that differs."""


def confirm(api: Api, action: Deletion | EvictPod, observed: ClusterSnapshot) -> str:
    """Return the only resourceVersion in which the object may be deleted; empty for any version.

    Raises StateChanged if the snapshot is outdated, and ApiError.
    """
    is_gone = _check_rosproxy(api, action.of, observed)
    if isinstance(action, EvictPod):
        _check_pod(api, action, observed)
    if is_gone or not isinstance(action, DeleteProxy | DeleteHelper):
        return ""
    target = next((p for p in observed.own_pods if p.pod.uid == action.uid), None)
    if target is None:
        raise StateChanged(f"pod {action.id}")
    _check_node(api, target.node, observed)
    version = ""
    current: list[Pod] = []
    for obj in api.each("pods", "", f"spec.nodeName={target.node}"):
        pod = _pod(obj)
        if _matters(pod, action.of):
            current.append(pod)
        if pod.uid == action.uid:
            version = _version(obj)
    expected = (
        pod for pod in observed.pods if pod.node == target.node and _matters(pod, action.of)
    )
    if _by_uid(current) != _by_uid(expected):
        raise StateChanged(f"the pods on node {target.node}")
    # A pod that the scheduler has not placed yet is not in the list of pods on the node.
    return version if target.pod.node == target.node else ""


def _check_rosproxy(api: Api, name: Name, observed: ClusterSnapshot) -> bool:
    """Return whether the RosProxy is gone. Raises StateChanged if it differs from the snapshot."""
    objs = api.list_fresh(PLURAL, name.namespace, f"metadata.name={name.name}")
    current = {_requested(rosproxy_record(obj)) for obj in objs}
    expected = {_requested(rosproxy) for rosproxy in observed.rosproxies if rosproxy.id == name}
    if name in observed.unusable:
        expected.add(_requested(observed.unusable[name]))
    if current != expected:
        raise StateChanged(f"RosProxy {name}")
    return not current


def _check_node(api: Api, name: str, observed: ClusterSnapshot) -> None:
    nodes = [objects.node(obj) for obj in api.list_fresh("nodes", "", f"metadata.name={name}")]
    if nodes != [*filter(None, [observed.nodes.get(name)])]:
        raise StateChanged(f"node {name}")


def _check_pod(api: Api, action: EvictPod, observed: ClusterSnapshot) -> None:
    objs = api.list_fresh("pods", action.id.namespace, f"metadata.name={action.id.name}")
    current = {_wiring(pod) for pod in map(_pod, objs)}
    if current != {_wiring(pod) for pod in observed.pods if pod.uid == action.uid}:
        raise StateChanged(f"pod {action.id}")


def _wiring(pod: Pod) -> tuple[object, ...]:
    labels = tuple(sorted(pod.labels.items()))
    return (
        pod.uid,
        pod.deleting,
        pod.ended,
        pod.wired_master_uri,
        pod.static_peers,
        pod.router_endpoint,
        pod.own_masters,
        pod.controller,
        labels,
    )


def _requested(rosproxy: RosProxy | InvalidRosProxy) -> tuple[object, ...]:
    # The generation counts changes of the spec, but not of annotations, and `remakes` comes from an
    # annotation (k8s.io/apiextensions-apiserver, pkg/registry/customresource/strategy.go,
    # PrepareForUpdate).
    flags = (rosproxy.deleting, rosproxy.remakes) if isinstance(rosproxy, RosProxy) else ()
    return rosproxy.uid, rosproxy.generation, *flags


def _pod(obj: Json) -> Pod:
    record = pod_record(obj)
    return record if isinstance(record, Pod) else record.pod


def _matters(pod: Pod, rosproxy: Name) -> bool:
    """Whether a pod may want the proxy, or may hold ports of the proxy."""
    return pod.id.namespace == rosproxy.namespace or bool(pod.every_port)


def _by_uid(pods: Iterable[Pod]) -> dict[str, object]:
    """Return the facts about pods that decide about a deletion, by uid."""
    return {
        pod.uid: (pod.labels, pod.ended, pod.deleting, pod.every_port, pod.host_network)
        for pod in pods
    }


def _version(obj: Json) -> str:
    return text_at(submap(obj, "metadata"), "resourceVersion")
