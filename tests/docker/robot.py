"""Robots: machines outside that run a roscore."""

import json
import xmlrpc.client
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection
from typing import Any

from tests.docker.engine import wait_until
from tests.docker.machines import Machine, addresses, join, machine, reach

ADDRESSED = 77
NAMED = 78
LAPTOP = 79
HOST_ADDRESS, ROBOT_ADDRESS = addresses(ADDRESSED)
MASTER_URI = f"http://{ROBOT_ADDRESS}:11311"

_NODES = """
import json, sys, xmlrpc.client
master = xmlrpc.client.ServerProxy(sys.argv[1])
state = master.getSystemState("/test")[2]
names = {name for kind in state for _, nodes in kind for name in nodes}
print(json.dumps({name: master.lookupNode("/test", name)[2] for name in names}))
"""


@dataclass(frozen=True)
class Robot(Machine):
    """A machine with a master.

    ``name`` is the host in URIs. A ``hidden`` robot is beside another network namespace, and this
    host does not reach the robot.
    """

    name: str
    hidden: bool = False

    @property
    def master_uri(self) -> str:
        return f"http://{self.name}:11311"

    def start_master(self, port: int = 11311) -> None:
        self.start("sh", "-c", f"ROS_MASTER_URI=http://{self.name}:{port} exec roscore -p {port}")
        wait_until(lambda: "/rosout" in self.nodes(port), 60, "roscore is up")

    def nodes(self, port: int = 11311) -> dict[str, str]:
        """The URI of each node at the master."""
        if not self.hidden:
            return nodes_at(f"http://{self.address}:{port}")
        text = self.run("python3", "-c", _NODES, f"http://{self.address}:{port}", check=False)
        uris: dict[str, str] = json.loads(text) if text.startswith("{") else {}
        return uris

    def uri(self, node: str, port: int = 11311) -> str:
        """The URI that the master has of a node; empty if none."""
        return self.nodes(port).get(f"/{node}", "")

    def knows_proxied(self, node: str, port: int = 11311) -> bool:
        """Whether the master knows a node by an address of this host."""
        return self.uri(node, port).startswith(f"http://{self.host_address}:")

    def publishers(self, topic: str) -> set[str]:
        """The nodes that the master knows to publish a topic."""
        return publishers_at(f"http://{self.address}:11311", topic)


def nodes_at(master_uri: str) -> dict[str, str]:
    """The URI of each node at a master; empty if the master does not answer."""
    master: Any = xmlrpc.client.ServerProxy(master_uri, _Transport())
    try:
        with master:
            state = master.getSystemState("/test")[2]
            names = {name for kind in state for _, nodes in kind for name in nodes}
            return {name: master.lookupNode("/test", name)[2] for name in names}
    except (OSError, xmlrpc.client.Error):
        return {}


def publishers_at(master_uri: str, topic: str) -> set[str]:
    """The nodes that a master knows to publish a topic."""
    with xmlrpc.client.ServerProxy(master_uri, _Transport()) as master:
        answer: Any = master.getSystemState("/test")
        return {node for name, nodes in answer[2][0] for node in nodes if name == topic}


class _Transport(xmlrpc.client.Transport):
    """A transport that waits for at most five seconds."""

    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = 5
        return connection


@contextmanager
def robot_outside(image: str) -> Iterator[Robot]:
    """A robot. The nodes of the robot announce the address."""
    settings = ("--env", f"ROS_MASTER_URI={MASTER_URI}", "--env", f"ROS_IP={ROBOT_ADDRESS}")
    with machine(image, "addressed", ADDRESSED, *settings) as own_machine:
        yield _robot(own_machine, own_machine.address)


@contextmanager
def named_robot(
    image: str, name: str = "robot", number: int = NAMED, namespace: str = ""
) -> Iterator[Robot]:
    """A usual robot. The nodes of the robot announce the host name."""
    with machine(image, name, number, *_names(name, number), namespace=namespace) as own_machine:
        yield _robot(own_machine, name, hidden=bool(namespace))


@contextmanager
def laptop(image: str, robot: Robot) -> Iterator[Machine]:
    """A second machine outside, beside the robot. Inside, the name does not resolve."""
    own = addresses(LAPTOP)[1]
    settings = ("--env", f"ROS_MASTER_URI={robot.master_uri}", "--env", f"ROS_IP={own}",
                "--add-host", f"{robot.name}:{robot.address}")  # fmt: skip
    with machine(image, "laptop", LAPTOP, *settings) as second_machine:
        join(robot, second_machine)
        reach(second_machine, robot.host_address)
        yield second_machine


def _names(name: str, number: int) -> tuple[str, ...]:
    return ("--hostname", name, "--add-host", f"{name}:{addresses(number)[1]}",
            "--env", f"ROS_MASTER_URI=http://{name}:11311")  # fmt: skip


def _robot(own_machine: Machine, name: str, hidden: bool = False) -> Robot:
    return Robot(**vars(own_machine), name=name, hidden=hidden)
