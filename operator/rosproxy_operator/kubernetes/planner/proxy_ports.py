"""The ports on which a proxy listens besides its range."""

from rosproxy_operator.common.ros2 import well_known_ports
from rosproxy_operator.kubernetes.resources.model import RosProxySpec
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, MASTER_PORT


def fixed_ports(spec: RosProxySpec) -> frozenset[int]:
    """Return the master port, the admin port, and for ROS 2 the well-known ports of the domain.

    A port of the range has the same number on the node and in the pod. So no range may contain the
    fixed ports.
    """
    ros2_ports = well_known_ports(spec.ros2.number) if spec.ros2 else ()
    return frozenset({MASTER_PORT, ADMIN_PORT, *ros2_ports})


def stand_in_protocols(spec: RosProxySpec) -> tuple[str, ...]:
    """Return "TCP" and "UDP", if the proxies of a RosProxy have stand-ins of that protocol.

    ROS 1 has stand-ins only with ``direction: Both``. Then UDPROS from pods to outside goes through
    UDP ports, also without ``spec.udp``.
    """
    is_bidirectional = spec.proxy.direction == "both"
    tcp = ("TCP",) if spec.ros1 and is_bidirectional else ()
    udp = ("UDP",) if spec.ros2 or is_bidirectional else ()
    return (*tcp, *udp)
