"""When an action that has had no effect is tried again: soon, then after ever longer pauses.

The planner asks (`Retries.is_due`) before each action whether it is to be done now. What was asked
for is noted, with the time and with the error if the API server refused it, and goes into the next
state; a task that is not asked for any more has had its effect and is forgotten.
"""

from collections.abc import Iterator, Mapping

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.resources.model import Name

LAG = 3.0
"""Seconds after which something that was done must be seen in the API server's lists."""
FIRST = 1.0
"""Seconds until something that failed is tried again, the first time."""
LONGEST = 60.0
"""Seconds between tries at most."""
PROMPT_RECREATIONS = 3
"""How often a pod that never got well is made anew without delay."""


class Task(msgspec.Struct, frozen=True):
    """Something to be done for a RosProxy to the object ``id``.

    ``detail`` tells tasks apart that concern objects of one name, or one object in several ways.
    """

    of: Name
    verb: str
    id: Name
    detail: str = ""


class RetryRecord(msgspec.Struct, frozen=True):
    """How often a task was asked for, and when the last time.

    ``effect``: it was seen to be done, yet it may have to be done again. ``error`` is what the
    API server said of it.
    """

    count: int
    at: float
    effect: bool = False
    error: str = ""

    @property
    def pause(self) -> float:
        """Seconds after which it may be tried again."""
        # The exponents are bounded, since 2.0 ** 1024 raises OverflowError.
        if self.effect and not self.error:
            excess = self.count - PROMPT_RECREATIONS
            return min(FIRST * 2.0 ** min(excess, 10), LONGEST) if excess >= 0 else 0.0
        first = FIRST if self.error else LAG
        return min(first * 2.0 ** min(self.count - 1, 10), LONGEST)


class Retries:
    """The attempts noted in one look. A task that is not asked about is forgotten."""

    def __init__(
        self,
        attempts: Mapping[Task, RetryRecord],
        failures: Mapping[Name, Mapping[Name, str]],
        now: float,
    ) -> None:
        self._attempts = {
            task: replace(record, error=failures.get(task.of, {}).get(task.id, record.error))
            for task, record in attempts.items()
        }
        self._now = now
        self.noted: dict[Task, RetryRecord] = {}
        self._later: list[float] = []
        self._recent: set[Task] = set()

    def is_due(self, task: Task) -> bool:
        """Whether a task is to be done now; if so, that is noted."""
        record = self._attempts.get(task)
        if record is not None and self._now - record.at < record.pause:
            self.noted[task] = record
            return False
        count, error = (record.count, record.error) if record else (0, "")
        self.noted[task] = RetryRecord(count + 1, self._now, error=error)
        return True

    def is_recent(self, task: Task, seconds: float) -> bool:
        """Whether a task was carried out less than so many seconds ago; its record is kept then."""
        record = self._attempts.get(task)
        left = record.at + seconds - self._now if record is not None else 0.0
        if record is None or record.error or left <= 0:
            return False
        self.noted[task] = record
        self._recent.add(task)
        self._later.append(left)
        return True

    def look_again_in(self, seconds: float) -> None:
        """Note that something else has to come first: look again in that many seconds."""
        self._later.append(seconds)

    def note_effect(self, task: Task) -> None:
        """Note that a task has had its effect, though it may have to be done again."""
        if task in self._attempts:
            self.noted[task] = replace(self._attempts[task], effect=True, error="")

    def failures(self, of: Name) -> Mapping[Name, str]:
        """What can't be done for a RosProxy: what the API server said, by the object."""
        noted = self.noted.items()
        return {task.id: record.error for task, record in noted if task.of == of and record.error}

    def pauses(self) -> Iterator[float]:
        """In how many seconds there is something to be tried again."""
        yield from self._later
        for task, record in self.noted.items():
            if not record.effect and task not in self._recent:
                yield max(record.at + record.pause - self._now, 0.0)
