"""Which pods the webhook would wire if they were created again."""

from rosproxy_operator.common.zenoh import tcp_endpoint
from rosproxy_operator.kubernetes.planner.pods.ros1_pods import names_former_master, why_lost
from rosproxy_operator.kubernetes.planner.pods.unwired import is_of_former_domain
from rosproxy_operator.kubernetes.planner.pods.wiring import (
    has_peers,
    masters_of,
    names_master,
    wired_override,
)
from rosproxy_operator.kubernetes.resources.model import (
    Pod,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    INJECT,
    master_uri,
    router_of,
)


def needs_recreation(pod: Pod, rosproxy: RosProxy, cluster_ip: str) -> bool:
    """Whether a pod does not use its proxy, and the webhook would wire a recreated pod.

    True if ROS_MASTER_URI, ROS_STATIC_PEERS, ROS_DOMAIN_ID or the endpoint in ZENOH_CONFIG_OVERRIDE
    is missing or outdated, or if the ROS 1 nodes of the pod may be unregistered for good. A
    variable that the template sets does not count, except a ROS_MASTER_URI that names the real
    master of the RosProxy, and a ZENOH_CONFIG_OVERRIDE that the webhook can extend. False for a pod
    without the label.
    """
    masters = masters_of(rosproxy)
    lacks_master = (
        rosproxy.spec.ros1
        and all(names_master(uri, masters) for uri in pod.own_masters)
        and not names_former_master(pod, rosproxy)
        and (pod.wired_master_uri != master_uri(cluster_ip) or bool(why_lost(pod, rosproxy)))
    )
    # A container without the endpoint in a wired pod comes from a later webhook.
    router = router_of(cluster_ip)
    lacks_router = (
        rosproxy.spec.zenoh is not None
        and pod.router_endpoint != tcp_endpoint(router)
        and any(wired_override(c.variables, router, pod.router_endpoint) for c in pod.containers)
    )
    peers = {c.variables["ROS_STATIC_PEERS"] for c in pod.containers if has_peers(c)}
    lacks_peers = (
        rosproxy.spec.ros2 is not None
        and peers <= {pod.static_peers}
        and pod.static_peers != cluster_ip
    )
    # Without the variable, the image may set the domain.
    lacks_domain = any(
        "ROS_DOMAIN_ID" in c.variables and is_of_former_domain(c, pod, rosproxy)
        for c in pod.containers
    )
    return INJECT in pod.labels and (lacks_master or lacks_peers or lacks_domain or lacks_router)
