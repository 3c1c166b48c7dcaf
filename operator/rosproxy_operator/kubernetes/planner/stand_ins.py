"""The ports of a proxy's stand-ins, through which only the selected pods reach outside."""

from rosproxy.leases.ports import PortRange
from rosproxy.ros1.registry.stand_ins import PORTS
from rosproxy_operator.kubernetes.resources.model import RosProxySpec

STAND_INS = PortRange(PORTS[0], PORTS[-1])
"""The ports of stand-ins, the same for ROS 1 and ROS 2."""


def stand_in_protocols(spec: RosProxySpec) -> tuple[str, ...]:
    """Return the protocols of the stand-ins of a RosProxy's proxies, empty without stand-ins.

    ROS 1 has stand-ins only with ``direction: Both``. UDPROS from pods to outside goes through UDP
    ports, also without ``spec.udp``.
    """
    is_bidirectional = spec.proxy.direction == "both"
    tcp = ("TCP",) if spec.ros1 and is_bidirectional else ()
    udp = ("UDP",) if spec.ros2 or is_bidirectional else ()
    return (*tcp, *udp)
