"""Findings about selected pods whose ROS 2 nodes the proxy can't discover.

The webhook sets ROS_STATIC_PEERS to the address of the RosProxy's Service, which leads to the proxy
on the pod's own node. A pod in which this variable has no effect gets an Event. The operator does
not see variables that the image sets. Unless the template sets ROS_DISTRO, only the name of the
image may tell the distribution.

The proxy also announces itself to the address of each pod, and some pod networks have multicast. So
the proxy may discover a pod without ROS_STATIC_PEERS. If this variable has an effect in no
container of a pod, that is a fault only if the proxy discovers no participant of the pod.
"""

import re
from collections.abc import Iterator
from itertools import chain

from rosproxy.shared.output.text import clean
from rosproxy_operator.common.problem import NOT_WIRED, Fault
from rosproxy_operator.common.ros2 import is_dds
from rosproxy_operator.kubernetes.planner.pods.pod_fixes import edit_fix, recreate_command
from rosproxy_operator.kubernetes.planner.pods.unwired import (
    UNKNOWN_WEBHOOK,
    is_of_former_domain,
    missing_variable,
)
from rosproxy_operator.kubernetes.planner.pods.wiring import has_peers, is_of_service
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.model import (
    VALUE_AT_RUNTIME,
    ClusterFinding,
    Pod,
    PodContainer,
    RosProxy,
)
from rosproxy_operator.kubernetes.status.findings import pod_finding

BEFORE_IRON = ("ardent", "bouncy", "crystal", "dashing", "eloquent", "foxy", "galactic", "humble")
"""Distributions without ROS_STATIC_PEERS (rmw_dds_common reads this variable since Iron)."""
_OLD = re.compile(rf"(?<![a-z0-9])({'|'.join(BEFORE_IRON)})(?![a-z0-9])")


def ros2_findings(
    pod: Pod,
    rosproxy: RosProxy,
    address: str,
    webhook: WebhookState = UNKNOWN_WEBHOOK,
    *,
    is_undiscovered: bool = True,
) -> Iterator[ClusterFinding]:
    """Yield findings about a pod; none if the RosProxy has no ROS 2.

    ``address`` is the address of the RosProxy's Service. ``is_undiscovered``: see
    `undiscovered.is_undiscovered`.
    """
    if rosproxy.spec.ros2 is None:
        return
    faults = [fault for c in pod.containers for fault in _other_faults(c, pod, rosproxy)]
    without_effect = [
        (*_peers_faults(c, pod, rosproxy, address, webhook), *_age_faults(c, pod))
        for c in pod.containers
    ]
    uses_peers = any(
        not found and (pod.static_peers or has_peers(container))
        for container, found in zip(pod.containers, without_effect, strict=True)
    )
    if uses_peers or is_undiscovered:
        faults += chain.from_iterable(without_effect)
    if is_undiscovered:
        faults += chain.from_iterable(_domain_faults(c, pod, rosproxy) for c in pod.containers)
    for reason, fault in dict.fromkeys(faults):
        yield pod_finding(pod, rosproxy, reason, fault, fatal=False)


def _peers_faults(
    container: PodContainer, pod: Pod, rosproxy: RosProxy, address: str, webhook: WebhookState
) -> Iterator[tuple[str, Fault]]:
    """Yield the reason and the fault, if ROS_STATIC_PEERS of a container is missing or wrong."""
    if not (pod.static_peers or any(map(has_peers, pod.containers))):
        yield NOT_WIRED, missing_variable("ROS_STATIC_PEERS", pod, rosproxy, webhook)
        return
    peers = container.variables.get("ROS_STATIC_PEERS", pod.static_peers or VALUE_AT_RUNTIME)
    if peers == VALUE_AT_RUNTIME or _names_service(peers, rosproxy, address):
        return
    if peers == pod.static_peers:
        text = f"was wired to {_shown(peers)} (ROS_STATIC_PEERS), but the proxy is at {address} now"
        yield NOT_WIRED, Fault(text, f"Run {recreate_command(pod)}")
        return
    text = f"variable ROS_STATIC_PEERS={_shown(peers)} of the template does not name the proxy"
    fix = f"Remove the variable from the template, or add {address} to the variable"
    yield NOT_WIRED, Fault(text, edit_fix(fix, pod))


def _age_faults(container: PodContainer, pod: Pod) -> Iterator[tuple[str, Fault]]:
    """Yield the reason and the fault, if ROS 2 is older than ROS_STATIC_PEERS."""
    name = container.variables.get("ROS_DISTRO") or container.image
    if distro := _OLD.search(name.lower()):
        text = f"has ROS 2 {distro[1].capitalize()}, which does not support ROS_STATIC_PEERS"
        fix = edit_fix("Use an image with Iron or a later distribution in the template", pod)
        yield "TooOld", Fault(text, fix)


def _domain_faults(
    container: PodContainer, pod: Pod, rosproxy: RosProxy
) -> Iterator[tuple[str, Fault]]:
    """Yield the reason and the fault, if a template with its own peers leaves the domain out."""
    number = rosproxy.spec.ros2.number if rosproxy.spec.ros2 else 0
    has_domain = "ROS_DOMAIN_ID" in container.variables
    if number and has_peers(container) and not has_domain and not pod.static_peers:
        text = (
            f"has no variable ROS_DOMAIN_ID (so 0), but RosProxy {rosproxy.id.name} has domain "
            f"{number}"
        )
        fix = edit_fix(f"Add ROS_DOMAIN_ID={number} to the template", pod)
        yield "OtherDomain", Fault(text, fix)


def _other_faults(
    container: PodContainer, pod: Pod, rosproxy: RosProxy
) -> Iterator[tuple[str, Fault]]:
    """Yield the reason and the fault, if a container uses another protocol or another domain."""
    get = container.variables.get
    rmw = get("RMW_IMPLEMENTATION", "")
    if not is_dds(rmw):
        text = (
            f"variable RMW_IMPLEMENTATION={_shown(rmw)} is not DDS, and a proxy forwards DDS only"
        )
        fix = edit_fix("Set rmw_fastrtps_cpp or rmw_cyclonedds_cpp in the template", pod)
        yield "NoDds", Fault(text, f"{fix}. Or use a RosProxy with spec.ros: zenoh")
    domain = get("ROS_DOMAIN_ID")
    number = rosproxy.spec.ros2.number if rosproxy.spec.ros2 else 0
    name = rosproxy.id.name
    if is_of_former_domain(container, pod, rosproxy):
        was = f"was wired to domain {_shown(domain)}" if domain else "was wired without a domain"
        text = f"{was}, but RosProxy {name} has domain {number} now"
        yield "OtherDomain", Fault(text, f"Run {recreate_command(pod)}")
        return
    # rcl treats an empty variable as unset (rcl, domain_id.c), and the webhook keeps the variable.
    if domain not in (None, VALUE_AT_RUNTIME) and (str(domain).strip() or "0") != str(number):
        value = _shown(str(domain)) or "(empty, so 0)"
        text = f"variable ROS_DOMAIN_ID={value} is not domain {number} of RosProxy {name}"
        removal = edit_fix("Remove the variable from the template", pod)
        edit = f"kubectl -n {rosproxy.id.namespace} edit rosproxy {name}"
        yield "OtherDomain", Fault(text, f"{removal}. Or change spec.domain: {edit}")


def _names_service(peers: str, rosproxy: RosProxy, address: str) -> bool:
    """Whether static peers name a RosProxy's Service. A semicolon separates two peers."""
    return any(is_of_service(host.strip(), rosproxy.id, address) for host in peers.split(";"))


def _shown(text: str) -> str:
    return clean(text)[:200]
