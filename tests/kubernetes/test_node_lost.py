"""A node that loses its plug, and comes back."""

import time

from tests.docker.engine import wait_until
from tests.kubernetes import release
from tests.kubernetes.cluster.layout import node_named
from tests.kubernetes.cluster.network import inside
from tests.kubernetes.conftest import cluster
from tests.kubernetes.measured import note
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import rosproxy
from tests.kubernetes.traffic import START, flow


def test_node_is_stopped_and_comes_back(net: Namespace, robot: Robot) -> None:
    """The other node's traffic goes on.

    The lost node's traffic returns with the node. The leading operator is lost with the node, and
    the other operator reports the loss.
    """
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    # The API server reaches Services by way of node1: that is so in this cluster only.
    other = "node1"
    lost_node = "node2"
    _leader_on(lost_node)
    webhook = release.operator().ip
    with (
        flow(net, robot, "rospy", on=other) as unharmed,
        flow(net, robot, "roscpp", on=lost_node) as hit,
    ):
        before = made.the_proxy(lost_node)
        lost = time.time()
        cluster("stop-node", lost_node)
        try:
            made.wait_status(lambda s: not made.on(lost_node).get("ready"), "the loss", 60)
            condition = made.wait_for("Degraded", seconds=60)
            assert lost_node in condition["message"], condition
            noticed = time.time() - lost
            assert made.proxies, "nothing is deleted on a node that may come back"
            # While kube-proxy still leads to the lost operator, new pods are unwired.
            wait_until(
                lambda: webhook not in inside(node_named(other), "iptables-save"),
                60,
                f"kube-proxy leads to {webhook} no more",
            )
            net.idle(on=other).wait_ready()
        finally:
            cluster("start-node", lost_node)
        up = time.time()
        hit.wait(since=up, seconds=START)
        again = hit.outward.wait_for("inside", since=up) - up
        after = made.the_proxy(lost_node, seconds=60)
        note(f"node stopped: told after {noticed:.1f} s; traffic again {again:.1f} s "
             f"after the node is ready")  # fmt: skip
        assert after.ports == before.ports
        gaps = unharmed.gaps(lost)
        assert gaps.unnoticed, gaps
        made.wait_for("Degraded", "False", seconds=60)
    release.wait_operator()


def _leader_on(node: str) -> None:
    """Make the operator on a node the leader. Each node has an operator."""
    if release.operator().body["spec"]["nodeName"] != node:
        release.kill_operator()
        release.wait_operator()
    assert release.operator().body["spec"]["nodeName"] == node
