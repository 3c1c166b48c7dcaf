"""Findings about misspelt labels and annotations of RosProxies, nodes, Services and pods.

A finding about a pod becomes an Event on the pod. If the namespace has RosProxies, the status of
the first also shows the finding. The texts stay the same from look to look, so each text becomes a
single Event.
"""

from collections.abc import Iterable, Iterator
from heapq import nsmallest

from rosproxy_operator.common.problem import UNKNOWN_NAME, Fault
from rosproxy_operator.kubernetes.planner.cluster_view import View, group_by_key
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Name,
    Reference,
    RosProxy,
)
from rosproxy_operator.kubernetes.status.findings import finding

MOST_PODS = 10
"""Most pods that are reported in a namespace: all pods of a Deployment have the same labels."""


def misspellings(view: View, rosproxy: RosProxy) -> Iterator[ClusterFinding]:
    """Yield the findings about names at a RosProxy, at its nodes and at the master's Service."""
    observed = view.observed
    yield from (finding(rosproxy, UNKNOWN_NAME, Fault(text)) for text in rosproxy.misspelt)
    for place in view.places.get(rosproxy.id, ()):
        node = observed.nodes.get(place.node)
        yield from _others(rosproxy, f"node {place.node}", node.misspelt if node else ())
    service = rosproxy.spec.master.service
    if service is not None:
        texts = observed.misspelt_services.get(service, ())
        yield from _others(rosproxy, f"service {service}", texts)


def _others(rosproxy: RosProxy, subject: str, texts: Iterable[str]) -> Iterator[ClusterFinding]:
    return (finding(rosproxy, UNKNOWN_NAME, Fault(text), subject=subject) for text in texts)


def misspelt_pod_findings(view: View) -> Iterator[ClusterFinding]:
    """Yield the findings about names at pods, each for the first RosProxy of the namespace."""
    pods = (p for p in view.observed.misspelt_pods if not (p.ended or p.deleting))
    for namespace, group in group_by_key((pod.id.namespace, pod) for pod in pods).items():
        rosproxies = (id for id in view.rosproxies if id.namespace == namespace)
        of = min(rosproxies, default=Name(namespace, ""))
        for pod in nsmallest(MOST_PODS, group, key=lambda p: p.id):
            about = Reference("Pod", pod.id, pod.uid)
            fix = edit_fix("Correct the name in the template", pod)
            for text in pod.misspelt:
                yield ClusterFinding(
                    f"pod {pod.id}",
                    text,
                    fix,
                    fatal=False,
                    reason=UNKNOWN_NAME,
                    of=of,
                    about=about,
                )
