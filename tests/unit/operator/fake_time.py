"""An event loop whose clock jumps: when everything waits, it is as late as is waited for."""

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any


class JumpingSelector(selectors.DefaultSelector):
    """Adds to ``now`` what would be waited for nothing."""

    now = 1000.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready and timeout:
            self.now += timeout
        return ready


class FakeTimeLoop(asyncio.SelectorEventLoop):
    """``await asyncio.sleep(3600)`` takes no time. Nothing may happen in threads or on sockets."""

    def __init__(self) -> None:
        self._jumping = JumpingSelector()
        super().__init__(self._jumping)

    def time(self) -> float:
        return self._jumping.now

    def hang(self, seconds: float) -> None:
        """Let time go by in which the loop does nothing."""
        self._jumping.now += seconds


def run(main: Coroutine[Any, Any, None]) -> None:
    """Run a test in such a loop."""
    with asyncio.Runner(loop_factory=FakeTimeLoop) as runner:
        runner.run(main)
