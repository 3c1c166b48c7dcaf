"""Nodes of ROS 2, in labelled containers and on a machine in a LAN with this host."""

import itertools
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from rosproxy.shared.documents.status_document import DomainStatus, parse_status
from tests.docker.controller import Proxy, proxies
from tests.docker.engine import docker, inspect, run, wait_until
from tests.docker.inside import ENABLE, Container, Inside, unique
from tests.docker.machines import Machine, addresses, machine
from tests.docker.nodes import Log

NUMBER = 91
HERE, THERE = addresses(NUMBER)
"""The addresses of this host and of the other machine on the LAN."""
OPTIONS = ("--ports", "32", "--advertise-host", HERE)
"""Options of the controller, so that the proxy finds outside on this LAN."""
_PROGRAMS = {"jazzy": "node.py", "kilted": "node.py", "cyclone": "participant.py"}
_numbers = itertools.count(1)


def command(vendor: str, kind: str, topic: str, *options: str) -> tuple[str, ...]:
    """The command of a node with an implementation of DDS."""
    program = (f"/opt/{vendor}/bin/python", f"/nodes/{_PROGRAMS[vendor]}")
    return (*program, kind, "--topic", topic, *options)


@dataclass(frozen=True)
class Outside:
    """The machine on the LAN."""

    machine: Machine

    def node(self, vendor: str, kind: str, topic: str, *options: str) -> "OutsideNode":
        """Start a node with its output in a file."""
        name = f"outside_{kind}_{next(_numbers)}"
        words = command(vendor, kind, topic, *options, "--name", name)
        file = f"/tmp/{name}.log"
        text = f"echo $$ >/tmp/{name}.pid; exec {' '.join(words)} >{file} 2>&1"
        self.machine.start("sh", "-c", text)
        path = self.machine.root / file.lstrip("/")
        return OutsideNode(name, self, Log(lambda: path.read_text() if path.exists() else ""))

    def end(self) -> None:
        """End all nodes."""
        self.machine.run("sh", "-c", "kill -KILL $(cat /tmp/*.pid); rm -f /tmp/*.pid", check=False)


@dataclass(frozen=True)
class OutsideNode:
    name: str
    outside: Outside
    log: Log


@contextmanager
def machine_on_lan(
    image: str, name: str = "lan", number: int = NUMBER, namespace: str = ""
) -> Iterator[Outside]:
    """A machine that sends multicast to the LAN."""
    with machine(image, name, number, namespace=namespace) as lan_machine:
        process = str(inspect(lan_machine.container)["State"]["Pid"])
        run("nsenter", "--target", process, "--net",
            "ip", "route", "add", "224.0.0.0/4", "dev", "eth0")  # fmt: skip
        yield Outside(lan_machine)


@dataclass(frozen=True)
class Inside2:
    """Makes networks, and containers with nodes of ROS 2."""

    made: Inside

    def node(
        self, network: str, vendor: str, kind: str, topic: str, *options: str, **more: Any
    ) -> Container:
        """Start a labelled container with the version of ROS in its environment."""
        name = unique(kind)
        env = ("--env", f"ROS_DISTRO={vendor}", *more.pop("options", ()))
        words = command(vendor, kind, topic, *options, "--name", Container(name).node)
        more.setdefault("labels", (ENABLE,))
        return self.made.run(network, *words, name=name, options=env, **more)


def domain(proxy: Proxy) -> DomainStatus:
    """The status of a proxy's domain; empty while the proxy does not answer."""
    text = docker("exec", proxy.name, "rosproxy", "status", "--json", check=False)
    try:
        (status,) = parse_status(text).domains
    except ValueError:
        return DomainStatus()
    return status


def ports(proxy: Proxy) -> dict[str, list[tuple[int, str]]]:
    """The ports of the range and the locators of each participant inside."""
    return {
        participant.guid_prefix: sorted((lease.port, lease.where) for lease in participant.leases)
        for participant in domain(proxy).inside
    }


def wait_for_line(log: Log, pattern: str, count: int = 3, seconds: float = 60) -> None:
    """Wait until ``count`` lines match."""
    wait_until(
        lambda: len(re.findall(pattern, log.read(), re.MULTILINE)) >= count, seconds,
        lambda: f"{count} of {pattern!r} in:\n{log.read()[-3000:]}",
    )  # fmt: skip


def ros2_proxies() -> list[Proxy]:
    """The proxies for ROS 2 on this engine."""
    return [proxy for proxy in proxies() if proxy.name.startswith("rosproxy-domain-")]


def ports_are_kept(proxy: Proxy) -> bool:
    """Whether both participants inside keep their ports for the next process."""
    participants = domain(proxy).inside
    return len(participants) == 2 and all(participant.kept for participant in participants)


def all_run(proxy: Proxy) -> bool:
    """Whether a proxy, its sandbox and its LAN relay run."""
    lan_relay = inspect(proxy.lan_relay, check=False)
    return proxy.running and bool(lan_relay) and bool(lan_relay["State"]["Running"])


def runs(proxy: Proxy) -> list[tuple[str, str]]:
    """The containers of a proxy with their start times."""
    inspections = (
        inspect(name, check=False) for name in (proxy.name, proxy.sandbox, proxy.lan_relay)
    )
    return [
        (inspection["Id"], inspection["State"]["StartedAt"])
        for inspection in inspections
        if inspection
    ]


class Flow:
    """A talker and a listener on each side. ``heard``: the messages of each listener."""

    def __init__(
        self,
        lan: Outside,
        inside2: Inside2,
        network: str = "",
        vendors: tuple[str, str] = ("jazzy", "kilted"),
        **more: Any,
    ) -> None:
        network = network or inside2.made.network()
        talker, listener = vendors
        self.talker = inside2.node(network, talker, "pub", "/out", "--word", "inside", **more)
        self.listener = inside2.node(network, listener, "sub", "/back", **more)
        lan.node("jazzy", "pub", "/back", "--word", "outside")
        self.outward = lan.node("jazzy", "sub", "/out").log
        self.inward = self.listener.log
        self.wait(0)

    @property
    def heard(self) -> tuple[tuple[Log, str], tuple[Log, str]]:
        return (self.outward, "inside"), (self.inward, "outside")

    def wait(self, since: float, seconds: float = 60) -> None:
        """Wait until messages flow in both directions; all parts run."""
        for log, text in self.heard:
            log.wait_for(text, count=10, since=since, seconds=seconds)

    def gaps(self, since: float) -> str:
        """The longest times without messages since ``since``, and the number of lost messages."""
        now = time.time()
        out, back = (log.longest_gap(text, since, now) for log, text in self.heard)
        lost = sum(log.lost(text, since) for log, text in self.heard)
        return (
            f"seconds without messages outward {out:.1f}, inward {back:.1f}; messages lost {lost}"
        )
