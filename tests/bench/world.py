"""Three machines in a row, each a network namespace, and the programs that run on them.

    outside (the master) -- host (the proxy, or what it is compared with) -- inside (the nodes)

The host routes, and nothing stands in the way: so the same two machines also talk directly.
"""

from __future__ import annotations

import itertools
import os
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from examples.demo.proxy_process import clean_environment
from tests.ros.processes import Process, descendants, stop_all
from tests.ros.topology import Place, run_command

OUTSIDE = "10.78.0.2"
HOST = "10.78.0.1"
"""The outside machine, and what it knows the host by."""
INSIDE = "172.31.0.2"
GATEWAY = "172.31.0.1"
"""The inside machine, and what it knows the host by."""
MASTER_PORT = 11311
MASTER = f"http://{OUTSIDE}:{MASTER_PORT}/"
PROXY = f"http://{GATEWAY}:{MASTER_PORT}/"
"""The master as the inside machine has it: the proxy."""
DESCRIPTORS = 65536
"""The limit of open files for this process and all that it starts."""
SYSTEM_PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
"""ROS's programs are the system Python's: no other Python may come first."""
PREFIX = "rosb"
"""Of the names of the namespaces; the process that has made them follows."""
_TICKS = os.sysconf("SC_CLK_TCK")
_NUMBERS = itertools.count(1)
ADDRESSES = {"outside": OUTSIDE, "host": HOST, "inside": INSIDE}
_SETTINGS = """
net.ipv4.ip_forward=1
net.ipv4.ip_local_port_range=10000 40000
net.core.somaxconn=4096
"""


class Proxy(NamedTuple):
    """A running proxy, its process id, and where inside nodes find their master."""

    process: Process
    pid: int
    master: str


class World:
    """The machines. Worlds do not see each other; they all have the same addresses.

    With ``apart``, outside and inside have processors of their own, half of them each: on the same
    one, two ends wake each other many times faster than two machines ever do, or these two at
    another moment. The host has them all.
    """

    def __init__(self, apart: bool = False) -> None:
        name = f"{PREFIX}{os.getpid()}-{next(_NUMBERS)}"
        self.places = {
            role: Place(role, f"{name}-{role}", role, [address])
            for role, address in ADDRESSES.items()
        }
        self.folder = Path(tempfile.mkdtemp(prefix="rosproxy-bench-"))
        self.processes: list[Process] = []
        self._processors = processors() if apart else {}

    def build(self) -> None:
        """Lays out namespaces, links and routes."""
        for place in self.places.values():
            run_command("ip", "netns", "add", place.namespace)
            run_command("ip", "-n", place.namespace, "link", "set", "lo", "up")
        self._link("outside", "out0", HOST)
        self._link("inside", "in0", GATEWAY)
        for role in self.places:
            self.run(role, "sysctl", "-q", "-p", "-", text=_SETTINGS)

    def _link(self, role: str, device: str, gateway: str) -> None:
        place = self.places[role].namespace
        host = self.places["host"].namespace
        peer = ("peer", "name", "eth0", "netns", place)
        run_command("ip", "-n", host, "link", "add", device, "type", "veth", *peer)
        ends = (host, device, gateway), (place, "eth0", self.places[role].address)
        for namespace, end, address in ends:
            run_command("ip", "-n", namespace, "addr", "add", f"{address}/24", "dev", end)
            run_command("ip", "-n", namespace, "link", "set", end, "up")
        run_command("ip", "-n", place, "route", "add", "default", "via", gateway)

    def remove(self) -> None:
        """Ends all programs and takes the machines away."""
        stop_all(self.processes, patience=2)
        for place in self.places.values():
            run_command("ip", "netns", "del", place.namespace)
        shutil.rmtree(self.folder, ignore_errors=True)

    def command(self, role: str, *argv: str) -> list[str]:
        """The command line that runs a program on a machine, as that same single process."""
        return self.places[role].command(self._pinned(role, argv))

    def _pinned(self, role: str, argv: tuple[str, ...]) -> tuple[str, ...]:
        if role not in self._processors:
            return argv
        return ("taskset", "--cpu-list", self._processors[role], *argv)

    def run(self, role: str, *argv: str, text: str | None = None) -> str:
        """Runs a program on a machine to its end; what it printed. RuntimeError if it fails."""
        return run_command("ip", "netns", "exec", self.places[role].namespace, *argv, text=text)

    def start(self, role: str, *argv: str, env: dict[str, str] | None = None) -> Process:
        """Starts a program on a machine; `stop`, or the end of the world, ends it."""
        title = f"{' '.join(Path(argument).name for argument in argv[:4])} ({role})"
        log = self.folder / f"{len(self.processes):04d}.log"
        env = self.environment(role) if env is None else env
        process = Process(title, self.places[role], self._pinned(role, argv), env, log)
        self.processes.append(process)
        return process

    @contextmanager
    def running(
        self, role: str, *argv: str, env: dict[str, str] | None = None
    ) -> Iterator[Process]:
        """A program on a machine, ended with its context."""
        process = self.start(role, *argv, env=env)
        try:
            yield process
        finally:
            process.stop()

    @contextmanager
    def entered(self, role: str) -> Iterator[None]:
        """Makes the sockets that this thread opens meanwhile belong to a machine."""
        with self.places[role].entered():
            yield

    def environment(self, role: str) -> dict[str, str]:
        """For Python programs of this repository, with the modules of this process."""
        paths = os.pathsep.join(path for path in sys.path if path)
        more = {"PYTHONPATH": paths, "PYTHONUNBUFFERED": "1", "HOME": str(self.folder)}
        return clean_environment(**more)

    def ros_environment(self, role: str) -> dict[str, str]:
        """For ROS's own programs, the system Python's among them."""
        uri = PROXY if role == "inside" else MASTER
        kept = {"PATH": SYSTEM_PATH, "LANG": "C.UTF-8", "PYTHONUNBUFFERED": "1"}
        home = {"HOME": str(self.folder), "ROS_LOG_DIR": str(self.folder)}
        return {**kept, **home, "ROS_MASTER_URI": uri, "ROS_IP": self.places[role].address}

    @contextmanager
    def master(self) -> Iterator[Process]:
        """ROS's own master, outside, when it answers."""
        argv = ("/usr/bin/python3", "/usr/bin/rosmaster", "--core", "-p", str(MASTER_PORT))
        with self.running("outside", *argv, env=self.ros_environment("outside")) as process:
            self.wait_listening(process, OUTSIDE, MASTER_PORT)
            yield process

    @contextmanager
    def proxy(self, data_plane: str = "auto", *options: str) -> Iterator[Proxy]:
        """A proxy of that master on the host, when it is ready, with the options of its users."""
        argv = [sys.executable, "-m", "rosproxy", "run", "--master-uri", MASTER]
        argv += ["--advertise-host", HOST, "--data-plane", data_plane, *options]
        with self.running("host", *argv) as process:
            process.wait_for("listening: ", timeout=60)
            yield Proxy(process, process.pid, PROXY)

    def wait_listening(self, process: Process, address: str, port: int) -> None:
        """Waits until outside is accepted there. RuntimeError if the process has ended."""
        deadline = time.monotonic() + 20
        with self.entered("outside"):
            while not _accepts(address, port):
                if process.returncode is not None or time.monotonic() > deadline:
                    raise RuntimeError(f"{process.title} does not listen:\n{process.output()}")
                time.sleep(0.02)


