"""What the user should know: the problems that `rosproxy status` shows.

Subjects are nodes' names and texts quote what nodes say, so that both are made harmless and
bounded here, once for all modules that note a problem.
"""

import time

import msgspec

from rosproxy.telemetry.text import brief

MOST = 50
"""Problems that are kept."""
LONGEST_SUBJECT = 200
LONGEST_TEXT = 500
"""Characters of a problem at most. Names of real nodes have some tens, the proxy's own texts up to
300; what is longer loses its middle."""


class NotedProblem(msgspec.Struct, frozen=True):
    """A problem: when (Unix time), with which node, port or option, and what.

    ``port`` is the lease of the node concerned, if it is about one. ``holds``: it is so until it is
    solved, and not only when it was noted.
    """

    when: float
    subject: str
    text: str
    port: int | None = None
    holds: bool = False


class Problems:
    """The most recent problems, newest last; the same one again replaces the older entry.

    Those that hold stay, however many others there are.
    """

    def __init__(self) -> None:
        self._problems: list[NotedProblem] = []

    def add(self, subject: str, text: str, port: int | None = None, holds: bool = False) -> None:
        """Note a problem. The caller has to call `solved` for a problem that ``holds``."""
        subject = brief(subject, LONGEST_SUBJECT)
        text = brief(text, LONGEST_TEXT)
        remaining = [p for p in self._problems if (p.subject, p.text) != (subject, text)]
        noted = [*remaining, NotedProblem(time.time(), subject, text, port, holds)]
        if len(noted) > MOST:
            noted.remove(next((p for p in noted if not p.holds), noted[0]))
        self._problems = noted

    def solved(self, subject: str) -> None:
        """Forget what was noted about a subject."""
        noted_subject = brief(subject, LONGEST_SUBJECT)
        self._problems = [p for p in self._problems if p.subject != noted_subject]

    def solved_at(self, port: int) -> None:
        """Forget what was noted about the node of a lease."""
        self._problems = [p for p in self._problems if p.port != port]

    def all(self) -> list[NotedProblem]:
        """All problems."""
        return self._problems

    def at(self, port: int) -> list[NotedProblem]:
        """The problems of the node of a lease."""
        return [p for p in self._problems if p.port == port]
