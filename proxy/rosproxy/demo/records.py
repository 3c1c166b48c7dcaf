"""What nodes note down about numbered messages, in a form that goes through JSON."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

TAIL_SECONDS = 1.0
"""How long the times of single messages are kept, to tell what a broken connection cut off."""


@dataclass
class Session:
    """One subscriber's connection at the publisher, and the messages written to it.

    Times are seconds of the system-wide monotonic clock, comparable between processes.
    """

    peer: str
    opened: float
    first: int | None = None
    last: int | None = None
    closed: float | None = None
    tail: deque[tuple[int, float]] = field(default_factory=deque)

    def note(self, number: int, now: float) -> None:
        """Note that `number` was written at `now`."""
        self.first = number if self.first is None else self.first
        self.last = number
        self.tail.append((number, now))
        while self.tail[0][1] < now - TAIL_SECONDS:
            self.tail.popleft()

    def to_json(self) -> dict[str, Any]:
        """Return the session as plain data; the tail only once it can matter."""
        tail = [list(item) for item in self.tail] if self.closed is not None else []
        return {
            "peer": self.peer,
            "opened": self.opened,
            "closed": self.closed,
            "first": self.first,
            "last": self.last,
            "tail": tail,
        }


class Received:
    """The numbers a subscriber received, as runs: a new one begins wherever the count jumps."""

    def __init__(self) -> None:
        self.count = 0
        self._runs: list[list[int]] = []

    def note(self, number: int) -> None:
        """Note that `number` has arrived."""
        self.count += 1
        if self._runs and number == self._runs[-1][1] + 1:
            self._runs[-1][1] = number
        else:
            self._runs.append([number, number])

    def to_json(self) -> dict[str, Any]:
        """Return the count and the runs `[first, last]` in order of arrival."""
        return {"count": self.count, "runs": [list(run) for run in self._runs]}


@dataclass
class Link:
    """One connection of a subscriber to a publisher: where it went and when it brought data."""

    uri: str
    address: str
    connected: float
    first_message: float | None = None
    closed: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the link as plain data."""
        return dict(self.__dict__)
