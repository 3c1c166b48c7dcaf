"""An event loop whose clock stands still while the process does.

A test judges by time what its nodes do: one that does not answer within a second is dead. Where
other programs take the processors, the test's own process comes to a halt for as long now and
then, proxy and nodes alike, and a node that is well would be dead by the wall's clock. By this one
it is not: a turn of the loop takes no longer than `WORK` where there was something to do, and no
longer than `WAIT` where there was nothing. So all that happens in one process happens in the order
and at the times that it would on a quiet machine. Threads and other processes have the real time.

`pass_time` lets it run ahead, for what is due in minutes.
"""

import asyncio
import selectors
from time import monotonic

WAIT = 0.02
"""Seconds by which the clock moves at most while the loop waits for something to happen."""
WORK = 0.002
"""Seconds by which it moves at most while the loop does what has happened."""
GLANCE = 0.001
"""Real seconds in which nothing may have happened for `WAIT` to be over, in haste."""

_Ready = list[tuple[selectors.SelectorKey, int]]


class PatientSelector(selectors.DefaultSelector):
    """Moves ``now``, in seconds, by what a wait took, or a turn of the loop between two of them."""

    def __init__(self) -> None:
        super().__init__()
        self._real = self.now = monotonic()
        self.in_haste = False

    def select(self, timeout: float | None = None) -> _Ready:
        """What has become ready; after `WAIT` at the latest, though it be nothing."""
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
    """Let so many seconds pass as fast as what is due in them is done. In a `PatientLoop` only."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, PatientLoop)
    loop.patient.in_haste = True
    try:
        await asyncio.sleep(seconds)
    finally:
        loop.patient.in_haste = False
