"""rospy and roscpp, topics and services, both ways: two nodes of the cluster and the robot."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from tests.docker.nodes import LIBRARIES, Log
from tests.kubernetes.pods import Namespace, Pod, namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import RosProxy, rosproxy
from tests.kubernetes.traffic import START, wait_for_service

NODES = ("node1", "node2")
PLACES = [(library, on) for library in LIBRARIES for on in NODES]


@dataclass
class World:
    """A publisher, a server and a subscriber to all topics, for each library on each node, and for
    each library on the robot.
    """

    rosproxy: RosProxy
    talkers: dict[tuple[str, str], Pod] = field(default_factory=dict)
    servers: dict[tuple[str, str], Pod] = field(default_factory=dict)
    listeners: dict[tuple[str, str], Pod] = field(default_factory=dict)
    callers: dict[tuple[str, str], Pod] = field(default_factory=dict)
    heard: dict[tuple[str, str], Log] = field(default_factory=dict)
    replies: dict[tuple[str, str], Log] = field(default_factory=dict)


@pytest.fixture(scope="module")
def world(_release: None, robot: Robot) -> Iterator[World]:
    """All nodes at once, to wait only once."""
    with namespace() as net:
        made = World(rosproxy(net.name, master={"uri": robot.master_uri}))
        wait_for_service(net)
        for library, on in PLACES:
            _start(made, net, robot, library, on)
        yield made


def _start(made: World, net: Namespace, robot: Robot, library: str, on: str) -> None:
    place = (library, on)
    mark = f"{library}_{on}"
    other = NODES[1 - NODES.index(on)]
    # As in a tutorial: with the URI of the robot's master, and the label.
    made.talkers[place] = net.node(
        *(library, "pub", "--topic", f"/from_{mark}", "--word", "inside"),
        on=on,
        env={"ROS_MASTER_URI": robot.master_uri},
    )
    made.servers[place] = net.node(library, "serve", "--service", f"/serve_{mark}", on=on)
    # What the pods of the other node publish, and the robot.
    made.listeners[place] = net.node(library, "sub", "--topic", f"/for_{mark}", on=on)
    made.heard[place] = robot.node(f"listener_{mark}", library, "sub", "--topic", f"/from_{mark}")
    robot.node(f"talker_{mark}", library, "pub", "--topic", f"/for_{mark}", "--word", "robot")
    net.node(library, "pub", "--topic", f"/for_{mark}", "--word", "far", on=other)
    net.node(library, "pub", "--topic", f"/for_{mark}", "--word", "near", on=on)
    patience = ("--count", "200", "--rate", "5", "--patience", str(START))
    made.replies[place] = robot.node(
        f"caller_{mark}", library, "call", "--service", f"/serve_{mark}", *patience
    )
    robot.node(f"server_{mark}", library, "serve", "--service", f"/robot_{mark}")
    made.callers[place] = net.node(
        library, "call", "--service", f"/robot_{mark}", *patience, on=on, restartPolicy="Never"
    )


@pytest.mark.parametrize(("library", "on"), PLACES)
def test_robot_hears_a_pod(library: str, on: str, world: World) -> None:
    world.heard[library, on].wait_for("inside", seconds=START)


@pytest.mark.parametrize("speaker", ["robot", "far", "near"])
@pytest.mark.parametrize(("library", "on"), PLACES)
def test_pod_hears(speaker: str, library: str, on: str, world: World) -> None:
    """Messages of the robot, of a pod on the other node, and of a pod on the same node."""
    world.listeners[library, on].log.wait_for(speaker, seconds=START)


@pytest.mark.parametrize(("library", "on"), PLACES)
def test_robot_calls_a_pod(library: str, on: str, world: World) -> None:
    world.replies[library, on].wait_for("ask", 5, seconds=START, verb="reply")


@pytest.mark.parametrize(("library", "on"), PLACES)
def test_pod_calls_the_robot(library: str, on: str, world: World) -> None:
    world.callers[library, on].log.wait_for("ask", 5, seconds=START, verb="reply")


def test_master_knows_pods_by_their_own_node(world: World, robot: Robot) -> None:
    for (_, on), pod in world.talkers.items():
        assert robot.knows_proxied(pod.node, on), robot.nodes()


def test_each_node_has_one_proxy(world: World) -> None:
    for on in NODES:
        world.rosproxy.the_proxy(on)
    assert len(world.rosproxy.proxies) == len(NODES)


def test_rosnode_of_the_robot_sees_all(world: World, robot: Robot) -> None:
    pod = world.talkers["roscpp", "node1"]
    assert "xmlrpc reply from" in robot.run("rosnode", "ping", "-c", "1", f"/{pod.node}")
    info = robot.run("rosnode", "info", f"/{pod.node}")
    assert "/from_roscpp_node1 [std_msgs/String]" in info
    assert "listener_roscpp_node1" in info
