"""Tells once of what keeps participants of ROS 2 apart: in the log, and as a problem.

What is wrong only for a moment is not told: a participant that has just been heard, or one whose
readers and writers are not all known. When it is mended, the problem goes.
"""

import logging

from rosproxy.admin.domain_problems import DomainProblem, domain_problems
from rosproxy.admin.ros2_status import Ros2State
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)

MOST_TOLD = 20
"""Told of at a time, so that nobody hides all other problems behind those of his own."""


class DomainWatch:
    """Looks at the domains, and notes what it finds in ``problems``."""

    def __init__(self, state: Ros2State, problems: Problems) -> None:
        self._state, self._problems = state, problems
        self._before: set[DomainProblem] = set()
        self._told: dict[str, set[DomainProblem]] = {}

    async def look(self) -> None:
        """Tell of what was found this time and the last, and forget what has gone."""
        found = {one for domain in self._state.status() for one in domain_problems(domain)}
        lasting = sorted(found & self._before, key=lambda one: (not one.grave, one.subject))
        self._before = found
        now: dict[str, set[DomainProblem]] = {}
        for one in lasting[:MOST_TOLD]:
            now.setdefault(one.subject, set()).add(one)
        for subject in self._told.keys() | now.keys():
            self._note(subject, self._told.get(subject, set()), now.get(subject, set()))
        self._told = now

    def _note(self, subject: str, before: set[DomainProblem], now: set[DomainProblem]) -> None:
        if before - now:
            self._problems.solved(subject)
        for one in sorted(now, key=lambda one: one.text):
            if before - now or one not in before:
                self._problems.add(subject, f"{one.text}: {one.fix}")
            if one not in before:
                log.warning("%s: %s; %s", subject, one.text, one.fix)
