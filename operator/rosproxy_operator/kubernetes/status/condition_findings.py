"""The findings of the doctor from the statuses of all RosProxies."""

from collections.abc import Iterable, Iterator

from rosproxy.admin.doctor_finding import DoctorFinding, error, ok, warning
from rosproxy_operator.kubernetes.resources.checks import int_at, submaps, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.names import INJECT
from rosproxy_operator.kubernetes.status.fixes import fix_for

_WRONG = {
    "MasterReachable": "False",
    "PortsReachable": "False",
    "PortsAllocated": "False",
    "Ready": "False",
    "Degraded": "True",
}
"""By condition, the status that means trouble; causes go before what follows from them."""


def cluster_findings(rosproxies: Iterable[Json]) -> list[DoctorFinding]:
    """All findings of a cluster, by its RosProxies; each text once, where it is a cause."""
    findings = [finding for rosproxy in rosproxies for finding in _findings_of(rosproxy)]
    if not findings:
        fix = (
            "create a RosProxy with kubectl apply; check that the cluster has the definition: "
            "kubectl get crd rosproxies.rosproxy.io"
        )
        return [warning("rosproxy", "cluster", "there is no RosProxy", fix)]
    return findings


def _findings_of(rosproxy: Json) -> Iterator[DoctorFinding]:
    metadata = rosproxy["metadata"]
    status = rosproxy.get("status", {})
    id = Name(metadata["namespace"], metadata["name"])
    subject = f"rosproxy {id}"
    conditions = {text_at(c, "type"): c for c in submaps(status, "conditions")}
    if int_at(status, "observedGeneration") < metadata.get("generation", 0):
        text = "the operator has not looked at the last change of this RosProxy yet"
        fix = (
            "check that the operator runs: kubectl get pods -A -l "
            "app.kubernetes.io/name=rosproxy-operator"
        )
        yield error("operator", subject, text, fix)
    messages: set[str] = set()
    for kind, bad in _WRONG.items():
        condition = conditions.get(kind, {})
        message = text_at(condition, "message")
        if text_at(condition, "status") == bad and message not in messages:
            messages.add(message)
            fix = fix_for(text_at(condition, "reason"), id)
            yield error("rosproxy", subject, f"{kind} is {bad}: {message}", fix)
    if messages:
        return
    if int_at(status, "nodes"):
        text = f"proxies {text_at(status, 'proxies')} ready, {int_at(status, 'rosNodes')} ROS nodes"
        yield ok("rosproxy", subject, text)
    else:
        text = "no running pod is selected"
        fix = f"add the label {INJECT}={metadata['name']} to the template of your pods"
        yield warning("rosproxy", subject, text, fix)
