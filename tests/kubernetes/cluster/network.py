"""The cables: a bridge in this network namespace, a namespace for each node, the robot's."""

from collections.abc import Iterable

from tests.docker.engine import run
from tests.kubernetes.cluster.layout import (
    BRIDGE,
    GATEWAY,
    NODES,
    POD_NETWORK,
    ROBOT_ADDRESS,
    SERVICE_NETWORK,
    Node,
)

_FORWARD = (
    ("FORWARD", "-i", BRIDGE, "-j", "ACCEPT"),
    ("FORWARD", "-o", BRIDGE, "-j", "ACCEPT"),
    # If a pod calls a Service that its node's kube-proxy does not know yet, another node must not
    # answer: only this machine finds Services through a node (`route_services`).
    ("FORWARD", "-i", BRIDGE, "-d", SERVICE_NETWORK, "-j", "DROP"),
)
"""Each rule is inserted before the former rules."""
_ROBOT_CABLE = "rpxrobot"


def make_bridge() -> None:
    """Make the bridge of all machines, unless the bridge exists."""
    if not _exists(BRIDGE):
        run("ip", "link", "add", BRIDGE, "type", "bridge")
    run("ip", "address", "replace", f"{GATEWAY}/24", "dev", BRIDGE)
    run("ip", "link", "set", BRIDGE, "up")
    run("sysctl", "-qw", "net.ipv4.ip_forward=1")
    for rule in _FORWARD:
        # Docker's policy for forwarding is DROP.
        if run("iptables", "-w", "-C", *rule, check=False):
            run("iptables", "-w", "-I", *rule)


def remove_bridge() -> None:
    for rule in _FORWARD:
        while not run("iptables", "-w", "-D", *rule, check=False):
            pass
    if _exists(BRIDGE):
        run("ip", "link", "delete", BRIDGE)


def plug_in_node(node: Node) -> None:
    """Make a node's namespace with a cable to the bridge and routes to all pods."""
    if node.namespace in namespaces():
        return
    run("ip", "netns", "add", node.namespace)
    cable = f"rpx{node.name}"
    run("ip", "link", "add", cable, "type", "veth", "peer", "name", "eth0",
        "netns", node.namespace)  # fmt: skip
    run("ip", "link", "set", cable, "master", BRIDGE, "up")
    inside(node, "ip", "link", "set", "lo", "up")
    inside(node, "ip", "address", "add", f"{node.address}/24", "dev", "eth0")
    inside(node, "ip", "link", "set", "eth0", "up")
    inside(node, "ip", "route", "add", "default", "via", GATEWAY)
    inside(node, "sysctl", "-qw", "net.ipv4.ip_forward=1", "net.ipv4.conf.all.send_redirects=0",
           "net.ipv4.conf.eth0.send_redirects=0")  # fmt: skip
    for other in NODES:
        if other != node:
            inside(node, "ip", "route", "add", other.pod_network, "via", other.address)
    # An address that no pod has any more is refused at once, as behind a CNI bridge.
    inside(node, "ip", "route", "add", "unreachable", node.pod_network)
    # What leaves the cluster comes from the node; among pods, addresses are kept.
    inside(node, "iptables", "-w", "-t", "nat", "-A", "POSTROUTING", "-s", node.pod_network,
           "!", "-d", POD_NETWORK, "-j", "MASQUERADE")  # fmt: skip
    run("ip", "route", "replace", node.pod_network, "via", node.address)
    route_services()


def unplug_node(node: Node) -> None:
    """Remove a node's namespace together with the cable."""
    if node.namespace in namespaces():
        run("ip", "netns", "delete", node.namespace)
    run("ip", "link", "delete", f"rpx{node.name}", check=False)
    run("ip", "route", "delete", node.pod_network, check=False)
    route_services()


def route_services() -> None:
    """Let the API server find webhooks: any node that is up translates Services' addresses."""
    up = [node for node in NODES if node.namespace in namespaces()]
    if up:
        run("ip", "route", "replace", SERVICE_NETWORK, "via", up[0].address)
    else:
        run("ip", "route", "delete", SERVICE_NETWORK, check=False)


def plug_in_robot(process: str, address: str = ROBOT_ADDRESS, cable: str = _ROBOT_CABLE) -> None:
    """Lay a cable to a container without a network. The container reaches only the bridge."""
    run("ip", "link", "delete", cable, check=False)
    run("ip", "link", "add", cable, "type", "veth", "peer", "name", "eth0",
        "netns", process)  # fmt: skip
    run("ip", "link", "set", cable, "master", BRIDGE, "up")
    far = ("nsenter", "--target", process, "--net")
    run(*far, "ip", "address", "add", f"{address}/24", "dev", "eth0")
    run(*far, "ip", "link", "set", "eth0", "up")
    run(*far, "ip", "route", "add", "224.0.0.0/4", "dev", "eth0")


def unplug_robot(cable: str = _ROBOT_CABLE) -> None:
    run("ip", "link", "delete", cable, check=False)


def inside(node: Node, *command: str) -> str:
    """Run a command in a node's network namespace."""
    return run("nsenter", f"--net=/run/netns/{node.namespace}", *command)


def namespaces() -> Iterable[str]:
    return [line.split()[0] for line in run("ip", "netns", "list").splitlines()]


def _exists(interface: str) -> bool:
    return "does not exist" not in run("ip", "link", "show", interface, check=False)
