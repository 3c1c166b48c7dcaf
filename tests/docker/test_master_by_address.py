"""A master given by address: nothing but the label, and the proxy is in the way of nodes."""

import time

import pytest

from tests.docker.controller import Controller, managed, proxies, the_proxy
from tests.docker.engine import docker, inspect, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.redirects import addressed_talker, redirected, rules
from tests.docker.robot import Robot


@pytest.mark.parametrize("library", [pytest.param("rospy", marks=pytest.mark.smoke), "roscpp"])
@pytest.mark.parametrize("known_by", ["", "ROS_IP", "ROS_HOSTNAME"])
def test_the_label_alone_is_enough(
    library: str, known_by: str, controller: Controller, near: Inside, robot: Robot
) -> None:
    """Topics and services both ways, also with a variable for the nodes' host.

    Only the network knows the name, and nothing has the address.
    """
    network = near.network()
    variables = {"ROS_IP": "192.0.2.99", "ROS_HOSTNAME": "talker"}
    options = ["--network-alias", "talker"]
    if known_by:
        options += ["--env", f"{known_by}={variables[known_by]}"]
    robot_listener = robot.node("robot_listener", library, "sub", "--topic", "/out")
    robot.node("robot_talker", library, "pub", "--topic", "/in", "--word", "robot")
    robot.node("server", library, "serve", "--service", "/there")
    began = time.time()
    try:
        node = near.node(
            network, library, "pub", "--topic", "/out", "--word", "inside", options=tuple(options)
        )
        robot_listener.wait_for("inside")
        print(
            f"{library}: heard {robot_listener.got('inside')[0].at - began:.1f} s after docker run"
        )
        server = near.node(network, library, "serve", "--service", "/ask")
        listener = near.node(network, library, "sub", "--topic", "/in")
        listener.log.wait_for("robot")
        wait_until(lambda: robot.knows_proxied(server.node), 60, server.log.read)
        robot.node("caller", library, "call", "--service", "/ask", "--count", "3").wait_for(
            "ask", verb="reply"
        )
        caller = near.node(network, library, "call", "--service", "/there", "--count", "3")
        caller.log.wait_for("ask", verb="reply")

        for container in (node, listener):
            assert robot.knows_proxied(container.node)
            assert inspect(container.name)["RestartCount"] == 0
            redirected(container, network)
    finally:
        for name in ("robot_listener", "robot_talker", "server", "caller"):
            robot.end(name)


def test_a_name_in_the_hosts_file_of_the_container(
    controller: Controller, near: Inside, robot: Robot
) -> None:
    """The file wins over the alias of the proxy, so the nodes used the real master."""
    network = near.network()
    entry = ("--add-host", f"{robot.name}:{robot.address}")
    node = near.node(
        network, "rospy", "pub", "--topic", "/out", "--word", "inside",
        uri=f"http://{robot.name}:11311", options=entry,
    )  # fmt: skip
    wait_until(lambda: robot.knows_proxied(node.node), 60, node.log.read)
    assert node.resolve(robot.name) == {robot.address}
    redirected(node, network)


def test_it_is_told_and_leaves_no_more_than_a_record(
    controller: Controller, near: Inside, robot: Robot
) -> None:
    network = near.network()
    node = addressed_talker(near, network, robot)
    redirected(node, network)

    (row,) = (row for row in controller.status()["containers"] if row["name"] == node.name)
    assert row["redirect"] == {"master": f"{robot.address}:11311", "in_place": True}
    assert f"{robot.address}:11311 is redirected to the proxy" in controller.command("status")
    assert "bypass the proxy" not in controller.problems()
    (record,) = managed("redirect")
    made = inspect(record)
    assert (made["State"]["Status"], made["State"]["ExitCode"]) == ("exited", 0)
    assert made["HostConfig"]["NetworkMode"] == f"container:{inspect(node.name)['Id']}"
    assert made["HostConfig"]["CapAdd"] == ["NET_ADMIN"]
    assert made["HostConfig"]["CapDrop"] == ["ALL"]
    assert made["HostConfig"]["SecurityOpt"] == ["no-new-privileges:true"]
    assert made["HostConfig"]["ReadonlyRootfs"]
    assert not made["Mounts"]

    docker("rm", "--force", node.name)

    wait_until(lambda: not managed("redirect"), 30, "the record is removed")


def test_a_network_in_common_that_is_not_the_way_outwards(
    controller: Controller, near: Inside, robot: Robot
) -> None:
    """The proxy must know nodes by the source address of their connections."""
    first, second = sorted((near.network(), near.network()))
    node = near.node(
        first, "roscpp", "pub", "--topic", "/out", "--word", "inside", verb="create",
        labels=(ENABLE, f"rosproxy.network={second}"),
    )  # fmt: skip
    docker("network", "connect", second, node.name)
    docker("start", node.name)

    wait_until(lambda: robot.knows_proxied(node.node), 60, node.log.read)

    assert the_proxy().networks == {second}
    redirected(node, second)


def test_networks_joined_later_and_left(controller: Controller, near: Inside, robot: Robot) -> None:
    first = near.network()
    second = near.network()
    node = addressed_talker(near, first, robot)
    robot_listener = robot.node("robot_listener", "roscpp", "sub", "--topic", "/out")
    try:
        robot_listener.wait_for("inside")
        docker("network", "connect", second, node.name)
        wait_until(lambda: the_proxy().networks == {first, second}, 60, "both are joined")
        docker("network", "disconnect", first, node.name)

        redirected(node, second)
        robot_listener.wait_for("inside", since=time.time())
    finally:
        robot.end("robot_listener")


def test_containers_that_share_a_network(
    controller: Controller, near: Inside, robot: Robot
) -> None:
    """The label may be on either; there are rules once in the network of both."""
    network = near.network()
    owner = near.idle(network, labels=(), uri="")
    mode = f"container:{owner.name}"
    nodes = [
        near.node(mode, "roscpp", "pub", "--topic", topic, "--word", "inside")
        for topic in ("/out", "/more")
    ]
    for node in nodes:
        wait_until(lambda: robot.knows_proxied(node.node), 60, node.log.read)  # noqa: B023
    redirected(owner, network)
    assert len(managed("redirect")) == 1

    for name in (owner, *nodes):
        docker("restart", "--time", "0", name.name)

    redirected(owner, network)
    for node in nodes:
        wait_until(lambda: robot.knows_proxied(node.node), 60, node.log.read)  # noqa: B023
    assert rules(owner).count("dnat to") == 1
    assert rules(owner) == rules(nodes[0])


def test_the_last_container_goes_and_nothing_is_left(
    controller: Controller, near: Inside, robot: Robot
) -> None:
    node = addressed_talker(near, near.network(), robot)

    docker("kill", node.name)

    wait_until(lambda: not proxies() and not managed("redirect"), 60, "all are removed")
    assert f"/{node.node}" not in robot.nodes()


def test_what_can_not_be_redirected_is_told(
    controller: Controller, near: Inside, robot: Robot
) -> None:
    """Without a way outwards nothing gets as far as a rule."""
    node = near.idle(near.network("--internal"))

    wait_until(lambda: f"container {node.name}" in controller.problems(), 30, controller.problems)

    assert "all networks of the container are internal" in controller.problems()
    assert not managed("redirect")
