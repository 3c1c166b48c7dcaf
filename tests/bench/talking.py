"""The commands and messages of a node that talks to another node: the same for each middleware.

Imported by programs that run with another Python, so this module imports only the standard library.
A message is a CDR text (std_msgs/String) that begins with the time of sending, in nanoseconds of
the machine's clock.
"""

from __future__ import annotations

import struct
import sys
import threading
import time
from collections.abc import Callable

TOPICS = ("ping", "pong", "stream")
"""A node publishes these below its own name, and subscribes to these below the other's name."""
PATIENCE = 30.0
"""Seconds in which both nodes must discover each other."""
_CDR_LE = b"\0\1\0\0"
_LOST = 2.0
"""Seconds after which a ping counts as lost."""


def message(size: int) -> bytes:
    """A CDR text with the time in the first bytes."""
    stamped = struct.pack("<q", time.time_ns()).ljust(size, b"\1")
    return _CDR_LE + struct.pack("<I", size + 1) + stamped + b"\0"


def age(data: bytes) -> int:
    """Microseconds since a message was sent."""
    return int((time.time_ns() - struct.unpack_from("<q", data, 8)[0]) // 1000)


class Talker:
    """Executes the commands of a node.

    ``publish`` sends a message to an own topic. ``is_met`` tells whether each own topic has a
    subscriber.
    """

    def __init__(self, publish: Callable[[str, bytes], object], is_met: Callable[[], bool]) -> None:
        self._publish = publish
        self._is_met = is_met
        self._back = threading.Event()
        self._ages: list[int] = []

    def take(self, topic: str, data: bytes) -> None:
        """Handle a message of the other node."""
        if topic == "ping":
            self._publish("pong", data)
        elif topic == "pong":
            self._back.set()
        else:
            self._ages.append(age(data))

    def met(self) -> str:
        """Wait until the other node subscribes to all three topics."""
        end = time.monotonic() + PATIENCE
        while not self._is_met():
            if time.monotonic() > end:
                return "failed: the other is not found"
            time.sleep(0.05)
        return "met"

    def ping(self, size: str, seconds: str) -> str:
        """Round trips for some seconds: microseconds of each."""
        took = []
        end = time.monotonic() + float(seconds)
        while time.monotonic() < end:
            self._back.clear()
            started = time.perf_counter_ns()
            self._publish("ping", message(int(size)))
            if self._back.wait(_LOST):
                took.append((time.perf_counter_ns() - started) // 1000)
        return " ".join(map(str, ["took", *took]))

    def go(self, size: str, rate: str, seconds: str) -> str:
        """Send at a rate for some seconds."""
        count = 0
        began = time.monotonic()
        while (now := time.monotonic()) < began + float(seconds):
            time.sleep(max(0.0, began + count / float(rate) - now))
            self._publish("stream", message(int(size)))
            count += 1
        return f"sent {count}"

    def count(self) -> str:
        """The number of arrived messages of a stream."""
        return f"count {len(self._ages)}"

    def off(self) -> str:
        """Microseconds that each message of a stream took, which is over."""
        ages = list(self._ages)
        self._ages[:] = []
        return " ".join(map(str, ["ages", *ages]))


def serve(talker: Talker) -> None:
    """Execute commands of standard input, one a line. The answers begin with "= "."""
    print("= ready", flush=True)
    for line in sys.stdin:
        command, *words = line.split()
        print("=", getattr(talker, command)(*words), flush=True)
