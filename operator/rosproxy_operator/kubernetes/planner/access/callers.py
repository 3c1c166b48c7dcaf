"""Which pods may use each proxy as their master: the addresses that proxies are told.

Those of all pods on the proxy's node that its RosProxy selects. A pod that is being deleted still
counts, since its ROS nodes unregister while they end; so does one that another RosProxy selects as
well, since it may have been wired before that was there.
"""

from collections.abc import Mapping

from rosproxy_operator.kubernetes.planner.pods.selection import selects
from rosproxy_operator.kubernetes.planner.view import grouped
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot


def callers(observed: ClusterSnapshot) -> Mapping[str, tuple[str, ...]]:
    """The addresses that may call each proxy, by the uid of its pod.

    A proxy whose RosProxy is gone or can't be read is left out: it goes on with what it knows.
    """
    rosproxies = {one.uid: one for one in observed.rosproxies if not one.deleting}
    there = (pod for pod in observed.pods if not (pod.ended or pod.host_network))
    pods = grouped(((pod.id.namespace, pod.node), pod) for pod in there)
    found: dict[str, tuple[str, ...]] = {}
    for proxy in observed.proxies:
        of = rosproxies.get(proxy.owner)
        if of is not None:
            own = (pod for pod in pods.get((of.id.namespace, proxy.on), ()) if selects(of, pod))
            found[proxy.pod.uid] = tuple(
                sorted({ip for pod in own for ip in (pod.ip, *pod.ips) if ip})
            )
    return found
