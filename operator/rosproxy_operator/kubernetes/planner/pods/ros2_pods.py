"""What keeps a selected pod's nodes of ROS 2 from being met, as far as the pod itself tells.

The webhook has set ROS_STATIC_PEERS to the address of the RosProxy's Service, which leads to the
proxy on the pod's own node. Where that can't help, the pod is told so by an Event. What an image
sets itself is not seen: only its name may tell the distribution.
"""

import re
from collections.abc import Iterator

from rosproxy.telemetry.text import clean
from rosproxy_operator.common.ros2 import is_dds
from rosproxy_operator.kubernetes.planner.pods.injection import never_told
from rosproxy_operator.kubernetes.resources.model import (
    ELSEWHERE,
    ClusterFinding,
    Pod,
    PodContainer,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import service_id
from rosproxy_operator.kubernetes.status.findings import pod_finding

BEFORE_IRON = ("ardent", "bouncy", "crystal", "dashing", "eloquent", "foxy", "galactic", "humble")
"""Distributions that know no ROS_STATIC_PEERS (rmw_dds_common has it since Iron)."""
_OLD = re.compile(rf"(?<![a-z0-9])({'|'.join(BEFORE_IRON)})(?![a-z0-9])")
_DEAF = ("OFF", "SYSTEM_DEFAULT")
"""Values of ROS_AUTOMATIC_DISCOVERY_RANGE with which static peers are not used."""


def unmet(pod: Pod, of: RosProxy, address: str) -> Iterator[ClusterFinding]:
    """What is wrong with a pod's variables; ``address`` is that of the RosProxy's Service."""
    if of.spec.ros2 is None:
        return
    found = dict.fromkeys(one for each in pod.containers for one in _problems(each, of, address))
    if (text := _peers_problem(pod, of, address)) and not any(r == "NotWired" for r, _ in found):
        found["NotWired", text] = None
    for reason, text in found:
        yield pod_finding(pod, of, reason, text, fatal=False)


def _peers_problem(pod: Pod, of: RosProxy, address: str) -> str:
    """What is wrong with what the webhook has set, or has not."""
    if pod.static_peers and pod.static_peers != address:
        return (
            f"was told ROS_STATIC_PEERS={clean(pod.static_peers)[:200]}, but its proxy is at "
            f"{address} now: create the pod anew"
        )
    if pod.static_peers or any("ROS_STATIC_PEERS" in one.variables for one in pod.containers):
        return ""
    return never_told("ROS_STATIC_PEERS", pod, of.id)


def _problems(one: PodContainer, of: RosProxy, address: str) -> Iterator[tuple[str, str]]:
    """Reason and text of what is wrong with a container."""
    get = one.variables.get
    rmw = get("RMW_IMPLEMENTATION", "")
    if not is_dds(rmw):
        text = f"sets RMW_IMPLEMENTATION={_shown(rmw)}, which is no DDS and can't be proxied"
        yield "NoDds", f"{text}: use rmw_fastrtps_cpp or rmw_cyclonedds_cpp"
    peers = get("ROS_STATIC_PEERS")
    if peers is not None and peers != ELSEWHERE and not _names(peers, of, address):
        text = f"sets ROS_STATIC_PEERS={_shown(peers)} itself, without its proxy"
        yield "NotWired", f"{text}: take the variable out of its template, or add {address} to it"
    domain, number = get("ROS_DOMAIN_ID"), of.spec.ros2.number if of.spec.ros2 else 0
    if domain not in (None, ELSEWHERE) and str(domain).strip() not in (str(number), ""):
        text = f"sets ROS_DOMAIN_ID={_shown(str(domain))}, but RosProxy {of.id.name} is for domain"
        yield "OtherDomain", f"{text} {number}: change either, then create the pod anew"
    old = _OLD.search(get("ROS_DISTRO", "").lower()) or _OLD.search(one.image.lower())
    if old:
        text = f"is of ROS 2 {old[1].capitalize()}, which knows no ROS_STATIC_PEERS"
        yield "TooOld", f"{text}: use Iron or a later one"
    reach = get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    if reach.upper() in _DEAF:
        text = f"sets ROS_AUTOMATIC_DISCOVERY_RANGE={_shown(reach)}, so it heeds no static peers"
        yield "Alone", f"{text}: take it off"
    if get("ROS_LOCALHOST_ONLY") == "1":
        yield "Alone", "sets ROS_LOCALHOST_ONLY=1, which keeps it to itself: take it off"


def _names(peers: str, of: RosProxy, address: str) -> bool:
    """Whether static peers, listed with semicolons, name a RosProxy's Service."""
    service = service_id(of.id)
    short = f"{service.name}.{service.namespace}"
    hosts = (one.strip().lower().rstrip(".") for one in peers.split(";"))
    names = (address, service.name, short)
    return any(host in names or f"{host}.".startswith(f"{short}.svc.") for host in hosts)


def _shown(text: str) -> str:
    return clean(text)[:200]
