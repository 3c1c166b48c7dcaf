"""A test's lab: the robot's router, the proxy, and nodes with the sessions of rmw_zenoh."""

from __future__ import annotations

import itertools
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from pathlib import Path

from rosproxy.shared.documents.status_document import ProxyStatus, ZenohStatus, parse_status
from tests.ros.processes import Process, stop_all, wait_until
from tests.ros.topology import Plan, PortMap, Topology, run_command

ENVIRONMENTS = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rosproxy" / "zenoh"
)
VERSIONS = ("1.6.2", "1.7.2", "1.10.2")
"""The library of the nodes and of the robot's router."""
OWN_VERSION = "1.7.2"
"""The library of the proxy, which the extra `zenoh` pins."""
SDK = "zenoh-ros2-sdk"
"""The environment of `nodes/sdk_node.py`."""
NODES = Path(__file__).parent / "nodes"
ROUTER_PORT = 7447
PLAN = Plan("z", (("c1", "c2"),), PortMap(ROUTER_PORT, ROUTER_PORT, ROUTER_PORT))
PORTS = {"c1": 7448, "c2": 7449}
"""The port of the proxy for each container."""
ADMIN_PORT = 11312
_REDIRECT = """
table ip zenoh_redirect {{
  chain out {{ type nat hook output priority -100;
    ip daddr 127.0.0.1 tcp dport {router} dnat to {proxy}:{port}; }}
  chain leave {{ type nat hook postrouting priority 100;
    ip saddr 127.0.0.0/8 oifname "eth0" masquerade; }}
}}
"""


