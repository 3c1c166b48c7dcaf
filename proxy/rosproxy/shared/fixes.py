"""Fixes: the options that correct a fault, or the labels and fields that an operator reads instead.

The fix depends on the program that has started the proxy. An operator sets VARIABLE in the
environment of its proxies. Without this variable, a user has started the proxy by hand.
"""

from enum import IntEnum
from typing import NamedTuple

VARIABLE = "ROSPROXY_OPERATOR"
"""The environment variable with the name of the operator: ``docker`` or ``kubernetes``."""


class Operator(IntEnum):
    """The program that has started a proxy; the value is the index in `Fix`."""

    NONE = 0
    DOCKER = 1
    KUBERNETES = 2


class Fix(NamedTuple):
    """An imperative for each operator, without a full stop at the end, with `str.format` fields."""

    by_hand: str
    docker: str
    kubernetes: str


_OPEN_HOSTPORTS = (
    "enable hostPorts in the nodes' network plug-in (CNI: the plug-in portmap); open the proxy's "
    "hostPorts in the node's firewall and in NetworkPolicies"
)
_KERNEL_BY_LABEL = (
    "start the operator with --allow-data-plane kernel (and with this option for every other data "
    "plane in labels), and add the label rosproxy.data-plane=kernel to a container of this proxy"
)
_KERNEL_BY_FIELD = "set spec.dataPlane: Kernel. The chart's allow.dataPlanes must list Kernel"
_LABELLED = "start {nodes} in a container with the label rosproxy.enable=true"
_INJECTED = "start {nodes} in a pod with the label rosproxy.io/inject=true"
FIXES = {
    "advertised host": Fix(
        "set --advertise-host ADDRESS (ROSPROXY_ADVERTISE_HOST)",
        "add the label rosproxy.advertise-host=ADDRESS to the containers of this proxy, or start "
        "the operator with --advertise-host ADDRESS",
        "set spec.advertise, or the annotation rosproxy.io/advertise-host=ADDRESS on the node",
    ),
    "larger range": Fix(
        "set a larger --port-range (ROSPROXY_PORT_RANGE), and publish the new range",
        "add the label rosproxy.ports=N to a container of this proxy, or start the operator with "
        "--ports N",
        "set a larger spec.ports",
    ),
    "other range": Fix(
        "set another --port-range (ROSPROXY_PORT_RANGE), and publish the new range",
        "start the operator with a --port-window without these ports",
        "set a spec.portWindow without these ports",
    ),
    "publish": Fix(
        "publish the {ports}: docker run -p {published}, and let the firewall accept it",
        "open the ports in the firewall of this host",
        _OPEN_HOSTPORTS,
    ),
    "publish for UDP": Fix(
        "publish the range for UDP",
        "open the ports for UDP in the firewall of this host",
        _OPEN_HOSTPORTS,
    ),
    "master": Fix(
        "set --master-uri {uri} (ROS_MASTER_URI)",
        "set ROS_MASTER_URI={uri} or the label rosproxy.master-uri={uri} in the containers of this "
        "proxy",
        "set spec.master.uri: {uri} or spec.master.service",
    ),
    "master's name": Fix(
        "add the name: docker run --add-host {host}:ADDRESS; or set the address: --master-uri "
        "http://ADDRESS:{port}",
        "add the line 'ADDRESS {host}' to /etc/hosts of this host; if the operator runs in a "
        "container, start that container with docker run --add-host {host}:ADDRESS",
        "set spec.master.address",
    ),
    "node's name": Fix(
        "make {host} known to the proxy and to all inside nodes: docker run --add-host "
        "{host}:ADDRESS",
        "make {host} known to the name server of this host",
        "add {host} to spec.hostAliases and to the hostAliases of the pods",
    ),
    "inside network": Fix(
        "set --inside-network (ROSPROXY_INSIDE_NETWORKS) to the network of this address",
        _LABELLED.format(nodes="the node"),
        _INJECTED.format(nodes="the node"),
    ),
    "selected": Fix(
        "select the address (POST /containers of the admin endpoint)",
        "label the container rosproxy.enable=true. The container must use the master of this proxy",
        "label the pod rosproxy.io/inject=true. The pod must use the master of this proxy",
    ),
    "selected participant": Fix(
        "select the address (POST /containers of the admin endpoint)",
        _LABELLED.format(nodes="the node"),
        _INJECTED.format(nodes="the node"),
    ),
    "nodes inside": Fix(
        "start {nodes} with ROS_MASTER_URI=http://PROXY:{port} (PROXY: the proxy's address inside)",
        _LABELLED,
        _INJECTED,
    ),
    "participants inside": Fix(
        "connect the nodes to an inside network of the proxy",
        _LABELLED.format(nodes="the nodes"),
        _INJECTED.format(nodes="the nodes"),
    ),
    "domain": Fix(
        "set --ros2-domain {domain} for the proxy",
        "add the label rosproxy.domain={domain} to its container",
        "select its pod with a RosProxy that has spec.domain: {domain}",
    ),
    "peer": Fix(
        "set --ros2-peer ADDRESS",
        "add the label rosproxy.peers=ADDRESS to the containers of this proxy, or start the "
        "operator with --ros2-peer ADDRESS",
        "add ADDRESS to spec.peers",
    ),
    "zenoh outside": Fix(
        "set --zenoh-peer HOST to connect to a router, or --zenoh-listen 7447 to be reached",
        "add the label rosproxy.peers=HOST to a container of this proxy. HOST runs a router",
        "add HOST to spec.peers. HOST runs a router",
    ),
    "zenoh hub": Fix(
        "if the other proxy runs, set --zenoh-hub-listen there, and let the firewall accept the "
        "port",
        "if the other proxy runs, set --zenoh-hub-listen there, and let the firewall accept the "
        "port",
        "if the other proxy runs, let the proxies connect to each other at port 7447 (firewall)",
    ),
    "rmw_zenoh": Fix(
        "for such nodes, start the proxy with --ros zenoh",
        "a container with that variable gets another proxy by the same label",
        "select such pods with a RosProxy that has spec.ros: zenoh",
    ),
    "zenoh certificate": Fix(
        "give all proxies of the graph a valid --zenoh-hub-certificate of the same CA, with the "
        "name in --zenoh-hub of the others, and check the clocks of the hosts",
        "give all proxies of the graph a valid --zenoh-hub-certificate of the same CA, with the "
        "name in --zenoh-hub of the others, and check the clocks of the hosts",
        "the operator makes this certificate from its key, a Secret with a name that ends in "
        "-key. After a change of the key, wait until the operator has recreated all proxies of the "
        "RosProxy. If the finding stays, delete the pods of both proxies, and check that no other "
        "pod has the labels of a proxy",
    ),
    "zenoh files": Fix(
        "write new files in place of the files. The proxy notices new files by itself",
        "write new files into the directory of the operator's --zenoh-link-certificates. The proxy "
        "notices new files by itself",
        "put a new certificate into the Secret of spec.link.secretName. The proxies notice new "
        "files by themselves",
    ),
    "zenoh peers": Fix(
        'set mode="client" in ZENOH_CONFIG_OVERRIDE of these nodes. In containers beside the '
        "proxy, you can also connect them to ports {ports} of the proxy, one for each container",
        'set mode="client" in ZENOH_CONFIG_OVERRIDE of these nodes. In containers of this host, '
        "remove connect/endpoints instead, and add the labels rosproxy.enable=true and "
        "rosproxy.peers",
        'set mode="client" in ZENOH_CONFIG_OVERRIDE of these nodes. In pods, remove the variable '
        "instead, and add the label rosproxy.io/inject=true",
    ),
    "zenoh nodes": Fix(
        "set for the nodes in containers: RMW_IMPLEMENTATION=rmw_zenoh_cpp and "
        """ZENOH_CONFIG_OVERRIDE='mode="client";connect/endpoints=["tcp/PROXY:{port}"];"""
        "connect/timeout_ms=-1'",
        "start nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp in a container with the label "
        "rosproxy.enable=true. Unset ZENOH_SESSION_CONFIG_URI there",
        _INJECTED.format(nodes="nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp"),
    ),
    "LAN relay": Fix(
        "run rosproxy lan-relay and set --ros2-lan-relay",
        "start the operator with --ros2-lan and this host's address on the LAN",
        "set spec.multicast: true",
    ),
    "relay proof": Fix(
        "give the proxy and its LAN relay the same secret (--ros2-lan-relay-secret of the proxy, "
        "--secret of the LAN relay), and set the clocks of both machines",
        "run docker restart with the name of the LAN relay's container; the operator gives both "
        "the same secret",
        "delete the pod of the LAN relay; the operator gives it and the proxy the same secret",
    ),
    "hidden source": Fix(
        "rootless Docker: set DOCKERD_ROOTLESS_ROOTLESSKIT_PORT_DRIVER=slirp4netns for the service "
        "of the engine; Docker Desktop: use an engine on Linux; Docker before 23.0: run conntrack "
        "-D -p udp as root on the host. See docs/guide/troubleshooting.md",
        "rootless Docker: set DOCKERD_ROOTLESS_ROOTLESSKIT_PORT_DRIVER=slirp4netns for the service "
        "of the engine; Docker Desktop: use an engine on Linux; Docker before 23.0: run conntrack "
        "-D -p udp as root on the host. See docs/guide/troubleshooting.md",
        "use a network plug-in that keeps the source of datagrams to hostPorts (CNI: the plug-in "
        "portmap)",
    ),
    "kernel plane": Fix(
        "set --data-plane kernel, and give the proxy the capability NET_ADMIN",
        _KERNEL_BY_LABEL,
        _KERNEL_BY_FIELD,
    ),
    "kernel rights": Fix(
        "give the proxy's container the capability NET_ADMIN (cap_add: NET_ADMIN), and run the "
        "container without no-new-privileges",
        f"{_KERNEL_BY_LABEL}. If both are set, let the engine give containers NET_ADMIN",
        f"{_KERNEL_BY_FIELD}. If both are set, check that no admission webhook removes NET_ADMIN "
        "or allowPrivilegeEscalation from the proxy's pod",
    ),
    "kernel forwards": Fix(
        "set net.ipv4.ip_forward there (sysctls: net.ipv4.ip_forward: 1; for nodes with IPv6 "
        "addresses net.ipv6.conf.all.forwarding: 1)",
        f"{_KERNEL_BY_LABEL}: the operator then sets net.ipv4.ip_forward. For nodes with IPv6 "
        "addresses, set net.ipv6.conf.all.forwarding on this host",
        "run sysctl -w net.ipv4.ip_forward=1 on the node, then delete the proxy's pod. For ROS "
        "nodes with IPv6 addresses, set net.ipv6.conf.all.forwarding",
    ),
    "direction both": Fix(
        "set --direction both",
        "add the label rosproxy.direction=both to the containers of this proxy",
        "set spec.direction: Both",
    ),
    "direction out": Fix(
        "set --direction out",
        "add the label rosproxy.direction=out to the containers of this proxy",
        "set spec.direction: Out",
    ),
    "UDPROS": Fix(
        "set --udp",
        "add the label rosproxy.udp=true to a container of this proxy",
        "set spec.udp: true",
    ),
    "connections of a source": Fix(
        "set a larger --max-connections-per-source",
        "start the operator with a larger --proxy-max-connections-per-source",
        "set a larger proxy.bounds.maxConnectionsPerSource in the chart's values",
    ),
    "connections to a port": Fix(
        "set a larger --max-connections-per-lease",
        "start the operator with a larger --proxy-max-connections-per-lease",
        "set a larger proxy.bounds.maxConnectionsPerLease in the chart's values",
    ),
    "open files": Fix(
        "raise the limit of open files (docker run --ulimit nofile=N)",
        'raise the limit of open files ("default-ulimits" in /etc/docker/daemon.json)',
        "raise the limit of open files in the container runtime of the node",
    ),
    "proxy runs": Fix(
        "check that the proxy runs: docker ps; docker logs CONTAINER. Then run docker exec "
        "CONTAINER rosproxy doctor",
        "check that the proxy runs: docker ps; docker logs CONTAINER. Then run rosproxy-operator "
        "docker doctor",
        "check that the proxy's pod runs: kubectl get pods -l rosproxy.io/proxy-of; kubectl logs "
        "POD. Then run rosproxy-operator kubernetes doctor",
    ),
    "ask the proxy": Fix(
        "run this where the proxy runs (docker exec CONTAINER rosproxy COMMAND), or name its admin "
        "endpoint: --admin http://HOST:PORT or ROSPROXY_ADMIN",
        "run this in the proxy's container: docker exec CONTAINER rosproxy COMMAND",
        "run this in the proxy's pod: kubectl exec POD -- rosproxy COMMAND",
    ),
    "status": Fix(
        "run rosproxy status --json",
        "run docker exec CONTAINER rosproxy status --json",
        "run kubectl exec POD -- rosproxy status --json",
    ),
}
"""The fixes by a key, which names what to set or to run."""

_speaks_for = [Operator.NONE]
"""The operator whose fixes this process gives; a list, so that `speak_for` can replace it."""


def speak_for(operator: str) -> None:
    """Have this process give the fixes of an operator, named as in VARIABLE.

    Any other text stands for a proxy that a user has started by hand.
    """
    names = {o.name.lower(): o for o in (Operator.DOCKER, Operator.KUBERNETES)}
    _speaks_for[0] = names.get(operator, Operator.NONE)


def how_to(key: str, **fields: object) -> str:
    """What to do: an imperative that begins in lower case, without a full stop at the end.

    ``key``: a key of FIXES. ``fields``: all fields in the text of this fix.
    """
    return FIXES[key][_speaks_for[0]].format(**fields)


def how_to_in_a_sentence(key: str, **fields: object) -> str:
    """`how_to`, with a capital letter at the beginning."""
    text = how_to(key, **fields)
    return text[:1].upper() + text[1:]
