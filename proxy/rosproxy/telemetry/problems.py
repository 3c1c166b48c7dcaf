"""What the user should know: the problems that `rosproxy status` shows."""

import time

import msgspec

MOST = 50


class NotedProblem(msgspec.Struct, frozen=True):
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
        self._items: list[NotedProblem] = []

    def add(self, subject: str, text: str, port: int | None = None) -> None:
        """Note a problem."""
        others = [p for p in self._items if (p.subject, p.text) != (subject, text)]
        self._items = [*others, NotedProblem(time.time(), subject, text, port)][-MOST:]

    def solved(self, subject: str) -> None:
        """Forget what was noted about a subject."""
        self._items = [p for p in self._items if p.subject != subject]

    def solved_at(self, port: int) -> None:
        """Forget what was noted about the node of a lease."""
        self._items = [p for p in self._items if p.port != port]

    def all(self) -> list[NotedProblem]:
        """All problems."""
        return self._items

    def at(self, port: int) -> list[NotedProblem]:
        """The problems of the node of a lease."""
        return [p for p in self._items if p.port == port]
