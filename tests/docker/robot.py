"""Robots: machines outside that run a roscore."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from tests.docker.engine import wait_until
from tests.docker.machines import Machine, addresses, join, machine, reach

ADDRESSED, NAMED, LAPTOP = 77, 78, 79
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
    """A machine with a master, which ``name`` stands for in URIs."""

    name: str

    @property
    def master_uri(self) -> str:
        return f"http://{self.name}:11311"

    def start_master(self, port: int = 11311) -> None:
        self.start("sh", "-c", f"ROS_MASTER_URI=http://{self.name}:{port} exec roscore -p {port}")
        wait_until(lambda: "/rosout" in self.nodes(port), 30, "roscore is up")

    def nodes(self, port: int = 11311) -> dict[str, str]:
        """Every node that the master knows, with its URI."""
        text = self.run("python3", "-c", _NODES, f"http://{self.address}:{port}", check=False)
        found: dict[str, str] = json.loads(text) if text.startswith("{") else {}
        return found

    def uri(self, node: str, port: int = 11311) -> str:
        """The URI that the master has of a node; empty if none."""
        return self.nodes(port).get(f"/{node}", "")

    def knows_proxied(self, node: str, port: int = 11311) -> bool:
        """Whether the master knows a node by an address of this host."""
        return self.uri(node, port).startswith(f"http://{self.host_address}:")


@contextmanager
def robot_outside(image: str) -> Iterator[Robot]:
    """A robot that calls itself by its address."""
    settings = ("--env", f"ROS_MASTER_URI={MASTER_URI}", "--env", f"ROS_IP={ROBOT_ADDRESS}")
    with machine(image, "addressed", ADDRESSED, *settings) as found:
        yield _robot(found, found.address)


@contextmanager
def named_robot(
    image: str, name: str = "robot", number: int = NAMED, namespace: str = ""
) -> Iterator[Robot]:
    """A robot as most are: it calls itself by its name, in URIs too."""
    with machine(image, name, number, *_names(name, number), namespace=namespace) as found:
        yield _robot(found, name)


@contextmanager
def laptop(image: str, robot: Robot) -> Iterator[Machine]:
    """A second machine outside, beside the robot. Inside, nobody can resolve its name."""
    own = addresses(LAPTOP)[1]
    settings = ("--env", f"ROS_MASTER_URI={robot.master_uri}", "--env", f"ROS_IP={own}",
                "--add-host", f"{robot.name}:{robot.address}")  # fmt: skip
    with machine(image, "laptop", LAPTOP, *settings) as found:
        join(robot, found)
        reach(found, robot.host_address)
        yield found


def _names(name: str, number: int) -> tuple[str, ...]:
    return ("--hostname", name, "--add-host", f"{name}:{addresses(number)[1]}",
            "--env", f"ROS_MASTER_URI=http://{name}:11311")  # fmt: skip


def _robot(found: Machine, name: str) -> Robot:
    return Robot(found.container, found.address, found.host_address, found.engine, name)
