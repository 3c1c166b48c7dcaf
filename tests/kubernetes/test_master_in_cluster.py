"""A roscore that runs in the cluster, behind a Service, and is published to the robot."""

from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from tests.docker.engine import wait_until
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import nodes_at
from tests.kubernetes import api
from tests.kubernetes.pods import Namespace, namespace, unique
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import RosProxy, rosproxy
from tests.kubernetes.traffic import START, wait_for_service

PUBLISHED = 11302


@dataclass(frozen=True)
class Inside:
    net: Namespace
    rosproxy: RosProxy
    master_uri: str


@pytest.fixture(scope="module")
def inside(_release: None, robot: Robot) -> Iterator[Inside]:
    with namespace() as net:
        start_master(net)
        made = rosproxy(
            net.name,
            "inside",
            ports=12,
            master={"service": {"name": "master"}, "publish": PUBLISHED},
        )
        uri = f"http://10.88.0.11:{PUBLISHED}"
        net.idle(on="node1")
        net.idle(on="node2")
        wait_until(
            lambda: "/rosout" in nodes_at(uri), 60, lambda: f"a master at {uri}: {made.tell()}"
        )
        wait_for_service(net)
        yield Inside(net, made, uri)


def start_master(net: Namespace) -> None:
    """Start a roscore like a user in a cluster: unlabelled, with a Service."""
    script = "ROS_IP=$(hostname -i) exec roscore"
    net.pod("sh", "-c", script, name="master", labels={"app": "master"}, on="node2")
    api.create({
        "apiVersion": "v1", "kind": "Service",
        "metadata": {"name": "master", "namespace": net.name},
        "spec": {"selector": {"app": "master"}, "ports": [{"port": 11311}]},
    })  # fmt: skip


@pytest.mark.parametrize("on", ["node1", "node2"])
@pytest.mark.parametrize("library", LIBRARIES)
def test_topics_and_services_with_the_robot(
    library: str, on: str, inside: Inside, robot: Robot
) -> None:
    mark = unique(library).replace("-", "_")
    talker = inside.net.node(library, "pub", "--topic", f"/out_{mark}", "--word", "inside", on=on)
    listener = inside.net.node(library, "sub", "--topic", f"/in_{mark}", on=on)
    inside.net.node(library, "serve", "--service", f"/serve_{mark}", on=on)
    here = {"master_uri": inside.master_uri}
    heard = robot.node(f"listener_{mark}", library, "sub", "--topic", f"/out_{mark}", **here)
    robot.node(f"talker_{mark}", library, "pub", "--topic", f"/in_{mark}", "--word", "out", **here)
    called = ("call", "--service", f"/serve_{mark}", "--count", "3", "--patience", str(START))
    replies = robot.node(f"caller_{mark}", library, *called, **here)

    heard.wait_for("inside", seconds=START)
    listener.log.wait_for("out", seconds=START)
    replies.wait_for("ask", 3, seconds=START, verb="reply")
    address = {"node1": "10.88.0.11", "node2": "10.88.0.12"}[on]
    assert nodes_at(inside.master_uri)[f"/{talker.node}"].startswith(f"http://{address}:")


def test_status_names_the_master(inside: Inside) -> None:
    inside.rosproxy.wait_for("MasterReachable")
    address = api.get("services", inside.net.name, "master")["spec"]["clusterIP"]
    status = inside.rosproxy.wait_status(lambda s: bool(s.get("master")), "the master is named")
    assert address in status["master"] or "master" in status["master"]


def test_missing_service_is_told(net: Namespace) -> None:
    made = rosproxy(net.name, master={"service": {"name": "nowhere"}})
    net.idle(on="node1")
    condition = made.wait_for("Ready", "False")
    assert "nowhere" in condition["message"], condition
    start_master_service_later(net, made)


def start_master_service_later(net: Namespace, made: RosProxy) -> None:
    """Start the missing master with its Service, which suffices."""
    start_master(net)
    made.change(master={"service": {"name": "master"}})
    made.wait_for("Ready", seconds=60)
