"""Pods that ask for a proxy by their label, and that no RosProxy selects.

The webhook warns at admission, but the controllers of Deployments drop its warnings. So such a pod
gets an Event, and the RosProxy for which the label may be meant reports the pod.
"""

from collections.abc import Iterator, Mapping
from heapq import nsmallest

from rosproxy_operator.kubernetes.planner.cluster_view import View, group_by_key
from rosproxy_operator.kubernetes.planner.pods.selection import why_not_selected
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Name, Reference

UNSELECTED_FOR_S = 60.0
"""A pod is reported after this time: its RosProxy may be created after the pod."""
MOST_PODS = 10
"""Reported pods of a namespace."""


def unselected_findings(
    view: View, since: Mapping[Name, float], now: float
) -> Iterator[ClusterFinding]:
    """Findings about the first few of these pods; ``since`` is when each was first seen so."""
    # A RosProxy that can't be read has a condition, and may be the one that is meant.
    unclear = {id.namespace for id in view.observed.unusable}
    pods = (p for p in view.observed.unselected_pods if p.id.namespace not in unclear)
    due = ((p.id.namespace, p) for p in pods if now - since.get(p.id, now) >= UNSELECTED_FOR_S)
    for namespace, group in group_by_key(due).items():
        rosproxies = [r for id, r in view.rosproxies.items() if id.namespace == namespace]
        of = min((r.id for r in rosproxies), default=Name(namespace, ""))
        for pod in nsmallest(MOST_PODS, group, key=lambda p: p.id):
            about = Reference("Pod", pod.id, pod.uid)
            text = why_not_selected(pod, rosproxies)
            yield ClusterFinding(
                f"pod {pod.id}", text, fatal=False, reason="NotWired", of=of, about=about
            )


def unselected_waits(since: Mapping[Name, float], now: float) -> Iterator[float]:
    """The seconds until each pod that is not reported yet is to be reported."""
    return (left for at in since.values() if (left := at + UNSELECTED_FOR_S - now) > 0)
