"""The label is enough for rmw_zenoh: sessions in containers and behind the robot's router meet."""

import itertools
import re
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.docker.controller import (
    Controller,
    Proxy,
    managed,
    remove_proxies,
    running_controller,
    the_proxy,
)
from tests.docker.engine import docker, inspect, run, wait_until
from tests.docker.inside import ENABLE, Container, Inside, inside, unique
from tests.docker.machines import Machine, machine
from tests.docker.redirects import rules
from tests.docker.zenoh import NODE, Node, node_on

NUMBER = 92
_numbers = itertools.count(1)


class Sides:
    """The robot with its router, and labelled containers on a network."""

    def __init__(self, robot: Machine, made: Inside) -> None:
        self.robot = robot
        self.made = made
        self.network = made.network()
        self.peers = (ENABLE, f"rosproxy.peers={robot.address}")

    def outside(self, kind: str, topic: str = "chatter") -> Node:
        """Start a node on the robot."""
        return node_on(self.robot, f"outside_{next(_numbers)}", kind, topic)

    def inside(self, kind: str, topic: str = "chatter", **more: Any) -> Node:
        """Start a node in a container with only the labels."""
        name = unique(kind)
        more.setdefault("labels", self.peers)
        network = more.pop("network", self.network)
        container = self.made.run(network, *NODE, kind, name, topic, name=name, **more)
        return Node(name, container.log, container)

    def end(self) -> None:
        """End all nodes on the robot."""
        self.robot.run("sh", "-c", "kill -KILL $(cat /tmp/*.pid); rm -f /tmp/*.pid", check=False)


@pytest.fixture(scope="module")
def controller(
    controller_image: str, proxy_image: str, _no_other_controller: None
) -> Iterator[Controller]:
    try:
        with running_controller(
            controller_image, "--proxy-image", proxy_image, names={}
        ) as started_controller:
            yield started_controller
    finally:
        remove_proxies()


@pytest.fixture(scope="module")
def robot(zenoh_image: str) -> Iterator[Machine]:
    """A machine outside with a router. The machine has a route only to this host."""
    with machine(zenoh_image, "zenoh", NUMBER) as robot:
        robot.start("rmw_zenohd")
        yield robot


@pytest.fixture
def sides(controller: Controller, zenoh_image: str, robot: Machine) -> Iterator[Sides]:
    with inside(zenoh_image, "") as made:
        sides = Sides(robot, made)
        yield sides
        sides.end()


def linked_proxy(controller: Controller) -> Proxy:
    """The proxy, once its links are up."""

    def is_linked() -> bool:
        rows = controller.status()["proxies"]
        return bool(rows) and all([*row["links"].values(), *row["links"]] for row in rows)

    proxy = the_proxy()
    wait_until(is_linked, 30, lambda: controller.command("status", check=False))
    return proxy


def test_topics_and_services_pass_and_the_container_stays_as_it_is(
    sides: Sides, controller: Controller
) -> None:
    began = time.time()
    talker = sides.inside("pub")
    assert talker.container is not None
    before = inspect(talker.name)
    listener = sides.inside("sub", labels=(ENABLE,))
    robot_listener = sides.outside("sub")
    server = sides.inside("serve", "inside", labels=(ENABLE,))
    robot_server = sides.outside("serve", "robot")
    callers = [
        (sides.inside("call", "inside", labels=(ENABLE,)), server),
        (sides.outside("call", "inside"), server),
        (sides.inside("call", "robot", labels=(ENABLE,)), robot_server),
    ]
    robot_listener.wait_for("got hello ", 1)
    print(f"the robot hears {time.time() - began:.1f} s after docker run")
    listener.wait_for("got hello ")
    for caller, answers in callers:
        caller.wait_for(f"answer of {answers.name}")

    assert "Sysctls" not in before["HostConfig"] or not before["HostConfig"]["Sysctls"]
    assert inspect(talker.name) == before
    document = controller.status()
    rows = {row["name"]: row for row in document["containers"]}
    assert rows[talker.name]["redirect"] == {"master": "127.0.0.1:7447", "in_place": True}
    assert [node["publishes"] for node in rows[talker.name]["zenoh_nodes"]] == [["/chatter"]]
    assert document["problems"] == []
    (row,) = document["proxies"]
    assert (row["ros"], row["links"]) == ("zenoh", {f"{sides.robot.address}:7447": True})
    assert not inspect(linked_proxy(controller).sandbox)["HostConfig"]["PortBindings"]
    targets = re.findall(r"dnat to \S+", rules(talker.container) + rules(Container(listener.name)))
    assert len(targets) == len({*targets}) == 2
    doctor = controller.command("doctor", check=False)
    assert f"zenoh peer {sides.robot.address}:7447: linked" in doctor


