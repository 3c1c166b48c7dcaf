"""An rclpy node that executes commands, one a line. Its answers begin with "= ".

Runs with the Python of a ROS 2 distribution, and imports nothing of this repository. Messages are
serialized std_msgs/String, so that the times do not include Python's conversion. A message begins
with the time of sending, in nanoseconds of the machine's clock.
"""

from __future__ import annotations

import struct
import sys
import threading
import time
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from std_msgs.msg import String

CDR_LE = b"\0\1\0\0"
PATIENCE = 30.0
LOST = 2.0
"""Seconds after which a ping counts as lost."""


def message(size: int) -> bytes:
    """A CDR text with the time in the first bytes."""
    stamped = struct.pack("<q", time.time_ns()).ljust(size, b"\1")
    return CDR_LE + struct.pack("<I", size + 1) + stamped + b"\0"


def age(data: bytes) -> int:
    """Microseconds since a message was sent."""
    return (time.time_ns() - struct.unpack_from("<q", data, 8)[0]) // 1000


class Talker:
    """The own topics (``/NAME/...``), and the topics of the other node (``/PEER/...``)."""

    def __init__(self, node: Any, name: str, peer: str) -> None:
        qos = QoSProfile(depth=1000)
        self._ping = node.create_publisher(String, f"/{name}/ping", qos)
        self._stream = node.create_publisher(String, f"/{name}/stream", qos)
        self._pong = node.create_publisher(String, f"/{name}/pong", qos)
        self._back = threading.Event()
        self._ages: list[int] = []
        self._kept = [
            node.create_subscription(String, f"/{peer}/{topic}", take, qos, raw=True)
            for topic, take in (
                ("ping", self._pong.publish),
                ("pong", lambda _: self._back.set()),
                ("stream", lambda data: self._ages.append(age(data))),
            )
        ]

    def met(self) -> str:
        """Wait until both nodes have discovered all three topics of the other."""
        end = time.monotonic() + PATIENCE
        publishers = (self._ping, self._stream, self._pong)
        while not all(publisher.get_subscription_count() for publisher in publishers):
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
            self._ping.publish(message(int(size)))
            if self._back.wait(LOST):
                took.append((time.perf_counter_ns() - started) // 1000)
        return " ".join(map(str, ["took", *took]))

    def go(self, size: str, rate: str, seconds: str) -> str:
        """Send at a rate for some seconds."""
        count = 0
        began = time.monotonic()
        while (now := time.monotonic()) < began + float(seconds):
            time.sleep(max(0.0, began + count / float(rate) - now))
            self._stream.publish(message(int(size)))
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


def main(name: str, peer: str) -> None:
    rclpy.init(args=[])
    node = rclpy.create_node(name)
    talker = Talker(node, name, peer)

    def spin() -> None:
        try:
            rclpy.spin(node)
        except ExternalShutdownException:
            return

    threading.Thread(target=spin, daemon=True).start()
    print("= ready", flush=True)
    for line in sys.stdin:
        command, *words = line.split()
        print("=", getattr(talker, command)(*words), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
