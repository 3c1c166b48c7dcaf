"""The robot outside the cluster: roscore and nodes."""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.docker.engine import docker, inspect, wait_until
from tests.docker.nodes import Log, node_command
from tests.docker.robot import nodes_at, publishers_at
from tests.kubernetes.cluster.layout import NODES, ROBOT, ROBOT_ADDRESS, node_named

_ports = itertools.count(11311)


@dataclass(frozen=True)
class Robot:
    """The robot for a module of tests, with a separate master at ``port``."""

    port: int
    root: Path

    @property
    def master_uri(self) -> str:
        return f"http://{ROBOT_ADDRESS}:{self.port}"

    def run(self, *command: str, check: bool = True, seconds: float = 30) -> str:
        """Run a program. A hanging program is stopped and fails the test."""
        words = (ROBOT, "timeout", str(seconds), *command)
        variable = ("--env", f"ROS_MASTER_URI={self.master_uri}")
        return docker("exec", *variable, *words, check=check, seconds=seconds + 10)

    def start_master(self) -> None:
        """Start what roscore starts, without roslaunch: at a fifth of the cost."""
        core = f"/usr/lib/rosout/rosout & exec rosmaster --core -p {self.port}"
        self._start("roscore", f"sh -c '{core}'", self.master_uri)
        wait_until(lambda: "/rosout" in self.nodes(), 40, lambda: self._output("roscore"))

    def node(self, name: str, library: str, role: str, *options: str, master_uri: str = "") -> Log:
        """Start a test node with its output in a file."""
        words = " ".join(node_command(library, role, *options, f"__name:={name}"))
        self._start(name, words, master_uri or self.master_uri)
        return Log(lambda: self._output(name))

    def end(self, name: str, signal: str = "KILL") -> None:
        """End the program of that name."""
        file = f"/tmp/{self.port}/{name}.pid"
        docker("exec", ROBOT, "sh", "-c", f"kill -{signal} $(cat {file})", check=False)

    def end_all(self) -> None:
        """Kill all nodes with their children."""
        script = f"cat /tmp/{self.port}/*.pid | sed s/^/-/ | xargs kill -KILL --"
        docker("exec", ROBOT, "sh", "-c", script, check=False)

    def nodes(self) -> dict[str, str]:
        """The URI of each node at the master; empty if the master does not answer."""
        return nodes_at(self.master_uri)

    def uri(self, node: str) -> str:
        """The URI that the master has of a node; empty if none."""
        return self.nodes().get(f"/{node}", "")

    def publishers(self, topic: str) -> set[str]:
        """The nodes that the master knows to publish a topic."""
        return publishers_at(self.master_uri, topic)

    def knows_proxied(self, node: str, on: str = "") -> bool:
        """Whether the master knows a node by an address of a node of the cluster."""
        hosts = [node_named(on)] if on else list(NODES)
        return self.uri(node).startswith(tuple(f"http://{host.address}:" for host in hosts))

    def _start(self, name: str, words: str, master_uri: str) -> None:
        base = f"/tmp/{self.port}/{name}"
        script = (
            f"mkdir -p /tmp/{self.port}; echo $$ >{base}.pid; "
            f"ROS_MASTER_URI={master_uri} exec {words} >{base}.log 2>&1"
        )
        docker("exec", "--detach", ROBOT, "setsid", "sh", "-c", script)

    def _output(self, name: str) -> str:
        """Read from the disk: a `docker exec` for each look would keep this machine busy."""
        try:
            return (self.root / f"tmp/{self.port}/{name}.log").read_text(errors="replace")
        except OSError:
            return ""


@contextmanager
def robot_with_master() -> Iterator[Robot]:
    """The robot with a roscore at a port that no other test uses."""
    pid = inspect(ROBOT)["State"]["Pid"]
    robot = Robot(next(_ports), Path(f"/proc/{pid}/root"))
    try:
        robot.start_master()
        yield robot
    finally:
        robot.end_all()
