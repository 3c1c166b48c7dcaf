"""Before something is deleted: whether that which it was decided from is still so.

What watches tell may be old. So the RosProxy, the node and the pods there that matter are read
from the API server's store; if one of them is another one than the look had seen, nothing is done:
the watch is about to tell, and the next look decides. Then the object is deleted only if it is as
it was read (uid and resourceVersion), so that nothing can come between. Where the RosProxy is gone
nothing else matters: the garbage collector is at its pods already, so they change meanwhile.
"""

from collections.abc import Iterable

from rosproxy_operator.kubernetes.api.client import Api
from rosproxy_operator.kubernetes.planner.actions import (
    DeleteEar,
    DeletePolicy,
    DeleteProxy,
    DeleteService,
    EvictPod,
)
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, own_pods
from rosproxy_operator.kubernetes.resources.model import InvalidRosProxy, Json, Name, Pod, RosProxy
from rosproxy_operator.kubernetes.resources.names import PLURAL
from rosproxy_operator.kubernetes.resources.records import pod_record, rosproxy_record
from rosproxy_operator.kubernetes.resources.values import part, word

Deletion = DeleteService | DeletePolicy | DeleteProxy | DeleteEar | EvictPod


class Stale(Exception):
    """What was decided from is not so any more; the message says what is another one."""


def confirm(api: Api, action: Deletion, observed: ClusterSnapshot) -> str:
    """The version in which the object may be deleted; empty for any. Raises Stale, ApiError."""
    gone = _check_rosproxy(api, action.of, observed)
    if isinstance(action, EvictPod):
        _check_pod(api, action, observed)
    if gone or not isinstance(action, DeleteProxy | DeleteEar):
        return ""
    own = own_pods(observed.proxies, observed.ears)
    one = next((one for one in own if one.pod.uid == action.uid), None)
    if one is None:
        raise Stale(f"pod {action.id}")
    _check_node(api, one.on, observed)
    found = api.fresh("pods", "", f"spec.nodeName={one.on}")
    there = [pod for pod in map(_pod, found) if _matters(pod, action.of)]
    seen = (pod for pod in observed.pods if pod.node == one.on and _matters(pod, action.of))
    if _by_uid(there) != _by_uid(seen):
        raise Stale(f"the pods on node {one.on}")
    if one.pod.node != one.on:
        return ""
    return next((_version(obj) for obj in found if _uid(obj) == action.uid), "")


def _check_rosproxy(api: Api, of: Name, observed: ClusterSnapshot) -> bool:
    """Whether the RosProxy is gone."""
    found = api.fresh(PLURAL, of.namespace, f"metadata.name={of.name}")
    now = {_asked(rosproxy_record(obj)) for obj in found}
    seen = {_asked(one) for one in observed.rosproxies if one.id == of}
    if of in observed.unusable:
        seen.add(_asked(observed.unusable[of]))
    if now != seen:
        raise Stale(f"RosProxy {of}")
    return not now


def _check_node(api: Api, name: str, observed: ClusterSnapshot) -> None:
    found = [objects.node(obj) for obj in api.fresh("nodes", "", f"metadata.name={name}")]
    if found != [*filter(None, [observed.nodes.get(name)])]:
        raise Stale(f"node {name}")


def _check_pod(api: Api, action: EvictPod, observed: ClusterSnapshot) -> None:
    found = api.fresh("pods", action.id.namespace, f"metadata.name={action.id.name}")
    now = {_wiring(pod) for pod in map(_pod, found)}
    if now != {_wiring(pod) for pod in observed.pods if pod.uid == action.uid}:
        raise Stale(f"pod {action.id}")


def _wiring(pod: Pod) -> tuple[object, ...]:
    labels = tuple(sorted(pod.labels.items()))
    return pod.uid, pod.deleting, pod.ended, pod.wired, pod.own_masters, pod.controller, labels


def _asked(one: RosProxy | InvalidRosProxy) -> tuple[object, ...]:
    more = (one.deleting, one.remakes) if isinstance(one, RosProxy) else ()
    return one.uid, one.generation, *more


def _pod(obj: Json) -> Pod:
    found = pod_record(obj)
    return found if isinstance(found, Pod) else found.pod


def _matters(pod: Pod, of: Name) -> bool:
    """Whether a pod may want the proxy, or take its ports."""
    return pod.id.namespace == of.namespace or bool(pod.every_port)


def _by_uid(pods: Iterable[Pod]) -> dict[str, object]:
    """What of pods is decided from: which there are, where they are, what they take and ask for."""
    return {
        pod.uid: (pod.labels, pod.ended, pod.deleting, pod.every_port, pod.host_network)
        for pod in pods
    }


def _uid(obj: Json) -> str:
    return word(part(obj, "metadata"), "uid")


def _version(obj: Json) -> str:
    return word(part(obj, "metadata"), "resourceVersion")
