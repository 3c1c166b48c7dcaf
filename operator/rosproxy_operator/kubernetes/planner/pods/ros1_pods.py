"""Findings about selected pods whose ROS 1 nodes do not use the proxy."""

from rosproxy.shared.output.text import clean
from rosproxy.shared.uris import parse_slave_uri
from rosproxy_operator.common.problem import NOT_WIRED, Fault
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix, recreate_command
from rosproxy_operator.kubernetes.planner.pods.unwired import UNKNOWN_WEBHOOK, missing_variable
from rosproxy_operator.kubernetes.planner.pods.wiring import is_of_service, masters_of, names_master
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.model import (
    VALUE_AT_RUNTIME,
    ClusterFinding,
    Name,
    Pod,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    MASTER_PORT,
    master_uri,
)
from rosproxy_operator.kubernetes.status.findings import pod_finding


def ros1_finding(
    pod: Pod, rosproxy: RosProxy, cluster_ip: str, webhook: WebhookState = UNKNOWN_WEBHOOK
) -> ClusterFinding | None:
    """Return a finding (reason NotWired) if the ROS 1 nodes of a selected pod do not use its proxy.

    Also if the pod has to be recreated: the ROS nodes may not be registered any more. Else None.
    ``cluster_ip`` is the address of the RosProxy's Service.
    """
    fault = _why_not_wired(pod, rosproxy, cluster_ip, webhook)
    return pod_finding(pod, rosproxy, NOT_WIRED, fault, fatal=False) if fault else None


def _why_not_wired(
    pod: Pod, rosproxy: RosProxy, cluster_ip: str, webhook: WebhookState
) -> Fault | None:
    """Return why the ROS 1 nodes of a pod do not use the proxy, and the fix; else None."""
    masters = masters_of(rosproxy)
    bypassing = [
        uri for uri in pod.own_masters if not _leads_to_proxy(uri, rosproxy.id, cluster_ip)
    ]
    foreign = [uri for uri in bypassing if not names_master(uri, masters)]
    if foreign:
        return Fault(
            f"variable ROS_MASTER_URI={clean(foreign[0])[:200]} of the template does not lead to "
            "the proxy, so the nodes bypass the proxy",
            edit_fix("Remove the variable from the template", pod),
        )
    if pod.wired_master_uri and pod.wired_master_uri != master_uri(cluster_ip):
        return Fault(
            f"was wired to {clean(pod.wired_master_uri)[:200]}, but the proxy is at "
            f"{master_uri(cluster_ip)} now",
            _recreation(pod, rosproxy),
        )
    uses_proxy = bool(pod.wired_master_uri) or not bypassing
    if uses_proxy and (lost := why_lost(pod, rosproxy)):
        return Fault(lost, _recreation(pod, rosproxy))
    if not bypassing and (pod.wired_master_uri or pod.own_masters):
        return None
    return missing_variable("ROS_MASTER_URI", pod, rosproxy, webhook)


def names_former_master(pod: Pod, rosproxy: RosProxy) -> bool:
    """Whether the template names a master that the RosProxy had before.

    The webhook keeps such a value, since the value may be another master on purpose. So the nodes
    of a new pod would bypass the proxy.
    """
    replaced = pod.replaced_master_uri
    return bool(replaced) and not names_master(replaced, masters_of(rosproxy))


def _recreation(pod: Pod, rosproxy: RosProxy) -> str:
    """The fix that makes the nodes of a new pod use the proxy."""
    if names_former_master(pod, rosproxy):
        former = f"ROS_MASTER_URI={clean(pod.replaced_master_uri)[:200]}"
        return edit_fix(f"Remove {former} from the template, which is not spec.master", pod)
    return f"Run {recreate_command(pod)}"


def why_lost(pod: Pod, rosproxy: RosProxy) -> str:
    """Return why the ROS 1 nodes of a wired pod may be unregistered for good; empty if they aren't.

    The proxy unregisters the nodes when the RosProxy is deleted, and when the operator moves the
    proxy or no longer needs the proxy (`unregistrations`). ROS 1 nodes don't register again by
    themselves. A container that was started later has new nodes, which register at their start. If
    a proxy has nodes at the address of the pod, the nodes of the pod are registered. That is
    unknown while the proxy does not answer.
    """
    is_registered = bool(rosproxy.registered & {pod.ip, *pod.ips})
    if not pod.running_since or is_registered or pod.node in rosproxy.silent:
        return ""
    # The times are RFC 3339 in UTC with whole seconds, so texts sort like times.
    if pod.running_since < rosproxy.created:
        return (
            f"is older than RosProxy {rosproxy.id.name}: the former RosProxy of that name was "
            "deleted, and the ROS nodes of the pod may have been unregistered at the master"
        )
    at = rosproxy.unregistered_at.get(pod.node, "")
    # Within the same second, the nodes may have registered before.
    if pod.running_since <= at:
        return (
            f"was started before {at}, when the proxy on node {pod.node} unregistered ROS nodes "
            f"after a change of RosProxy {rosproxy.id.name} or of the selected pods. The ROS nodes "
            "of this pod may have been unregistered for good"
        )
    return ""


def _leads_to_proxy(uri: str, rosproxy_id: Name, cluster_ip: str) -> bool:
    """Whether a ROS_MASTER_URI leads to a RosProxy's Service, by address or by name.

    The operator can't see a value that is only known at run time, and accepts that value.
    """
    if uri == VALUE_AT_RUNTIME:
        return True
    master = parse_slave_uri(uri.strip())
    if master is None or master.port != MASTER_PORT:
        return False
    return is_of_service(master.host, rosproxy_id, cluster_ip)
