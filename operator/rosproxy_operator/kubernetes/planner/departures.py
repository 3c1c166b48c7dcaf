"""Finds addresses of ROS nodes that no pod has any more, so that the proxy unregisters the nodes.

A proxy finds out by probing that a ROS node is gone, which takes long. The API server tells the
operator sooner that a pod is gone. So the operator compares the addresses of a proxy's ROS nodes
with the addresses of the pods on the node. The operator has to be sure: a ROS 1 node that the proxy
unregisters by mistake does not register again.
"""

from collections.abc import Collection, Iterator, Mapping
from ipaddress import ip_address, ip_network

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.cluster_view import group_by_key
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPod, ProxyReport
from rosproxy_operator.kubernetes.resources.model import ClusterNode

UNKNOWN_ADDRESS_GRACE_S = 15.0
"""Seconds until an address in a node's pod networks counts as gone, if no pod was seen with it.

A pod's containers run before the API server knows the address of the pod.
"""
GONE_ADDRESS_KEPT_S = 15.0
"""Seconds that the operator remembers the address of a gone pod that no proxy reports.

The report of a proxy may be older than the look. A node that has just registered is in the next
report.
"""
SILENT_PROXY_ADDRESS_KEPT_S = 3600.0
"""The same as `GONE_ADDRESS_KEPT_S`, while a proxy of the node does not answer."""
DEPARTURE_RECHECK_S = 3.0
"""Seconds to the next look after pods have gone."""


class Departures(msgspec.Struct, frozen=True):
    """The gone addresses, by the uid of the proxy's pod, and the next state of the operator."""

    addresses: Mapping[str, tuple[str, ...]]
    state: ClusterState


def find_departures(observed: ClusterSnapshot, state: ClusterState, now: float) -> Departures:
    """Return the addresses that proxies report and that no running pod of the node has.

    An address that a pod of the node had at a former look counts as gone at once. Any other address
    has to be in the pod networks of the node, and counts as gone after `UNKNOWN_ADDRESS_GRACE_S`
    seconds. Such an address does not count while a pod of the node has no address yet. Proxies that
    do not answer and nodes that are not ready are skipped.
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
        # A pod that the API server lists without an address may have the unseen address.
        has_pending = any(not pod.ip and not pod.host_network for pod in living)
        late = {
            ip
            for ip, at in since.items()
            if now - at >= UNKNOWN_ADDRESS_GRACE_S and not has_pending
        }
        if addresses := (missing & last_seen[node.name].keys()) | late:
            departed[proxy.pod.uid] = tuple(sorted(addresses))
    reports = group_by_key((p.node, observed.reports.get(p.pod.uid)) for p in observed.proxies)
    kept = {name: _kept(reports[name], times, now) for name, times in last_seen.items()}
    return Departures(departed, replace(state, addresses=kept, strange=strange))


def _is_pod_ip(address: str, proxy: ProxyPod, node: ClusterNode) -> bool:
    """Whether an address is in the node's pod networks and of the proxy's IP version.

    The comparison knows only the first address of a pod with addresses of both IP versions.
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
    """Return the addresses to remember: a proxy reports the address, or may still report it."""
    answered = [report for report in reports if report is not None and report.answered]
    named = {address for report in answered for address in report.addresses}
    longest = GONE_ADDRESS_KEPT_S if len(answered) == len(reports) else SILENT_PROXY_ADDRESS_KEPT_S
    return {ip: at for ip, at in last_seen.items() if ip in named or now - at < longest}


def next_checks(departed: Departures, now: float) -> Iterator[float]:
    """Yield the seconds until the next look that may find gone addresses."""
    # An address with another time than `now` is of a pod that this look has not seen.
    recent = (at for ips in departed.state.addresses.values() for at in ips.values() if at != now)
    if departed.addresses or any(now - at < GONE_ADDRESS_KEPT_S for at in recent):
        yield DEPARTURE_RECHECK_S
    strange = (at + UNKNOWN_ADDRESS_GRACE_S - now for at in departed.state.strange.values())
    yield from (seconds for seconds in strange if seconds > 0)
