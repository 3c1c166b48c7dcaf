"""Several masters, and a master that moves to another address."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.docker.controller import Controller, Process, proxies, remove_proxies, the_proxy
from tests.docker.engine import run, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.machines import cable
from tests.docker.robot import Robot, named_robot

ROVER = 80
MOVER = 82


@pytest.fixture(scope="module")
def rover(ros_image: str) -> Iterator[Robot]:
    """Another robot with its own master."""
    with named_robot(ros_image, "rover", ROVER) as robot:
        robot.start_master()
        yield robot


def test_two_masters_on_one_network(
    start_controller: Callable[..., Controller], net: Inside, named: Robot, rover: Robot
) -> None:
    """Each name leads to a different proxy with different ports."""
    start_controller(names={rover.name: rover.address})
    network = net.network()
    robots = {robot.name: robot for robot in (named, rover)}
    nodes = {
        name: net.node(network, "rospy", "pub", "--topic", "/out", "--word", name,
                       uri=robot.master_uri)
        for name, robot in robots.items()
    }  # fmt: skip
    listeners = {name: robot.node("listener", "rospy", "sub", "--topic", "/out")
            for name, robot in robots.items()}  # fmt: skip
    try:
        for name, listener in listeners.items():
            listener.wait_for(name)
            assert {got.text for got in listener.got()} == {name}
            assert robots[name].knows_proxied(nodes[name].node)
        first, second = proxies()
        assert not set(first.ports) & set(second.ports)
    finally:
        for robot in robots.values():
            robot.end("listener")


def test_two_masters_of_one_host(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    """Two roscores on the robot have the same host name. In separate networks, both are found."""
    named.start_master(port=11312)
    start_controller()
    nodes = {
        port: net.node(net.network(), "roscpp", "pub", "--topic", "/out",
                       uri=f"http://{named.name}:{port}")
        for port in (11311, 11312)
    }  # fmt: skip

    for port, node in nodes.items():
        wait_until(lambda: named.knows_proxied(node.node, port), 60, node.log.read)  # noqa: B023

    assert len(proxies()) == 2
    assert not named.uri(nodes[11311].node, 11312)


def test_label_wins_over_the_environment(
    start_controller: Callable[..., Controller], net: Inside, named: Robot, rover: Robot
) -> None:
    start_controller(names={rover.name: rover.address})
    labels = (ENABLE, f"rosproxy.master-uri={rover.master_uri}")
    node = net.node(net.network(), "roscpp", "pub", "--topic", "/out", labels=labels,
                    uri="http://rosproxy:11311")  # fmt: skip

    wait_until(lambda: rover.knows_proxied(node.node), 60, node.log.read)
    assert not named.uri(node.node)


@pytest.mark.usefixtures("_no_other_controller")
def test_masters_host_gets_another_address(
    ros_image: str, proxy_image: str, net: Inside, tmp_path: Path
) -> None:
    """The proxy follows the name, without being made anew."""
    with named_robot(ros_image, "mover", MOVER) as robot:
        robot.start_master()
        options = ("--proxy-image", proxy_image, "--advertise-host", robot.host_address)
        controller = Process(tmp_path, *options, names={robot.name: robot.address})
        controller.start()
        try:
            node = net.node(net.network(), "rospy", "pub", "--topic", "/out", "--word", "inside",
                            uri=robot.master_uri)  # fmt: skip
            wait_until(lambda: robot.knows_proxied(node.node), 60, controller.logs)
            number = the_proxy().id

            address = move(robot)
            controller.name(robot.name, address)
            later = net.node(net.networks[0], "rospy", "sub", "--topic", "/new",
                             uri=robot.master_uri)  # fmt: skip
            moved = replace(robot, address=address)

            wait_until(lambda: moved.knows_proxied(later.node), 40, controller.logs)
            moved.node("listener", "rospy", "sub", "--topic", "/out").wait_for("inside")
            assert the_proxy().id == number
        finally:
            controller.stop()
            remove_proxies()


@pytest.mark.usefixtures("_no_other_controller")
def test_a_master_given_by_address_gets_another_one(
    ros_image: str, proxy_image: str, net: Inside, tmp_path: Path
) -> None:
    """With the master's name in a label, nodes go on with the old address. Otherwise a new
    container works.
    """
    with named_robot(ros_image, "mover", MOVER) as robot:
        robot.start_master()
        options = ("--proxy-image", proxy_image, "--advertise-host", robot.host_address)
        controller = Process(tmp_path, *options, names={robot.name: robot.address})
        controller.start()
        try:
            network = net.network()
            old = f"http://{robot.address}:11311"
            named = (ENABLE, f"rosproxy.master-uri={robot.master_uri}")
            node = net.node(network, "rospy", "pub", "--topic", "/out", "--word", "inside",
                            uri=old, labels=named)  # fmt: skip
            plain = net.node(network, "roscpp", "pub", "--topic", "/plain", "--word", "new",
                             uri=old)  # fmt: skip
            for container in (node, plain):
                wait_until(
                    lambda: robot.knows_proxied(container.node),  # noqa: B023
                    60, controller.logs,
                )  # fmt: skip

            address = move(robot)
            controller.name(robot.name, address)
            plain.remove()
            moved = replace(robot, address=address)
            later = net.node(network, "rospy", "sub", "--topic", "/new", uri=old, labels=named)
            plain = net.node(network, "roscpp", "pub", "--topic", "/plain", "--word", "new",
                             uri=f"http://{address}:11311")  # fmt: skip

            for container in (later, plain):
                wait_until(
                    lambda: moved.knows_proxied(container.node),  # noqa: B023
                    60, controller.logs,
                )  # fmt: skip
            moved.node("listener", "rospy", "sub", "--topic", "/out").wait_for("inside")
            moved.node("listener2", "rospy", "sub", "--topic", "/plain").wait_for("new")
        finally:
            controller.stop()
            remove_proxies()


def move(robot: Robot) -> str:
    """Give the robot another address on the same cable. Return the address."""
    address = f"198.18.{MOVER + 1}.2"
    run("ip", "route", "add", f"{address}/32", "dev", cable(MOVER))
    script = f"""
        ip address add {address}/32 dev eth0
        ip address del {robot.address}/30 dev eth0
        ip route add {robot.host_address}/32 dev eth0 src {address}
    """
    pid = run("docker", "inspect", "--format", "{{.State.Pid}}", robot.container)
    run("nsenter", "--target", pid, "--net", "sh", "-ec", script)
    robot.run("sh", "-c", f"echo {address} {robot.name} >/etc/hosts")
    return address
