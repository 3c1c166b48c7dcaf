"""An event loop with a clock that stands still while the process does not run.

The proxy judges nodes by time: a node that does not answer within a second is dead. If other
programs take the processors, the test's process stands still for as long now and then, with proxy
and nodes. By the wall clock a healthy node would then be dead. By this clock a turn of the loop
takes at most `WORK` with events, and at most `WAIT` without. So events in a single process have the
order and the times of a quiet machine. Threads and other processes have the real time.

`pass_time` lets the clock run ahead, for events that are due in minutes.
"""

import asyncio
import selectors
from time import monotonic

WAIT = 0.02
"""Seconds by which the clock moves at most while the loop waits for something to happen."""
WORK = 0.002
"""Seconds by which the clock moves at most while the loop handles events."""
GLANCE = 0.001
"""Real seconds in which nothing may have happened for `WAIT` to be over, in haste."""

_Ready = list[tuple[selectors.SelectorKey, int]]


class PatientSelector(selectors.DefaultSelector):
    """Moves ``now`` by the seconds of a wait, or of a turn of the loop between two waits."""

    def __init__(self) -> None:
        super().__init__()
        self._real = self.now = monotonic()
        self.in_haste = False

    def select(self, timeout: float | None = None) -> _Ready:
        """The ready files, perhaps none after `WAIT`."""
        self._move(WORK)
        wait = WAIT if timeout is None else min(timeout, WAIT)
        ready = super().select(min(wait, GLANCE) if self.in_haste else wait)
        self._move(WAIT)
        if self.in_haste and not ready and wait > GLANCE:
            self.now += wait - GLANCE
        return ready

    def _move(self, most: float) -> None:
        real = monotonic()
        self.now += min(real - self._real, most)
        self._real = real


class PatientLoop(asyncio.SelectorEventLoop):
    """asyncio's loop with that clock."""

    def __init__(self) -> None:
        self.patient = PatientSelector()
        super().__init__(self.patient)

    def time(self) -> float:
        """Seconds of a clock that stands still while the process does."""
        return self.patient.now


async def pass_time(seconds: float) -> None:
    """Let these seconds pass as fast as the due events are handled. In a `PatientLoop` only."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, PatientLoop)
    loop.patient.in_haste = True
    try:
        await asyncio.sleep(seconds)
    finally:
        loop.patient.in_haste = False
