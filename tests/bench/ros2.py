"""ROS 2: rclpy nodes with a direct path, the kernel plane and a relay; many participants.

Data from outside to inside passes the proxy or the kernel plane. Data from inside to outside passes
neither, so a ping passes in one direction only.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from rosproxy.ros2.ports.locator_ports import EVIDENCE_PERIOD_S
from tests.bench.book import DIRECT, Book
from tests.bench.nodes import busy
from tests.bench.ros import RosNode, running_node
from tests.bench.talks import Site, measure
from tests.bench.ways import COPY, KERNEL, PLANES
from tests.bench.world import (
    ADDRESSES,
    HOST,
    INSIDE,
    OUTSIDE,
    SYSTEM_PATH,
    World,
    anonymous,
    world,
)
from tests.ros.processes import Process
from tests.ros2.lab import ENVIRONMENTS
from tests.ros2.machines import wait_for_links

FIRST_PORT = 41000
NETWORK = "172.31.0.0/24"
SECOND = "172.31.0.3"
"""Another address of the inside machine: the proxy serves at most 64 participants at an address."""
SIZES = (1, 10, 100)
QUICK_SIZES = (1, 10)
IDLE_SECONDS = 10.0
QUICK_IDLE_SECONDS = 5.0
MOST_ROUNDS = 3
"""Rounds of the crowds, each of which waits until the proxy has been up for a while."""
PATIENCE = 120.0
PATH = "rosproxy"


def run(book: Book, rounds: int, quick: bool) -> None:
    with ExitStack() as stack:
        sites = [stack.enter_context(site(name)) for name in (DIRECT, KERNEL, COPY)]
        measure(book, sites, rounds, quick)
    for _ in range(min(rounds, MOST_ROUNDS)):
        for size in QUICK_SIZES if quick else SIZES:
            book.add("discovery, s", DIRECT, discovered(size), size)
            measure_crowd(book, size, QUICK_IDLE_SECONDS if quick else IDLE_SECONDS)
    book.note(
        "Discovery is the time from the start of the first participant until an outside reader has "
        "found a writer of each participant. The proxy has run for half a minute before. "
        "Participants are of Cyclone DDS, up to fifty in one process"
    )


@contextmanager
def site(name: str) -> Iterator[Site]:
    """A world with perhaps a proxy, and two nodes that have discovered each other."""
    with world(apart=True) as place, ExitStack() as stack:
        wait_for_links(place)
        pid = None if name == DIRECT else stack.enter_context(proxy(place, PLANES[name]))
        nodes = {
            role: stack.enter_context(talker(place, role, peer, name == DIRECT))
            for role, peer in (("inside", "outside"), ("outside", "inside"))
        }
        for node in nodes.values():
            node.ask("met")
        if name == KERNEL:
            wait_forwarded(place)
        yield Site(name, nodes, pid)


@contextmanager
def proxy(place: World, plane: str) -> Iterator[int]:
    """Run the proxy on the host. Yields the process id, once ready."""
    argv = [sys.executable, "-m", "rosproxy", "run", "--ros", "2", "--data-plane", plane]
    argv += ["--advertise-host", HOST, "--port-range", f"{FIRST_PORT}-{FIRST_PORT + 999}"]
    argv += ["--inside-network", NETWORK, "--ros2-peer", OUTSIDE]
    with place.running("host", *argv) as process:
        process.wait_for("listening: ", timeout=60)
        yield process.pid


def wait_forwarded(place: World) -> None:
    """Wait until the kernel forwards both ports of a participant's user data."""
    words = "nft", "-j", "list", "map", "inet", f"rosproxy-udp-{FIRST_PORT}", "ports"
    end = time.monotonic() + PATIENCE
    while True:
        listed = json.loads(place.run("host", *words))["nftables"]
        if any(len(record["map"].get("elem", [])) == 2 for record in listed if "map" in record):
            return
        if time.monotonic() > end:
            raise RuntimeError("the kernel does not forward: see `rosproxy status` for the reason")
        time.sleep(0.1)


@contextmanager
def talker(place: World, role: str, peer: str, direct: bool) -> Iterator[RosNode]:
    """An rclpy node on a machine, once ready. A direct node knows the other's address."""
    program = str(Path(__file__).with_name("ros2_node.py"))
    command = place.command(role, python("jazzy"), program, role, peer)
    # The machines share memory, which must not carry data here.
    env = environment(place) | {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    if direct:
        env["ROS_STATIC_PEERS"] = ADDRESSES[peer]
    with running_node(command, env, place.folder / f"talker-{role}.log") as node:
        yield node


def environment(place: World) -> dict[str, str]:
    return {"PATH": SYSTEM_PATH, "HOME": str(place.folder), "PYTHONUNBUFFERED": "1"}


def python(name: str) -> str:
    """The Python of an environment of the ROS 2 layer."""
    return str(ENVIRONMENTS / name / "bin/python")


def discovered(size: int) -> float:
    """The seconds for discovering ``size`` participants directly."""
    with world() as place:
        return crowded(place, size, OUTSIDE)


def measure_crowd(book: Book, size: int, idle: float) -> None:
    """Measure the same through the proxy, with the proxy's costs."""
    with world() as place, proxy(place, "auto") as pid:
        time.sleep(EVIDENCE_PERIOD_S)  # now the proxy no longer waits for former participants
        before = anonymous(pid)
        book.add("discovery, s", PATH, crowded(place, size), size)
        book.add("CPU when idle, ms/s", PATH, busy(pid, idle) * 1000, size)
        if size == max(SIZES):
            book.add("memory per participant, KiB", PATH, (anonymous(pid) - before) / size, size)


def crowded(place: World, size: int, peer: str = "") -> float:
    """Seconds from the first participant's making until outside has found a writer of each."""
    wait_for_links(place)
    place.run("inside", "ip", "addr", "add", f"{SECOND}/24", "dev", "eth0")
    index = "<ParticipantIndex>0</ParticipantIndex>"
    watch = cyclone(place, "outside", OUTSIDE, index, "watch")
    watch.wait_for("^ready", timeout=PATIENCE)
    peers = f'<Peers><Peer address="{peer}"/></Peers>' if peer else ""
    parts = {INSIDE: size - size // 2, SECOND: size // 2}
    crowds = [
        cyclone(place, "inside", address, peers, "crowd", str(count))
        for address, count in parts.items()
        if count
    ]
    matched_at = float(watch.wait_for(rf"^found {size} (\S+)", timeout=PATIENCE)[1])
    return matched_at - min(float(crowd.wait_for(r"^began (\S+)")[1]) for crowd in crowds)


def cyclone(place: World, role: str, address: str, discovery: str, *words: str) -> Process:
    """A program with participants of Cyclone DDS at an address of a machine."""
    interface = f'<Interfaces><NetworkInterface address="{address}"/></Interfaces>'
    config = f"<General>{interface}</General><Discovery>{discovery}</Discovery>"
    uri = f"<CycloneDDS><Domain>{config}</Domain></CycloneDDS>"
    program = str(Path(__file__).with_name("ros2_crowd.py"))
    env = environment(place) | {"CYCLONEDDS_URI": uri}
    return place.start(role, python("cyclone"), program, *words, env=env)
