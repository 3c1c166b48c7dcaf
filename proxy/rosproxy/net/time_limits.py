"""Time limits of calls, as with `asyncio.timeout`, but with a shared timer for many calls.

uvloop spends a turn of the event loop on each cancelled timer: a twentieth of the time of a call.
"""

import asyncio
import math

LOOK_INTERVAL_S = 0.1
"""Shortest time between two looks at all limits, in seconds. A limit may end that much later."""


class TimeLimits:
    """The limits in force, and the timer for the limit that may run out first."""

    def __init__(self) -> None:
        self.running = set[TimeLimit]()
        self.next_look = math.inf
        self._timer: asyncio.TimerHandle | None = None

    def look_at(self, when: float, loop: asyncio.AbstractEventLoop) -> None:
        """Look at ``when`` (the loop's time in seconds), not later, whether a limit has run out."""
        if self._timer is not None:
            self._timer.cancel()
        self.next_look = when
        self._timer = loop.call_at(when, self._look, loop)

    def _look(self, loop: asyncio.AbstractEventLoop) -> None:
        self.next_look = math.inf
        now = loop.time()
        for limit in [limit for limit in self.running if limit.end <= now]:
            self.running.discard(limit)
            limit.run_out()
        if self.running:
            first_end = min(limit.end for limit in self.running)
            self.look_at(max(first_end, now + LOOK_INTERVAL_S), loop)


class TimeLimit:
    """Raises TimeoutError if the code in the context takes longer than ``seconds``.

    The timer stays when the context ends, because usually a later limit needs the timer.
    """

    __slots__ = ("_cancels", "_has_run_out", "_limits", "_seconds", "_task", "end")

    def __init__(self, limits: TimeLimits, seconds: float) -> None:
        self._limits = limits
        self._seconds = seconds
        self._has_run_out = False

    def __enter__(self) -> None:
        """Start to count."""
        loop = asyncio.get_running_loop()
        task = asyncio.current_task(loop)
        if task is None:
            raise RuntimeError("a time limit needs a task")
        self._task = task
        self._cancels = task.cancelling()
        self.end = loop.time() + self._seconds
        self._limits.running.add(self)
        if self.end < self._limits.next_look:
            self._limits.look_at(self.end, loop)

    def run_out(self) -> None:
        """Cancel the code in the context."""
        self._has_run_out = True
        self._task.cancel()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> None:
        """Raise TimeoutError if only the limit has cancelled the task."""
        self._limits.running.discard(self)
        is_cause = self._has_run_out and self._task.uncancel() <= self._cancels
        if is_cause and kind is asyncio.CancelledError:
            raise TimeoutError from error
