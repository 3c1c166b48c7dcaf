"""Selects the RosProxy of a pod, by the pod's labels."""

from collections.abc import Iterable, Mapping

from rosproxy.shared.output.text import shorten
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.common.zenoh import tcp_endpoint
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix, recreate_fix
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    ClusterNode,
    Pod,
    RosProxy,
    Selector,
)
from rosproxy_operator.kubernetes.resources.names import (
    COMPONENT_LABEL,
    INJECT,
    NAME_LABEL,
    is_own,
    master_uri,
    router_of,
)
from rosproxy_operator.kubernetes.status.findings import pod_finding

LABEL_OFF_VALUES = ("", "false")
"""Values of the label with which no RosProxy selects the pod, not even by a podSelector."""
MOST_NAMES = 5
"""Most RosProxies that a text names."""
_MOST_SELECTOR_CHARACTERS = 100
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
    result is a finding with the reason Ambiguous. But a pod that was wired to a single one of them
    stays there: without its proxy, the ROS 1 nodes of the pod would be unregistered for good. For a
    pod in the host's network, the result is a finding with the reason HostNetwork. If no RosProxy
    selects the pod, the result is None.
    """
    taking = _taking(pod, rosproxies)
    if not taking:
        return None
    named = _named(pod, taking)
    wired = [r for r in taking if _is_wired_to(pod, r)]
    if not named and len(taking) > 1 and len(wired) != 1:
        text = f"is selected by RosProxy {_names(taking)}, so the pod gets no proxy"
        return pod_finding(pod, taking[0], "Ambiguous", Fault(text, _choice_fix(pod, taking[0])))
    rosproxy = (named or (wired if len(wired) == 1 else taking))[0]
    if pod.host_network:
        text = (
            "is on the node's own network (hostNetwork), where ROS nodes need no proxy and get none"
        )
        change = f"Remove hostNetwork or the label {INJECT} from the template"
        if INJECT not in pod.labels:
            change = f"Remove hostNetwork from the template, or add the label {INJECT}=false"
        fix = edit_fix(change, pod)
        return pod_finding(pod, rosproxy, "HostNetwork", Fault(text, fix))
    return rosproxy


def ambiguity_warning(pod: Pod, rosproxies: Iterable[RosProxy]) -> Fault | None:
    """Return the fault of a pod that stays with its RosProxy though several select the pod.

    The result is None if the choice is clear, or if `select_rosproxy` chooses no RosProxy.
    """
    taking = _taking(pod, rosproxies)
    wired = [r for r in taking if _is_wired_to(pod, r)]
    if len(taking) <= 1 or len(wired) != 1 or _named(pod, taking):
        return None
    kept = wired[0]
    return Fault(
        f"is selected by RosProxy {_names(taking)}. This pod stays with {kept.id.name}, but a new "
        "pod with this label gets no proxy",
        _choice_fix(pod, kept),
    )


def why_not_selected(pod: Pod, rosproxies: Iterable[RosProxy]) -> Fault | None:
    """Return why no RosProxy selects a labelled pod, and the fix.

    The result is None if the pod has no label, or a value of `LABEL_OFF_VALUES`. The caller has
    checked that no RosProxy selects the pod.
    """
    label = pod.labels.get(INJECT, "")
    local = sorted(
        (r for r in rosproxies if r.id.namespace == pod.id.namespace), key=lambda r: r.id
    )
    names = [r.id.name for r in local]
    if label in LABEL_OFF_VALUES:
        return None
    lost = "outside can't reach the ROS nodes of the pod"
    if not names:
        return Fault(
            f"namespace {pod.id.namespace} has no RosProxy, so {lost}",
            f"Create a RosProxy there, then {recreate_fix(pod)}",
        )
    if label not in (_ANY, *names):
        value = " or ".join(names[:MOST_NAMES])
        if label.lower() in (_ANY, *LABEL_OFF_VALUES):
            value = f"{label.lower()} in lower case"
        return Fault(
            f"label {INJECT}={label} names no RosProxy of namespace {pod.id.namespace}, so {lost}",
            edit_fix(f"Set the label to {value} in the template", pod),
        )
    selectors = [
        f"{r.id.name} ({shown(r.spec.pod_selector)})" for r in local if r.spec.pod_selector
    ]
    named = next((name for name in names if name == label), names[0])
    return Fault(
        "the labels of the pod do not match spec.podSelector of RosProxy "
        f"{' and '.join(selectors[:MOST_NAMES])}, so {lost}",
        f"{edit_fix('Add the missing labels to the template', pod)}. Or correct the selector: "
        f"kubectl -n {pod.id.namespace} edit rosproxy {named}; then {recreate_fix(pod)}",
    )


def shown(selector: Selector) -> str:
    """A label selector as kubectl writes it, such as ``app=talker,tier in (a,b)``."""
    parts = [f"{key}={value}" for key, value in selector.labels.items()]
    for key, operator, values in selector.expressions:
        words = {"In": "in", "NotIn": "notin"}.get(operator)
        if words:
            parts.append(f"{key} {words} ({','.join(sorted(values))})")
        else:
            parts.append(f"!{key}" if operator == "DoesNotExist" else key)
    return shorten(",".join(parts), _MOST_SELECTOR_CHARACTERS)


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


def _taking(pod: Pod, rosproxies: Iterable[RosProxy]) -> list[RosProxy]:
    """Return the RosProxies that select a pod, sorted."""
    return sorted((r for r in rosproxies if selects(r, pod)), key=lambda r: r.id)


def _named(pod: Pod, rosproxies: Iterable[RosProxy]) -> list[RosProxy]:
    """Return the RosProxy that the label of a pod names, in a list; empty without one."""
    return [r for r in rosproxies if r.id.name == pod.labels.get(INJECT)]


def _names(rosproxies: Iterable[RosProxy]) -> str:
    return " and ".join(r.id.name for r in rosproxies)


def _choice_fix(pod: Pod, rosproxy: RosProxy) -> str:
    label = f"{INJECT}={rosproxy.id.name}"
    change = f"Set the label to the name of one RosProxy, such as {label} in the template"
    return edit_fix(change, pod)


def _is_wired_to(pod: Pod, rosproxy: RosProxy) -> bool:
    """Whether a variable that the webhook set in a pod has the address of the RosProxy."""
    address = rosproxy.cluster_ip
    if not address:
        return False
    router = tcp_endpoint(router_of(address))
    wired = (pod.wired_master_uri, pod.static_peers, pod.router_endpoint)
    return bool({*wired} & {master_uri(address), address, router})


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
