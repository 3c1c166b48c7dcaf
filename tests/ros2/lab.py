"""A test's lab: machines, a proxy, a LAN relay, and participants."""

from __future__ import annotations

import itertools
import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import DomainStatus, ProxyStatus, parse_status
from tests.ros.processes import Process, stop_all, wait_until
from tests.ros.topology import Place, Topology, run_command
from tests.ros2.machines import PORTS

ENVIRONMENTS = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rosproxy" / "ros2"
)
NODES = Path(__file__).parent / "nodes"
PROGRAMS = {"jazzy": "node.py", "kilted": "node.py", "cyclone": "participant.py"}
"""The program of a node for each implementation of DDS."""
LAN_RELAY_PORT = 47090
LAN_RELAY_SECRET = "0123456789abcdef"
ADMIN_PORT = 11312


def numbers(reader: Process) -> list[int]:
    """The numbers of a subscriber's messages, in order of arrival."""
    return [int(line.split()[2]) for line in reader.output().splitlines() if "got " in line]


def is_whole(reader: Process) -> bool:
    """Whether a subscriber has got each message once and in order, from the first on."""
    got = numbers(reader)
    return got == list(range(got[0], got[0] + len(got)))


class Lab:
    """A robot outside, containers inside, and the proxy at the boundary."""

    def __init__(self, topology: Topology, folder: Path) -> None:
        self.topology = topology
        self.folder = folder
        self.proxy_prefix: tuple[str, ...] = ()
        self.proxy_role = "px"
        self.port_range = PORTS.bound
        self.host = topology.plan.host
        self.gateway = "172.30.1.1"
        self.options: tuple[str, ...] = ("--ros2-peer", topology.plan.robot)
        self.proxy: Process | None = None
        self.lan_relay: Process | None = None
        self.nodes: list[Process] = []
        self._numbers = itertools.count(1)

    def place(self, role: str) -> Place:
        return self.topology.places[role]

    def unique(self, stem: str) -> str:
        """A unique name."""
        return f"{stem}_{next(self._numbers)}"

    def start_proxy(self) -> None:
        """Start the proxy and wait until ready."""
        argv = [*self.proxy_prefix, sys.executable, "-m", "rosproxy", "run", "--ros", "2"]
        argv += ["--advertise-host", self.host, "--port-range", self.port_range, *self.options]
        self.proxy = self._spawn("rosproxy", self.proxy_role, argv, self._own_environment())
        self.proxy.wait_for("listening: ")

    def start_lan_relay(self) -> None:
        """Start the LAN relay on the host."""
        argv = [sys.executable, "-m", "rosproxy", "lan-relay", "--lan", self.place("host").address]
        argv += ["--bind", str(HostPort(self.gateway, LAN_RELAY_PORT))]
        argv += ["--proxy", str(HostPort(self.place("px").address, PORTS.first))]
        self.lan_relay = self._spawn("lan-relay", "host", argv, self._own_environment())
        self.lan_relay.wait_for("ready: ")

    def restart_proxy(self) -> None:
        """Kill and restart the proxy."""
        assert self.proxy is not None
        self.proxy.kill()
        self.start_proxy()

    def node(
        self,
        vendor: str,
        role: str,
        kind: str,
        name: str = "",
        env: Mapping[str, str] | None = None,
        **options: object,
    ) -> Process:
        """Start a node on a machine, with options of its program."""
        name = name or self.unique(kind.replace(",", "_"))
        argv = [str(ENVIRONMENTS / vendor / "bin/python"), str(NODES / PROGRAMS[vendor]), kind]
        argv += ["--name", name]
        for option, value in options.items():
            argv.append(f"--{option.replace('_', '-')}")
            argv += [] if value is True else [str(value)]
        usual = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": str(self.folder)}
        node = self._spawn(f"{vendor} {kind} {name} ({role})", role, argv, {**usual, **(env or {})})
        self.nodes.append(node)
        return node

    def status(self) -> ProxyStatus:
        """The status of the proxy."""
        return parse_status(self._get("/status"))

    def page(self) -> dict[str, Any]:
        """The document of the live page."""
        document: dict[str, Any] = json.loads(self._get("/graph"))
        return document

    def told(self) -> set[str]:
        """The texts of the proxy's problems, and of findings and broken links on the page."""
        page = self.page()
        findings = [finding["text"] for finding in page.get("findings", ())]
        broken = [link["text"] for link in page["links"].values() if link["state"] == "broken"]
        problems = [f"{problem.subject}: {problem.text}" for problem in self.status().problems]
        return {*problems, *findings, *broken}

    def _get(self, path: str) -> bytes:
        with self.place(self.proxy_role).entered():
            asking = HTTPConnection("127.0.0.1", ADMIN_PORT, timeout=20)
            with closing(asking):
                asking.request("GET", path)
                return asking.getresponse().read()

    def tell(self, path: str, **body: object) -> dict[str, int]:
        """The proxy's answer to an operator's call."""
        with self.place(self.proxy_role).entered():
            asking = HTTPConnection("127.0.0.1", ADMIN_PORT, timeout=20)
            with closing(asking):
                asking.request("POST", path, json.dumps(body))
                answer: dict[str, int] = json.loads(asking.getresponse().read())
        return answer

    def tool(self, command: str, *names: str, fails: bool = False) -> str:
        """The output of a command that asks the proxy, on the proxy's machine."""
        argv = [sys.executable, "-m", "rosproxy", command, *names]
        process = self._spawn(command, "px", argv, self._own_environment())
        assert process.wait() == int(fails), process.output()
        return process.output()

    def domain(self) -> DomainStatus:
        """The status of the proxy's only domain."""
        (domain,) = self.status().domains
        return domain

    def in_proxy(self, *argv: str) -> str:
        """The output of a program on the proxy's machine."""
        return run_command("ip", "netns", "exec", self.place("px").namespace, *argv)

    def unproven(self) -> dict[str, int]:
        """The number of unproven participants on each side."""
        lines = self._get("/metrics").decode().splitlines()
        told = (line for line in lines if line.startswith("rosproxy_ros2_unproven_participants{"))
        return {
            line.split('side="')[1].split('"')[0]: int(float(line.split()[-1])) for line in told
        }

    def ports(self) -> dict[str, list[tuple[int, str]]]:
        """The ports of the range and the locators of each participant inside."""
        return {
            participant.guid_prefix: sorted(
                (lease.port, lease.where) for lease in participant.leases
            )
            for participant in self.domain().inside
        }

    def wait_for_participants(self, inside: int, outside: int, timeout: float = 60.0) -> None:
        """Wait until the proxy knows so many on each side."""

        def counts_match() -> bool:
            domain = self.domain()
            return (len(domain.inside), len(domain.outside)) == (inside, outside)

        wait_until(f"{inside} participants inside and {outside} outside", counts_match, timeout)

    def stop_nodes(self) -> None:
        """End all nodes."""
        stop_all(self.nodes)
        self.nodes.clear()

    def stop(self) -> None:
        """End everything."""
        stop_all([process for process in (self.proxy, self.lan_relay) if process])

    @contextmanager
    def used(self) -> Iterator[None]:
        """Check and end all programs after use."""
        try:
            yield
            self.check()
        finally:
            self.stop_nodes()
            self.stop()

    def check(self) -> None:
        """Raises AssertionError if the proxy or the LAN relay has ended, or has failed inside."""
        for process in (self.proxy, self.lan_relay):
            if process is not None:
                assert process.returncode is None, process.output()
                assert "Traceback" not in process.output(), process.output()

    def transcripts(self) -> list[tuple[str, str]]:
        """The output of all programs."""
        processes = [*self.nodes, *(process for process in (self.proxy, self.lan_relay) if process)]
        return [(process.title, process.output()[-3000:]) for process in processes]

    def _own_environment(self) -> dict[str, str]:
        env = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "PYTHONUNBUFFERED": "1"}
        env |= {
            "ROSPROXY_ROS2_LAN_RELAY_SECRET": LAN_RELAY_SECRET,
            "ROSPROXY_LAN_RELAY_SECRET": LAN_RELAY_SECRET,
        }
        return env | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}

    def _spawn(self, title: str, role: str, argv: list[str], env: Mapping[str, str]) -> Process:
        log = self.folder / f"{next(self._numbers):04d}.log"
        return Process(title, self.place(role), argv, env, log)
