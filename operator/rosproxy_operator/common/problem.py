"""What is wrong, told for every engine: texts for people, and each of them once in the log."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that keeps an object from what its user wants; the text says what to do.

    ``subject`` names the object: ``container talker``, ``network app``, ``proxy rosproxy-…``.
    With ``fatal`` the object is left out; otherwise the problem is a warning.
    """

    subject: str
    text: str
    fatal: bool = True

    @property
    def log_fields(self) -> dict[str, str]:
        """What a log entry about it has as fields, to be given as ``extra``."""
        kind, _, name = self.subject.partition(" ")
        return {kind: name} if kind in ("container", "pod", "proxy") else {}


def bounded(text: str, most: int) -> str:
    """A text of at most so many characters."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


class ProblemLog:
    """Remembers which problems were told."""

    def __init__(self) -> None:
        self._told: dict[Problem, None] = {}

    def update(self, problems: Iterable[Problem]) -> None:
        """Take note of the problems that there are now."""
        now = dict.fromkeys(problems)
        for problem in now:
            if problem not in self._told:
                level = logging.ERROR if problem.fatal else logging.WARNING
                text = "%s: %s"
                log.log(level, text, problem.subject, problem.text, extra=problem.log_fields)
        for subject in sorted({p.subject for p in self._told} - {p.subject for p in now}):
            log.info("%s: solved", subject)
        self._told = now
