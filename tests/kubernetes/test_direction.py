"""Pods that reach only the proxy, by NetworkPolicy: ``direction: Both``.

The tests' cluster enforces no policies. So each node's filter replaces the policy on the way to the
robot: only pods that the policy does not select get there.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.docker.engine import wait_until
from tests.docker.nodes import LIBRARIES
from tests.kubernetes import api
from tests.kubernetes.cluster.layout import NODES, POD_NETWORK, ROBOT_ADDRESS
from tests.kubernetes.cluster.network import inside
from tests.kubernetes.pods import Namespace, Pod
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import RosProxy, rosproxy
from tests.kubernetes.traffic import START, flow, wait_for_service


@contextmanager
def kept_in(made: RosProxy) -> Iterator[None]:
    """Block the way to the robot for all pods except the current proxies."""
    free = [made.the_proxy(node.name).ip for node in NODES]
    rules = [("-s", POD_NETWORK, "-d", ROBOT_ADDRESS, "-j", "DROP")]
    rules += [("-s", address, "-d", ROBOT_ADDRESS, "-j", "ACCEPT") for address in free]
    for node in NODES:
        for rule in rules:  # inserted before the former rules
            inside(node, "iptables", "-w", "-I", "FORWARD", *rule)
    try:
        yield
    finally:
        for node in NODES:
            for rule in rules:
                inside(node, "iptables", "-w", "-D", "FORWARD", *rule)


def selected(made: RosProxy) -> set[str]:
    """The pods that the pods' policy selects. The policy must allow no address outside."""
    name = f"rosproxy-{made.name}.pods"
    wait_until(lambda: bool(api.get("networkpolicies", made.namespace, name)), 45, made.tell)
    spec = api.get("networkpolicies", made.namespace, name)["spec"]
    assert spec["policyTypes"] == ["Egress"]
    assert not [to for rule in spec["egress"] for to in rule.get("to", ()) if "ipBlock" in to]
    (expression,) = spec["podSelector"]["matchExpressions"]
    bodies = api.objects(
        "pods", made.namespace, f"{expression['key']} in ({','.join(expression['values'])})"
    )
    return {body["metadata"]["name"] for body in bodies}


def caller(net: Namespace, robot: Robot, library: str) -> Pod:
    """A pod that calls a service of the robot."""
    robot.node(f"server_{library}", library, "serve", "--service", f"/robot_{library}")
    patience = ("--count", "200", "--rate", "5", "--patience", str(START))
    words = ("call", "--service", f"/robot_{library}", *patience)
    return net.node(library, *words, on="node2", restartPolicy="Never")


@pytest.mark.parametrize("library", LIBRARIES)
def test_pods_reach_the_robot_through_the_proxy_alone(
    library: str, net: Namespace, robot: Robot
) -> None:
    made = rosproxy(
        net.name, master={"uri": robot.master_uri}, ports=8, direction="Both", podEgress="Proxy"
    )
    wait_for_service(net)
    idle = {net.idle(on=node.name).name for node in NODES}
    with kept_in(made):
        asks = caller(net, robot, library)
        with flow(net, robot, library) as traffic:
            pods = {pod.name for pod in (traffic.talker, traffic.listener, traffic.server, asks)}
            assert selected(made) == pods | idle
            asks.log.wait_for("ask", 5, seconds=START, verb="reply")
            lost = time.time()
            made.the_proxy().crash()
            traffic.wait(since=lost + 1.5, seconds=60)


def test_without_it_they_hear_nobody_and_doctor_says_what_to_do(
    net: Namespace, robot: Robot
) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    wait_for_service(net)
    for node in NODES:
        net.idle(on=node.name)
    with kept_in(made):
        robot.node("robot_talker_shut", "roscpp", "pub", "--topic", "/shut", "--word", "outside")
        deaf = net.node("roscpp", "sub", "--topic", "/shut", on="node1")
        net.node("roscpp", "pub", "--topic", "/heard", "--word", "inside", on="node1")
        robot_listener = robot.node("robot_listener_shut", "roscpp", "sub", "--topic", "/heard")
        robot_listener.wait_for("inside", seconds=START)
        told = made.the_proxy().run("rosproxy", "doctor", "/shut", check=False)
        assert "spec.direction: Both" in " ".join(told.split()), told
        assert not deaf.log.got("outside")


def test_udpros_crosses_the_boundary_both_ways(net: Namespace, robot: Robot) -> None:
    """Not with headers of 54, 108, ... bytes, where roscpp ends the header by a NUL, without a
    proxy, too.

    The length of the topics here avoids such headers.
    """
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8, direction="Both", udp=True)
    wait_for_service(net)
    for node in NODES:
        net.idle(on=node.name)
    with kept_in(made):
        robot.node("robot_talker", "roscpp", "pub", "--topic", "/quick_by_udp", "--word", "quick")
        listener = net.node("roscpp", "sub", "--topic", "/quick_by_udp", "--udp", "1", on="node1")
        net.node("roscpp", "pub", "--topic", "/back_by_udp", "--word", "back", on="node2")
        robot_listener = robot.node(
            "robot_listener", "roscpp", "sub", "--topic", "/back_by_udp", "--udp", "1"
        )
        listener.log.wait_for("quick", 10, seconds=START)
        robot_listener.wait_for("back", 10, seconds=START)
        lost = time.time()
        made.the_proxy("node1").crash()
        listener.log.wait_for("quick", 10, since=lost + 1.5, seconds=60)
