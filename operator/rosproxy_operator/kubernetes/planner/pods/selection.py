"""Which pods a RosProxy takes."""

from collections.abc import Iterable, Mapping

from rosproxy_operator.kubernetes.planner.pods.injection import again, edited
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    ClusterNode,
    Pod,
    RosProxy,
    Selector,
)
from rosproxy_operator.kubernetes.resources.names import COMPONENT_LABEL, INJECT, NAME_LABEL, is_own
from rosproxy_operator.kubernetes.status.findings import pod_finding

LABEL_OFF_VALUES = ("", "false")
"""Values of the label with which a pod is left alone, whatever a podSelector says."""
MOST_NAMES = 5
"""RosProxies that a text names."""
_ANY = "true"
_PART_OF_LABEL = "app.kubernetes.io/part-of"


def matches(selector: Selector, labels: Mapping[str, str]) -> bool:
    """Whether a label selector fits labels.

    As ``Requirement.Matches`` in k8s.io/apimachinery, pkg/labels/selector.go, says.
    """
    if any(labels.get(key) != value for key, value in selector.labels.items()):
        return False
    return all(_fits(*e, labels) for e in selector.expressions)


def own_values(name: str) -> tuple[str, str]:
    """The values of the label with which the RosProxy ``name`` is asked for."""
    return _ANY, name


def select_rosproxy(pod: Pod, rosproxies: Iterable[RosProxy]) -> RosProxy | ClusterFinding | None:
    """The RosProxy of a pod, of those of any namespace that are not being deleted.

    Of several it is the one that the pod's label names. A finding (reason Ambiguous or HostNetwork)
    says why it has none though it was selected; None: no RosProxy selects it.
    """
    taking = sorted((r for r in rosproxies if selects(r, pod)), key=lambda r: r.id)
    named = [r for r in taking if r.id.name == pod.labels.get(INJECT)]
    if not taking:
        return None
    if not named and len(taking) > 1:
        names = [r.id.name for r in taking]
        text = (
            f"is selected by RosProxy {' and '.join(names)}, so the pod gets no proxy. Set the "
            f"label to the name of one RosProxy, such as {INJECT}={names[0]}"
        )
        return pod_finding(pod, taking[0], "Ambiguous", text)
    rosproxy = (named or taking)[0]
    if pod.host_network:
        text = (
            "is on the node's own network (hostNetwork), where ROS nodes need no proxy and get "
            f"none. Remove the label {INJECT}, or remove hostNetwork"
        )
        return pod_finding(pod, rosproxy, "HostNetwork", text)
    return rosproxy


def why_not_selected(pod: Pod, rosproxies: Iterable[RosProxy]) -> str:
    """Why no RosProxy takes a pod that is labelled, and what to do.

    Empty if the pod is not labelled, or its label says that it is to be left alone.
    """
    label = pod.labels.get(INJECT, "")
    names = sorted(r.id.name for r in rosproxies if r.id.namespace == pod.id.namespace)
    if label in LABEL_OFF_VALUES:
        return ""
    lost = "outside can't reach the ROS nodes of the pod"
    if not names:
        return (
            f"namespace {pod.id.namespace} has no RosProxy, so {lost}. Create a RosProxy there, "
            f"then {again(pod)}"
        )
    if label not in (_ANY, *names):
        value = " or ".join(names[:MOST_NAMES])
        if label.lower() in (_ANY, *LABEL_OFF_VALUES):
            value = f"{label.lower()} in lower case"
        return (
            f"label {INJECT}={label} names no RosProxy of namespace {pod.id.namespace}, so {lost}. "
            f"{edited(f'Set the label to {value} in the template', pod)}"
        )
    return (
        "the labels of the pod do not match spec.podSelector of RosProxy "
        f"{' and '.join(names[:MOST_NAMES])}, "
        f"so {lost}. Change the labels or the selector, then {again(pod)}"
    )


def wants_proxy(pod: Pod) -> bool:
    """Whether a pod asks for a proxy by its label."""
    return pod.labels.get(INJECT, "") not in LABEL_OFF_VALUES and not _is_ours(pod.labels)


def on_node(rosproxy: RosProxy, node: ClusterNode) -> bool:
    """Whether the RosProxy's nodeSelector fits a node."""
    return matches(Selector(rosproxy.spec.node_selector or {}), node.labels)


def selects(rosproxy: RosProxy, pod: Pod) -> bool:
    """Whether a RosProxy that is not being deleted selects a pod, perhaps along with others."""
    label = pod.labels.get(INJECT)
    selector = rosproxy.spec.pod_selector
    same_namespace = rosproxy.id.namespace == pod.id.namespace
    if not same_namespace or rosproxy.deleting or label in LABEL_OFF_VALUES or _is_ours(pod.labels):
        return False
    if selector is None:
        return label in own_values(rosproxy.id.name)
    return matches(selector, pod.labels)


def _is_ours(labels: Mapping[str, str]) -> bool:
    """Whether labels are those of a proxy, or of the operator as its chart labels it."""
    names = (labels.get(NAME_LABEL), labels.get(_PART_OF_LABEL))
    return is_own(labels) or (labels.get(COMPONENT_LABEL) == "operator" and "rosproxy" in names)


def _fits(key: str, operator: str, values: frozenset[str], labels: Mapping[str, str]) -> bool:
    match operator:
        case "In":
            return labels.get(key) in values
        case "NotIn":
            return labels.get(key) not in values
        case "Exists":
            return key in labels
        case _:  # DoesNotExist
            return key not in labels
