"""Nodes of rmw_zenoh: the programs of tests/zenoh/nodes in containers and on machines."""

import itertools
import re
from dataclasses import dataclass

from tests.docker.engine import wait_until
from tests.docker.inside import Container
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
