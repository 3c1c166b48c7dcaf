"""Find values of ROS_IP and ROS_HOSTNAME that keep the nodes of a container from working.

A node announces the address in ROS_IP, or the name in ROS_HOSTNAME. Most values do no harm, since
the proxy replaces the address. Two values do harm:

- A loopback address: rospy and roscpp listen on loopback alone, so the proxy can't reach the nodes.
- The address of this host, as in manuals of drivers. roslaunch does not reach its own server at
  that address, and ends before any call to a master (`ROSLaunchNode.start` in roslaunch/server.py).
"""

from rosproxy.shared.addresses import is_loopback
from rosproxy_operator.common.problem import Fault, bounded
from rosproxy_operator.docker.planner.model import Container, HostState
from rosproxy_operator.proxy_spec.place import Place

_ADDRESS_VARIABLES = ("ROS_IP", "ROS_HOSTNAME")


def wrong_own_address(container: Container, place: Place, observed: HostState) -> Fault | None:
    """Return what is wrong with ROS_IP or ROS_HOSTNAME of a ROS 1 container; None for no fault."""
    for name in _ADDRESS_VARIABLES:
        value = container.variables.get(name, "").strip().lower()
        fix = f"Unset {name}: no node behind a proxy needs this variable"
        if value and is_loopback(value):
            text = f"variable {name}={bounded(value, 80)} makes the nodes listen on loopback only, "
            return Fault(f"{text}so the proxy can't reach them", fix)
        if value and value in _names_of_this_host(place, observed):
            text = f"variable {name}={value} is the address of this host, not of the container. So "
            return Fault(f"{text}roslaunch ends with 'Unable to contact my own server'", fix)
    return None


def _names_of_this_host(place: Place, observed: HostState) -> frozenset[str]:
    """Return the known addresses and names of this host, in lower case."""
    gateways = (network.gateway for network in observed.networks)
    towards = observed.advertise.values()
    return frozenset(
        {place.advertise_host.lower(), observed.default_route_address, *gateways, *towards} - {""}
    )
