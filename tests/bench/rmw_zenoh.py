"""rmw_zenoh: sessions with its defaults, direct, with a single router, and through rosproxy."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tests.bench.book import DIRECT, Book
from tests.bench.nodes import busy
from tests.bench.ros import RosNode, running_node
from tests.bench.talks import Site, measure
from tests.bench.world import GATEWAY, HOST, OUTSIDE, SYSTEM_PATH, World, resident, world
from tests.ros.processes import Process
from tests.zenoh.lab import ENVIRONMENTS, NODES, OWN_VERSION, ROUTER_PORT

PORT = 7448
"""The first port of the proxy for containers."""
NODE_PORT = 7500
"""The port of the node outside for a direct connection."""
BY_HAND = "one router"
TO_ROBOT = "rosproxy to a robot's router"
CONTAINERS = "rosproxy between containers"
TWO_HOSTS = "rosproxy on two hosts"
PATH = "rosproxy"
PYTHON = str(ENVIRONMENTS / OWN_VERSION / "bin/python")
PROGRAM = str(Path(__file__).with_name("zenoh_node.py"))
SIZES = (2, 20, 100)
QUICK_SIZES = (2, 20)
IDLE_SECONDS = 10.0
QUICK_IDLE_SECONDS = 5.0
PATIENCE = 60.0


def run(book: Book, rounds: int, quick: bool) -> None:
    with ExitStack() as stack:
        ways = (direct, one_router, to_robot, between_containers, two_hosts)
        sites = [stack.enter_context(way()) for way in ways]
        measure(book, sites, rounds, quick)
    for size in QUICK_SIZES if quick else SIZES:
        measure_crowd(book, size, QUICK_IDLE_SECONDS if quick else IDLE_SECONDS)
    book.note(
        "Nodes are sessions of the zenoh library with the defaults of rmw_zenoh, as clients of "
        "the routers. The CPU is that of all routers of the proxy on the host"
    )


@contextmanager
def direct() -> Iterator[Site]:
    """The node inside connects to the node outside."""
    with world(apart=True) as place:
        listen = f'connect/endpoints=[];listen/endpoints=["tcp/{OUTSIDE}:{NODE_PORT}"]'
        to_node = f'connect/endpoints=["tcp/{OUTSIDE}:{NODE_PORT}"]'
        with talkers(place, listen, to_node) as nodes:
            yield Site(DIRECT, nodes, None)


@contextmanager
def one_router() -> Iterator[Site]:
    """Both nodes are clients of a router on the host, as people do by hand."""
    overrides = client(HOST, ROUTER_PORT), client(GATEWAY, ROUTER_PORT)
    with (
        world(apart=True) as place,
        router(place, "host"),
        talkers(place, *overrides) as nodes,
    ):
        yield Site(BY_HAND, nodes, None)


@contextmanager
def to_robot() -> Iterator[Site]:
    """The node outside uses the router of the robot, and the proxy links to this router."""
    overrides = client("127.0.0.1", ROUTER_PORT), client(GATEWAY, PORT)
    with (
        world(apart=True) as place,
        router(place, "outside"),
        proxy(place, "host", "--zenoh-peer", OUTSIDE) as process,
        talkers(place, *overrides) as nodes,
    ):
        yield Site(TO_ROBOT, nodes, process.pid)


@contextmanager
def between_containers() -> Iterator[Site]:
    """The machine outside stands for another container on the host, with a port of its own."""
    overrides = client(HOST, PORT + 1), client(GATEWAY, PORT)
    with (
        world(apart=True) as place,
        proxy(place, "host") as process,
        talkers(place, *overrides) as nodes,
    ):
        yield Site(CONTAINERS, nodes, process.pid)


@contextmanager
def two_hosts() -> Iterator[Site]:
    """The machine outside is another host, whose proxy links to the proxy of the host."""
    overrides = client("127.0.0.1", PORT), client(GATEWAY, PORT)
    with (
        world(apart=True) as place,
        proxy(place, "host", "--zenoh-listen", str(ROUTER_PORT)) as process,
        proxy(place, "outside", "--zenoh-hub", HOST),
        talkers(place, *overrides) as nodes,
    ):
        yield Site(TWO_HOSTS, nodes, process.pid)


def client(host: str, port: int) -> str:
    """The value of ZENOH_CONFIG_OVERRIDE that makes a node a client of a router."""
    return f'mode="client";connect/endpoints=["tcp/{host}:{port}"]'


@contextmanager
def talkers(place: World, outside: str, inside: str) -> Iterator[dict[str, RosNode]]:
    """Two nodes that have discovered each other, with these values of ZENOH_CONFIG_OVERRIDE."""
    overrides = {"outside": (outside, "inside"), "inside": (inside, "outside")}
    with ExitStack() as stack:
        nodes = {
            role: stack.enter_context(talker(place, role, peer, override))
            for role, (override, peer) in overrides.items()
        }
        for node in nodes.values():
            node.ask("met")
        yield nodes


@contextmanager
def talker(place: World, role: str, peer: str, override: str) -> Iterator[RosNode]:
    """A node on a machine, once ready."""
    command = place.command(role, PYTHON, PROGRAM, "talk", role, peer)
    env = environment(place) | {"ZENOH_CONFIG_OVERRIDE": override}
    with running_node(command, env, place.folder / f"talker-{role}.log") as node:
        yield node


@contextmanager
def router(place: World, role: str) -> Iterator[None]:
    """A router with the defaults of rmw_zenohd on a machine, once ready."""
    argv = (PYTHON, str(NODES / "router.py"))
    with place.running(role, *argv, env=environment(place)) as process:
        process.wait_for("router runs", timeout=PATIENCE)
        yield


@contextmanager
def proxy(place: World, role: str, *options: str, ports: int = 2) -> Iterator[Process]:
    """A proxy with these ports for containers, once ready."""
    argv = [sys.executable, "-m", "rosproxy", "run", "--ros", "zenoh"]
    argv += ["--zenoh-ports", f"{PORT}-{PORT + ports - 1}", *options]
    (packages,) = (ENVIRONMENTS / OWN_VERSION).glob("lib/python3*/site-packages")
    env = place.environment(role)
    env["PYTHONPATH"] = os.pathsep.join((env["PYTHONPATH"], str(packages)))
    with place.running(role, *argv, env=env) as process:
        process.wait_for("listening: ", timeout=PATIENCE)
        yield process


def measure_crowd(book: Book, size: int, idle: float) -> None:
    """Measure the costs of a proxy with a node in each of so many containers."""
    with world() as place, proxy(place, "host", ports=size) as process:
        words = ("crowd", str(size), GATEWAY, str(PORT))
        crowd = place.start("inside", PYTHON, PROGRAM, *words, env=environment(place))
        crowd.wait_for("^ready", timeout=PATIENCE)
        book.add("CPU when idle, ms/s", PATH, busy(process.pid, idle) * 1000, size)
        book.add("memory, MiB", PATH, resident(process.pid) / 1024, size)


def environment(place: World) -> dict[str, str]:
    paths = {"PATH": SYSTEM_PATH, "HOME": str(place.folder), "PYTHONPATH": str(NODES)}
    return paths | {"PYTHONUNBUFFERED": "1"}
