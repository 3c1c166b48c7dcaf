"""Having unwired pods made anew, where their RosProxy asks for that.

A pod that was created while no operator answered the API server is never wired any more; it has to
be created again. With the annotation `REMAKE` on the RosProxy such a pod is evicted, if its
controller makes it anew; PodDisruptionBudgets hold. One at a time: the next one goes once none of
the pods is about to go or to start; after the first ones there are growing pauses, so that a
webhook that does not work costs a pod a minute and no more.
"""

from collections.abc import Iterator

from rosproxy_operator.kubernetes.planner.actions import Action, EvictPod
from rosproxy_operator.kubernetes.planner.pods.injection import has_come_unwired
from rosproxy_operator.kubernetes.planner.pods.selection import selects
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.context import ClusterContext
from rosproxy_operator.kubernetes.resources.model import Pod, RosProxy

RECREATING_CONTROLLERS = ("ReplicaSet", "ReplicationController", "StatefulSet", "DaemonSet")
"""Kinds of controllers that make a pod anew. A Job would count its pod as failed."""


def remake_unwired(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Evict one pod that is not wired, if it is time for that."""
    if not rosproxy.remakes:
        return
    task = Task(rosproxy.id, "remake", rosproxy.id)
    context.retries.note_effect(task)  # the count is kept as long as this is asked for
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
    """Whether a pod is not wired, would be if it were made anew, and is made anew if it goes.

    ``cluster_ip`` is the address of the RosProxy's Service.
    """
    makes_anew = pod.controller in RECREATING_CONTROLLERS and not pod.deleting and not pod.ended
    return makes_anew and has_come_unwired(pod, rosproxy, cluster_ip)
