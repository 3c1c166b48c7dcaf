"""Findings about selected pods whose rmw_zenoh nodes do not use the proxy.

The webhook makes the nodes clients of the proxy's router, by ZENOH_CONFIG_OVERRIDE. The operator
does not see variables that the image sets.
"""

from collections.abc import Iterator

from rosproxy.shared.output.text import clean
from rosproxy_operator.common.problem import NOT_WIRED, Fault
from rosproxy_operator.common.zenoh import OVERRIDE, connect_endpoints, is_client, tcp_endpoint
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix, recreate_command
from rosproxy_operator.kubernetes.planner.pods.unwired import UNKNOWN_WEBHOOK, missing_variable
from rosproxy_operator.kubernetes.planner.pods.wiring import is_of_service, uses_dds, wired_override
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.model import (
    REFERENCE,
    ClusterFinding,
    Pod,
    PodContainer,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import ROUTERS, router_of
from rosproxy_operator.kubernetes.status.findings import pod_finding


def zenoh_findings(
    pod: Pod, rosproxy: RosProxy, address: str, webhook: WebhookState = UNKNOWN_WEBHOOK
) -> Iterator[ClusterFinding]:
    """Yield findings about a pod. ``address`` is the address of the RosProxy's Service."""
    if rosproxy.spec.zenoh is None:
        return
    found = dict.fromkeys(p for c in pod.containers for p in _problems(c, pod, rosproxy, address))
    fault = _wiring_problem(pod, rosproxy, address, webhook)
    if fault and not any(reason == NOT_WIRED for reason, _ in found):
        found[NOT_WIRED, fault] = None
    for reason, fault in found:
        yield pod_finding(pod, rosproxy, reason, fault, fatal=False)


def _wiring_problem(
    pod: Pod, rosproxy: RosProxy, address: str, webhook: WebhookState
) -> Fault | None:
    """The fault of the override that the webhook sets; None if there is no fault."""
    router = router_of(address)
    endpoint = tcp_endpoint(router)
    if pod.router_endpoint and pod.router_endpoint != endpoint:
        return Fault(
            f"was wired to {clean(pod.router_endpoint)[:200]} ({OVERRIDE}), but the proxy is at "
            f"{endpoint} now",
            f"Run {recreate_command(pod)}",
        )
    if pod.router_endpoint:
        return None
    lacking = (wired_override(c.variables, router, endpoint) for c in pod.containers)
    if not pod.containers or any(lacking):
        return missing_variable(OVERRIDE, pod, rosproxy, webhook)
    return None


def _problems(
    container: PodContainer, pod: Pod, rosproxy: RosProxy, address: str
) -> Iterator[tuple[str, Fault]]:
    """Yield the reason and the fault, for each fault of a container."""
    if uses_dds(container.variables):
        rmw = clean(container.variables["RMW_IMPLEMENTATION"])[:200]
        text = f"variable RMW_IMPLEMENTATION={rmw} is DDS, and RosProxy {rosproxy.id.name} is for "
        fix = edit_fix("Set rmw_zenoh_cpp in the template", pod)
        yield "NoZenoh", Fault(f"{text}rmw_zenoh", f"{fix}. Or use a RosProxy with spec.ros: 2")
        return
    override = container.variables.get(OVERRIDE, "")
    extended = wired_override(container.variables, router_of(address), pod.router_endpoint)
    if extended or REFERENCE in override:
        return
    if not _leads_to_proxy(override, rosproxy, address, pod.router_endpoint):
        text = f"variable {OVERRIDE} of the template connects the nodes past the proxy"
        fix = "Remove mode and connect/endpoints from the variable, and name routers outside in "
        yield NOT_WIRED, Fault(text, edit_fix(f"{fix}spec.peers", pod))
    elif not is_client(override):
        text = f"variable {OVERRIDE} of the template makes the nodes peers of the proxy's router, "
        text += "which passes no messages between two peers"
        yield NOT_WIRED, Fault(text, edit_fix("Add mode=client to the variable", pod))


def _leads_to_proxy(override: str, rosproxy: RosProxy, address: str, wired: str) -> bool:
    """Whether all endpoints of an override name the RosProxy's Service.

    ``wired`` is the endpoint that the webhook has set: `_wiring_problem` judges this endpoint.
    """
    endpoints = connect_endpoints(override)
    return bool(endpoints) and all(
        protocol == "tcp"
        and at.port == ROUTERS.first
        and (tcp_endpoint(at) == wired or is_of_service(at.host, rosproxy.id, address))
        for protocol, at in endpoints
    )
