"""Which pods may use each proxy as their master: the addresses that proxies are told.

Those of all pods on the proxy's node that its RosProxy selects. A pod that is being deleted still
counts, since its ROS nodes unregister while they end; so does one that another RosProxy selects as
well, since it may have been wired before that one was created.
"""

from collections.abc import Mapping

from rosproxy_operator.kubernetes.planner.cluster_view import group_by_key
from rosproxy_operator.kubernetes.planner.pods.selection import selects
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot


def callers(observed: ClusterSnapshot) -> Mapping[str, tuple[str, ...]]:
    """The addresses that may call each proxy, by the uid of its pod.

    A proxy whose RosProxy is gone or can't be read is left out: it goes on with what it knows.
    """
    rosproxies = {r.uid: r for r in observed.rosproxies if not r.deleting}
    live_pods = (pod for pod in observed.pods if not (pod.ended or pod.host_network))
    pods = group_by_key(((pod.id.namespace, pod.node), pod) for pod in live_pods)
    addresses: dict[str, tuple[str, ...]] = {}
    for proxy in observed.proxies:
        rosproxy = rosproxies.get(proxy.owner)
        if rosproxy is not None:
            selected = (
                p for p in pods.get((rosproxy.id.namespace, proxy.node), ()) if selects(rosproxy, p)
            )
            addresses[proxy.pod.uid] = tuple(
                sorted({ip for pod in selected for ip in (pod.ip, *pod.ips) if ip})
            )
    return addresses
