"""A document that is costly to make: callers that ask at the same time share a document.

A caller always gets a document that is made after the call. So a caller that asks after an action
sees the effect of that action. A cache by age could answer with the earlier state.

After each document there is a pause, so that documents take at most SHARE of the processor. They
take more only if LONGEST_PAUSE cuts the pause short. Callers that ask in the pause wait for the
next document, and all these callers get the same document.
"""

import asyncio
import time
from collections.abc import Callable
from typing import Generic, TypeVar

SHARE = 0.1
"""Share of a processor that the documents take, unless LONGEST_PAUSE cuts the pause short."""
LONGEST_PAUSE = 1.0
"""Longest pause, in seconds: an operator waits 3 s for an answer."""
Document = TypeVar("Document")


class SharedDocument(Generic[Document]):
    """The document that ``make`` returns. ``clock`` (seconds) measures how long ``make`` takes."""

    def __init__(
        self, make: Callable[[], Document], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._make = make
        self._clock = clock
        self._next: asyncio.Task[Document] | None = None
        self._due = 0.0

    async def newest(self) -> Document:
        """A document that is made after this call. Raises the exceptions of ``make``."""
        if self._next is None:
            self._next = asyncio.create_task(self._make_when_due())
        # Shielded: other callers may wait for the document of a caller that has gone.
        return await asyncio.shield(self._next)

    def close(self) -> None:
        """End the pause. Waiting callers get CancelledError."""
        if self._next is not None:
            self._next.cancel()

    async def _make_when_due(self) -> Document:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(self._due - loop.time())
        # `make` does not await: a caller from now on gets the next document.
        self._next = None
        began = self._clock()
        try:
            return self._make()
        finally:
            pause = (self._clock() - began) * (1 / SHARE - 1)
            self._due = loop.time() + min(pause, LONGEST_PAUSE)
