"""The examples with the operator, started as in the READMEs, with real nodes."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.docker.controller import MANAGED, UPLINK, remove_proxies, the_proxy
from tests.docker.engine import ROOT, compose, containers, docker, inspect, logs, wait_until
from tests.docker.machines import machine
from tests.docker.nodes import Log
from tests.docker.robot import Robot
from tests.docker.ros2 import HERE, THERE, Outside, wait_for_line
from tests.docker.zenoh import NODE, Node, node_on

EXAMPLES = ROOT / "examples/docker"
ROS2 = EXAMPLES / "ros2"
ZENOH = EXAMPLES / "zenoh"
ZENOH_NUMBER = 95
SOCKET_PROXY = EXAMPLES / "socket-proxy"


STATUS = ("exec", "-T", "operator", "rosproxy-operator", "docker", "status", "--wait", "60")


@dataclass
class Example:
    """An unchanged Compose file, with an extra file for the robot's name, which no name server
    knows.
    """

    directory: Path
    variables: dict[str, str]
    extra: Path = field(default=Path())

    def compose(self, *arguments: str) -> str:
        files = ("--file", "compose.yaml", "--file", str(self.extra))
        return compose(self.directory, *files, *arguments, variables=self.variables)

    def container(self, service: str) -> str:
        return self.compose("ps", "--quiet", service).splitlines()[-1]


@contextmanager
def example(
    directory: Path, robot: Robot, images: dict[str, str], temporary: Path
) -> Iterator[Example]:
    extra = temporary / "names.yaml"
    hosts = f'["{robot.name}:{robot.address}"]'
    extra.write_text(f"services:\n  operator:\n    extra_hosts: {hosts}\n")
    variables = {"ROS_MASTER_URI": robot.master_uri, "ADVERTISE_HOST": robot.host_address}
    project = Example(directory, {**variables, **images}, extra)
    with running(project):
        yield project


@contextmanager
def running(project: Example) -> Iterator[None]:
    """An example that is up, and of which nothing is left in the end."""
    try:
        project.compose("up", "--detach", "--no-build")
        yield
    finally:
        print(project.compose("logs", "operator"))
        project.compose("rm", "--stop", "--force", "talker", "listener")
        remove_proxies()
        project.compose("down", "--timeout", "2")
        remove_proxies()


@pytest.fixture(scope="module")
def images(
    ros_image: str, proxy_image: str, controller_image: str, haproxy_image: str
) -> dict[str, str]:
    return {
        "ROS_IMAGE": ros_image,
        "ROSPROXY_IMAGE": proxy_image,
        "ROSPROXY_OPERATOR_IMAGE": controller_image,
        "HAPROXY_IMAGE": haproxy_image,
    }


def works_both_ways(project: Example, robot: Robot) -> None:
    """Check the traffic that the README promises."""
    heard = robot.run("rostopic", "echo", "-n", "3", "/chatter")
    assert heard.count("hello from inside") == 3

    words = ("rostopic", "pub", "-r", "2", "/command", "std_msgs/String", "hello from outside")
    robot.start("timeout", "20", *words)
    wait_until(
        lambda: project.compose("logs", "listener").count("hello from outside") >= 3, 20,
        lambda: project.compose("logs", "listener"),
    )  # fmt: skip


@pytest.mark.usefixtures("_no_other_controller")
def test_example_with_labels(named: Robot, images: dict[str, str], tmp_path: Path) -> None:
    with example(EXAMPLES, named, images, tmp_path) as project:
        works_both_ways(project, named)

        status = project.compose(*STATUS)
        assert the_proxy().name in status
        assert "talker" in status
        assert "listener" in status
        assert 11412 in the_proxy().ports

        project.compose("stop", "operator")
        project.compose("run", "--rm", "-T", "operator", "docker", "uninstall")
        assert containers(MANAGED) == []
        assert UPLINK not in docker("network", "ls", "--format", "{{.Name}}").split()


@pytest.mark.usefixtures("_no_other_controller")
def test_example_with_a_master_by_address(
    robot: Robot, images: dict[str, str], tmp_path: Path
) -> None:
    """The services are stock, except for the label."""
    with example(EXAMPLES, robot, images, tmp_path) as project:
        assert project.variables["ROS_MASTER_URI"] == f"http://{robot.address}:11311"
        works_both_ways(project, robot)

        status = project.compose("exec", "-T", "operator", "rosproxy-operator", "docker", "status")
        assert status.count(f"{robot.address}:11311 is redirected to the proxy") == 2


@pytest.mark.usefixtures("_no_other_controller")
def test_example_behind_a_socket_proxy(
    named: Robot, images: dict[str, str], tmp_path: Path
) -> None:
    docker("network", "create", UPLINK)
    with example(SOCKET_PROXY, named, images, tmp_path) as project:
        works_both_ways(project, named)

        operator = inspect(project.container("operator"))
        assert operator["Config"]["User"] == "10001:10001"
        assert not operator["Mounts"]
        forbidden = (
            "import os, requests as r; url = os.environ['DOCKER_HOST'].replace('tcp', 'http');"
            "print([r.get(url + '/v1.41/info').status_code,"
            "r.post(url + '/v1.41/containers/x/exec').status_code,"
            "r.delete(url + '/v1.41/networks/x').status_code])"
        )
        said = docker("exec", operator["Id"], "/opt/rosproxy/bin/python", "-c", forbidden)
        assert said == "[403, 403, 403]"


def test_socket_proxy_allows_what_the_operator_calls() -> None:
    """The documentation lists the calls. A unit test compares this list with the code."""
    documented = (ROOT / "docs/reference/permissions.md").read_text()
    calls = re.findall(r"^(GET|POST|DELETE) (/\S+)$", documented, re.MULTILINE)
    text = (SOCKET_PROXY / "haproxy.cfg").read_text()
    allowed = re.findall(r"acl (get|post|delete)_path path -m reg \^(/\S+)\$", text)

    assert len(calls) > 10
    assert calls == [(verb.upper(), path.replace("/v[0-9.]+", "")) for verb, path in allowed]


@pytest.mark.usefixtures("_no_other_controller")
@pytest.mark.parametrize(
    "variables",
    [
        pytest.param({"ADVERTISE_HOST": HERE}, id="lan"),
        pytest.param({"ADVERTISE_HOST": HERE, "ROS2_LAN": "none", "ROS2_PEERS": THERE}, id="peers"),
    ],
)
def test_example_with_ros_2(
    variables: dict[str, str],
    lan: Outside,
    images: dict[str, str],
    ros2_image: str,
    tmp_path: Path,
) -> None:
    extra = tmp_path / "none.yaml"
    extra.write_text("services: {}\n")
    project = Example(ROS2, {**variables, **images, "ROS2_IMAGE": ros2_image}, extra)
    try:
        with running(project):
            listener = lan.node("jazzy", "sub", "/chatter")
            lan.node("jazzy", "pub", "/command", "--word", "hello")
            wait_for_line(listener.log, "^got hello from inside ")
            wait_until(
                lambda: project.compose("logs", "listener").count("hello ") >= 3, 30,
                lambda: project.compose("logs", "listener"),
            )  # fmt: skip
            status = project.compose(*STATUS)
            assert "domain 0" in status
            assert status.count("1 participant") == 2
    finally:
        lan.end()


@pytest.mark.usefixtures("_no_other_controller")
def test_example_with_zenoh(images: dict[str, str], zenoh_image: str, tmp_path: Path) -> None:
    """Sessions with the defaults of rmw_zenoh stand for the programs of the nodes."""
    commands = {"talker": (*NODE, "pub", "talker"), "listener": (*NODE, "sub", "listener")}
    services = {name: {"command": [*words, "chatter"]} for name, words in commands.items()}
    extra = tmp_path / "commands.yaml"
    extra.write_text(json.dumps({"services": services}))
    with machine(zenoh_image, "example", ZENOH_NUMBER) as robot:
        robot.start("rmw_zenohd")
        variables = {"ROBOT": robot.address, "ROS2_ZENOH_IMAGE": zenoh_image, **images}
        project = Example(ZENOH, variables, extra)
        with running(project):
            container = project.container("listener")
            listener = Node("listener", Log(lambda: logs(container)))
            outside = node_on(robot, "outside", "sub", "chatter")
            outside.wait_for("got hello ")
            listener.wait_for("got hello ")
            status = project.compose(*STATUS)
            assert f"{robot.address}:7447" in status
            assert status.count("127.0.0.1:7447 is redirected to the proxy") == 2


def test_examples_need_no_more_than_their_readme_says() -> None:
    """The README tells to set exactly the variables without a default."""
    for directory in (EXAMPLES, SOCKET_PROXY, ROS2, ZENOH):
        needed = set(re.findall(r"\$\{(\w+):\?", (directory / "compose.yaml").read_text()))
        told = set(re.findall(r"export (\w+)=", (directory / "README.md").read_text()))
        assert needed == told, directory
