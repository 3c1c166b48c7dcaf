"""Reachability of the proxies' ports from outside, if all else is well."""

from tests.kubernetes.cluster.layout import node_named
from tests.kubernetes.cluster.node import without_host_ports
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import rosproxy
from tests.kubernetes.test_doctor import doctor


def test_a_network_plug_in_without_host_ports_is_told_with_the_fix(
    net: Namespace, robot: Robot
) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=4)
    net.idle(on="node1")
    with without_host_ports(node_named("node2")):
        net.idle(on="node2")
        condition = made.wait_for("PortsReachable", "False", seconds=60)
        cut_off = made.the_proxy("node2")
    assert condition["reason"] == "PortsUnreachable"
    text = (
        f"proxy {cut_off.name} on node node2: outside does not reach ports {cut_off.ports} of "
        "10.88.0.12 (nothing listens there). Enable hostPorts in the nodes' network plug-in (CNI: "
        "the plug-in portmap), then delete the proxy's pod"
    )
    assert condition["message"].startswith(text)
    assert "node1" not in condition["message"]
    made.wait_event("PortsUnreachable", "the plug-in portmap")
    made.wait_for("Ready")
    made.wait_for("Degraded")
    code, findings = doctor(net.name)
    assert code == 1
    assert findings[0]["text"].startswith(f"PortsReachable is False: {text}")
    # The node has the plug-in again. The fix is that of the message.
    cut_off.remove()
    made.wait_for("PortsReachable", seconds=60)
    made.wait_for("Degraded", "False")
