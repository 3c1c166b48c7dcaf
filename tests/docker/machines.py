"""Machines outside: each in a separate network namespace, with a cable to this host.

Each machine is a container without a network, which then gets an end of a veth pair. The cable is
the only route: the machine reaches this host's published ports, but no container networks.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.docker.engine import docker, engine_url, inspect, run
from tests.docker.nodes import Log, node_command


@dataclass(frozen=True)
class Machine:
    """A machine at ``address``.

    ``host_address`` is this host at the other end of the cable. ``engine`` runs the machine, and
    may differ from the engine of the nodes inside. ``root`` is the path to the machine's files from
    here.
    """

    container: str
    address: str
    host_address: str
    engine: str
    root: Path

    def run(self, *command: str, seconds: float = 30, check: bool = True) -> str:
        """Run a program. A hanging program is stopped and fails the test."""
        return docker(
            "exec", self.container, "timeout", str(seconds), *command,
            check=check, seconds=seconds + 10, engine=self.engine,
        )  # fmt: skip

    def start(self, *command: str) -> None:
        docker("exec", "--detach", self.container, *command, engine=self.engine)

    def node(self, name: str, library: str, role: str, *options: str) -> Log:
        """Start a test node with its output in a file."""
        file = f"/tmp/{name}.log"
        # Remove the output of a node with this name in another test.
        (self.root / file.lstrip("/")).unlink(missing_ok=True)
        command = node_command(library, role, *options, f"__name:={name}")
        self.start("sh", "-c", f"echo $$ >/tmp/{name}.pid; exec {' '.join(command)} >{file} 2>&1")
        return Log(lambda: self._read(file))

    def _read(self, file: str) -> str:
        """Read from the disk: a `docker exec` for each look would keep this machine busy."""
        try:
            return (self.root / file.lstrip("/")).read_text(errors="replace")
        except FileNotFoundError:
            return ""

    def end(self, name: str, signal: str = "INT") -> None:
        """End the test node of that name."""
        self.run("sh", "-c", f"kill -{signal} $(cat /tmp/{name}.pid)", check=False)


@contextmanager
def machine(
    image: str, name: str, number: int, *options: str, namespace: str = ""
) -> Iterator[Machine]:
    """A machine with addresses from a number, beside this host or a network namespace."""
    container = f"rosproxy-test-{name}-{os.getpid()}"
    host_address, address = addresses(number)
    engine = engine_url()
    docker("run", "--detach", "--init", "--network", "none", "--name", container, *options,
           image, "sleep", "infinity")  # fmt: skip
    try:
        plug(container, number, namespace)
        root = Path(f"/proc/{inspect(container)['State']['Pid']}/root")
        yield Machine(container, address, host_address, engine, root)
    finally:
        docker("rm", "--force", container, check=False, engine=engine)
        # The engine keeps the namespace of a container for up to a minute.
        run("ip", "link", "delete", cable(number), check=False)


def cable(number: int) -> str:
    """The name of this host's end of a machine's cable."""
    return f"rpx{number}h{os.getpid()}"[:15]


def addresses(number: int) -> tuple[str, str]:
    """This host's address on a machine's cable, and the machine's."""
    return f"198.18.{number}.1", f"198.18.{number}.2"


def plug(container: str, number: int, namespace: str = "") -> None:
    """Lay a cable between a container and this host, or another network namespace."""
    interface = "eth0"
    here = cable(number)
    process = str(inspect(container)["State"]["Pid"])
    host_address, address = addresses(number)
    near = ("nsenter", f"--net={namespace}") if namespace else ()
    far = ("nsenter", "--target", process, "--net")
    run("ip", "link", "add", here, "type", "veth", "peer", "name", interface, "netns", process)
    if namespace:
        run("ip", "link", "set", here, "netns", namespace)
    run(*near, "ip", "address", "add", f"{host_address}/30", "dev", here)
    run(*near, "ip", "link", "set", here, "up")
    run(*far, "ip", "address", "add", f"{address}/30", "dev", interface)
    run(*far, "ip", "link", "set", interface, "up")


def join(first: Machine, second: Machine) -> None:
    """Lay a cable between two machines, so that each reaches the other's address."""
    pids = [str(inspect(machine.container)["State"]["Pid"]) for machine in (first, second)]
    ends = [("nsenter", "--target", pid, "--net") for pid in pids]
    run(*ends[0], "ip", "link", "add", "eth1", "type", "veth", "peer", "name", "eth1",
        "netns", pids[1])  # fmt: skip
    for end, peer in ((ends[0], second), (ends[1], first)):
        run(*end, "ip", "link", "set", "eth1", "up")
        run(*end, "ip", "route", "add", peer.address, "dev", "eth1")


def reach(source: Machine, address: str) -> None:
    """Add a route from a machine to another address of this host, over the cable."""
    pid = str(inspect(source.container)["State"]["Pid"])
    run("nsenter", "--target", pid, "--net", "ip", "route", "add", address, "via",
        source.host_address)  # fmt: skip
