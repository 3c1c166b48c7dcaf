"""Real nodes: images at full rate and small messages at 1 kHz, of rospy and roscpp, both ways."""

from __future__ import annotations

import itertools
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tests.bench.book import DIRECT, Book, in_turn, loss, percentile
from tests.bench.compiled import compiled
from tests.bench.ways import KERNEL, PLANES, SPLICE, tcpros_address
from tests.bench.world import INSIDE, MASTER, PROXY, World, world

LIBRARIES = ("rospy", "roscpp")
IMAGE = 6_000_000
SMALL = 1024
WINDOW = 4
"""Most images on the way: enough to keep both ends busy, few enough to avoid drops."""
SECONDS = 0.8
QUICK_SECONDS = 0.5
PATIENCE = 1.0
"""Seconds without a message after which missing messages count as lost."""
_NUMBERS = itertools.count(1)
# As in a container's network.
_MASQUERADE = f"""
table ip nat {{
  chain leaving {{
    type nat hook postrouting priority srcnat
    ip saddr {INSIDE} oifname "out0" masquerade
  }}
}}
"""


class Kind(NamedTuple):
    """Messages of a size, at a rate; 0 is as fast as the subscriber receives."""

    title: str
    size: int
    rate: float


KINDS = (Kind("6 MB at full rate", IMAGE, 0), Kind("1 KiB at 1 kHz", SMALL, 1000))


class Pair(NamedTuple):
    """A publisher and a subscriber."""

    publisher: str
    subscriber: str
    role: str

    @property
    def title(self) -> str:
        ends = ("inside", "outside") if self.role == "inside" else ("outside", "inside")
        return f"{self.publisher} {ends[0]} → {self.subscriber} {ends[1]}"


PAIRS = [Pair(*words) for words in itertools.product(LIBRARIES, LIBRARIES, ("inside", "outside"))]


class Site(NamedTuple):
    """A way with a node of each library at either end."""

    name: str
    world: World
    nodes: dict[tuple[str, str], RosNode]


def run(book: Book, rounds: int, quick: bool) -> None:
    with ExitStack() as stack:
        sites = [stack.enter_context(site(name)) for name in (DIRECT, KERNEL, SPLICE)]
        for number in range(rounds):
            for kind, pair in itertools.product(KINDS, PAIRS):
                for current_site in in_turn(sites, number):
                    measure(book, current_site, kind, pair, QUICK_SECONDS if quick else SECONDS)


@contextmanager
def site(name: str) -> Iterator[Site]:
    """A world with a master, perhaps a proxy, and four nodes that wait for commands."""
    with world(apart=True) as place, place.master(), ExitStack() as stack:
        if name != DIRECT:
            place.run("host", "nft", "-f", "-", text=_MASQUERADE)
            stack.enter_context(place.proxy(PLANES[name]))
        uris = {"outside": MASTER, "inside": MASTER if name == DIRECT else PROXY}
        keys = itertools.product(LIBRARIES, uris)
        nodes = {key: stack.enter_context(ros_node(place, *key, uris[key[1]])) for key in keys}
        yield Site(name, place, nodes)


def measure(book: Book, site: Site, kind: Kind, pair: Pair, seconds: float) -> None:
    """Measure a new topic each time, so that no earlier message counts."""
    other = "outside" if pair.role == "inside" else "inside"
    publisher = site.nodes[pair.publisher, pair.role]
    subscriber = site.nodes[pair.subscriber, other]
    number = next(_NUMBERS)
    topic = f"/images_{number}"
    path = site.world.folder / f"{number}.socket"
    try:
        subscriber.ask("on", topic, path)
        sent = publisher.ask("go", topic, kind.size, kind.rate, seconds, WINDOW, path)
        wait_for_rest(subscriber, int(sent[1]))
        count, took, *times = map(float, subscriber.ask("off")[1:])
        if pair.role == "inside" and site.name == KERNEL:
            tcpros_address(site.world, f"/{pair.publisher}_inside", topic, must_be_fast=True)
        enter(book, site.name, f"{pair.title}, {kind.title}", float(sent[1]), count, took, times)
    except RuntimeError as error:
        book.note(f"{site.name}, {pair.title}, {kind.title}: {error}")


def wait_for_rest(subscriber: RosNode, sent: int) -> None:
    """Until all have arrived, or no more come."""
    count = 0
    since = time.monotonic()
    while count < sent and time.monotonic() < since + PATIENCE:
        time.sleep(0.02)
        if (now := int(subscriber.ask("count")[1])) > count:
            count = now
            since = time.monotonic()


def enter(
    book: Book, path: str, title: str, sent: float, count: float, took: float, times: list[float]
) -> None:
    if count < 2:
        raise RuntimeError(f"{count:.0f} of {sent:.0f} messages arrived")
    book.add(f"{title}: rate, 1/s", path, (count - 1) / took)
    book.add(f"{title}: latency p50, ms", path, percentile(times, 50) / 1000)
    book.add(f"{title}: latency p99, ms", path, percentile(times, 99) / 1000)
    book.add(f"{title}: loss, %", path, 100 * loss(sent, count))


class RosNode:
    """A running node that executes commands, one a line."""

    def __init__(self, process: subprocess.Popen[str], log: Path) -> None:
        self._process = process
        self._log = log

    def ask(self, *words: object) -> list[str]:
        """The words of the answer. Raises RuntimeError if the node failed or ended."""
        pipe: Any = self._process.stdin
        pipe.write(" ".join(map(str, words)) + "\n")
        pipe.flush()
        return self.answer()

    def answer(self) -> list[str]:
        lines: Any = self._process.stdout
        reply = next((line for line in lines if line.startswith("= ")), "= failed: ended")
        words: list[str] = reply.split()[1:]
        if words[0] == "failed:":
            raise RuntimeError(" ".join(words[1:]) + self._log.read_text()[-500:])
        return words


@contextmanager
def ros_node(place: World, library: str, role: str, master: str) -> Iterator[RosNode]:
    """A node of a library on a machine, once ready."""
    programs = {
        "rospy": ["/usr/bin/python3", str(Path(__file__).with_name("images.py"))],
        "roscpp": [str(compiled("images", "roscpp", "sensor_msgs"))],
    }
    command = place.command(role, *programs[library], f"__name:={library}_{role}")
    env = place.ros_environment(role) | {"ROS_MASTER_URI": master}
    with running_node(command, env, place.folder / f"{library}-{role}.log") as node:
        yield node


@contextmanager
def running_node(command: Sequence[str], env: Mapping[str, str], log: Path) -> Iterator[RosNode]:
    """A program with commands on standard input, once ready, killed at the end."""
    pipe = subprocess.PIPE
    with (
        log.open("w") as errors,
        subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=errors, text=True, env=env
        ) as process,
    ):
        node = RosNode(process, log)
        try:
            node.answer()
            yield node
        finally:
            process.kill()
