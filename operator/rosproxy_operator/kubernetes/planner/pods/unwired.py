"""Why a pod has no variable of the webhook, or has the variable of a former domain."""

from datetime import datetime, timedelta

from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix, recreate_command
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.model import (
    Pod,
    PodContainer,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    INJECT,
    service_id,
)

WEBHOOK_READY_AFTER = timedelta(minutes=1)
"""Time after which the webhook is sure to wire the pods of a new RosProxy.

The time starts when the RosProxy exists and the webhook is ready.
"""


UNKNOWN_WEBHOOK = WebhookState()


def missing_variable(variable: str, pod: Pod, rosproxy: RosProxy, webhook: WebhookState) -> Fault:
    """The fault of a pod without the variable: the reason and the fix."""
    text = f"has no variable {variable} with the address of the proxy"
    if INJECT not in pod.labels:
        label = f"{INJECT}={rosproxy.id.name}"
        fix = edit_fix(f"Add the label {label} to the template", pod)
        return Fault(f"{text}, since the pod has no label {INJECT}", fix)
    restart = f"Run {recreate_command(pod)}"
    if not webhook.served:
        fix = edit_fix(f"Set {variable} in the template", pod)
        reason = "the operator serves no webhook (webhook.enabled=false)"
        return Fault(f"{text}, since {reason}", fix)
    if pod.wired_master_uri or pod.static_peers or pod.router_endpoint:
        changed = f"spec.ros of RosProxy {rosproxy.id.name} has changed"
        return Fault(f"{text}, since {changed} after the pod was created", restart)
    if younger := _younger_object(pod, rosproxy, webhook.service_since):
        return Fault(f"{text}, since the pod is older than {younger}", restart)
    reason = (
        "no operator answered the API server at the webhook port (chart value webhook.port) when "
        "the pod was created"
    )
    if should_be_wired(pod, rosproxy, webhook.since, webhook.service_since):
        return Fault(
            f"{text}, since {reason}, although an operator was ready",
            "Allow connections from the API server to the webhook port of the operator's pods "
            f"(NetworkPolicy, firewall). {restart}",
        )
    return Fault(f"{text}, since {reason}", restart)


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
    (``service_since``; empty if unknown). False if another time is not known.
    """
    if not (pod.created and rosproxy.created and ready_since):
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
