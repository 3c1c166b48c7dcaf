"""Eviction of unwired pods, for each RosProxy with the annotation `REMAKE`.

The webhook wires a pod only when the pod is created. If no operator answered the API server at that
moment, only a new pod can be wired. So the operator evicts an unwired pod whose controller creates
a new pod. The evictions respect PodDisruptionBudgets.

The operator evicts a single pod at a time, and waits while a selected pod starts or is being
deleted. The first evictions follow without a pause. Then the pauses grow, up to a minute
(`planner.retries`). So a webhook that does not work causes few evictions.
"""

from collections.abc import Iterator

from rosproxy_operator.kubernetes.planner.actions import Action, EvictPod
from rosproxy_operator.kubernetes.planner.pods.recreation import needs_recreation
from rosproxy_operator.kubernetes.planner.pods.selection import selects
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.context import ClusterContext
from rosproxy_operator.kubernetes.resources.model import Pod, RosProxy

RECREATING_CONTROLLERS = ("ReplicaSet", "ReplicationController", "StatefulSet", "DaemonSet")
"""Kinds of controllers that replace an evicted pod. A Job counts an evicted pod as failed."""


def remake_unwired(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the eviction of a single unwired pod, if an eviction is due."""
    if not rosproxy.remakes:
        return
    task = Task(rosproxy.id, "remake", rosproxy.id)
    context.retries.note_effect(task)  # keeps the count of evictions, and so the pauses
    address = context.cluster_ip(rosproxy)
    pods = context.view.selected_pods.get(rosproxy.id, ())
    candidates = [pod for pod in pods if address and is_to_be_remade(pod, rosproxy, address)]
    selected = [pod for pod in context.observed.pods if not pod.ended and selects(rosproxy, pod)]
    busy = any(pod.deleting or pod.phase == "Pending" for pod in selected)
    if candidates and not busy and context.retries.is_due(task):
        pod = min(candidates, key=lambda p: p.id)
        why = f"not wired to its proxy. The {pod.controller} of the pod creates a new pod"
        yield EvictPod(rosproxy.id, pod.id, pod.uid, why)


def is_to_be_remade(pod: Pod, rosproxy: RosProxy, cluster_ip: str) -> bool:
    """Whether a pod is unwired, and its controller creates a new pod that the webhook would wire.

    ``cluster_ip`` is the address of the RosProxy's Service.
    """
    is_recreated = pod.controller in RECREATING_CONTROLLERS and not pod.deleting and not pod.ended
    return is_recreated and needs_recreation(pod, rosproxy, cluster_ip)
