"""The doctor's findings from the statuses of all RosProxies."""

from collections.abc import Collection, Iterator

from rosproxy.shared.documents.doctor_finding import DoctorFinding, error, ok, warning
from rosproxy_operator.kubernetes.resources.checks import int_at, submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.status.fixes import fix_for
from rosproxy_operator.kubernetes.status.operator_findings import (
    UNKNOWN,
    Operators,
    unmanaged_finding,
    unnoticed_finding,
)

_BAD_STATUS = {
    "MasterReachable": "False",
    "PortsReachable": "False",
    "PeersReachable": "False",
    "SitesReachable": "False",
    "Listening": "False",
    "PortsAllocated": "False",
    "Ready": "False",
    "Degraded": "True",
}
"""By condition, the status that the doctor reports as an error.

The order matters: causes come before consequences. So a text that several conditions share is
reported at the cause.
"""


def cluster_findings(
    rosproxies: Collection[Json], operators: Operators = UNKNOWN
) -> list[DoctorFinding]:
    """The findings of all RosProxies, each text once for a RosProxy.

    Without any RosProxy, the only finding is a warning.
    """
    findings = [f for rosproxy in rosproxies for f in _findings_of(rosproxy, operators)]
    if not rosproxies:
        fix = (
            "create a RosProxy with kubectl apply; check that the cluster has the definition: "
            "kubectl get crd rosproxies.rosproxy.io"
        )
        return [warning("rosproxy", "cluster", "there is no RosProxy", fix)]
    return findings


def is_unnoticed(rosproxy: Json) -> bool:
    """Whether no operator has written the status since the last change of the spec."""
    generation = int_at(submap(rosproxy, "metadata"), "generation")
    return int_at(submap(rosproxy, "status"), "observedGeneration") < generation


def _findings_of(rosproxy: Json, operators: Operators) -> Iterator[DoctorFinding]:
    metadata = rosproxy["metadata"]
    status = rosproxy.get("status", {})
    id = Name(metadata["namespace"], metadata["name"])
    subject = f"rosproxy {id}"
    conditions = {text_at(c, "type"): c for c in submaps(status, "conditions")}
    if foreign := unmanaged_finding(id, operators):
        yield foreign
        return
    if is_unnoticed(rosproxy) and not operators.missing:
        yield unnoticed_finding(id, operators)
    messages: set[str] = set()
    for kind, bad in _BAD_STATUS.items():
        condition = conditions.get(kind, {})
        message = text_at(condition, "message")
        if text_at(condition, "status") == bad and message not in messages:
            messages.add(message)
            fix = fix_for(text_at(condition, "reason"), id)
            yield error("rosproxy", subject, f"{kind} is {bad}: {message}", fix)
    if messages or is_unnoticed(rosproxy):
        return
    if int_at(status, "nodes"):
        text = f"proxies {text_at(status, 'proxies')} ready, {int_at(status, 'rosNodes')} ROS nodes"
        yield ok("rosproxy", subject, text)
    else:
        text, _, fix = text_at(conditions.get("Ready", {}), "message").partition(". ")
        yield warning("rosproxy", subject, text or "no running pod is selected", fix)
