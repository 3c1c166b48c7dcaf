"""A machine outside: ROS in a network namespace of its own, one cable away from this host.

It is a container without any network, which then gets one end of a veth pair. Its only
route is the cable: this host's published ports are in reach, container networks are not.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from tests.docker.engine import docker, inspect, run, wait_until

HOST_ADDRESS = "198.18.77.1"
ROBOT_ADDRESS = "198.18.77.2"
MASTER_URI = f"http://{ROBOT_ADDRESS}:11311"


@dataclass(frozen=True)
class Robot:
    container: str

    def run(self, *command: str, seconds: float = 30, check: bool = True) -> str:
        """Run a ROS program on the robot; one that hangs is stopped and fails the test."""
        return docker(
            "exec", self.container, "timeout", str(seconds), *command,
            check=check, seconds=seconds + 10,
        )  # fmt: skip

    def start(self, *command: str) -> None:
        docker("exec", "--detach", self.container, *command)

    def start_master(self) -> None:
        self.start("roscore")
        wait_until(
            lambda: "/rosout" in self.run("rosnode", "list", check=False), 30, "roscore is up"
        )


@contextmanager
def robot_outside(image: str) -> Iterator[Robot]:
    name = f"rosproxy-test-robot-{os.getpid()}"
    settings = ("--env", f"ROS_MASTER_URI={MASTER_URI}", "--env", f"ROS_IP={ROBOT_ADDRESS}")
    docker("run", "--detach", "--init", "--network", "none", "--name", name, *settings,
           image, "sleep", "infinity")  # fmt: skip
    try:
        connect(str(inspect(name)["State"]["Pid"]))
        yield Robot(name)
    finally:
        docker("rm", "--force", name, check=False)


def connect(process: str) -> None:
    """Lay the cable between this host and the network namespace of a process."""
    here, there = f"rpxh{os.getpid()}"[:15], "eth0"
    inside = ("nsenter", "--target", process, "--net")
    run("ip", "link", "add", here, "type", "veth", "peer", "name", there, "netns", process)
    run("ip", "address", "add", f"{HOST_ADDRESS}/30", "dev", here)
    run("ip", "link", "set", here, "up")
    run(*inside, "ip", "address", "add", f"{ROBOT_ADDRESS}/30", "dev", there)
    run(*inside, "ip", "link", "set", there, "up")
