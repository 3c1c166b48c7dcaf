"""Findings about selected pods whose rmw_zenoh nodes do not use the proxy.

The webhook makes the nodes clients of the proxy's router, by ZENOH_CONFIG_OVERRIDE. The operator
does not see variables that the image sets.
"""

from collections.abc import Iterator

from rosproxy.telemetry.text import clean
from rosproxy_operator.common.ros2 import is_dds
from rosproxy_operator.common.zenoh import OVERRIDE, connect_endpoints, is_client, tcp_endpoint
from rosproxy_operator.kubernetes.planner.pods.wiring import (
    UNKNOWN_WEBHOOK,
    edit_fix,
    is_of_service,
    missing_variable_text,
    recreate_command,
)
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.model import (
    VALUE_AT_RUNTIME,
    ClusterFinding,
    Pod,
    PodContainer,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import ROUTERS, router_of
from rosproxy_operator.kubernetes.status.findings import pod_finding

_UNKNOWN = VALUE_AT_RUNTIME[:2]
"""The begin of a reference to another variable, whose value the operator does not see."""


def zenoh_findings(
    pod: Pod, rosproxy: RosProxy, address: str, webhook: WebhookState = UNKNOWN_WEBHOOK
) -> Iterator[ClusterFinding]:
    """Yield findings about a pod. ``address`` is the address of the RosProxy's Service."""
    if rosproxy.spec.zenoh is None:
        return
    found = dict.fromkeys(p for c in pod.containers for p in _problems(c, pod, rosproxy, address))
    text = _wiring_problem(pod, rosproxy, address, webhook)
    if text and not any(reason == "NotWired" for reason, _ in found):
        found["NotWired", text] = None
    for reason, text in found:
        yield pod_finding(pod, rosproxy, reason, text, fatal=False)


def _wiring_problem(pod: Pod, rosproxy: RosProxy, address: str, webhook: WebhookState) -> str:
    """The fault of the override that the webhook sets; empty if there is no fault."""
    endpoint = tcp_endpoint(router_of(address))
    if pod.router_endpoint and pod.router_endpoint != endpoint:
        return (
            f"was wired to {clean(pod.router_endpoint)[:200]} ({OVERRIDE}), but the proxy is at "
            f"{endpoint} now. Run {recreate_command(pod)}"
        )
    may_use_zenoh = [c for c in pod.containers if not _uses_dds(c)]
    if pod.router_endpoint or any(OVERRIDE in c.variables for c in may_use_zenoh):
        return ""
    if pod.containers and not may_use_zenoh:
        return ""
    return missing_variable_text(OVERRIDE, pod, rosproxy, webhook)


def _problems(
    container: PodContainer, pod: Pod, rosproxy: RosProxy, address: str
) -> Iterator[tuple[str, str]]:
    """Yield the reason and the text of each fault of a container."""
    if _uses_dds(container):
        rmw = clean(container.variables["RMW_IMPLEMENTATION"])[:200]
        text = f"variable RMW_IMPLEMENTATION={rmw} is DDS, and RosProxy {rosproxy.id.name} is for "
        yield "NoZenoh", f"{text}rmw_zenoh. Use rmw_zenoh_cpp, or a RosProxy with spec.ros: 2"
        return
    override = container.variables.get(OVERRIDE)
    if override is None or _UNKNOWN in override:
        return
    if not _leads_to_proxy(override, rosproxy, address, pod.router_endpoint):
        text = f"variable {OVERRIDE} of the template connects the nodes past the proxy"
        fix = "Remove mode and connect/endpoints from the variable, and name routers outside in "
        yield "NotWired", f"{text}. {edit_fix(f'{fix}spec.peers', pod)}"
    elif not is_client(override):
        text = f"variable {OVERRIDE} of the template makes the nodes peers of the proxy's router, "
        text += "which passes no messages between two peers"
        yield "NotWired", f"{text}. {edit_fix('Add mode=client to the variable', pod)}"


def _uses_dds(container: PodContainer) -> bool:
    rmw = container.variables.get("RMW_IMPLEMENTATION", "")
    return bool(rmw) and is_dds(rmw) and _UNKNOWN not in rmw


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
