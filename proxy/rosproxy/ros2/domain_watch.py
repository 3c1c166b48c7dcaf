"""Reports the problems of ROS 2 domains once: in the log, and as problems of the proxy.

A problem has to last for two checks. So the proxy does not report participants that have just
appeared, and readers and writers that are not all known yet. The problem disappears after the fix.
"""

import logging

from rosproxy.ros2.domain_problems import DomainProblem, domain_problems
from rosproxy.ros2.status import Ros2State
from rosproxy.shared.documents.status_bounds import fair_choice
from rosproxy.shared.output.problems import Problems

log = logging.getLogger(__name__)

MOST_NOTED = 20
"""The highest number of problems reported at a time, with fair shares by address."""


class DomainWatch:
    """Checks the domains, and reports to ``problems``."""

    def __init__(self, state: Ros2State, problems: Problems) -> None:
        self._state = state
        self._problems = problems
        self._previous: set[DomainProblem] = set()
        self._noted: dict[str, set[DomainProblem]] = {}

    async def look(self) -> None:
        """Report the problems that this check and the last one found.

        Withdraw the problems that are gone.
        """
        problems = {p for domain in self._state.status() for p in domain_problems(domain)}
        # Grave problems first, because at most MOST_NOTED are reported.
        lasting = sorted(problems & self._previous, key=lambda p: (not p.grave, p.subject))
        self._previous = problems
        current: dict[str, set[DomainProblem]] = {}
        for problem in fair_choice(lasting, lambda p: p.owner, MOST_NOTED):
            current.setdefault(problem.subject, set()).add(problem)
        for subject in self._noted.keys() | current.keys():
            self._note(subject, self._noted.get(subject, set()), current.get(subject, set()))
        self._noted = current

    def _note(self, subject: str, former: set[DomainProblem], current: set[DomainProblem]) -> None:
        if former - current:
            # This withdraws all problems of the subject. The lasting ones are added again below.
            self._problems.solved(subject)
        for problem in sorted(current, key=lambda p: p.text):
            if former - current or problem not in former:
                # A problem that is not grave may be no fault, and is kept as an event.
                text = f"{problem.text}. Fix: {problem.fix}"
                self._problems.add(subject, text, holds=problem.grave)
            if problem not in former:
                log.warning("%s: %s. Fix: %s", subject, problem.text, problem.fix)
