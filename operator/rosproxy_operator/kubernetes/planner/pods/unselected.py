"""Findings about pods whose label asks for a proxy, and that no RosProxy selects.

The webhook warns at admission, but the controller of a Deployment drops warnings. So the pod gets
an Event. If the namespace has RosProxies, the status of the first also reports the pod.
"""

from collections.abc import Iterator, Mapping
from heapq import nsmallest

from rosproxy_operator.common.problem import NOT_WIRED, Fault
from rosproxy_operator.kubernetes.planner.cluster_view import View, group_by_key
from rosproxy_operator.kubernetes.planner.pods.selection import why_not_selected
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Name, Reference

UNSELECTED_FOR_S = 60.0
"""Seconds until a pod is reported: a user may create the RosProxy after the pod."""
MOST_PODS = 10
"""Most pods that are reported in a namespace."""


def unselected_findings(
    view: View, since: Mapping[Name, float], now: float
) -> Iterator[ClusterFinding]:
    """Yield the findings about the first `MOST_PODS` pods of each namespace.

    ``since`` is the time at which the operator first saw each pod without a RosProxy.
    """
    # The label may mean an unusable RosProxy. The status of that RosProxy tells the fault already.
    unclear = {id.namespace for id in view.observed.unusable}
    pods = (p for p in view.observed.unselected_pods if p.id.namespace not in unclear)
    due = ((p.id.namespace, p) for p in pods if now - since.get(p.id, now) >= UNSELECTED_FOR_S)
    for namespace, group in group_by_key(due).items():
        rosproxies = [r for id, r in view.rosproxies.items() if id.namespace == namespace]
        of = min((r.id for r in rosproxies), default=Name(namespace, ""))
        for pod in nsmallest(MOST_PODS, group, key=lambda p: p.id):
            about = Reference("Pod", pod.id, pod.uid)
            fault = why_not_selected(pod, rosproxies) or Fault("")
            yield ClusterFinding(
                f"pod {pod.id}", *fault, fatal=False, reason=NOT_WIRED, of=of, about=about
            )


def unselected_waits(since: Mapping[Name, float], now: float) -> Iterator[float]:
    """Yield the seconds until each pod that is not reported yet is reported."""
    return (left for at in since.values() if (left := at + UNSELECTED_FOR_S - now) > 0)
