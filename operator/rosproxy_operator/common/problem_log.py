"""Problems in the log: each is told once when it appears and once when it is solved."""

import logging
from collections.abc import Iterable

from rosproxy_operator.common.problem import Problem

log = logging.getLogger(__name__)


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
                log.log(level, "%s: %s", problem.subject, problem.text)
        subjects = {problem.subject for problem in now}
        solved = {p.subject for p in self._told} - subjects
        for subject in sorted(solved):
            log.info("%s: solved", subject)
        self._told = now
