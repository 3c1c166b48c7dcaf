"""A stock Compose file, like in tutorials. The label is the only change."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docker.controller import Controller
from tests.docker.engine import compose
from tests.docker.nodes import Log, node_command
from tests.docker.robot import Robot

FILES = ("--file", "compose.yaml", "--file", "labels.yaml")
NODES = {
    "py_pub": ("rospy", "pub", "--topic", "/from_py", "--word", "py"),
    "cpp_pub": ("roscpp", "pub", "--topic", "/from_cpp", "--word", "cpp"),
    "py_sub": ("rospy", "sub", "--topic", "/to_py"),
    "cpp_sub": ("roscpp", "sub", "--topic", "/to_cpp"),
    "beside": ("roscpp", "pub", "--topic", "/from_beside", "--word", "beside"),
}
"""The commands of services. ``beside`` is in the network of another service."""


@pytest.fixture
def project(tmp_path: Path, ros_image: str, robot: Robot) -> Iterator[Path]:
    """Two Compose files: a stock file without rosproxy, and a file that adds labels."""
    services = {
        name: {
            "image": ros_image,
            "command": [*node_command(*words), f"__name:={name}"],
            "environment": {"ROS_MASTER_URI": robot.master_uri},
            "restart": "always",
        }
        for name, words in NODES.items()
    }
    services["beside"]["network_mode"] = "service:py_pub"
    stock = json.dumps({"version": "3.7", "services": services})  # which YAML is, too
    assert "rosproxy" not in stock.replace(ros_image, "")
    (tmp_path / "compose.yaml").write_text(stock)
    labels = {name: {"labels": {"rosproxy.enable": "true"}} for name in NODES}
    (tmp_path / "labels.yaml").write_text(json.dumps({"version": "3.7", "services": labels}))
    yield tmp_path
    compose(tmp_path, *FILES, "down", "--timeout", "2", variables={})


def printed(project: Path, service: str) -> Log:
    """The output of a service. Compose puts the service's name before each line."""

    def read() -> str:
        text = compose(project, *FILES, "logs", "--no-color", service, variables={})
        return text.replace(" | ", "\n")

    return Log(read)


def test_a_stock_compose_file_and_a_label(
    project: Path, controller: Controller, robot: Robot
) -> None:
    heard = {
        word: robot.node(f"listener_{word}", library, "sub", "--topic", f"/from_{word}")
        for word, library in (("py", "roscpp"), ("cpp", "rospy"), ("beside", "rospy"))
    }
    for word, library in (("py", "roscpp"), ("cpp", "rospy")):
        robot.node(f"talker_{word}", library, "pub", "--topic", f"/to_{word}", "--word", "robot")
    try:
        compose(project, *FILES, "up", "--detach", variables={})

        for word, log in heard.items():
            log.wait_for(word)
        for service in ("py_sub", "cpp_sub"):
            printed(project, service).wait_for("robot")
        assert all(robot.knows_proxied(name) for name in NODES)
        assert controller.problems() == ""
    finally:
        for name in ("listener_py", "listener_cpp", "listener_beside", "talker_py", "talker_cpp"):
            robot.end(name)