def _accepts(address: str, port: int) -> bool:
    try:
        socket.create_connection((address, port), 1).close()
    except OSError:
        return False
    return True


def processors() -> dict[str, str]:
    """Whose processors are which; of a single one, both have it."""
    cpus = sorted(os.sched_getaffinity(0))
    half = len(cpus) // 2
    parts = {"inside": cpus[:half] or cpus, "outside": cpus[half:]}
    return {role: ",".join(map(str, role_cpus)) for role, role_cpus in parts.items()}


@contextmanager
def world(apart: bool = False) -> Iterator[World]:
    """A new world, taken away with its context."""
    made = World(apart)
    try:
        made.build()
        yield made
    finally:
        made.remove()


def cpu_seconds(pid: int) -> float:
    """CPU time of a process and all below it, user's and system's, since each began."""
    return cpu_seconds_of(family(pid))


def family(pid: int) -> list[int]:
    """A process and all below it."""
    return [pid, *descendants(pid)]


def cpu_seconds_of(pids: list[int]) -> float:
    """Their CPU time; to find a thousand of them can take longer than what is measured."""
    return sum(map(_seconds, pids))


def _seconds(pid: int) -> float:
    """With that of children that it has reaped; none for one that has just ended.

    A clock tick is more than each of a thousand processes gets in a second: where a process has
    no other thread, its own nanoseconds are taken.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        nanoseconds = int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])
    except OSError:
        return 0.0
    own = sum(map(int, stat[11:13])) / _TICKS
    reaped = sum(map(int, stat[13:15])) / _TICKS
    return reaped + (nanoseconds / 1e9 if stat[17] == "1" else own)


def machine_cpu_seconds() -> float:
    """CPU time of the whole machine that was not idle: of both ends and of the kernel, too."""
    user, nice, system, _, _, hard, soft, *_ = Path("/proc/stat").read_text().split()[1:9]
    busy = (user, nice, system, hard, soft)
    return sum(map(int, busy)) / _TICKS


def resident(pid: int) -> int:
    """KiB of memory of a process and all below it, shared pages shared out among their users.

    What the kernel holds for sockets and pipes is not in it.
    """
    return sum(_rolled_up(member, "Pss:") for member in family(pid))


def anonymous(pid: int) -> int:
    """KiB of memory of a process and all below it that no file stands behind.

    Other than the share of what is shared it does not get less where others start.
    """
    return sum(_rolled_up(member, "Anonymous:") for member in family(pid))


def _rolled_up(pid: int, kind: str) -> int:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next(int(line.split()[1]) for line in lines if line.startswith(kind))
