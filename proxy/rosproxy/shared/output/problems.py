"""The problems that a user should know, as `rosproxy status` shows them.

Subjects and texts quote names that nodes have chosen. This module makes both harmless and bounds
both, for all modules that note problems.
"""

import time

import msgspec

from rosproxy.shared.output.text import brief

MOST_PROBLEMS = 50
"""Most problems that are kept."""
LONGEST_SUBJECT = 200
"""Characters of a subject; a longer subject loses its middle. Names of nodes have some tens."""
LONGEST_TEXT = 500
"""Characters of a text; a longer text loses its middle. The proxy's own texts have up to 300."""
DENIED = "policy"
WOULD_BE_DENIED = "policy_audit"
"""The reasons of denials by the policy, and of would-be denials in audit mode."""


class NotedProblem(msgspec.Struct, frozen=True):
    """A problem, first noted at ``since`` and last noted at ``when``: Unix times in seconds.

    ``subject``: a node, port or option. ``port``: the lease of the node, if the problem concerns a
    node. ``holds``: the problem lasts until `Problems.solved`; other problems are events.
    """

    since: float
    when: float
    subject: str
    text: str
    port: int | None = None
    holds: bool = False


class Problems:
    """The last MOST_PROBLEMS problems, newest last.

    A repeated problem replaces the older entry, and keeps its ``since``. Beyond MOST_PROBLEMS, the
    oldest event goes. If all problems hold, the oldest of all goes.
    """

    def __init__(self) -> None:
        self._problems: list[NotedProblem] = []

    def add(self, subject: str, text: str, port: int | None = None, holds: bool = False) -> None:
        """Note a problem. For a problem that ``holds``, the caller has to call `solved` later."""
        subject = brief(subject, LONGEST_SUBJECT)
        text = brief(text, LONGEST_TEXT)
        now = time.time()
        same = [p for p in self._problems if (p.subject, p.text) == (subject, text)]
        since = same[0].since if same else now
        remaining = [p for p in self._problems if p not in same]
        noted = [*remaining, NotedProblem(since, now, subject, text, port, holds)]
        if len(noted) > MOST_PROBLEMS:
            noted.remove(next((p for p in noted if not p.holds), noted[0]))
        self._problems = noted

    def solved(self, subject: str) -> None:
        """Remove the problems of a subject."""
        noted_subject = brief(subject, LONGEST_SUBJECT)
        self._problems = [p for p in self._problems if p.subject != noted_subject]

    def solved_at(self, port: int) -> None:
        """Remove the problems of the node that holds ``port``."""
        self._problems = [p for p in self._problems if p.port != port]

    def all(self) -> list[NotedProblem]:
        """All problems, newest last."""
        return self._problems

    def at(self, port: int) -> list[NotedProblem]:
        """The problems of the node that holds ``port``."""
        return [p for p in self._problems if p.port == port]


def refusal_subject(reason: str) -> str:
    """The subject of the problem for the last refusal of a reason."""
    return f"refused: {reason.replace('_', ' ')}"
