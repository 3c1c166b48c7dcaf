"""A healthy pair: a participant sends 100 messages a second to another during attacks.

    python -m tests.abuse.pair PREFIX INSIDE OUTSIDE TARGET TARGET_PORT PROXY

A separate process, so that the test cannot hold up the pair. Standard input is the socket that
receives, and that announces the participant. The process prints a line before the first message. On
SIGTERM it prints the number of sent and lost messages, and the longest time without a message in
seconds.
"""

import json
import signal
import socket
import subprocess
import sys
import time
from types import FrameType, TracebackType
from typing import NamedTuple

from tests.abuse.ros2_neighbours import WELL_KNOWN, Address, Participant, udp
from tests.unit.ros2.discovery.domains import spdp

INTERVAL = 0.01
ANNOUNCED_EACH = 100
"""Messages after which the participant inside announces itself again."""
STARTED = "started\n"
LAST_WAIT = 0.5
"""Seconds that the last messages may take."""


class Figures(NamedTuple):
    """The results of a pair."""

    sent: int
    lost: int
    longest_gap: float


class Stream:
    """Sends numbered messages to a port of the proxy, and receives them inside."""

    def __init__(self, sender: socket.socket, receiver: socket.socket, target: Address) -> None:
        self._sender = sender
        self._receiver = receiver
        self._target = target
        self._received = set[int]()
        self._last_time = time.monotonic()
        self._longest_gap = 0.0
        self._sent = 0

    def send(self) -> None:
        """Send the next message, and receive until the time of another message."""
        self._sender.sendto(b"message %d" % self._sent, self._target)
        self._sent += 1
        self._receive(INTERVAL)

    def figures(self) -> Figures:
        """Wait for the last messages; what has been seen."""
        self._receive(LAST_WAIT if len(self._received) < self._sent else 0.0)
        return Figures(self._sent, self._sent - len(self._received), self._longest_gap)

    def _receive(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0:
            self._receiver.settimeout(remaining)
            try:
                datagram = self._receiver.recv(65536)
            except TimeoutError:
                continue
            if datagram.startswith(b"message "):
                self._note(int(datagram[8:]))

    def _note(self, number: int) -> None:
        now = time.monotonic()
        self._longest_gap = max(self._longest_gap, now - self._last_time)
        self._last_time = now
        self._received.add(number)


class Pair:
    """Runs this module as long as the context lasts. Then ``figures`` has the result."""

    figures: Figures

    def __init__(self, inside: Participant, outside: str, target: Address, proxy: str) -> None:
        self._command = [sys.executable, "-m", "tests.abuse.pair", inside.prefix.hex()]
        self._command += [inside.address, outside, target[0], str(target[1]), proxy]
        self._data = inside.data

    def __enter__(self) -> "Pair":
        self._process = subprocess.Popen(
            self._command, stdin=self._data.fileno(), stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        # An attack that is over sooner than a process starts would meet no pair.
        assert self._process.stdout.readline() == STARTED
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.send_signal(signal.SIGTERM)
        text, _ = self._process.communicate()
        self.figures = Figures(*json.loads(text))


def main() -> None:
    """Send and receive until a signal comes."""
    prefix, address, outside, host, port, proxy = sys.argv[1:]
    ended = False

    def end(_number: int, _frame: FrameType | None) -> None:
        nonlocal ended
        ended = True

    signal.signal(signal.SIGTERM, end)
    receiver = socket.socket(fileno=sys.stdin.fileno())
    stream = Stream(udp(outside), receiver, (host, int(port)))
    announcement = spdp(bytes.fromhex(prefix), address)
    print(STARTED, end="", flush=True)
    count = 0
    while not ended:
        if count % ANNOUNCED_EACH == 0:
            receiver.sendto(announcement, (proxy, WELL_KNOWN))
        stream.send()
        count += 1
    print(json.dumps(stream.figures()))


if __name__ == "__main__":
    main()
