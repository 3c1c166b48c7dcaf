"""What is wrong, for every engine: texts for users, each logged once."""

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
    """Logs each problem once, and when it is solved."""

    def __init__(self) -> None:
        self._logged: dict[Problem, None] = {}

    def update(self, problems: Iterable[Problem]) -> None:
        """Take note of the problems that there are now."""
        current = dict.fromkeys(problems)
        for problem in current:
            if problem not in self._logged:
                level = logging.ERROR if problem.fatal else logging.WARNING
                text = "%s: %s"
                log.log(level, text, problem.subject, problem.text, extra=problem.log_fields)
        for subject in sorted({p.subject for p in self._logged} - {p.subject for p in current}):
            log.info("%s: solved", subject)
        self._logged = current
