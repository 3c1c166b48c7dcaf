"""What a proxy is to be told of the pods on its node: which addresses no pod has any more.

A proxy finds out by probing that a ROS node is gone, which takes long; the operator knows from the
API server that a pod is gone. It compares the addresses at which a proxy has ROS nodes with those
of the pods that are there, and is careful: what is unregistered by mistake is not found again.
"""

from collections.abc import Collection, Iterator, Mapping
from ipaddress import ip_address, ip_network

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.cluster_view import group_by_key
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPod, ProxyReport
from rosproxy_operator.kubernetes.resources.model import ClusterNode

UNKNOWN_ADDRESS_GRACE = 15.0
"""Seconds after which an address in a node's pod network counts as gone that no pod was seen with.

A pod's containers run before the API server knows its address.
"""
REMEMBERED = 15.0
"""Seconds for which the address of a pod that is gone is remembered, though no proxy names it.

A proxy's answer may be older than the look: what has just registered is named in the next one.
"""
LONGEST = 3600.0
"""The same while a proxy does not answer at all."""
LOOK_AGAIN_AFTER = 3.0
"""Seconds until proxies are looked at again whose pods have just gone."""


class Departures(msgspec.Struct, frozen=True):
    """The addresses that are gone, by the uid of the proxy's pod, and what is remembered."""

    addresses: Mapping[str, tuple[str, ...]]
    state: ClusterState


def find_departures(observed: ClusterSnapshot, state: ClusterState, now: float) -> Departures:
    """Compare where the proxies' ROS nodes are with the pods that there are.

    An address counts as gone if a pod was seen with it and none has it now; or if it belongs to the
    node's pod networks and every pod there has had another one for `UNKNOWN_ADDRESS_GRACE` seconds.
    """
    pod_by_uid = {pod.uid: pod for pod in (*(p.pod for p in observed.proxies), *observed.pods)}
    pods = group_by_key((pod.node, pod) for pod in pod_by_uid.values())
    last_seen: dict[str, dict[str, float]] = {}
    for name in {p.node for p in observed.proxies}:
        seen_now = {pod.ip: now for pod in pods.get(name, ()) if pod.ip and not pod.host_network}
        last_seen[name] = {**state.addresses.get(name, {}), **seen_now}
    departed: dict[str, tuple[str, ...]] = {}
    strange: dict[tuple[str, str], float] = {}
    for proxy in observed.proxies:
        report = observed.reports.get(proxy.pod.uid)
        node = observed.nodes.get(proxy.node)
        if report is None or not report.answered or node is None or not node.ready:
            continue
        living = [pod for pod in pods.get(node.name, ()) if not pod.ended]
        missing = report.addresses - {pod.ip for pod in living}
        unseen = {ip for ip in missing - last_seen[node.name].keys() if _is_pod_ip(ip, proxy, node)}
        since = {ip: state.strange.get((node.name, ip), now) for ip in unseen}
        strange |= {(node.name, ip): at for ip, at in since.items()}
        # A pod that is listed without an address yet may be the one at the unseen address.
        has_pending = any(not pod.ip and not pod.host_network for pod in living)
        late = {
            ip for ip, at in since.items() if now - at >= UNKNOWN_ADDRESS_GRACE and not has_pending
        }
        if addresses := (missing & last_seen[node.name].keys()) | late:
            departed[proxy.pod.uid] = tuple(sorted(addresses))
    reports = group_by_key((p.node, observed.reports.get(p.pod.uid)) for p in observed.proxies)
    kept = {name: _kept(reports[name], times, now) for name, times in last_seen.items()}
    return Departures(departed, replace(state, addresses=kept, strange=strange))


def _is_pod_ip(address: str, proxy: ProxyPod, node: ClusterNode) -> bool:
    """Whether an address is in the pod networks, and of the family that pods are listed with.

    Of a pod with addresses of both families only one is known here.
    """
    try:
        ip = ip_address(address)
        proxy_ip = ip_address(proxy.pod.ip)
        networks = [ip_network(network, strict=False) for network in node.pod_networks]
    except ValueError:
        return False
    return ip.version == proxy_ip.version and any(ip in network for network in networks)


def _kept(
    reports: Collection[ProxyReport | None], last_seen: Mapping[str, float], now: float
) -> dict[str, float]:
    """Which addresses are worth remembering: those that a proxy names, or may name yet."""
    answered = [report for report in reports if report is not None and report.answered]
    named = {address for report in answered for address in report.addresses}
    longest = REMEMBERED if len(answered) == len(reports) else LONGEST
    return {ip: at for ip, at in last_seen.items() if ip in named or now - at < longest}


def next_checks(departed: Departures, now: float) -> Iterator[float]:
    """In how many seconds there may be something to tell the proxies."""
    # The addresses that pods have at this moment were all seen at `now`.
    recent = (at for ips in departed.state.addresses.values() for at in ips.values() if at != now)
    if departed.addresses or any(now - at < REMEMBERED for at in recent):
        yield LOOK_AGAIN_AFTER
    strange = (at + UNKNOWN_ADDRESS_GRACE - now for at in departed.state.strange.values())
    yield from (seconds for seconds in strange if seconds > 0)
