"""A labelled pod for a dry run: shows whether the API server reaches the webhook.

In a dry run the API server calls the webhook, and creates nothing. If the API server reaches an
operator, the answer is a wired pod.
"""

from collections.abc import Sequence

from rosproxy_operator.kubernetes.planner.pods.selection import matches, select_rosproxy
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at, texts_at
from rosproxy_operator.kubernetes.resources.model import Json, RosProxy, Selector
from rosproxy_operator.kubernetes.resources.names import INJECT

_NAMESPACE_NAME = "kubernetes.io/metadata.name"
"""The label of each namespace with the name of the namespace."""
_AMOUNTS = {"cpu": "1m", "memory": "1Mi"}
_SPEC = {
    "automountServiceAccountToken": False,
    "securityContext": {
        "runAsNonRoot": True,
        "runAsUser": 10001,
        "seccompProfile": {"type": "RuntimeDefault"},
    },
    "containers": [
        {
            "name": "ros",
            "image": "rosproxy",
            "resources": {"requests": _AMOUNTS, "limits": _AMOUNTS},
            "securityContext": {
                "allowPrivilegeEscalation": False,
                "capabilities": {"drop": ["ALL"]},
            },
        }
    ],
}
"""The restricted Pod Security Standard and quotas of CPU and memory admit this spec."""


def trial_pod(webhook: Json, rosproxies: Sequence[RosProxy]) -> Json | None:
    """Return a pod that a webhook of a MutatingWebhookConfiguration has to wire.

    None if no RosProxy has a Service, or if the doctor can't be sure that the API server calls the
    webhook for a pod: the webhook may have matchConditions, or select namespaces by own labels.
    """
    candidates = (r for r in sorted(rosproxies, key=lambda r: r.id) if r.cluster_ip)
    pods = ((rosproxy, _pod(webhook, rosproxy)) for rosproxy in candidates)
    return next((pod for r, pod in pods if _is_called(webhook, pod, r, rosproxies)), None)


def _pod(webhook: Json, rosproxy: RosProxy) -> Json:
    own = rosproxy.spec.pod_selector.labels if rosproxy.spec.pod_selector else {}
    wanted = texts_at(webhook, "objectSelector", "matchLabels")
    labels = {**wanted, **own, INJECT: rosproxy.id.name}
    metadata = {
        "generateName": "rosproxy-doctor-",
        "namespace": rosproxy.id.namespace,
        "labels": labels,
    }
    return {"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": _SPEC}


def _is_called(
    webhook: Json, pod: Json, rosproxy: RosProxy, rosproxies: Sequence[RosProxy]
) -> bool:
    """Whether the API server is sure to call a webhook for a pod, and the pod gets a RosProxy."""
    of_namespaces = _selector(submap(webhook, "namespaceSelector"))
    keys = {*of_namespaces.labels, *(key for key, _, _ in of_namespaces.expressions)}
    return (
        keys <= {_NAMESPACE_NAME}
        and matches(of_namespaces, {_NAMESPACE_NAME: rosproxy.id.namespace})
        and matches(_selector(submap(webhook, "objectSelector")), pod["metadata"]["labels"])
        and not submaps(webhook, "matchConditions")
        and select_rosproxy(objects.pod(pod), rosproxies) == rosproxy
    )


def _selector(selector: Json) -> Selector:
    """Return a selector that the API server has checked."""
    expressions = (
        (text_at(e, "key"), text_at(e, "operator"), frozenset(map(str, e.get("values") or ())))
        for e in submaps(selector, "matchExpressions")
    )
    return Selector(texts_at(selector, "matchLabels"), tuple(expressions))
