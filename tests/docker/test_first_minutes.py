"""The commonest mistakes of a first try: the advice, followed word by word, until messages flow."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.docker.controller import Controller, the_proxy
from tests.docker.engine import docker, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.nodes import node_command
from tests.docker.robot import Robot

ADVICE = re.compile(r"[Ss]et ROS_MASTER_URI=(\S+)(?: and the label (\S+=\S+))?(?:; or wait|$)")


def told(controller: Controller, name: str) -> str:
    """Wait for a problem of a container in the status. Return the text."""
    subject = f"container {name}: "

    def lines() -> list[str]:
        return [line for line in controller.problems().splitlines() if line.startswith(subject)]

    wait_until(lambda: bool(lines()), 60, controller.logs)
    (line,) = lines()
    return line.removeprefix(subject)


def advised(text: str) -> tuple[str, tuple[str, ...]]:
    """The variable's value and the labels that the text tells to set."""
    advice = ADVICE.search(text)
    assert advice, text
    uri, label = advice.groups()
    return uri, (label,) if label else ()


def test_a_label_names_the_master_and_no_variable_does(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    controller = start_controller()
    network = net.network()
    labels = (ENABLE, f"rosproxy.master-uri={named.master_uri}")
    first = net.idle(network, uri="", labels=labels)

    text = told(controller, first.name)

    assert text.startswith("has no variable ROS_MASTER_URI")
    uri, more = advised(text)
    first.remove()
    node = net.node(network, "rospy", "pub", "--topic", "/out", uri=uri, labels=(*labels, *more))
    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)
    assert named.run("rostopic", "echo", "-n", "1", "/out")
    assert controller.problems() == ""


def test_a_wrong_port_came_first(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    controller = start_controller()
    network = net.network()
    bad = net.idle(network, uri=f"http://{named.name}:11312")
    the_proxy()
    first = net.idle(network)

    text = told(controller, first.name)

    assert bad.name in text
    uri, more = advised(text)
    first.remove()
    node = net.node(network, "rospy", "pub", "--topic", "/out", uri=uri, labels=(ENABLE, *more))
    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)
    assert named.run("rostopic", "echo", "-n", "1", "/out")
    assert node.name not in controller.problems()


def test_the_running_operator_is_asked(
    start_controller: Callable[..., Controller], net: Inside
) -> None:
    """The command has neither the operator's options nor the image's name."""
    controller = start_controller("--port-window", "13400-13499", "--ports", "7")
    node = net.idle(net.network())

    wait_until(lambda: bool(controller.status()["proxies"]), 30, controller.logs)
    status = controller.status()

    assert status["operator"] == "http://127.0.0.1:21313"
    (proxy,) = status["proxies"]
    assert proxy["range"] == "13400-13406"
    assert controller.command("plan", "--wait", "60") == "Nothing to do."
    other = docker(
        "exec", controller.container, "rosproxy-operator", "docker", "--proxy-image", "no:such",
        "status", check=False,
    )  # fmt: skip
    assert "No operator was asked" in other
    assert "proxy image no:such" in other
    node.remove()


@pytest.mark.parametrize("how", ["on the default bridge", "disconnected"])
def test_a_container_without_a_network_is_connected_while_it_runs(
    how: str, start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    controller = start_controller()
    home = "bridge" if how == "on the default bridge" else net.network()
    container = net.idle(home)
    if how == "disconnected":
        docker("network", "disconnect", home, container.name)

    advice = told(controller, container.name).rpartition(": ")[2].partition(". With Compose")[0]

    try:
        for command in advice.split("; "):
            program, *words = command.split()
            assert program == "docker"
            docker(*words)
        container.start(*node_command("rospy", "pub", "--topic", "/out", "__name:=connected"))
        wait_until(lambda: named.knows_proxied("connected"), 60, controller.logs)
        assert named.run("rostopic", "echo", "-n", "1", "/out")
        assert controller.problems() == ""
    finally:
        container.remove()
        wait_until(_network_removed, 30, "the network is removed")


def _network_removed() -> bool:
    """Remove the network, which the proxy may still use."""
    docker("network", "rm", "ros", check=False)
    return "ros" not in docker("network", "ls", "--format", "{{.Name}}").split()


@pytest.fixture
def without_nft(proxy_image: str, tmp_path: Path) -> Iterator[str]:
    """A proxy's image that can set no redirect, as where the kernel lacks what nft needs."""
    tag = "rosproxy-test-without-nft:latest"
    says = "echo 'Error: Could not process rule: Operation not supported' >&2; exit 1"
    (tmp_path / "Dockerfile").write_text(
        f"FROM {proxy_image}\nUSER 0\n"
        f'RUN printf "#!/bin/sh\\n{says}\\n" >/usr/sbin/nft\n'
        "USER 10001:10001\n"
    )
    docker("build", "--tag", tag, tmp_path)
    yield tag
    docker("rmi", "--force", tag, check=False)


def test_where_no_redirect_can_be_set_the_name_is_told(
    start_controller: Callable[..., Controller], near: Inside, robot: Robot, without_nft: str
) -> None:
    controller = start_controller("--proxy-image", without_nft)
    network = near.network()
    first = near.idle(network)

    text = told(controller, first.name)

    assert "docker logs" in text
    uri, more = advised(text)
    first.remove()
    node = near.node(network, "rospy", "pub", "--topic", "/out", uri=uri, labels=(ENABLE, *more))
    wait_until(lambda: robot.knows_proxied(node.node), 60, node.log.read)
    assert robot.run("rostopic", "echo", "-n", "1", "/out")
    assert controller.problems() == ""


ROSLAUNCH = (
    'echo \'<launch><node pkg="rostopic" type="rostopic" name="said" required="true" '
    'args="pub -r 5 /out std_msgs/String hello"/></launch>\' > /tmp/one.launch'
    " && exec roslaunch --wait /tmp/one.launch"
)


def test_the_hosts_address_as_the_containers_own(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    """As in manuals of drivers: roslaunch ends with this address, and starts without."""
    controller = start_controller()
    network = net.network()
    command = ("sh", "-c", ROSLAUNCH)
    first = net.run(network, *command, options=("--env", f"ROS_IP={named.host_address}"))

    text = told(controller, first.name)

    wait_until(lambda: first.state == "exited", 60, first.log.read)
    quoted = re.search(r"ends with '(.+)'\.", text)
    assert quoted
    assert quoted[1] in first.log.read()
    advice = re.search(r"Unset (\w+):", text)
    assert advice
    assert advice[1] == "ROS_IP"
    first.remove()
    net.run(network, *command)
    wait_until(lambda: named.knows_proxied("said"), 60, controller.logs)
    assert "hello" in named.run("rostopic", "echo", "-n", "1", "/out")
    assert controller.problems() == ""
