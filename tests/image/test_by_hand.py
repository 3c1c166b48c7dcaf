"""The examples with a proxy declared by hand, started as in the READMEs, with real nodes.

The robot cannot reach any container, so all traffic goes through the proxy's published ports.
"""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.docker.engine import ROOT, compose, docker, inspect, wait_until
from tests.docker.robot import HOST_ADDRESS, MASTER_URI, Robot

EXAMPLE = ROOT / "examples/docker/by-hand"
KERNEL = ROOT / "examples/docker/kernel"
PUBLISHED = range(11000, 11020)


class Inside:
    """The containers of an example."""

    def __init__(self, directory: Path, proxy_image: str, ros_image: str) -> None:
        self._directory = directory
        self._variables = {
            "ROSPROXY_IMAGE": proxy_image,
            "ROS_IMAGE": ros_image,
            "ROS_MASTER_URI": MASTER_URI,
            "ADVERTISE_HOST": HOST_ADDRESS,
        }

    def compose(self, *arguments: str) -> str:
        return compose(self._directory, *arguments, variables=self._variables)

    def container(self, service: str) -> str:
        return self.compose("ps", "--quiet", service).splitlines()[-1]

    def run(self, *command: str, seconds: int = 30) -> str:
        """Run a ROS program in the talker's container."""
        limited = ("timeout", str(seconds), *command)
        return docker("exec", self.container("talker"), *limited, seconds=seconds + 10)

    def start(self, *command: str) -> None:
        docker("exec", "--detach", self.container("talker"), *command)


@contextmanager
def example(inside: Inside) -> Iterator[Inside]:
    try:
        inside.compose("up", "--detach", "--no-build")
        yield inside
    finally:
        print(inside.compose("logs", "rosproxy"))
        inside.compose("down", "--timeout", "5")


@pytest.fixture(scope="module")
def inside(robot: Robot, proxy_image: str, ros_image: str) -> Iterator[Inside]:
    with example(Inside(EXAMPLE, proxy_image, ros_image)) as inside:
        yield inside


def nodes(robot: Robot) -> dict[str, str]:
    """The URI of each node at the master."""
    lines = robot.run("rosnode", "list", "--all").splitlines()
    return {name.strip(): uri.strip() for uri, name in (line.split("\t") for line in lines)}


def inside_ports(robot: Robot) -> set[int]:
    matches = (re.match(rf"http://{HOST_ADDRESS}:(\d+)", uri) for uri in nodes(robot).values())
    return {int(match[1]) for match in matches if match}


def test_robot_has_no_way_around_the_proxy(robot: Robot, inside: Inside) -> None:
    networks = inspect(inside.container("talker"))["NetworkSettings"]["Networks"]
    (address,) = (network["IPAddress"] for network in networks.values())
    connect = f"import socket; socket.create_connection(('{address}', 11311), 3)"
    assert "unreachable" in robot.run("python3", "-c", connect, check=False)


def test_talker_is_heard_outside(robot: Robot, inside: Inside) -> None:
    heard = robot.run("rostopic", "echo", "-n", "3", "/chatter")
    assert heard.count("hello from inside") == 3


def test_talker_hears_the_robot(robot: Robot, inside: Inside) -> None:
    robot.start("rostopic", "pub", "-r", "5", "/command", "std_msgs/String", "hello from outside")
    heard = inside.run("rostopic", "echo", "-n", "3", "/command")
    assert heard.count("hello from outside") == 3


def test_roscpp_node_inside_hears_and_is_heard(robot: Robot, inside: Inside) -> None:
    robot.start("rostopic", "pub", "-r", "5", "/there", "std_msgs/String", "round trip")
    inside.start("/usr/lib/topic_tools/relay", "/there", "/back", "__name:=relay")
    assert robot.run("rostopic", "echo", "-n", "3", "/back").count("round trip") == 3

    robot.run("rosnode", "kill", "/relay")
    wait_until(lambda: "/relay" not in nodes(robot), 25, "the killed node signs off")


def test_services_are_called_both_ways(robot: Robot, inside: Inside) -> None:
    inner = next(name for name, uri in nodes(robot).items() if HOST_ADDRESS in uri)
    assert "loggers" in robot.run("rosservice", "call", f"{inner}/get_loggers")
    assert "loggers" in inside.run("rosservice", "call", "/rosout/get_loggers")


def test_nodes_are_known_by_published_ports(robot: Robot, inside: Inside) -> None:
    ports = inside_ports(robot)
    assert ports
    assert ports <= set(PUBLISHED)


def test_robot_is_heard_again_after_the_proxy_was_killed(robot: Robot, inside: Inside) -> None:
    before = inside_ports(robot)
    proxy = inside.container("rosproxy")

    docker("restart", "--time", "0", proxy)

    heard = robot.run("rostopic", "echo", "-n", "3", "/chatter")
    assert heard.count("hello from inside") == 3
    assert before <= inside_ports(robot)


def test_stopping_the_example_leaves_no_entry_behind(robot: Robot, inside: Inside) -> None:
    inside.compose("stop", "--timeout", "10")
    wait_until(lambda: not inside_ports(robot), 25, lambda: str(nodes(robot)))


def test_example_with_the_kernel(robot: Robot, proxy_image: str, ros_image: str) -> None:
    """The last test, because this example has the same ports as the others."""
    with example(Inside(KERNEL, proxy_image, ros_image)) as inside:
        assert robot.run("rostopic", "echo", "-n", "3", "/chatter").count("from inside") == 3
        assert counted(inside) > 0

        docker("restart", "--time", "0", inside.container("rosproxy"))

        assert robot.run("rostopic", "echo", "-n", "3", "/chatter").count("from inside") == 3
        assert counted(inside) > 0


def counted(inside: Inside) -> int:
    """The bytes that the kernel has forwarded, once there are any."""

    def status() -> dict[str, Any]:
        text = docker("exec", inside.container("rosproxy"), "rosproxy", "status", "--json",
                      check=False)  # fmt: skip
        document: dict[str, Any] = json.loads(text)
        return document

    def sent() -> int:
        return sum(int(node["data_plane"]["sent"]) for node in status()["nodes"])

    assert status()["data_plane"]["plane"] == "kernel", status()
    wait_until(lambda: sent() > 0, 60, lambda: str(status()))
    return sent()
