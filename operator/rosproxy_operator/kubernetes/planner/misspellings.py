"""Findings about misspelt labels and annotations: at the RosProxy for which they may be meant.

A pod gets an Event as well, and the Event alone if its namespace has no RosProxy. The texts stay
the same from look to look, so that each becomes one Event, and each namespace gets only a few.
"""

from collections.abc import Iterable, Iterator
from heapq import nsmallest

from rosproxy_operator.kubernetes.planner.cluster_view import View, group_by_key
from rosproxy_operator.kubernetes.planner.pods.injection import edited
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Name,
    Reference,
    RosProxy,
)
from rosproxy_operator.kubernetes.status.findings import finding

MOST_PODS = 10
"""Reported pods of a namespace: all pods of a Deployment have the same labels."""
REASON = "UnknownName"


def misspellings(view: View, rosproxy: RosProxy) -> Iterator[ClusterFinding]:
    """What is wrong with names at a RosProxy, its nodes and the Service of its master."""
    observed = view.observed
    yield from (finding(rosproxy, REASON, text) for text in rosproxy.misspelt)
    for place in view.places.get(rosproxy.id, ()):
        node = observed.nodes.get(place.node)
        yield from _others(rosproxy, f"node {place.node}", node.misspelt if node else ())
    service = rosproxy.spec.master.service
    if service is not None:
        texts = observed.misspelt_services.get(service, ())
        yield from _others(rosproxy, f"service {service}", texts)


def _others(rosproxy: RosProxy, subject: str, texts: Iterable[str]) -> Iterator[ClusterFinding]:
    return (finding(rosproxy, REASON, text, subject=subject) for text in texts)


def misspelt_pod_findings(view: View) -> Iterator[ClusterFinding]:
    """What is wrong with names at pods. Of several RosProxies of a namespace the first gets it."""
    pods = (p for p in view.observed.misspelt_pods if not (p.ended or p.deleting))
    for namespace, group in group_by_key((pod.id.namespace, pod) for pod in pods).items():
        rosproxies = (id for id in view.rosproxies if id.namespace == namespace)
        of = min(rosproxies, default=Name(namespace, ""))
        for pod in nsmallest(MOST_PODS, group, key=lambda p: p.id):
            about = Reference("Pod", pod.id, pod.uid)
            fix = edited("Correct the name in the template", pod)
            for text in pod.misspelt:
                joint = " " if text.endswith("?") else ". "
                yield ClusterFinding(
                    f"pod {pod.id}",
                    f"{text}{joint}{fix}",
                    fatal=False,
                    reason=REASON,
                    of=of,
                    about=about,
                )
