"""Checks, before an object is deleted, that the facts behind that decision still hold.

Watches may lag. So the RosProxy, the node and the pods there that matter are read from the API
server's store; if one of them differs from what the look had seen, nothing is deleted: the watch
will deliver the change, and the next look decides. Then the object is deleted only if it is as it
was read (uid and resourceVersion), so that nothing can change in between. Where the RosProxy is
gone nothing else matters: the garbage collector deletes its pods already, so they keep changing.
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
    """The facts behind a deletion have changed; the message says which object differs."""


def confirm(api: Api, action: Deletion | EvictPod, observed: ClusterSnapshot) -> str:
    """The version in which the object may be deleted; empty for any.

    Raises StateChanged, ApiError.
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
    # One that is not on that node yet is not in this list.
    return version if target.pod.node == target.node else ""


def _check_rosproxy(api: Api, name: Name, observed: ClusterSnapshot) -> bool:
    """Whether the RosProxy is gone."""
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
        pod.own_masters,
        pod.controller,
        labels,
    )


def _requested(rosproxy: RosProxy | InvalidRosProxy) -> tuple[object, ...]:
    # The generation counts changes of the spec, not of annotations, which `remakes` comes from
    # (k8s.io/apiextensions-apiserver, pkg/registry/customresource/strategy.go, PrepareForUpdate).
    flags = (rosproxy.deleting, rosproxy.remakes) if isinstance(rosproxy, RosProxy) else ()
    return rosproxy.uid, rosproxy.generation, *flags


def _pod(obj: Json) -> Pod:
    record = pod_record(obj)
    return record if isinstance(record, Pod) else record.pod


def _matters(pod: Pod, rosproxy: Name) -> bool:
    """Whether a pod may want the proxy, or take its ports."""
    return pod.id.namespace == rosproxy.namespace or bool(pod.every_port)


def _by_uid(pods: Iterable[Pod]) -> dict[str, object]:
    """The facts about pods that a deletion is decided from, by the pods' uids."""
    return {
        pod.uid: (pod.labels, pod.ended, pod.deleting, pod.every_port, pod.host_network)
        for pod in pods
    }


def _version(obj: Json) -> str:
    return text_at(submap(obj, "metadata"), "resourceVersion")
