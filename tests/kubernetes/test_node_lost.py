"""A node whose plug is pulled, and that comes back."""

import time

from tests.kubernetes import release
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.conftest import cluster
from tests.kubernetes.measured import note
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import rosproxy
from tests.kubernetes.traffic import flow


def test_node_is_stopped_and_comes_back(net: Namespace, robot: Robot) -> None:
    """The other node's traffic does not notice; this one's is there again when it is back."""
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    # The API server reaches Services by way of node1: that is so in this cluster only.
    other, lost_node = "node1", "node2"
    _operator_on(other, not_on=lost_node)
    with (
        flow(net, robot, "rospy", on=other) as unharmed,
        flow(net, robot, "roscpp", on=lost_node) as hit,
    ):
        before = made.the_proxy(lost_node)
        lost = time.time()
        cluster("stop-node", lost_node)
        try:
            made.wait_status(lambda s: not made.on(lost_node).get("ready"), "it is told", 60)
            condition = made.wait_for("Degraded", seconds=60)
            assert lost_node in condition["message"], condition
            noticed = time.time() - lost
            assert made.proxies, "nothing is deleted on a node that may come back"
            net.idle(on=other).wait_ready()
        finally:
            cluster("start-node", lost_node)
        up = time.time()
        hit.wait(since=up, seconds=120)
        again = hit.outward.wait_for("inside", since=up) - up
        after = made.the_proxy(lost_node, seconds=60)
        note(f"node stopped: told after {noticed:.1f} s; traffic again {again:.1f} s "
             f"after the node is ready")  # fmt: skip
        assert after.ports == before.ports
        gaps = unharmed.gaps(lost)
        assert gaps.unnoticed, gaps
        made.wait_for("Degraded", "False", seconds=60)


def _operator_on(node: str, not_on: str) -> None:
    """Have the operator run on a node."""
    if release.operator().body["spec"]["nodeName"] != node:
        kubectl("cordon", not_on)
        release.kill_operator()
        release.wait_operator()
        kubectl("uncordon", not_on)
