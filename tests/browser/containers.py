"""Thirty real nodes of ROS 1 and ten of ROS 2, in labelled containers and on machines outside.

The operator runs on a real Docker engine. The robot and the laptop have nodes of ROS 1, the cart
has nodes of ROS 2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from tests.docker import images
from tests.docker.controller import remove_proxies, running_controller
from tests.docker.engine import run, running_engine, wait_until
from tests.docker.inside import ENABLE, Inside, inside, remove_leftovers
from tests.docker.nodes import node_command
from tests.docker.robot import laptop, named_robot
from tests.docker.ros2 import HERE, command, machine_on_lan
from tests.docker.test_doctor import page

Words = tuple[str, ...]
Nodes = Mapping[str, Words]
"""The role, the topic and the options of each node."""
PUB = "pub"
SUB = "sub"
ROBOT_NODES: Nodes = {
    "/camera/driver": (PUB, "/camera/image", "--rate", "10", "--size", "30000"),
    "/lidar/driver": (PUB, "/scan", "--rate", "10", "--size", "6000"),
    "/imu/driver": (PUB, "/imu", "--rate", "20"),
    "/battery/monitor": (PUB, "/battery", "--rate", "2"),
    "/joints/reader": (PUB, "/joint_states", "--rate", "10"),
    "/base/controller": (SUB, "/cmd_vel"),
    "/arm/controller": (SUB, "/arm/goal"),
    "/gripper/controller": (SUB, "/gripper/command"),
    "/safety/stop": (SUB, "/safety/state"),
    "/diagnostics/collector": (SUB, "/diagnostics"),
}
LAPTOP_NODES: Nodes = {
    "/viewer/objects": (SUB, "/objects"),
    "/viewer/map": (SUB, "/map"),
    "/recorder/plan": (SUB, "/plan"),
    "/teleop/joystick": (PUB, "/joy", "--rate", "10"),
}
CONTAINERS: Mapping[str, Nodes] = {
    "detector-gpu-1": {
        "/perception/detector": (SUB, "/camera/image"),
        "/perception/objects": (PUB, "/objects", "--rate", "5", "--size", "2000"),
        "/perception/tracker": (SUB, "/objects"),
        "/perception/battery": (SUB, "/battery"),
    },
    "slam-1": {
        "/mapping/scan_matcher": (SUB, "/scan"),
        "/mapping/imu_filter": (SUB, "/imu"),
        "/mapping/builder": (PUB, "/map", "--rate", "2", "--size", "40000"),
        "/mapping/localiser": (SUB, "/map"),
    },
    "nav-stack-2": {
        "/navigation/planner": (PUB, "/plan", "--rate", "5", "--size", "2000"),
        "/navigation/driver": (PUB, "/cmd_vel", "--rate", "10"),
        "/navigation/joystick": (SUB, "/joy"),
        "/navigation/safety": (PUB, "/safety/state", "--rate", "5"),
    },
    "arm-driver-1": {
        "/manipulation/arm": (PUB, "/arm/goal", "--rate", "2"),
        "/manipulation/gripper": (PUB, "/gripper/command", "--rate", "2"),
        "/manipulation/joints": (SUB, "/joint_states"),
        "/manipulation/health": (PUB, "/diagnostics", "--rate", "2"),
    },
}
"""The nodes of ROS 1 in each container (tests/ros/nodes).

