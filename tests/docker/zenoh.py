"""Nodes of rmw_zenoh: the programs of tests/zenoh/nodes in containers and on machines."""

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.docker.engine import wait_until
from tests.docker.inside import Container
from tests.docker.machines import Machine
from tests.docker.nodes import Log

NODE = ("python", "/nodes/node.py")
PERIOD_S = 0.1
"""Seconds between two messages of a publisher (tests/zenoh/nodes/node.py)."""


@dataclass(frozen=True)
class Node:
    """A session with the defaults of rmw_zenoh. ``container``: None for a node elsewhere."""

    name: str
    log: Log
    container: Container | None = None

    def wait_for(self, text: str, count: int = 5, seconds: float = 60) -> None:
        """Wait until the node has printed ``count`` more lines that begin with ``text``."""
        before = self.count(text)
        wait_until(lambda: self.count(text) >= before + count, seconds, self.log.read)

    def count(self, text: str) -> int:
        return len(re.findall(f"^{re.escape(text)}", self.log.read(), re.MULTILINE))

    def has(self, text: str) -> bool:
        """Whether the node has printed a line that begins with ``text``."""
        return self.count(text) > 0

    def outage(self, since: int = 0) -> float:
        """The longest time without messages of the only publisher, in seconds.

        ``since``: the number of the first message that counts.
        """
        found = re.findall(r"^got hello (\d+)$", self.log.read(), re.MULTILINE)
        numbers = [number for number in map(int, found) if number >= since]
        gaps = (later - earlier for earlier, later in itertools.pairwise(numbers))
        return max(gaps, default=0) * PERIOD_S

    def latest(self) -> int:
        """The number of the latest message of the only publisher; -1 if none has come."""
        return max(
            map(int, re.findall(r"^got hello (\d+)$", self.log.read(), re.MULTILINE)), default=-1
        )


def node_on(machine: Machine, name: str, kind: str, topic: str) -> Node:
    """Start a node on a machine."""
    words = " ".join((*NODE, kind, name, topic))
    file = f"/tmp/{name}.log"
    machine.start("sh", "-c", f"echo $$ >/tmp/{name}.pid; exec {words} >{file} 2>&1")
    path = machine.root / file.lstrip("/")
    return Node(name, Log(lambda: path.read_text() if path.exists() else ""))


@dataclass(frozen=True)
class Cloud:
    """Another site: a machine with a proxy that listens for links, and nodes beside the proxy.

    ``start`` starts a program in the machine's container, ``root`` is the machine's file system.
    """

    start: Callable[..., object]
    root: Path

    @staticmethod
    def options(files: Path) -> tuple[str, ...]:
        """Options of ``docker run`` for the proxy's image. ``files``: certificate, key and CA."""
        nodes = Path(__file__).parents[1] / "zenoh/nodes"
        volumes = ("--volume", f"{files}:/link:ro", "--volume", f"{nodes}:/nodes:ro")
        return ("--user", "0", "--entrypoint", "", *volumes)

    def start_proxy(self) -> None:
        """Start the proxy, and wait until it listens."""
        files = (
            "--zenoh-certificate /link/tls.crt --zenoh-key /link/tls.key --zenoh-ca /link/ca.crt"
        )
        listen = "--zenoh-ports 7448-7448 --zenoh-link-listen tls/7447"
        log = self._run("proxy", f"rosproxy run --ros zenoh {listen} {files}")
        wait_until(lambda: "listening: " in log.read(), 30, log.read)

    def node(self, name: str, kind: str, topic: str) -> Node:
        """Start a node."""
        override = 'connect/endpoints=["tcp/127.0.0.1:7448"]'
        words = f"env ZENOH_CONFIG_OVERRIDE='{override}' {' '.join(NODE)} {kind} {name} {topic}"
        return Node(name, self._run(name, words))

    def _run(self, name: str, words: str) -> Log:
        path = self.root / f"tmp/{name}.log"
        self.start("sh", "-c", f"PYTHONUNBUFFERED=1 exec {words} >/tmp/{name}.log 2>&1")
        return Log(lambda: path.read_text() if path.exists() else "")
