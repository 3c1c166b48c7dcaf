"""A test's lab: machines, a roscore, a proxy, nodes and tools."""

from __future__ import annotations

import itertools
import json
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

from tests.ros import wire
from tests.ros.cpp import compiled_node
from tests.ros.forks import PROGRAMS, Forks
from tests.ros.processes import Process, stop_all, wait_until
from tests.ros.topology import (
    ADVERTISED_NAME,
    MASTER_PORT,
    OUT_HOST,
    OUT_NODE,
    PUBLISHED_MASTER_PORT,
    Place,
    Topology,
)

SYSTEM_PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
"""ROS's programs are the system Python's: no other Python may come first."""
MASTER_URI = f"http://robot:{MASTER_PORT}"
ROSCORE = f"exec roscore -p {MASTER_PORT}"
CORE = f"/usr/lib/rosout/rosout & exec rosmaster --core -p {MASTER_PORT}"
"""The programs of roscore without roslaunch, at a fifth of the cost."""
ADMIN_PORT = 11312
CALLER = "/rosproxy_tests"


@dataclass(frozen=True)
class Result:
    """The exit code and the output of a tool."""

    returncode: int
    output: str


class Lab:
    """A topology with a real master outside and a proxy at the boundary."""

    def __init__(self, topology: Topology, folder: Path, forks: Forks) -> None:
        self.topology = topology
        self.folder = folder
        self._forks = forks
        self.flat = topology.plan.flat
        self.advertise_host = OUT_HOST
        self.master_role = "out"
        self.roscore = CORE
        self.proxy_options: tuple[str, ...] = ()
        self.proxy_prefix: tuple[str, ...] = ()
        self.proxy_path = SYSTEM_PATH
        self.programs = {"rospy": ("node.py",), "roscpp": (str(compiled_node()),)}
        self.master: Process | None = None
        self.proxy: Process | None = None
        self.nodes: list[Process] = []
        self.master_answered = 0.0
        self._proxy_mark = 0
        self._numbers = itertools.count(1)

    def place(self, role: str) -> Place:
        return self.topology.places[role]

    def unique(self, prefix: str) -> str:
        """A name that no other test uses."""
        return f"{prefix}_{next(self._numbers)}"

    # roscore and proxy

    def start_master(self) -> None:
        """Starts a real master and rosout, and waits until both serve."""
        place = self.place(self.master_role)
        uri = f"http://{place.hostname}:{MASTER_PORT}"
        env = self.environment(place.role) | {"ROS_MASTER_URI": uri}
        self.master = self._spawn("roscore", place, ["sh", "-c", self.roscore], env)
        wait_until("the master answers", lambda: self._master_answers("getPid"))
        self.master_answered = time.time()
        wait_until("rosout is there", lambda: self._master_answers("lookupNode", "/rosout"))

    def _master_answers(self, method: str, *arguments: str) -> bool:
        master = self.place(self.master_role).address
        try:
            return bool(
                wire.call(self.place("px"), master, MASTER_PORT, method, CALLER, *arguments)
            )
        except (OSError, LookupError):
            return False

    def start_proxy(self) -> None:
        """Starts the proxy with this lab's settings, and waits until ready."""
        if self.flat:
            return
        ports = self.topology.plan.ports
        argv = [sys.executable, "-m", "rosproxy", "run", "--master-uri", self._upstream()]
        argv += ["--advertise-host", self.advertise_host, "--port-range", ports.bound]
        if ports.published != ports.bound:
            argv += ["--advertise-port-range", ports.published]
        plan = self.topology.plan
        usual = "both" if plan.isolated else "out"
        argv += ["--direction", os.environ.get("ROS_TESTS_DIRECTION", usual)]
        if plan.isolated and plan.second is None:
            # By default the first network, which here is the proxy's way out, is not inside.
            for number in range(1, len(plan.networks) + 1):
                argv += ["--inside-network", f"172.30.{number}.0/24"]
        self.proxy = self.spawn_proxy("px", [*argv, *self.proxy_options])
        self.proxy.wait_for(r"listening: ")

    def _upstream(self) -> str:
        """The URI of the real master for the proxy."""
        if self.master_role == "out":
            return MASTER_URI
        return f"http://{self.place(self.master_role).address}:{MASTER_PORT}"

    def spawn_proxy(self, role: str, argv: list[str]) -> Process:
        """Starts a proxy on a machine, as the image would."""
        env = {"PATH": self.proxy_path, "PYTHONUNBUFFERED": "1", "HOME": str(self.folder)}
        env["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
        env["SSL_CERT_FILE"] = "/dev/null"  # as in the image
        return self._spawn("rosproxy", self.place(role), [*self.proxy_prefix, *argv], env)

    def ensure_running(self) -> None:
        """Starts roscore and proxy if a former test has left them dead."""
        if self.master is None or self.master.returncode is not None:
            self.start_master()
        if self.proxy is None or self.proxy.returncode is not None:
            self.start_proxy()
        self._proxy_mark = self.proxy.mark() if self.proxy else 0

    def check_proxy(self) -> None:
        """Raises AssertionError if the proxy has died or printed a traceback in this test."""
        if self.proxy:
            log = self.proxy.output(self._proxy_mark)
            assert self.proxy.returncode is None, f"the proxy has ended:\n{log[-3000:]}"
            assert "Traceback" not in log, log[-6000:]

    def transcripts(self) -> list[tuple[str, str]]:
        """(title, output) of the proxy and of each node since the test began."""
        parts = [(node.title, node.output()[-2000:]) for node in self.nodes]
        if self.proxy:
            parts.append(("rosproxy", self.proxy.output(self._proxy_mark)[-6000:]))
        return parts

    def stop(self) -> None:
        """Ends everything that was started here."""
        self.stop_nodes(patience=1)
        stop_all([process for process in (self.proxy, self.master) if process])

    # nodes and tools

    def node(
        self, library: str, role: str, kind: str, name: str = "", env: Any = None, **options: Any
    ) -> Process:
        """Starts a test node of a library in `programs`, in the role `kind`.

        The option `remap` is a list of remappings.
        """
        words = [*options.pop("remap", []), f"__name:={name or self.unique(kind)}"]
        for option, value in options.items():
            words += [f"--{option.replace('_', '-')}", str(value)]
        return self.start(role, *self.programs[library], kind, *words, env=env)

    def start(self, role: str, *argv: str, env: Mapping[str, str] | None = None) -> Process:
        """Starts any program on a machine. The program ends with the test."""
        title = " ".join([Path(argv[0]).name, *argv[1:]])
        forks = self._forks if argv[0] in PROGRAMS else None
        if forks:
            argv = (PROGRAMS[argv[0]], *argv[1:])
        process = self._spawn(
            f"{title} ({role})",
            self.place(role),
            argv,
            self.environment(role) | dict(env or {}),
            forks,
        )
        self.nodes.append(process)
        return process

    def run(self, role: str, *argv: str, timeout: float = 30, check: bool = True) -> Result:
        """Runs a program on a machine until the end. Raises AssertionError after a failure."""
        process = self.start(role, *argv)
        code = process.wait(timeout)
        if check and code != 0:
            raise AssertionError(f"{process.title} ended {code}:\n{process.output()}")
        return Result(code, process.output())

    def rosproxy(self, *argv: str, check: bool = True) -> Result:
        """Runs a subcommand of rosproxy where the proxy is."""
        return self.run("px", sys.executable, "-m", "rosproxy", *argv, check=check)

    def tell(self, path: str, **body: Any) -> dict[str, Any]:
        """POSTs to the proxy's admin endpoint from where the proxy is; the answer."""
        with self.place("px").entered():
            connection = HTTPConnection("127.0.0.1", ADMIN_PORT, timeout=20)
            try:
                connection.request("POST", path, json.dumps(body))
                reply = connection.getresponse()
                text = reply.read().decode()
            finally:
                connection.close()
        assert reply.status == 200, text
        answer: dict[str, Any] = json.loads(text)
        return answer

    def read(self, path: str) -> str:
        """A document of the proxy's admin endpoint, from the proxy's machine."""
        with self.place("px").entered():
            connection = HTTPConnection("127.0.0.1", ADMIN_PORT, timeout=20)
            try:
                connection.request("GET", path)
                return connection.getresponse().read().decode()
            finally:
                connection.close()

    def links(self, topic: str) -> list[dict[str, Any]]:
        """The links of a topic on the live page."""
        links = json.loads(self.read("/graph"))["links"].values()
        return [link for link in links if link["name"] == topic]

    def wait_shown(self, topic: str, **wanted: Any) -> dict[str, Any]:
        """Waits for a link of a topic on the live page with these values and counted messages."""
        shown: list[dict[str, Any]] = []

        def is_so() -> bool:
            shown[:] = self.links(topic)
            return any(wanted.items() <= link.items() and link.get("hz") for link in shown)

        wait_until(f"the page shows {topic}: {wanted}", is_so)
        return next(link for link in shown if link.get("hz"))

    def environment(self, role: str) -> dict[str, str]:
        """All that a ROS program on this machine gets: no ROS_IP, no ROS_HOSTNAME."""
        home = self.folder / role
        home.mkdir(exist_ok=True)
        return {
            "PATH": SYSTEM_PATH,
            "LANG": "C.UTF-8",
            "HOME": str(home),
            "ROS_HOME": str(home),
            "ROS_LOG_DIR": str(home / "log"),
            "ROS_MASTER_URI": self.master_uri(role),
            "PYTHONUNBUFFERED": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
        }

    def stop_nodes(self, patience: float = 4) -> None:
        """Ends what `node` and `start` have started."""
        stop_all(self.nodes, patience)
        self.nodes.clear()

    def _spawn(
        self, title: str, place: Place, argv: Any, env: Mapping[str, str],
        forks: Forks | None = None,
    ) -> Process:  # fmt: skip
        log = self.folder / f"{next(self._numbers):04d}.log"
        return Process(title, place, argv, env, log, forks)

    # what the real master knows

    def ask_master(self, method: str, *arguments: Any, role: str = "out") -> Any:
        """Calls the master as a program on that machine does: inside, through the proxy."""
        address, port = self.master_address(role)
        return wire.call(self.place(role), address, port, method, CALLER, *arguments)

    def master_uri(self, role: str) -> str:
        """ROS_MASTER_URI on a machine; inside with a name of the proxy, perhaps an alias."""
        if self._is_inside(role) and not self.topology.plan.alias:
            return f"http://rosproxy:{MASTER_PORT}"
        if self.master_role == "out":
            return MASTER_URI
        return f"http://{ADVERTISED_NAME}:{PUBLISHED_MASTER_PORT}"

    def master_address(self, role: str) -> tuple[str, int]:
        """The same as an address and a port."""
        if self._is_inside(role):
            return self.place("px").address, MASTER_PORT
        if self.master_role == "out":
            return OUT_NODE, MASTER_PORT
        return OUT_HOST, PUBLISHED_MASTER_PORT

    def _is_inside(self, role: str) -> bool:
        return role.startswith("c") and not self.flat

    def node_uri(self, name: str) -> str | None:
        """The slave URI that outside sees for a node, or nothing."""
        try:
            return str(self.ask_master("lookupNode", _absolute(name)))
        except LookupError:
            return None

    def registered(self, name: str) -> bool:
        """Whether any publication, subscription or service of this node is registered."""
        state = self.ask_master("getSystemState")
        return any(_absolute(name) in names for table in state for _, names in table)

    def users(self, topic: str) -> tuple[list[str], list[str]]:
        """The names of the publishers and of the subscribers of a topic."""
        publishers, subscribers, _ = self.ask_master("getSystemState")
        return dict(publishers).get(topic, []), dict(subscribers).get(topic, [])

    def wait_registered(self, name: str, timeout: float = 60) -> None:
        """Wait until a node is up.

        The services of the logger are the last registrations of every node. Before, a node asks the
        master for parameters, and rospy gives up for good after a failed call.
        """
        level = f"{_absolute(name)}/set_logger_level"

        def is_up() -> bool:
            services = dict(self.ask_master("getSystemState")[2])
            return _absolute(name) in services.get(level, [])

        wait_until(f"{name} is registered", is_up, timeout)

    def wait_unregistered(self, name: str, timeout: float = 60) -> None:
        wait_until(f"{name} is unregistered", lambda: not self.registered(name), timeout)


def _absolute(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"
