"""Connections on which an answer is due that nobody waits for any more.

A peer that finds its caller gone need not survive that: a node of roslisp ends when it can't write
its answer (SBCL's debugger is disabled in programs). So whoever gives up waiting leaves the
connection here, and it is closed when the answer has come, or when the peer has ended it.
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

LATE_TIMEOUT = 60.0
"""Seconds that an answer has to come."""
MOST_LATE = 256
"""Connections of one kind of peer; the one that was left first is closed for another."""


class LateAnswers:
    """Waits for the answers on connections that were left."""

    def __init__(self) -> None:
        self._waiting: dict[asyncio.Task[None], None] = {}
        self._ended = False

    def __len__(self) -> int:
        """How many there are."""
        return len(self._waiting)

    def wait(self, answer: Callable[[], Awaitable[object]], close: Callable[[], None]) -> None:
        """Have ``close`` called, which closes a connection, once ``answer`` has come or failed."""
        if self._ended:
            close()
            return

        def done(task: asyncio.Task[None]) -> None:
            self._waiting.pop(task, None)
            close()

        task = asyncio.get_running_loop().create_task(_await_late(answer))
        self._waiting[task] = None
        task.add_done_callback(done)
        if len(self._waiting) > MOST_LATE:
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.cancel()

    async def end(self) -> None:
        """Close all of them, for good."""
        self._ended = True
        waiting = list(self._waiting)
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)


async def _await_late(answer: Callable[[], Awaitable[object]]) -> None:
    with contextlib.suppress(Exception):  # whatever it is, nobody wants it
        async with asyncio.timeout(LATE_TIMEOUT):
            await answer()
