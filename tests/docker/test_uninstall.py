"""Uninstalling by the guide: nothing of the operator is left, and nodes go on."""

from collections.abc import Callable

from tests.docker.controller import HARDENED, MANAGED, UPLINK, Controller
from tests.docker.engine import containers, docker, wait_until
from tests.docker.inside import Inside
from tests.docker.redirects import addressed_talker, redirected, rules
from tests.docker.robot import Robot
from tests.docker.ros2 import Inside2


def uninstall(operator_image: str, proxy_image: str, *options: str, check: bool = True) -> str:
    """Run the guide's command. Return the output."""
    socket = "/var/run/docker.sock:/var/run/docker.sock"
    return docker("run", "--rm", "--network", "host", *HARDENED, "--volume", socket,
                  operator_image, "docker", "--proxy-image", proxy_image, *options,
                  "uninstall", check=check)  # fmt: skip


def test_nothing_is_left_once_the_operator_has_ended(
    start_controller: Callable[..., Controller],
    near: Inside,
    inside2: Inside2,
    robot: Robot,
    controller_image: str,
    proxy_image: str,
) -> None:
    controller = start_controller()
    network = near.network()
    node = addressed_talker(near, network, robot)
    redirected(node, network)
    inside2.node(inside2.made.network(), "jazzy", "pub", "/two")
    roles = {"proxy", "ports", "lan-relay", "redirect"}

    def made() -> set[str]:
        return {c["Labels"]["io.rosproxy.role"] for c in containers(MANAGED)}

    # An engine before 23.0 needs a flush besides.
    wait_until(lambda: made() >= roles, 60, lambda: docker("ps", "--all"))
    images = controller_image, proxy_image
    assert "an operator is running" in uninstall(*images, check=False)
    assert made() >= roles, "an operator is running, so that all stays"

    docker("rm", "--force", controller.container)
    uninstall(*images)

    assert containers(MANAGED) == []
    assert UPLINK not in docker("network", "ls", "--format", "{{.Name}}").split()
    assert rules(node) == ""
    assert node.state == "running"
    assert not robot.knows_proxied(node.node)
    uninstall(*images)
