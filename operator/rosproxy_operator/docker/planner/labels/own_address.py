"""What a container's variables say of its own address, where that keeps its nodes from working.

A node gives others the address in ROS_IP, or the name in ROS_HOSTNAME, as its own. Through the
proxy most values do no harm, since the proxy gives its own instead. Two do: with a loopback address
rospy and roscpp listen there alone, so that the proxy can't reach them; and with the address of
this host, as manuals of drivers have it, roslaunch finds nobody at its own address and ends before
it has asked a master (`ROSLaunchNode.start` in roslaunch/server.py).
"""

from rosproxy.net.addresses import is_loopback
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.docker.planner.model import Container, HostState, Key

VARIABLES = ("ROS_IP", "ROS_HOSTNAME")


def wrong_own_address(container: Container, key: Key, observed: HostState) -> str:
    """What is wrong with how a container of ROS 1 calls its own host; empty if nothing is."""
    for name in VARIABLES:
        value = container.variables.get(name, "").strip().lower()
        fix = f"Unset {name}: no node behind a proxy needs this variable"
        if value and is_loopback(value):
            return (
                f"variable {name}={bounded(value, 80)} makes the nodes listen on loopback only, so "
                f"the proxy can't reach them. {fix}"
            )
        if value and value in _of_this_host(key, observed):
            return (
                f"variable {name}={value} is the address of this host, not of the container. So "
                f"roslaunch ends with 'Unable to contact my own server'. {fix}"
            )
    return ""


def _of_this_host(key: Key, observed: HostState) -> frozenset[str]:
    """This host's addresses and names, as far as they are known."""
    gateways = (network.gateway for network in observed.networks)
    towards = observed.advertise.values()
    return frozenset({key.advertise_host.lower(), observed.far, *gateways, *towards} - {""})
