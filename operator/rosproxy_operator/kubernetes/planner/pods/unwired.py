"""Why a pod has no variable of the webhook, or has the variable of a former domain."""

from datetime import datetime, timedelta

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.output.text import clean
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.common.zenoh import OVERRIDE, client_override
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix, recreate_command
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.model import (
    Pod,
    PodContainer,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    INJECT,
    ROUTERS,
    master_uri,
    service_id,
)
from rosproxy_operator.kubernetes.resources.objects import MASTER_VARIABLE

WEBHOOK_READY_AFTER = timedelta(minutes=1)
"""Time after which the webhook is sure to wire the pods of a new RosProxy.

The time starts when the RosProxy exists and the webhook is ready.
"""
UNKNOWN_WEBHOOK = WebhookState()
MOST_SHOWN_CHARACTERS = 200
_STATIC = "Node"
"""The kind of a static pod's controller. A change of its mirror pod changes no container."""


def missing_variable(variable: str, pod: Pod, rosproxy: RosProxy, webhook: WebhookState) -> Fault:
    """The fault of a pod without the variable: the reason and the fix."""
    reason, fix = _why_missing(variable, pod, rosproxy, webhook)
    return Fault(f"has no variable {variable} with the address of the proxy, since {reason}", fix)


def _why_missing(
    variable: str, pod: Pod, rosproxy: RosProxy, webhook: WebhookState
) -> tuple[str, str]:
    """The reason why a pod has no variable, and the fix."""
    if of_template := _why_never_wired(variable, pod, rosproxy, webhook):
        return of_template
    restart = f"Run {recreate_command(pod)}"
    if known := _why_not_at_creation(pod, rosproxy, webhook):
        return known, restart
    reason = (
        "no operator answered the API server at the webhook port (chart value webhook.port) when "
        "the pod was created"
    )
    if should_be_wired(pod, rosproxy, webhook.since, webhook.service_since):
        opening = (
            "Allow connections from the API server to the webhook port of the operator's pods "
            "(NetworkPolicy, firewall)"
        )
        return f"{reason}, although an operator was ready", f"{opening}. {restart}"
    return reason, restart


def _why_never_wired(
    variable: str, pod: Pod, rosproxy: RosProxy, webhook: WebhookState
) -> tuple[str, str] | None:
    """Why the webhook would not wire a new pod with this template, and the fix; None if it would.

    The webhook wires a pod by the label that the template has.
    """
    label = f"{INJECT}={rosproxy.id.name}"
    labelling = edit_fix(f"Add the label {label} to the template", pod)
    by_hand = edit_fix(f"Set {_assignment(variable, rosproxy)} in the template", pod)
    if not webhook.served:
        return "the operator serves no webhook (webhook.enabled=false)", by_hand
    if pod.controller == _STATIC:
        return "the webhook can't change a static pod", by_hand
    if INJECT not in pod.labels:
        return f"the pod has no label {INJECT}", labelling
    if pod.labelled_later:
        return f"the label {INJECT} was added after the pod was created", labelling
    return None


def _why_not_at_creation(pod: Pod, rosproxy: RosProxy, webhook: WebhookState) -> str:
    """Why the webhook did not wire a pod that it would wire now; empty if unknown."""
    if pod.wired_master_uri or pod.static_peers or pod.router_endpoint:
        return "the pod was created for another spec.ros, or for another RosProxy"
    if younger := _younger_object(pod, rosproxy, webhook.service_since):
        return f"the pod is older than {younger}"
    if pod.not_wired_because:
        known = clean(pod.not_wired_because)[:MOST_SHOWN_CHARACTERS]
        return f"the webhook could not wire the pod when it was created ({known})"
    return ""


def _assignment(variable: str, rosproxy: RosProxy) -> str:
    """The variable with the value that leads to a RosProxy's Service by name."""
    host = service_id(rosproxy.id).name
    if variable == MASTER_VARIABLE:
        return f"{variable}={master_uri(host)}, and ROS_IP from status.podIP,"
    router = HostPort(host, ROUTERS.first)
    return f"{variable}={client_override(router) if variable == OVERRIDE else host}"


def _younger_object(pod: Pod, rosproxy: RosProxy, service_since: str) -> str:
    """The object that an unwired pod lacked at its creation; empty if both objects existed.

    A pod of the same second as the object lacked the object, too: otherwise the webhook would have
    wired the pod. The operator creates the Service, so the Service is younger than the RosProxy.
    """
    if pod.created and pod.created < rosproxy.created:
        return f"RosProxy {rosproxy.id.name}"
    if pod.created and pod.created <= service_since:
        return f"Service {service_id(rosproxy.id).name} of the RosProxy"
    return ""


def should_be_wired(
    pod: Pod, rosproxy: RosProxy, ready_since: str, service_since: str = ""
) -> bool:
    """Whether the webhook should have wired a pod when the pod was created.

    The pod must be at least `WEBHOOK_READY_AFTER` younger than the RosProxy, than the time
    ``ready_since`` at which the webhook became ready, and than the Service of the RosProxy
    (``service_since``; empty if unknown). False if another time is not known, if the webhook has
    left the pod alone, and for a pod that the webhook can't wire.
    """
    if not (pod.created and rosproxy.created and ready_since):
        return False
    if pod.not_wired_because or pod.labelled_later or pod.controller == _STATIC:
        return False
    others = filter(None, (rosproxy.created, ready_since, service_since))
    latest = max(datetime.fromisoformat(time) for time in others)
    return datetime.fromisoformat(pod.created) - latest >= WEBHOOK_READY_AFTER


def is_of_former_domain(container: PodContainer, pod: Pod, rosproxy: RosProxy) -> bool:
    """Whether a container was wired before the domain of the RosProxy changed.

    Without ROS_DOMAIN_ID, the RosProxy had no domain then. But the image may set the variable.
    """
    ros2 = rosproxy.spec.ros2
    if ros2 is None:
        return False
    own = container.variables.get("ROS_DOMAIN_ID")
    if own is None:
        is_discovered = rosproxy.discovered & {pod.ip, *pod.ips}
        return bool(pod.static_peers and ros2.domain and not is_discovered)
    return own == pod.wired_domain != str(ros2.number) and own != ""
