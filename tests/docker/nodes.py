"""The test nodes of tests/ros and tests/ros2, in containers and on machines, and their output."""

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass

from tests.docker.engine import wait_until

LIBRARIES = ("rospy", "roscpp")
UNNOTICED = 10.0
"""Seconds without a message that a busy machine may cause by itself; see also `Log.lost`."""
_PROGRAMS = {"rospy": ("python3", "/nodes/node.py"), "roscpp": ("/nodes/node",)}
_GOT = re.compile(r"^(got|reply|sent) (\S+) (\d+) size \d+(?: crc \w+)? at ([\d.]+)", re.MULTILINE)


def node_command(library: str, role: str, *options: str) -> tuple[str, ...]:
    return (*_PROGRAMS[library], role, *options)


@dataclass(frozen=True)
class Got:
    """A message or reply that a node has received; ``at`` is the clock's time in seconds."""

    text: str
    number: int
    at: float


@dataclass(frozen=True)
class Log:
    """The output of a node, read anew each time."""

    read: Callable[[], str]

    def got(self, text: str = "", verb: str = "got") -> list[Got]:
        """The received, or sent, messages with this word."""
        messages = (Got(m[2], int(m[3]), float(m[4])) for m in _GOT.finditer(self.read())
                 if m[1] == verb)  # fmt: skip
        return [got for got in messages if not text or got.text == text]

    def wait_for(
        self, text: str, count: int = 3, seconds: float = 60, since: float = 0, verb: str = "got"
    ) -> float:
        """Wait until the node has received ``count`` messages with a word. Return the time of the
        first.
        """

        def fresh() -> list[Got]:
            return [got for got in self.got(text, verb) if got.at >= since]

        wait_until(
            lambda: len(fresh()) >= count, seconds,
            lambda: f"{count} messages {text!r} since {since} in:\n{self.read()[-3000:]}",
        )  # fmt: skip
        return fresh()[0].at

    def lost(self, text: str, since: float) -> int:
        """The number of missing messages between the received messages since then."""
        numbers = {got.number for got in self.got(text) if got.at >= since}
        return max(numbers) - min(numbers) + 1 - len(numbers)

    def longest_gap(self, text: str, since: float, until: float, verb: str = "got") -> float:
        """The longest time in which no message came."""
        times = [got.at for got in self.got(text, verb) if since <= got.at <= until]
        edges = [since, *times, until]
        return max(later - earlier for earlier, later in itertools.pairwise(edges))
