"""What the user should know: the problems that `rosproxy status` shows."""

import time
from collections import deque
from dataclasses import dataclass

MOST = 50


@dataclass(frozen=True, slots=True)
class NotedProblem:
    """A problem: when (Unix time), with which node, port or option, and what.

    ``port`` is the lease of the node concerned, if it is about one.
    """

    when: float
    subject: str
    text: str
    port: int | None = None


class Problems:
    """The most recent problems, newest last; the same one again replaces the older entry."""

    def __init__(self) -> None:
        self._items: deque[NotedProblem] = deque(maxlen=MOST)

    def add(self, subject: str, text: str, port: int | None = None) -> None:
        """Note a problem."""
        self._keep([p for p in self._items if (p.subject, p.text) != (subject, text)])
        self._items.append(NotedProblem(time.time(), subject, text, port))

    def solved(self, subject: str) -> None:
        """Forget what was noted about a subject."""
        self._keep([p for p in self._items if p.subject != subject])

    def solved_at(self, port: int) -> None:
        """Forget what was noted about the node of a lease."""
        self._keep([p for p in self._items if p.port != port])

    def all(self) -> list[NotedProblem]:
        """All problems."""
        return list(self._items)

    def at(self, port: int) -> list[NotedProblem]:
        """The problems of the node of a lease."""
        return [p for p in self._items if p.port == port]

    def _keep(self, kept: list[NotedProblem]) -> None:
        self._items = deque(kept, maxlen=MOST)
