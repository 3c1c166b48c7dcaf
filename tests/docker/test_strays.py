"""Nodes that reach the real master before the proxy starts, and register directly.

The nodes' network has a name server that knows the robot. Without adoption, outside could not reach
these nodes.
"""

import time
from collections.abc import Callable, Iterator

import pytest

from tests.docker.controller import Controller, proxies
from tests.docker.engine import docker, inspect, wait_until
from tests.docker.inside import Container, Inside
from tests.docker.name_server import name_server
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import Robot


@pytest.fixture
def dns_options(named: Robot) -> Iterator[tuple[str, ...]]:
    """Options for containers that can resolve the robot's name."""
    with name_server(named.host_address, {named.name: named.address}):
        yield ("--dns", named.host_address)


def is_stray(robot: Robot, node: Container) -> bool:
    """Whether the master has the node with the container's host name."""
    hostname = inspect(node.name)["Config"]["Hostname"]
    return robot.uri(node.node).startswith(f"http://{hostname}:")


@pytest.mark.parametrize("library", LIBRARIES)
def test_nodes_that_registered_first_are_adopted(
    library: str, start_controller: Callable[..., Controller], net: Inside, named: Robot,
    dns_options: tuple[str, ...],
) -> None:  # fmt: skip
    network = net.network()
    node = net.node(
        network, library, "pub", "--topic", "/out", "--word", "inside", options=dns_options
    )
    server = net.node(network, library, "serve", "--service", "/ask", options=dns_options)
    listener = net.node(network, library, "sub", "--topic", "/in", options=dns_options)
    for container in (node, server, listener):
        wait_until(lambda: is_stray(named, container), 60, container.log.read)  # noqa: B023
    robot_listener = named.node("robot_listener", library, "sub", "--topic", "/out")
    named.node("robot_talker", library, "pub", "--topic", "/in", "--word", "robot")
    try:
        wait_until(lambda: "ready" in robot_listener.read(), 60, robot_listener.read)
        assert not robot_listener.got()
        began = time.time()

        start_controller()

        heard = robot_listener.wait_for("inside") - began
        print(f"{library}: heard {heard:.1f} s after the controller was started")
        caller = named.node("caller", library, "call", "--service", "/ask", "--count", "3")
        caller.wait_for("ask", verb="reply")
        listener.log.wait_for("robot", since=time.time())
        for container in (node, server, listener):
            assert named.knows_proxied(container.node)
            assert inspect(container.name)["RestartCount"] == 0
            assert "shutdown" not in container.log.read()
        docker("stop", node.name)
        wait_until(lambda: not named.uri(node.node), 5, "the node is unregistered")
    finally:
        named.end("robot_listener")
        named.end("robot_talker")


@pytest.mark.parametrize("library", LIBRARIES)
def test_node_that_starts_faster_than_its_proxy(
    library: str, start_controller: Callable[..., Controller], net: Inside, named: Robot,
    dns_options: tuple[str, ...],
) -> None:  # fmt: skip
    start_controller()
    network = net.network()
    robot_listener = named.node("robot_listener", library, "sub", "--topic", "/out")
    try:
        for text in ("first", "second", "third"):
            began = time.time()
            has_proxy = bool(proxies())
            net.node(
                network, library, "pub", "--topic", "/out", "--word", text, options=dns_options
            )
            heard = robot_listener.wait_for(text) - began
            print(f"{library}: heard {heard:.1f} s after docker run, "
                  f"{'with' if has_proxy else 'without'} a proxy")  # fmt: skip
    finally:
        named.end("robot_listener")