No container has the name of a namespace. Otherwise the picture would not show whether the page
names the container.
"""
CART_NODES: Nodes = {
    "cart_pose": (PUB, "/cart/pose"),
    "cart_task": (SUB, "/cart/task"),
    "lift_driver": (SUB, "/lift/command"),
    "lift_state": (PUB, "/lift/state"),
    "dock_sensor": (PUB, "/dock/state"),
}
CONTAINERS2: Mapping[str, Nodes] = {
    "dispatcher-1": {"fleet_pose": (SUB, "/cart/pose"), "fleet_task": (PUB, "/cart/task")},
    "elevator-bridge": {
        "lift_command": (PUB, "/lift/command"),
        "lift_monitor": (SUB, "/lift/state"),
    },
    "charger-1": {"dock_monitor": (SUB, "/dock/state")},
}
"""The nodes of ROS 2 in each container (tests/ros2/nodes)."""
ON_LAN = (ENABLE, f"rosproxy.advertise-host={HERE}")
PATIENCE_S = 180
"""Seconds until all topics flow, or until the page shows the broken link."""
BROKEN_TOPIC = "/cmd_vel"
FIREWALL = """
table ip rosproxy_picture {{
  chain arrivals {{
    type filter hook prerouting priority -300
    tcp dport {port} drop
  }}
}}
"""


@contextmanager
def fleet(folder: Path) -> Iterator[None]:
    """Run all nodes and the operator, until all topics flow. ``folder``: for the engine's log."""
    with ExitStack() as stack:
        stack.enter_context(running_engine(folder / "dockerd.log"))
        remove_leftovers()
        remove_proxies()
        ros = images.build_image(images.ROS)
        ros2 = images.build_image(images.ROS2)
        proxy = images.build_image(images.PROXY)
        operator = images.build_image(images.OPERATOR)
        robot = stack.enter_context(named_robot(ros))
        robot.start_master()
        other = stack.enter_context(laptop(ros, robot))
        cart = stack.enter_context(machine_on_lan(ros2, "cart"))
        made = stack.enter_context(inside(ros, robot.master_uri))
        stack.callback(remove_proxies)
        options = ("--proxy-image", proxy, "--ports", "48", "--grace", "3")
        names = {robot.name: robot.address}
        stack.enter_context(running_controller(operator, *options, names=names))
        for machine, nodes in ((robot, ROBOT_NODES), (other, LAPTOP_NODES)):
            machine.start(*all_of(nodes, ros1_command))
        cart.machine.start(*all_of(CART_NODES, ros2_command))
        start_containers(made, ros2)
        wait_until(lambda: not wrong_topics(), PATIENCE_S, lambda: f"{wrong_topics()} are ok")
        yield


def ros1_command(name: str, words: Words) -> tuple[str, ...]:
    """The command of a node of ROS 1."""
    role, topic, *options = words
    namespace, _, own_name = name.rpartition("/")
    names = f"__ns:={namespace}", f"__name:={own_name}"
    return node_command("roscpp", role, "--topic", topic, *options, *names)


def ros2_command(name: str, words: Words) -> tuple[str, ...]:
    """The command of a node of ROS 2."""
    kind, topic, *options = words
    return command("jazzy", kind, topic, *options, "--name", name)


def all_of(nodes: Nodes, to_command: Callable[[str, Words], Words]) -> Words:
    """A command that runs all nodes at the same time."""
    commands = (to_command(name, words) for name, words in nodes.items())
    text = " & ".join(f"{' '.join(words)} >/dev/null" for words in commands)
    return "sh", "-c", f"{text} & wait"


def start_containers(made: Inside, ros2: str) -> None:
    """Start the labelled containers, all on one network."""
    network = made.network()
    for name, nodes in CONTAINERS.items():
        made.run(network, *all_of(nodes, ros1_command), name=name)
    for name, nodes in CONTAINERS2.items():
        version = ("--env", "ROS_DISTRO=jazzy")
        words = all_of(nodes, ros2_command)
        made.run(network, *words, name=name, image=ros2, uri="", labels=ON_LAN, options=version)


def links() -> list[dict[str, Any]]:
    """The links on the operator's page; empty if the operator does not answer."""
    try:
        return list(page()["links"].values())
    except OSError:
        return []


def wrong_topics() -> set[str]:
    """The topics without a link that is ok, or with a broken link."""
    tables = (ROBOT_NODES, LAPTOP_NODES, CART_NODES, *CONTAINERS.values(), *CONTAINERS2.values())
    topics = {words[1] for nodes in tables for words in nodes.values()}
    states = [(link["name"], link.get("state")) for link in links()]
    healthy = {name for name, state in states if state == "ok"}
    broken = {name for name, state in states if state == "broken"}
    return topics - healthy | topics & broken


@contextmanager
def firewall() -> Iterator[None]:
    """Let a firewall of the host drop what outside sends to the publisher of `BROKEN_TOPIC`."""
    port = next(link["port"] for link in links() if link["name"] == BROKEN_TOPIC)
    run("nft", "-f", "-", input=FIREWALL.format(port=port))
    try:
        wait_until(lambda: wrong_topics() == {BROKEN_TOPIC}, PATIENCE_S, lambda: f"{links()}")
        yield
    finally:
        run("nft", "delete", "table", "ip", "rosproxy_picture")
