"""What the planning depends on besides what is seen in the cluster."""

from dataclasses import dataclass

from rosproxy.leases.ports import PortRange

NODE_PORTS = PortRange(30000, 32767)
"""The API server's own default of --service-node-port-range."""
EPHEMERAL = PortRange(32768, 60999)
"""Linux's own default of net.ipv4.ip_local_port_range."""


@dataclass(frozen=True, slots=True)
class ClusterSettings:
    """The operator's options that decide what is planned.

    ``image`` and ``image_pull_policy`` are those of proxies whose RosProxy names none; an empty
    policy leaves it to Kubernetes. ``node_ports`` is the API server's --service-node-port-range,
    ``ephemeral`` the range from which the nodes' kernels take ports for connections: no hostPort
    is taken from either.
    """

    image: str = "rosproxy:latest"
    image_pull_policy: str = ""
    node_ports: PortRange = NODE_PORTS
    ephemeral: PortRange = EPHEMERAL
