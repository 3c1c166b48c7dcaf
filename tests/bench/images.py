"""The rospy twin of cpp/images.cpp: the same lines on standard input, the same answers.

Runs with the system's Python, which has rospy, and imports nothing of this repository.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time
from typing import Any

import rospy
from sensor_msgs.msg import Image

PATIENCE = 10.0
RECEIVE_BUFFER = 2**23
"""More than a message: with less, rospy is slow by itself."""


class Window:
    """How many messages may still be sent."""

    def __init__(self, path: str, size: int) -> None:
        self._left = size
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(path)

    def take(self) -> None:
        """Take a place in the window. A lost message frees its place after a second."""
        while self._arrived(0.0 if self._left > 0 else 1.0):
            self._left += 1
        self._left = max(self._left, 1) - 1

    def _arrived(self, patience: float) -> bool:
        self._socket.settimeout(patience)
        try:
            return bool(self._socket.recv(1))
        except OSError:  # nothing there, at once or in time
            return False


class Node:
    """The node's current publisher and subscriber."""

    def __init__(self) -> None:
        self._publisher: Any = None
        self._subscriber: Any = None
        self._told = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._path = ""
        self._arrivals: list[tuple[int, int]] = []

    def go(self, topic: str, size: str, rate: str, seconds: str, window: str, path: str) -> str:
        if self._publisher:
            self._publisher.unregister()
        self._publisher = rospy.Publisher(topic, Image, queue_size=1000)
        deadline = time.monotonic() + PATIENCE
        while not self._publisher.get_num_connections():
            if time.monotonic() > deadline:
                return "failed: no subscriber"
            time.sleep(0.01)
        time.sleep(0.1)
        return self._publish(
            Image(data=bytes(int(size))), float(rate), float(seconds), window, path
        )

    def _publish(self, image: Image, rate: float, seconds: float, window: str, path: str) -> str:
        left = Window(path, int(window))
        begin = time.monotonic()
        count = 0
        while (now := time.monotonic()) < begin + seconds:
            if rate > 0:
                time.sleep(max(0.0, begin + count / rate - now))
            else:
                left.take()
            image.header.stamp = rospy.Time(*divmod(time.time_ns(), 10**9))
            self._publisher.publish(image)
            count += 1
        return f"sent {count}"

    def on(self, topic: str, path: str) -> str:
        self._path = path
        self._arrivals = []
        options = {"queue_size": 1000, "buff_size": RECEIVE_BUFFER, "tcp_nodelay": True}
        self._subscriber = rospy.Subscriber(topic, Image, self._take, **options)
        return "on"

    def _take(self, image: Image) -> None:
        now = time.time_ns()
        with contextlib.suppress(OSError):
            self._told.sendto(b"x", socket.MSG_DONTWAIT, self._path)
        self._arrivals.append((now, now - image.header.stamp.to_nsec()))

    def count(self) -> str:
        return f"count {len(self._arrivals)}"

    def off(self) -> str:
        self._subscriber.unregister()
        arrivals = list(self._arrivals)
        took = (arrivals[-1][0] - arrivals[0][0]) / 1e9 if arrivals else 0
        return " ".join(map(str, ["got", len(arrivals), took, *(t // 1000 for _, t in arrivals)]))


def main() -> None:
    rospy.init_node("images")
    node = Node()
    print("= ready", flush=True)
    for line in sys.stdin:
        command, *words = line.split()
        print("=", getattr(node, command)(*words), flush=True)


if __name__ == "__main__":
    main()
