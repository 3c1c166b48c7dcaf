"""Selects the RosProxy of a pod, by the pod's labels."""

from collections.abc import Iterable, Mapping

from rosproxy_operator.kubernetes.planner.pods.wiring import edit_fix, recreate_fix
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
"""Values of the label with which no RosProxy selects the pod, not even by a podSelector."""
MOST_NAMES = 5
"""Most RosProxies that a text names."""
_ANY = "true"
_PART_OF_LABEL = "app.kubernetes.io/part-of"


def matches(selector: Selector, labels: Mapping[str, str]) -> bool:
    """Whether a label selector matches labels.

    The rules are from ``Requirement.Matches`` in k8s.io/apimachinery, pkg/labels/selector.go.
    """
    if any(labels.get(key) != value for key, value in selector.labels.items()):
        return False
    return all(_fits(*e, labels) for e in selector.expressions)


def own_values(name: str) -> tuple[str, str]:
    """The values of the label that ask for the RosProxy ``name``."""
    return _ANY, name


def select_rosproxy(pod: Pod, rosproxies: Iterable[RosProxy]) -> RosProxy | ClusterFinding | None:
    """Return the RosProxy that takes a pod, or the reason why a selected pod gets no proxy.

    If several RosProxies select the pod, the pod's label has to name one of them: otherwise the
    result is a finding with the reason Ambiguous. For a pod in the host's network, the result is a
    finding with the reason HostNetwork. If no RosProxy selects the pod, the result is None.
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
    """Return why no RosProxy selects a labelled pod, and the fix.

    The result is empty if the pod has no label, or a value of `LABEL_OFF_VALUES`. The caller has
    checked that no RosProxy selects the pod.
    """
    label = pod.labels.get(INJECT, "")
    names = sorted(r.id.name for r in rosproxies if r.id.namespace == pod.id.namespace)
    if label in LABEL_OFF_VALUES:
        return ""
    lost = "outside can't reach the ROS nodes of the pod"
    if not names:
        return (
            f"namespace {pod.id.namespace} has no RosProxy, so {lost}. Create a RosProxy there, "
            f"then {recreate_fix(pod)}"
        )
    if label not in (_ANY, *names):
        value = " or ".join(names[:MOST_NAMES])
        if label.lower() in (_ANY, *LABEL_OFF_VALUES):
            value = f"{label.lower()} in lower case"
        return (
            f"label {INJECT}={label} names no RosProxy of namespace {pod.id.namespace}, so {lost}. "
            f"{edit_fix(f'Set the label to {value} in the template', pod)}"
        )
    return (
        "the labels of the pod do not match spec.podSelector of RosProxy "
        f"{' and '.join(names[:MOST_NAMES])}, "
        f"so {lost}. Change the labels or the selector, then {recreate_fix(pod)}"
    )


def wants_proxy(pod: Pod) -> bool:
    """Whether the label of a pod asks for a proxy."""
    return pod.labels.get(INJECT, "") not in LABEL_OFF_VALUES and not _is_ours(pod.labels)


def on_node(rosproxy: RosProxy, node: ClusterNode) -> bool:
    """Whether the RosProxy's nodeSelector matches a node."""
    return matches(Selector(rosproxy.spec.node_selector or {}), node.labels)


def selects(rosproxy: RosProxy, pod: Pod) -> bool:
    """Whether a RosProxy that is not being deleted selects a pod, maybe with other RosProxies."""
    label = pod.labels.get(INJECT)
    selector = rosproxy.spec.pod_selector
    same_namespace = rosproxy.id.namespace == pod.id.namespace
    if not same_namespace or rosproxy.deleting or label in LABEL_OFF_VALUES or _is_ours(pod.labels):
        return False
    if selector is None:
        return label in own_values(rosproxy.id.name)
    return matches(selector, pod.labels)


def _is_ours(labels: Mapping[str, str]) -> bool:
    """Whether the labels are of a pod that the operator creates, or of the operator's own pod."""
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
