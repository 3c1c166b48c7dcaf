"""Three machines in a row, each a network namespace, and programs on these machines.

    outside (the master) -- host (the proxy, or another relay) -- inside (the nodes)

The host routes without a filter, so that the same two machines also talk directly.
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
"""The outside machine, and the host's address there."""
INSIDE = "172.31.0.2"
GATEWAY = "172.31.0.1"
"""The inside machine, and the host's address there."""
MASTER_PORT = 11311
MASTER = f"http://{OUTSIDE}:{MASTER_PORT}/"
PROXY = f"http://{GATEWAY}:{MASTER_PORT}/"
"""The master for the inside machine: the proxy."""
DESCRIPTORS = 65536
"""The limit of open files for this process and its children."""
SYSTEM_PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
"""ROS's programs are the system Python's: no other Python may come first."""
PREFIX = "rosb"
"""The prefix of the namespaces' names. The process id follows."""
_TICKS = os.sysconf("SC_CLK_TCK")
_NUMBERS = itertools.count(1)
ADDRESSES = {"outside": OUTSIDE, "host": HOST, "inside": INSIDE}
_SETTINGS = """
net.ipv4.ip_forward=1
net.ipv4.ip_local_port_range=10000 40000
net.core.somaxconn=4096
"""


class Proxy(NamedTuple):
    """A running proxy, the process id, and the master's URI for inside nodes."""

    process: Process
    pid: int
    master: str


class World:
    """The machines. Worlds are separate, with the same addresses in each.

    With ``apart``, outside and inside have half of the processors each, and the host has all. On
    the same processor, two ends wake each other many times faster than two machines, which would
    distort some measurements.
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
        """Runs a program on a machine. Returns the output. Raises RuntimeError after a failure."""
        return run_command("ip", "netns", "exec", self.places[role].namespace, *argv, text=text)

    def start(self, role: str, *argv: str, env: dict[str, str] | None = None) -> Process:
        """Starts a program on a machine, which runs until `stop` or the end of the world."""
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
        """A program on a machine, ended with the context."""
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
        """The environment of ROS's own programs, also with the system's Python."""
        uri = PROXY if role == "inside" else MASTER
        kept = {"PATH": SYSTEM_PATH, "LANG": "C.UTF-8", "PYTHONUNBUFFERED": "1"}
        home = {"HOME": str(self.folder), "ROS_LOG_DIR": str(self.folder)}
        return {**kept, **home, "ROS_MASTER_URI": uri, "ROS_IP": self.places[role].address}

    @contextmanager
    def master(self) -> Iterator[Process]:
        """ROS's own master, outside, once it answers."""
        argv = ("/usr/bin/python3", "/usr/bin/rosmaster", "--core", "-p", str(MASTER_PORT))
        with self.running("outside", *argv, env=self.ros_environment("outside")) as process:
            self.wait_listening(process, OUTSIDE, MASTER_PORT)
            yield process

    @contextmanager
    def proxy(self, data_plane: str = "auto", *options: str) -> Iterator[Proxy]:
        """A proxy of that master on the host, once ready, with a user's options."""
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
    """The processors of each machine. A single processor is shared."""
    cpus = sorted(os.sched_getaffinity(0))
    half = len(cpus) // 2
    parts = {"inside": cpus[:half] or cpus, "outside": cpus[half:]}
    return {role: ",".join(map(str, role_cpus)) for role, role_cpus in parts.items()}


@contextmanager
def world(apart: bool = False) -> Iterator[World]:
    """A new world, removed with the context."""
    made = World(apart)
    try:
        made.build()
        yield made
    finally:
        made.remove()


def cpu_seconds(pid: int) -> float:
    """The CPU time of a process and all descendants, user and system, since their starts."""
    return cpu_seconds_of(family(pid))


def family(pid: int) -> list[int]:
    """A process and all descendants."""
    return [pid, *descendants(pid)]


def cpu_seconds_of(pids: list[int]) -> float:
    """The CPU time of processes. Finding a thousand processes may take longer than the
    measurement.
    """
    return sum(map(_seconds, pids))


def _seconds(pid: int) -> float:
    """The CPU time of a process and its reaped children; 0 after its end.

    A clock tick is more than each of a thousand processes gets in a second. So a process with a
    single thread is measured in nanoseconds.
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
    """The memory of a process and all descendants in KiB, with a share of each shared page.

    Without the kernel's memory for sockets and pipes.
    """
    return sum(_rolled_up(member, "Pss:") for member in family(pid))


def anonymous(pid: int) -> int:
    """The anonymous memory of a process and all descendants in KiB.

    Unlike shares of shared pages, this does not shrink when other processes start.
    """
    return sum(_rolled_up(member, "Anonymous:") for member in family(pid))


def _rolled_up(pid: int, kind: str) -> int:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next(int(line.split()[1]) for line in lines if line.startswith(kind))
