"""The doctor's findings about operators: whether an operator runs, and manages a namespace.

Without an operator, all other findings are consequences.
"""

from collections.abc import Iterator

import msgspec

from rosproxy.shared.documents.doctor_finding import DoctorFinding, error
from rosproxy.shared.output.text import listed
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.status.operator_options import option_values

OPERATOR_SELECTOR = "app.kubernetes.io/component=operator,app.kubernetes.io/part-of=rosproxy"
"""Label selector of the pods of operators."""
_CHECK = "operator"
_OPTION = "--namespace"
MANAGE = "add the namespace to the chart's value namespaces and run helm upgrade"
"""The fix for a namespace that no operator manages."""


class Operators(msgspec.Struct, frozen=True):
    """The operators in the cluster. ``pods`` is None if the doctor could not read the pods.

    In ``refused_namespaces`` no operator has the right to write the status of a RosProxy.
    """

    pods: tuple[Json, ...] | None = None
    refused_namespaces: frozenset[str] = frozenset()

    @property
    def missing(self) -> bool:
        """Whether there is certainly no operator."""
        return self.pods == ()

    @property
    def ready_since(self) -> str:
        """Since when an operator is ready, in RFC 3339; empty if no operator is ready.

        Of several ready pods, the time is the earliest.
        """
        return min(filter(None, map(ready_since, self.pods or ())), default="")

    @property
    def namespaces(self) -> frozenset[str]:
        """The namespaces that operators manage; empty for all namespaces, or if unknown."""
        managed = [_namespaces(pod) for pod in self.pods or ()]
        return frozenset().union(*managed) if all(managed) else frozenset()


UNKNOWN = Operators()


def operator_findings(operators: Operators) -> Iterator[DoctorFinding]:
    """An error if no operator runs, or if no operator is ready."""
    if operators.missing:
        text = "no operator runs in the cluster, so no pod is wired and no proxy is created"
        fix = (
            "install the operator: helm upgrade --install rosproxy charts/rosproxy-operator "
            "--namespace rosproxy-system --create-namespace, or kubectl apply -f "
            "manifests/install.yaml"
        )
        yield error(_CHECK, _CHECK, text, fix)
    elif operators.pods and not operators.ready_since:
        ids = sorted(str(_id(pod)) for pod in operators.pods)
        text = f"no operator is ready (pods {listed(ids)}), so no pod is wired"
        namespace = _id(operators.pods[0]).namespace
        fix = f"{_log(namespace)}; {describe_operators(namespace)}"
        yield error(_CHECK, _CHECK, text, fix)


def unmanaged_finding(rosproxy: Name, operators: Operators) -> DoctorFinding | None:
    """The error about a RosProxy in a namespace that no operator manages, else None."""
    text = why_unmanaged(rosproxy.namespace, operators)
    fix = f"{MANAGE}, or create the RosProxy in a namespace of the value"
    return error(_CHECK, f"rosproxy {rosproxy}", text, fix) if text else None


def why_unmanaged(namespace: str, operators: Operators) -> str:
    """Why no operator looks after a namespace; empty if an operator does, or if that is unknown."""
    managed = operators.namespaces
    if not managed or namespace in managed:
        return ""
    return (
        f"no operator manages the namespace {namespace} (option {_OPTION} of the operator: "
        f"{listed(sorted(managed))})"
    )


def unnoticed_finding(rosproxy: Name, operators: Operators) -> DoctorFinding:
    """The error about a RosProxy for whose last change no operator has written a status."""
    subject = f"rosproxy {rosproxy}"
    namespace = rosproxy.namespace
    if namespace in operators.refused_namespaces:
        text = "the operator lacks the right to patch rosproxies/status in this namespace"
        fix = (
            "install the operator's chart or manifests again, which contain the role; with "
            "rbac.create=false, add the right to your role"
        )
        return error(_CHECK, subject, text, fix)
    text = "the operator has not looked at the last change of this RosProxy yet"
    fix = f"check that the operator runs: kubectl get pods -A -l {OPERATOR_SELECTOR}"
    if managers := _managers(operators, namespace):
        fix = _log(_id(managers[0]).namespace)
    return error(_CHECK, subject, text, fix)


def _log(namespace: str) -> str:
    return (
        f"read the operator's log: kubectl -n {namespace} logs -l "
        "app.kubernetes.io/component=operator --prefix"
    )


def describe_operators(namespace: str) -> str:
    """The commands that show why operators are not ready."""
    return (
        f"read kubectl -n {namespace} describe pods -l app.kubernetes.io/component=operator, and "
        f"helm -n {namespace} list"
    )


def ready_since(pod: Json) -> str:
    """Since when a pod is ready, in RFC 3339; empty if the pod is not ready."""
    conditions = submaps(submap(pod, "status"), "conditions")
    ready = (c for c in conditions if c.get("type") == "Ready" and c.get("status") == "True")
    return next((text_at(c, "lastTransitionTime") for c in ready), "")


def service_accounts(operators: Operators, namespace: str) -> tuple[Name, ...]:
    """The service accounts of the operators that manage a namespace, each once."""
    pods = _managers(operators, namespace)
    ids = (Name(_id(p).namespace, text_at(submap(p, "spec"), "serviceAccountName")) for p in pods)
    return tuple(dict.fromkeys(id for id in ids if id.name))


def _managers(operators: Operators, namespace: str) -> list[Json]:
    """The pods of the operators that manage a namespace."""
    managed = [(pod, _namespaces(pod)) for pod in operators.pods or ()]
    return [pod for pod, namespaces in managed if not namespaces or namespace in namespaces]


def _id(pod: Json) -> Name:
    metadata = submap(pod, "metadata")
    return Name(text_at(metadata, "namespace"), text_at(metadata, "name"))


def _namespaces(pod: Json) -> frozenset[str]:
    """The namespaces that an operator manages; empty for all namespaces, or if unknown."""
    namespaces = frozenset(option_values(pod, _OPTION))
    return frozenset() if "" in namespaces else namespaces
