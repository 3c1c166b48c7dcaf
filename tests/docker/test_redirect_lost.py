"""Redirects while operators end, start, and change options."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.docker.controller import Process, managed, remove_proxies, the_proxy
from tests.docker.engine import docker, inspect, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.nodes import LIBRARIES
from tests.docker.redirects import addressed_talker, redirected, rules
from tests.docker.robot import Robot


@pytest.fixture
def process(
    tmp_path: Path, proxy_image: str, _no_other_controller: None
) -> Iterator[Callable[..., Process]]:
    """Controllers that can be killed, started with other options and asked; none is left."""
    made: list[Process] = []

    def start(*options: str) -> Process:
        made.append(Process(tmp_path, "--proxy-image", proxy_image, *options))
        made[-1].start()
        return made[-1]

    try:
        yield start
    finally:
        for started in made:
            started.stop()
        remove_proxies()


def told(running: Process, directory: Path) -> str:
    """The output of the status with a controller's options."""
    return " ".join(Process(directory, *running.options).once("status").split())


@pytest.mark.parametrize("library", LIBRARIES)
def test_nodes_that_were_quicker_are_adopted(
    library: str, process: Callable[..., Process], near: Inside, robot: Robot
) -> None:
    network = near.network()
    node = near.node(network, library, "pub", "--topic", "/out", "--word", "inside")
    server = near.node(network, library, "serve", "--service", "/ask")
    for container in (node, server):
        wait_until(lambda: robot.uri(container.node) != "", 60, container.log.read)  # noqa: B023
        assert not robot.knows_proxied(container.node)
    listener = robot.node("listener", library, "sub", "--topic", "/out")
    try:
        process()

        listener.wait_for("inside")
        robot.node("caller", library, "call", "--service", "/ask", "--count", "3").wait_for(
            "ask", verb="reply"
        )
        for container in (node, server):
            assert robot.knows_proxied(container.node)
            assert inspect(container.name)["RestartCount"] == 0
            assert "shutdown" not in container.log.read()
    finally:
        for name in ("listener", "caller"):
            robot.end(name)


def test_after_whatever_is_lost_it_is_there_again(
    process: Callable[..., Process], near: Inside, robot: Robot
) -> None:
    network = near.network()
    running = process()
    node = addressed_talker(near, network, robot, "rospy")
    listener = robot.node("listener", "rospy", "sub", "--topic", "/out")
    try:
        listener.wait_for("inside")
        for command in (
            ("restart", "--time", "0", node.name),
            ("kill", the_proxy().name),
            ("rm", "--force", the_proxy().name),
            ("rm", "--force", the_proxy().name, the_proxy().sandbox),
        ):
            since = time.time()
            docker(*command, seconds=120)
            listener.wait_for("inside", since=since)
            redirected(node, network)
        running.kill()
        docker("restart", "--time", "0", node.name)
        wait_until(lambda: node.state == "running", 30, "it runs")
        assert not rules(node)
        running.start()
        redirected(node, network)
        listener.wait_for("inside", since=time.time())
        wait_until(lambda: len(managed("redirect")) == 1, 30, lambda: str(managed("redirect")))
    finally:
        robot.end("listener")


def test_the_proxys_address_changes(
    process: Callable[..., Process], near: Inside, robot: Robot
) -> None:
    network = near.network("--subnet", "10.213.77.0/24")
    running = process()
    node = addressed_talker(near, network, robot)
    redirected(node, network)
    proxy = the_proxy()
    old = proxy.address(network)
    running.kill()
    docker("network", "disconnect", network, proxy.sandbox)
    near.idle(network, labels=(), options=("--ip", old))

    running.start()

    redirected(node, network)
    assert proxy.address(network) != old
    later = near.node(network, "roscpp", "pub", "--topic", "/more")
    wait_until(lambda: robot.knows_proxied(later.node), 60, later.log.read)


def test_redirects_can_be_switched_off(
    process: Callable[..., Process], near: Inside, robot: Robot, tmp_path: Path
) -> None:
    """By label for a container, by option for all. Existing redirects are removed."""
    network = near.network()
    running = process()
    node = addressed_talker(near, network, robot)
    other = near.idle(network, labels=(ENABLE, "rosproxy.redirect=false"))
    redirected(node, network)
    assert "Or remove label rosproxy.redirect='false'" in told(running, tmp_path)
    assert not rules(other)
    running.kill()

    off = process("--no-redirect")

    wait_until(lambda: not managed("redirect"), 30, "the record is removed")
    assert not rules(node)
    assert "start the operator without --no-redirect" in told(off, tmp_path)
    late = near.node(network, "rospy", "pub", "--topic", "/late")
    wait_until(lambda: bool(robot.uri(late.node)), 60, late.log.read)
    assert the_proxy().running
