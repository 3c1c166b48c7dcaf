"""Topics and services through a proxy during disturbances."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from tests.docker.engine import inspect
from tests.docker.inside import ENABLE, Container, Inside, unique
from tests.docker.nodes import UNNOTICED, Log
from tests.docker.robot import Robot


@dataclass(frozen=True)
class Traffic:
    """A publisher, a subscriber and a server inside, each with a peer outside.

    ``outward`` are messages at the robot, ``inward`` messages inside, ``service`` the robot's
    replies from the service inside.
    """

    talker: Container
    listener: Container
    server: Container
    outward: Log
    inward: Log
    service: Log
    words: tuple[str, str]

    def wait(self, since: float = 0, seconds: float = 60) -> None:
        """Wait until messages and replies flow."""
        self.outward.wait_for(self.words[0], since=since, seconds=seconds)
        self.inward.wait_for(self.words[1], since=since, seconds=seconds)
        self.service.wait_for("ask", since=since, seconds=seconds, verb="reply")

    def gaps(self, since: float) -> "Gaps":
        """The longest pauses since then."""
        now = time.time()
        return Gaps(
            self.outward.longest_gap(self.words[0], since, now),
            self.inward.longest_gap(self.words[1], since, now),
            self.service.longest_gap("ask", since, now, verb="reply"),
            self.outward.lost(self.words[0], since) + self.inward.lost(self.words[1], since),
        )


@dataclass(frozen=True)
class Gaps:
    """Seconds without anything heard outside, heard inside, answered from inside; messages lost."""

    outward: float
    inward: float
    service: float
    lost: int

    @property
    def unnoticed(self) -> bool:
        """Whether connections have lasted: nothing was lost, nor was there a long pause."""
        return not self.lost and max(self.outward, self.inward, self.service) < UNNOTICED

    def __str__(self) -> str:
        return (f"seconds without messages outward {self.outward:.1f}, "
                f"inward {self.inward:.1f}, without service {self.service:.1f}; "
                f"messages lost {self.lost}")  # fmt: skip


@contextmanager
def traffic(
    net: Inside, robot: Robot, network: str, library: str, labels: tuple[str, ...] = (ENABLE,)
) -> Iterator[Traffic]:
    """Twenty messages and five calls a second, which cost a processor more."""
    out, back, service = (f"/{unique(kind).replace('-', '_')}" for kind in ("out", "in", "serve"))
    mark = out.rsplit("_", 1)[1]
    talker = net.node(network, library, "pub", "--topic", out, "--word", "inside",
                      labels=labels)  # fmt: skip
    listener = net.node(network, library, "sub", "--topic", back, labels=labels)
    server = net.node(network, library, "serve", "--service", service, labels=labels)
    names = [f"{role}_{mark}" for role in ("listener", "talker", "caller")]
    outward = robot.node(names[0], library, "sub", "--topic", out)
    robot.node(names[1], library, "pub", "--topic", back, "--word", "outside")
    called = robot.node(names[2], library, "call", "--service", service, "--rate", "5",
                        "--count", "100000")  # fmt: skip
    flow = Traffic(talker, listener, server, outward, listener.log, called, ("inside", "outside"))
    try:
        flow.wait()
        yield flow
    finally:
        for name in names:
            robot.end(name, "KILL")


def crash(container: str) -> None:
    """Kill the program of a container from behind, as the kernel would for want of memory."""
    os.kill(inspect(container)["State"]["Pid"], signal.SIGKILL)
