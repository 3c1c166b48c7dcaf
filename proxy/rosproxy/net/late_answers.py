"""Connections on which a peer still owes an answer, although no caller waits for the answer.

A node of roslisp ends when it can't write its reply (programs run with SBCL's debugger disabled).
So a caller that stops waiting does not close the connection, but leaves the connection here. The
connection is closed when the answer has arrived, when the peer has closed the connection, or after
LATE_TIMEOUT_S.
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

LATE_TIMEOUT_S = 60.0
"""Seconds in which a late answer must arrive."""
MOST_LATE = 256
"""The highest number of connections that wait. For a further connection the oldest is closed."""


class LateAnswers:
    """Waits for the late answers on connections, and closes the connections."""

    def __init__(self) -> None:
        self._waiting: dict[asyncio.Task[None], None] = {}
        self._ended = False

    def __len__(self) -> int:
        """How many connections wait for an answer."""
        return len(self._waiting)

    def wait(self, answer: Callable[[], Awaitable[object]], close: Callable[[], None]) -> None:
        """Await ``answer`` in the background, then call ``close`` to close the connection."""
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
        """Close all connections, and later connections at once."""
        self._ended = True
        waiting = list(self._waiting)
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)


async def _await_late(answer: Callable[[], Awaitable[object]]) -> None:
    with contextlib.suppress(Exception):  # no caller waits for the answer or the error
        async with asyncio.timeout(LATE_TIMEOUT_S):
            await answer()
