"""Having pods made anew that came by unwired, where their RosProxy asks for that.

A pod that was created while no operator answered the API server is never wired any more; it has to
be created again. With the annotation `REMAKE` on the RosProxy such a pod is evicted, if whoever
made it makes it anew; PodDisruptionBudgets hold. One at a time: the next one goes once none of the
pods is about to go or to start; after the first ones there are growing pauses, so that a webhook
that does not work costs a pod a minute and no more.
"""

from collections.abc import Iterator

from rosproxy_operator.kubernetes.planner.actions import Action, EvictPod
from rosproxy_operator.kubernetes.planner.pods.injection import has_come_unwired
from rosproxy_operator.kubernetes.planner.pods.selection import selects
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.reconcile import ClusterContext
from rosproxy_operator.kubernetes.resources.model import Pod, RosProxy

MAKERS = ("ReplicaSet", "ReplicationController", "StatefulSet", "DaemonSet")
"""Kinds of controllers that make a pod anew. A Job would count its pod as failed."""


def remake_unwired(context: ClusterContext, of: RosProxy) -> Iterator[Action]:
    """Evict one pod that is not wired, if it is time for that."""
    if not of.remakes:
        return
    task = Task(of.id, "remake", of.id)
    context.retries.effect(task)  # how often is remembered as long as it is asked for
    address = context.cluster_ip(of)
    pods = context.view.taken.get(of.id, ())
    left = [pod for pod in pods if address and is_to_be_remade(pod, of, address)]
    there = [pod for pod in context.observed.pods if not pod.ended and selects(of, pod)]
    busy = any(pod.deleting or pod.phase == "Pending" for pod in there)
    if left and not busy and context.retries.ask(task):
        pod = min(left, key=lambda one: one.id)
        why = f"it is not wired to its proxy; its {pod.controller} makes it anew"
        yield EvictPod(of.id, pod.id, pod.uid, why)


def is_to_be_remade(pod: Pod, of: RosProxy, cluster_ip: str) -> bool:
    """Whether a pod is not wired, would be if it were made anew, and is made anew if it goes.

    ``cluster_ip`` is the address of the RosProxy's Service.
    """
    makes_anew = pod.controller in MAKERS and not pod.deleting and not pod.ended
    return makes_anew and of.spec.ros1 and has_come_unwired(pod, cluster_ip)
