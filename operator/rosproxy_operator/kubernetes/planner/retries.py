"""Delays the retries of an action that has had no effect, with growing pauses.

The planner asks `Retries.is_due` before each action. `Retries` records each task, with the time and
the error of the API server, for the next state. If the planner does not ask again, the task has had
its effect, and `Retries` forgets the task.
"""

from collections.abc import Iterator, Mapping

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.resources.model import Name

WATCH_LAG_S = 3.0
"""Seconds for the watches to show the effect of an action; the first pause without an error."""
FIRST_PAUSE_S = 1.0
"""Seconds from the first error of the API server to the next try.

Also the first pause after `PROMPT_RECREATIONS` creations.
"""
LONGEST_PAUSE_S = 60.0
"""Longest pause between two tries, in seconds."""
PROMPT_RECREATIONS = 3
"""Creations without a pause, for a pod that never runs well. Then the pauses grow."""


class Task(msgspec.Struct, frozen=True):
    """A change of the object ``id`` for the RosProxy ``of``.

    ``detail`` tells tasks for the same ``id`` apart, for example by the uid of the object.
    """

    of: Name
    verb: str
    id: Name
    detail: str = ""


class RetryRecord(msgspec.Struct, frozen=True):
    """The number of tries of a task, and the time ``at`` of the last try.

    ``at`` is in seconds of the operator's monotonic clock.

    With ``effect`` the task has had its effect, but may be due again: a created pod may fail.
    ``error`` is the error of the API server, empty without an error.
    """

    count: int
    at: float
    effect: bool = False
    error: str = ""

    @property
    def pause(self) -> float:
        """Seconds from the last try to the next try."""
        # The exponents have a limit, because 2.0 ** 1024 raises OverflowError.
        if self.effect and not self.error:
            excess = self.count - PROMPT_RECREATIONS
            return (
                min(FIRST_PAUSE_S * 2.0 ** min(excess, 10), LONGEST_PAUSE_S) if excess >= 0 else 0.0
            )
        first = FIRST_PAUSE_S if self.error else WATCH_LAG_S
        return min(first * 2.0 ** min(self.count - 1, 10), LONGEST_PAUSE_S)


class Retries:
    """The records of one look. ``noted`` becomes the ``attempts`` of the next state.

    ``attempts`` and ``failures`` are from the looks before. ``failures`` has the errors of the API
    server, by RosProxy and object. ``now`` is in seconds of the operator's monotonic clock.
    """

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
        self._delayed: set[Task] = set()

    def is_due(self, task: Task) -> bool:
        """Whether to carry out a task now. If so, the try is recorded."""
        record = self._attempts.get(task)
        if record is not None and self._now - record.at < record.pause:
            self.noted[task] = record
            self._delayed.add(task)
            return False
        count, error = (record.count, record.error) if record else (0, "")
        self.noted[task] = RetryRecord(count + 1, self._now, error=error)
        return True

    def is_recent(self, task: Task, seconds: float) -> bool:
        """Whether a task was carried out without an error in the last ``seconds``.

        If so, the record stays, and another look follows after this time.
        """
        record = self._attempts.get(task)
        left = record.at + seconds - self._now if record is not None else 0.0
        if record is None or record.error or left <= 0:
            return False
        self.noted[task] = record
        self._recent.add(task)
        self._later.append(left)
        return True

    def look_again_in(self, seconds: float) -> None:
        """Request another look after this time, because another change has to come first."""
        self._later.append(seconds)

    def note_effect(self, task: Task) -> None:
        """Record that a task has had its effect, and keep the count: the task may be due again."""
        if task in self._attempts:
            self.noted[task] = replace(self._attempts[task], effect=True, error="")

    def failures(self, of: Name) -> Mapping[Name, str]:
        """The errors of the API server for a RosProxy, by object."""
        noted = self.noted.items()
        return {task.id: record.error for task, record in noted if task.of == of and record.error}

    def pauses(self) -> Iterator[float]:
        """Yield the seconds until each next try.

        A task with ``effect`` counts only if the planner has asked for the task, and has to wait.
        """
        yield from self._later
        for task, record in self.noted.items():
            is_wanted = not record.effect or task in self._delayed
            if is_wanted and task not in self._recent:
                yield max(record.at + record.pause - self._now, 0.0)