class Lab:
    """A robot with a router, two containers, and the proxy beside the containers."""

    def __init__(self, topology: Topology, folder: Path) -> None:
        self.topology = topology
        self.folder = folder
        self.proxy: Process | None = None
        self.processes: list[Process] = []
        self._numbers = itertools.count(1)

    def unique(self, stem: str) -> str:
        """A name that no other node has."""
        return f"{stem}_{next(self._numbers)}"

    def start_proxy(self, *options: str, with_robot: bool = True, files: int | None = None) -> None:
        """Start the proxy and wait until ready. ``files``: the limit of open files."""
        robot = ["--zenoh-peer", self.topology.plan.robot] if with_robot else []
        self.proxy = self.start_proxy_on("px", *robot, *options, files=files)

    def start_proxy_on(self, role: str, *options: str, files: int | None = None) -> Process:
        """Start a proxy on a machine, and wait until ready."""
        argv = ["prlimit", f"--nofile={files}"] if files else []
        argv += [sys.executable, "-m", "rosproxy", "run", "--ros", "zenoh"]
        argv += ["--zenoh-ports", f"{min(PORTS.values())}-{max(PORTS.values())}"]
        argv += options
        (packages,) = (ENVIRONMENTS / OWN_VERSION).glob("lib/python3*/site-packages")
        paths = [*(path for path in sys.path if path), str(packages)]
        proxy = self.start(role, argv, {"PYTHONPATH": os.pathsep.join(paths)})
        proxy.wait_for("listening: ")
        return proxy

    def restart_proxy(self, *options: str) -> None:
        """Kill the process of the proxy, and start another."""
        assert self.proxy is not None
        os.kill(self.proxy.pid, 9)
        self.proxy.wait()
        self.start_proxy(*options)

    def start_router(self, version: str) -> Process:
        """Start the router of the robot."""
        router = self._program(version, "out", "router.py")
        router.wait_for("router runs")
        return router

    def start_cutter(self, port: int) -> None:
        """Start a port before the router of the robot, which ends sessions at once."""
        cutter = self._program(OWN_VERSION, "out", "cutter.py", str(port), str(ROUTER_PORT))
        cutter.wait_for("cuts sessions")

    def node(
        self, version: str, role: str, kind: str, topic: str = "chatter", **environment: str
    ) -> Process:
        """Start a node with its name as the title. In a container without a redirect, the node is a
        client.
        """
        return self._node(version, role, "node.py", kind, self.unique(kind), topic, **environment)

    def sdk_node(self, role: str, owners: Iterable[str]) -> Process:
        """Start a node of the other library, which uses what ``owners`` offer."""
        return self._node(SDK, role, "sdk_node.py", self.unique("sdk"), ",".join(owners))

    def _node(self, version: str, role: str, *words: str, **environment: str) -> Process:
        """Start a program, of which the argument before the last is the name of the node."""
        if not environment and role != "out" and not self.is_redirected(role):
            environment = self.as_client()
        node = self._program(version, role, *words, **environment)
        node.title = words[-2]
        return node

    def as_client(self, port: int = min(PORTS.values())) -> dict[str, str]:
        """The variable that makes nodes clients of a port of the proxy."""
        proxy = self.topology.places["px"].address
        override = f'mode="client";connect/endpoints=["tcp/{proxy}:{port}"]'
        return {"ZENOH_CONFIG_OVERRIDE": override}

    def as_laptop(self) -> dict[str, str]:
        """The variable that makes nodes clients of the published port for outside."""
        override = (
            f'mode="client";connect/endpoints=["tcp/{self.topology.plan.host}:{ROUTER_PORT}"]'
        )
        return {"ZENOH_CONFIG_OVERRIDE": override}

    def redirect(self, role: str) -> None:
        """Lead localhost:7447 in a container to the port of the container at the proxy."""
        place = self.topology.places[role]
        enter = ("ip", "netns", "exec", place.namespace)
        run_command(*enter, "sysctl", "-qw", "net.ipv4.conf.all.route_localnet=1")
        proxy = self.topology.places["px"].address
        rules = _REDIRECT.format(router=ROUTER_PORT, proxy=proxy, port=PORTS[role])
        run_command(*enter, "nft", "-f", "-", text=rules)

    def is_redirected(self, role: str) -> bool:
        """Whether `redirect` is in force."""
        enter = ("ip", "netns", "exec", self.topology.places[role].namespace)
        return "table ip zenoh_redirect" in run_command(*enter, "nft", "list", "tables")

    def end_redirects(self) -> None:
        """Take all redirects away."""
        for role in filter(self.is_redirected, PORTS):
            enter = ("ip", "netns", "exec", self.topology.places[role].namespace)
            run_command(*enter, "nft", "delete", "table", "ip", "zenoh_redirect")

    def status(self, role: str = "px") -> ProxyStatus:
        """The status of the proxy on a machine."""
        with self.topology.places[role].entered():
            asking = HTTPConnection("127.0.0.1", ADMIN_PORT, timeout=20)
            with closing(asking):
                asking.request("GET", "/status")
                return parse_status(asking.getresponse().read())

    def problems(self) -> dict[str, str]:
        """The texts of the proxy's problems, by subject."""
        return {problem.subject: problem.text for problem in self.status().problems}

    def post_policy(self, *layers: Mapping[str, object]) -> None:
        """Give the proxy layers of rules, as an operator does."""
        body = json.dumps({"layers": layers})
        with self.topology.places["px"].entered():
            asking = HTTPConnection("127.0.0.1", ADMIN_PORT, timeout=20)
            with closing(asking):
                asking.request("POST", "/policy", body, {"Content-Type": "application/json"})
                answer = asking.getresponse()
                told = answer.read()
                assert answer.status == 200, told

    def zenoh(self, role: str = "px") -> ZenohStatus:
        """The status of the routers of the proxy on a machine."""
        zenoh = self.status(role).zenoh
        assert zenoh is not None
        return zenoh

    def wait_for_link(self) -> None:
        """Wait until the hub is linked with the router of the robot."""
        wait_until("the link is up", lambda: self.zenoh().links[0].up, 30)

    def router_process(self, proxy: Process | None = None) -> int:
        """The process of the routers, of the proxy on px or of another."""
        proxy = proxy or self.proxy
        assert proxy is not None
        (child,) = Path(f"/proc/{proxy.pid}/task/{proxy.pid}/children").read_text().split()
        return int(child)

    def peak_memory(self) -> int:
        """The most memory in bytes that the process of the routers has used."""
        status = Path(f"/proc/{self.router_process()}/status").read_text()
        (kibibytes,) = re.findall(r"^VmHWM:\s+(\d+) kB$", status, re.MULTILINE)
        return int(kibibytes) * 1024

    def start(self, role: str, argv: list[str], environment: Mapping[str, str]) -> Process:
        """Start a program on a machine."""
        usual = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "PYTHONUNBUFFERED": "1"}
        log = self.folder / f"{next(self._numbers):04d}.log"
        place = self.topology.places[role]
        process = Process(" ".join(argv[-3:]), place, argv, {**usual, **environment}, log)
        self.processes.append(process)
        return process

    def _program(self, version: str, role: str, *words: str, **environment: str) -> Process:
        python = str(ENVIRONMENTS / version / "bin/python")
        program, *arguments = words
        return self.start(role, [python, str(NODES / program), *arguments], environment)

    @contextmanager
    def used(self) -> Iterator[None]:
        """End what was started, and check the proxy, when the lab is not used any more."""
        try:
            yield
            if self.proxy is not None:
                assert self.proxy.returncode is None, self.proxy.output()
                assert "Traceback" not in self.proxy.output(), self.proxy.output()
        finally:
            stop_all(self.processes, patience=2.0)
            self.end_redirects()

    def transcripts(self) -> list[tuple[str, str]]:
        """The output of all programs."""
        return [(process.title, process.output()[-3000:]) for process in self.processes]
