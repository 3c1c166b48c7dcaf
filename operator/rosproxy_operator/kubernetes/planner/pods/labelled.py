"""Findings of the doctor about labelled pods.

The doctor reads the pods itself: no operator has to run.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

from rosproxy.shared.documents.doctor_finding import DoctorFinding, error
from rosproxy.shared.output.text import listed, plural
from rosproxy_operator.kubernetes.planner.cluster_view import group_by_key
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix, recreate_command
from rosproxy_operator.kubernetes.planner.pods.recreation import needs_recreation
from rosproxy_operator.kubernetes.planner.pods.selection import select_rosproxy, wants_proxy
from rosproxy_operator.kubernetes.planner.pods.unwired import should_be_wired
from rosproxy_operator.kubernetes.resources.model import Name, Pod, RosProxy
from rosproxy_operator.kubernetes.resources.names import INJECT
from rosproxy_operator.kubernetes.status.operator_findings import (
    MANAGE,
    Operators,
    why_unmanaged,
)

MOST_COMMANDS = 5
"""Most commands in a fix."""
MOST_MISSPELT_FINDINGS = 10
"""Most findings about misspelt labels and annotations of pods."""


def missing_rosproxy_findings(
    pods: Iterable[Pod], with_rosproxy: frozenset[str], operators: Operators
) -> Iterator[DoctorFinding]:
    """Yield an error for each namespace that has labelled pods, but no RosProxy.

    ``with_rosproxy`` has the namespaces with a RosProxy.
    """
    unserved = (p for p in pods if wants_proxy(p) and p.id.namespace not in with_rosproxy)
    for namespace, group in sorted(group_by_key((p.id.namespace, p) for p in unserved).items()):
        names = listed(sorted(p.id.name for p in group))
        text = (
            f"the namespace has no RosProxy, but {plural(len(group), 'pod')} with the label "
            f"{INJECT} ({names}), so outside can't reach the ROS nodes of these pods"
        )
        restarts = sorted({recreate_command(pod) for pod in group})[:MOST_COMMANDS]
        fix = f"create a RosProxy in the namespace, then run {'; '.join(restarts)}"
        if unmanaged := why_unmanaged(namespace, operators):
            text = f"{unmanaged}, and {text}"
            fix = f"{MANAGE}, {fix}"
        yield error("pods", f"namespace {namespace}", text, fix)


def misspelt_findings(pods: Iterable[Pod], with_rosproxy: frozenset[str]) -> list[DoctorFinding]:
    """Return errors about misspelt labels and annotations of pods, in namespaces without RosProxy.

    Pods with the same text and the same fix share an error. The list has at most
    MOST_MISSPELT_FINDINGS. In a namespace with a RosProxy, the status of the RosProxy reports them.
    """
    unserved = sorted((p for p in pods if p.id.namespace not in with_rosproxy), key=lambda p: p.id)
    first: dict[tuple[str, str], Pod] = {}
    for pod in unserved:
        for text in pod.misspelt:
            first.setdefault((text, edit_fix("correct the name in the template", pod)), pod)
    found = [error("pods", f"pod {pod.id}", text, fix) for (text, fix), pod in first.items()]
    return found[:MOST_MISSPELT_FINDINGS]


def unreached(
    pods: Iterable[Pod],
    rosproxies: Sequence[RosProxy],
    ready_since: str,
    service_since: Callable[[Name], str],
) -> list[str]:
    """Return the unwired pods that were created while an operator was ready, as NAMESPACE/NAME.

    ``ready_since`` is the RFC 3339 time at which an operator became ready; empty without an
    operator. ``service_since`` returns since when a RosProxy has its Service; empty if unknown.
    """
    chosen = [(pod, select_rosproxy(pod, rosproxies)) for pod in pods]
    return sorted(
        str(pod.id)
        for pod, rosproxy in chosen
        if isinstance(rosproxy, RosProxy)
        and rosproxy.cluster_ip
        and not (pod.wired_master_uri or pod.static_peers or pod.router_endpoint)
        and needs_recreation(pod, rosproxy, rosproxy.cluster_ip)
        and should_be_wired(pod, rosproxy, ready_since)
        and should_be_wired(pod, rosproxy, ready_since, service_since(rosproxy.id))
    )
