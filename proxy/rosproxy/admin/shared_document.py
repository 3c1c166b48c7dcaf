"""A document that is costly to make, made once for all callers that ask meanwhile.

A caller always gets a document whose making began after the call. So a caller that asks after an
action sees the effect of that action: a cache by age would answer with the state before it. What is
bounded is how often the document is made: after each making there is a pause, so that the making
takes no more than a share of the processor. Callers that ask in the pause wait for the next one,
and all of them get the same bytes.
"""

import asyncio
import time
from collections.abc import Callable
from typing import Generic, TypeVar

SHARE = 0.1
"""Share of a processor that the making of a document may take."""
LONGEST_PAUSE = 1.0
"""Seconds between two makings at most: an operator waits 3 s for an answer."""
Document = TypeVar("Document")


class SharedDocument(Generic[Document]):
    """What ``make`` returns, anew for each caller, and seldom. ``clock`` measures the making."""

    def __init__(
        self, make: Callable[[], Document], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._make = make
        self._clock = clock
        self._next: asyncio.Task[Document] | None = None
        self._due = 0.0

    async def newest(self) -> Document:
        """A document that is made from now on. Raises what ``make`` raises."""
        if self._next is None:
            self._next = asyncio.create_task(self._make_when_due())
        # A caller that goes away takes the document from no other caller.
        return await asyncio.shield(self._next)

    def close(self) -> None:
        """End the pause: callers that wait are cancelled."""
        if self._next is not None:
            self._next.cancel()

    async def _make_when_due(self) -> Document:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(self._due - loop.time())
        # The making has no await in it: a caller from now on gets the next document.
        self._next = None
        began = self._clock()
        try:
            return self._make()
        finally:
            pause = (self._clock() - began) * (1 / SHARE - 1)
            self._due = loop.time() + min(pause, LONGEST_PAUSE)
