"""Who is told that a label or annotation is misspelt: the RosProxy that it may be meant for.

A pod is told of it as well. What is told stays the same from look to look, so that each is told
once, and there are few of each RosProxy.
"""

from collections.abc import Iterable, Iterator

from rosproxy_operator.kubernetes.planner.cluster_view import View
from rosproxy_operator.kubernetes.resources.model import ClusterFinding, Pod, RosProxy
from rosproxy_operator.kubernetes.status.findings import finding, pod_finding

MOST_PODS = 10
"""Pods of a RosProxy's namespace that are told of: of a Deployment all have the same names."""
REASON = "UnknownName"


def misspellings(view: View, rosproxy: RosProxy) -> Iterator[ClusterFinding]:
    """What is wrong with the names of labels and annotations, as far as it concerns a RosProxy."""
    observed = view.observed
    yield from (finding(rosproxy, REASON, f"has {text}") for text in rosproxy.misspelt)
    for pod in _pods(view, rosproxy):
        for text in pod.misspelt:
            yield pod_finding(pod, rosproxy, REASON, f"has {text}", fatal=False)
    for place in view.places.get(rosproxy.id, ()):
        node = observed.nodes.get(place.node)
        yield from _others(rosproxy, f"node {place.node}", node.misspelt if node else ())
    service = rosproxy.spec.master.service
    if service is not None:
        texts = observed.misspelt_services.get(service, ())
        yield from _others(rosproxy, f"service {service}", texts)


def _others(rosproxy: RosProxy, subject: str, texts: Iterable[str]) -> Iterator[ClusterFinding]:
    return (finding(rosproxy, REASON, f"has {text}", subject=subject) for text in texts)


def _pods(view: View, rosproxy: RosProxy) -> list[Pod]:
    """The pods of its namespace; of several RosProxies there the first one is told."""
    namespace = rosproxy.id.namespace
    if rosproxy.id != min(id for id in view.rosproxies if id.namespace == namespace):
        return []
    pods = (
        pod
        for pod in view.observed.misspelt_pods
        if pod.id.namespace == namespace and not (pod.ended or pod.deleting)
    )
    return sorted(pods, key=lambda pod: pod.id)[:MOST_PODS]
