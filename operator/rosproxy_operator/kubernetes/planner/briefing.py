"""What the operator sends each proxy: policy, callers, peers, former ports and gone pods.

The callers of a proxy are the selected pods on the proxy's node. A pod that is being deleted
counts, because its ROS nodes unregister while they end. A pod that a second RosProxy selects as
well counts, too: the webhook may have wired the pod before the second RosProxy existed. A pod in
the host's network is no caller.
"""

from collections.abc import Mapping

import msgspec

from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy_operator.common.proxy_status import Leases
from rosproxy_operator.kubernetes.planner.cluster_view import group_by_key
from rosproxy_operator.kubernetes.planner.manifests import policy_of
from rosproxy_operator.kubernetes.planner.pods.selection import selects
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.settings import ClusterSettings


class Briefing(msgspec.Struct, frozen=True):
    """What the operator sends a proxy.

    ``policy`` has all layers. ``callers`` has the IP addresses of the pods that may use the proxy.
    Both are None if the RosProxy is gone, is being deleted or can't be read: the proxy then keeps
    the policy and callers that it has. A proxy for rmw_zenoh knows no callers. ``peers`` has the
    ROS 2 peers, None without ROS 2. ``former_ports`` has the ports of ROS 2 participants at the
    former proxy. ``gone`` has IP addresses that no pod has any more.
    """

    policy: tuple[PolicyLayer, ...] | None = None
    callers: tuple[str, ...] | None = None
    peers: tuple[str, ...] | None = None
    former_ports: Leases = {}
    gone: tuple[str, ...] = ()


def briefings(
    observed: ClusterSnapshot,
    settings: ClusterSettings,
    peers: Mapping[str, tuple[str, ...]],
    former_ports: Mapping[str, Leases],
    gone: Mapping[str, tuple[str, ...]],
) -> dict[str, Briefing]:
    """Return the briefing of each proxy, by the uid of the proxy's pod.

    ``peers``, ``former_ports`` and ``gone`` have the same keys. ``observed`` is the snapshot before
    `within_bounds`, so the proxies of a RosProxy that asks for too much still get updates.
    """
    rosproxies = {r.uid: r for r in observed.rosproxies if not r.deleting}
    live_pods = (pod for pod in observed.pods if not (pod.ended or pod.host_network))
    pods = group_by_key(((pod.id.namespace, pod.node), pod) for pod in live_pods)
    by_uid: dict[str, Briefing] = {}
    for proxy in observed.proxies:
        uid = proxy.pod.uid
        policy = callers = None
        if rosproxy := rosproxies.get(proxy.owner):
            policy = policy_of(rosproxy, settings)
        if rosproxy and rosproxy.spec.zenoh is None:
            nearby = pods.get((rosproxy.id.namespace, proxy.node), ())
            ips = {ip for p in nearby if selects(rosproxy, p) for ip in (p.ip, *p.ips) if ip}
            callers = tuple(sorted(ips))
        former = former_ports.get(uid, {})
        by_uid[uid] = Briefing(policy, callers, peers.get(uid), former, gone.get(uid, ()))
    return by_uid