def test_messages_flow_again_after_the_proxy_was_killed(
    sides: Sides, controller: Controller
) -> None:
    sides.inside("pub")
    listener = sides.inside("sub")
    caller = sides.inside("call", "robot")
    robot_listener = sides.outside("sub")
    robot_server = sides.outside("serve", "robot")
    every = [
        (listener, "got hello "),
        (robot_listener, "got hello "),
        (caller, f"answer of {robot_server.name}"),
    ]
    for node, text in every:
        node.wait_for(text)
    proxy = linked_proxy(controller)

    killed = time.time()
    docker("kill", proxy.name)

    for node, text in every:
        node.wait_for(text)
        print(f"{node.name}: five more messages {time.time() - killed:.1f} s after the kill")


def test_a_router_given_by_address_just_works(sides: Sides, controller: Controller) -> None:
    override = f'ZENOH_CONFIG_OVERRIDE=connect/endpoints=["tcp/{sides.robot.address}:7447"]'
    talker = sides.inside("pub", labels=(ENABLE,), options=("--env", override))
    listener = sides.inside("sub", labels=(ENABLE,))
    robot_listener = sides.outside("sub")

    robot_listener.wait_for("got hello ")
    listener.wait_for("got hello ")
    wait_until(
        lambda: f"ip daddr {sides.robot.address}" in rules(Container(talker.name)), 30,
        lambda: rules(Container(talker.name)),
    )  # fmt: skip
    assert controller.problems() == ""


def test_a_router_in_a_container_is_dialed(sides: Sides, controller: Controller) -> None:
    """Nodes in the network namespace of the router use the router, other nodes the proxy."""
    router = sides.made.run(sides.network, "rmw_zenohd", labels=sides.peers, name=unique("router"))
    neighbour = sides.inside("sub", network=f"container:{router.name}", labels=(ENABLE,))
    talker = sides.inside("pub", labels=(ENABLE,))
    robot_listener = sides.outside("sub")

    robot_listener.wait_for("got hello ")
    neighbour.wait_for("got hello ")
    assert not rules(router)
    assert rules(Container(talker.name))
    (row,) = controller.status()["proxies"]
    assert row["links"] == {f"{router.name}:7447": True, f"{sides.robot.address}:7447": True}


def test_a_label_hides_a_topic_from_outside(sides: Sides, controller: Controller) -> None:
    """The rule holds when the proxy is lost, and other topics of the container flow on."""
    topic = unique("hidden").replace("-", "_")
    rule = f"rosproxy.policy=deny publish /{topic}"
    hider = sides.inside("pub", topic, labels=(*sides.peers, rule))
    assert hider.container is not None
    hider.container.start(*NODE, "pub", "shown", "shown")
    denied = [sides.outside("sub", topic), sides.inside("sub", topic)]
    allowed = [sides.outside("sub", "shown"), sides.inside("sub", "shown")]
    for node in allowed:
        node.wait_for("got hello ")
    wait_until(
        lambda: f"publish /{topic} of /{hider.name}" in proxy_status(),
        30, proxy_status,
    )  # fmt: skip

    docker("kill", the_proxy().name)
    for node in allowed:
        node.wait_for("got hello ")
    assert [node.count("got ") for node in denied] == [0, 0]


def proxy_status() -> str:
    """What `rosproxy status` says in the proxy's container."""
    return docker("exec", the_proxy().name, "rosproxy", "status", check=False)


def test_the_last_container_goes_and_nothing_is_left(sides: Sides, controller: Controller) -> None:
    talker = sides.inside("pub")
    robot_listener = sides.outside("sub")
    robot_listener.wait_for("got hello ")
    docker("kill", talker.name)
    wait_until(
        lambda: not [*managed("redirect"), *managed("proxy"), *managed("ports")], 60,
        lambda: docker("ps", "--all"),
    )  # fmt: skip


def test_neighbours_do_not_reach_loopback(sides: Sides) -> None:
    """The redirect lets packets to 127.0.0.0/8 leave the container, but none come in."""
    talker = sides.inside("pub")
    assert talker.container is not None
    server = "from socket import *; s = create_server(('127.0.0.1', 8000)); s.accept()"
    talker.container.start("python", "-c", server)
    wait_until(lambda: bool(rules(Container(talker.name))), 30, "the redirect is in place")
    intruder = sides.made.idle(
        sides.network, labels=(),
        options=("--cap-add", "NET_ADMIN", "--sysctl", "net.ipv4.conf.all.route_localnet=1"),
    )  # fmt: skip
    address = talker.container.address(sides.network)
    intruder.run("ip", "address", "delete", "127.0.0.1/8", "dev", "lo")
    intruder.run("ip", "route", "add", "127.0.0.1", "via", address)
    dial = "from socket import *; create_connection(('127.0.0.1', 8000), 3)"

    assert "timed out" in intruder.run("python", "-c", dial, check=False)

    pid = inspect(talker.name)["State"]["Pid"]
    enter = ("nsenter", f"--net=/proc/{pid}/ns/net", "nft")
    table = re.findall(r"rosproxy-redirect-\w+", run(*enter, "list", "tables"))[0]
    run(*enter, "flush", "chain", "ip", table, "guard")
    assert intruder.run("python", "-c", dial, check=False) == ""
