"""What each proxy is told: its policy, which pods may use it, its peers, and which pods are gone.

The pods that may use a proxy as their master are those on its node that its RosProxy selects. A pod
that is being deleted counts, since its ROS nodes unregister while they end. A pod that another
RosProxy selects as well counts, too: it may have been wired before that RosProxy was created.
"""

from collections.abc import Mapping

import msgspec

from rosproxy.access.layers import PolicyLayer
from rosproxy_operator.common.proxy_status import Leases
from rosproxy_operator.kubernetes.planner.cluster_view import group_by_key
from rosproxy_operator.kubernetes.planner.manifests import policy_of
from rosproxy_operator.kubernetes.planner.pods.selection import selects
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.settings import ClusterSettings


class Briefing(msgspec.Struct, frozen=True):
    """What a proxy is told.

    ``policy`` are all layers of its policy, ``callers`` the addresses of pods that may use it; None
    where its RosProxy is gone or can't be read: the proxy goes on with what it knows. ``peers`` are
    those of ROS 2, ``former_ports`` the ports of participants at the proxy before it. ``gone`` are
    the addresses of pods that are no more.
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
    """Return what all proxies are told, by the uid of their pods.

    ``peers``, ``former_ports`` and ``gone`` are by the same uid. ``observed`` also has RosProxies
    that ask for more than they may: their proxies go on.
    """
    rosproxies = {r.uid: r for r in observed.rosproxies if not r.deleting}
    live_pods = (pod for pod in observed.pods if not (pod.ended or pod.host_network))
    pods = group_by_key(((pod.id.namespace, pod.node), pod) for pod in live_pods)
    told: dict[str, Briefing] = {}
    for proxy in observed.proxies:
        uid = proxy.pod.uid
        policy = callers = None
        if rosproxy := rosproxies.get(proxy.owner):
            policy = policy_of(rosproxy, settings)
            nearby = pods.get((rosproxy.id.namespace, proxy.node), ())
            ips = {ip for p in nearby if selects(rosproxy, p) for ip in (p.ip, *p.ips) if ip}
            callers = tuple(sorted(ips))
        former = former_ports.get(uid, {})
        told[uid] = Briefing(policy, callers, peers.get(uid), former, gone.get(uid, ()))
    return told
