"""Findings about misspelt labels and annotations: at the RosProxy for which they may be meant.

A pod gets an Event as well. The texts stay the same from look to look, so that each becomes one
Event, and each RosProxy gets only a few.
"""

from collections.abc import Iterable, Iterator

from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.planner.pods.injection import edited
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Pod, RosProxy
from rosproxy_operator.kubernetes.status.findings import finding, pod_finding

MOST_PODS = 10
"""Reported pods of a RosProxy's namespace: all pods of a Deployment have the same labels."""
REASON = "UnknownName"


def misspellings(view: View, rosproxy: RosProxy) -> Iterator[ClusterFinding]:
    """What is wrong with the names of labels and annotations, as far as it concerns a RosProxy."""
    observed = view.observed
    yield from (finding(rosproxy, REASON, text) for text in rosproxy.misspelt)
    for pod in _pods(view, rosproxy):
        fix = edited("Correct the name in the template", pod)
        for text in pod.misspelt:
            joint = " " if text.endswith("?") else ". "
            yield pod_finding(pod, rosproxy, REASON, f"{text}{joint}{fix}", fatal=False)
    for place in view.places.get(rosproxy.id, ()):
        node = observed.nodes.get(place.node)
        yield from _others(rosproxy, f"node {place.node}", node.misspelt if node else ())
    service = rosproxy.spec.master.service
    if service is not None:
        texts = observed.misspelt_services.get(service, ())
        yield from _others(rosproxy, f"service {service}", texts)


def _others(rosproxy: RosProxy, subject: str, texts: Iterable[str]) -> Iterator[ClusterFinding]:
    return (finding(rosproxy, REASON, text, subject=subject) for text in texts)


def _pods(view: View, rosproxy: RosProxy) -> list[Pod]:
    """The pods of its namespace; of several RosProxies there, only the first one reports them."""
    namespace = rosproxy.id.namespace
    if rosproxy.id != min(id for id in view.rosproxies if id.namespace == namespace):
        return []
    pods = (
        pod
        for pod in view.observed.misspelt_pods
        if pod.id.namespace == namespace and not (pod.ended or pod.deleting)
    )
    return sorted(pods, key=lambda pod: pod.id)[:MOST_PODS]
