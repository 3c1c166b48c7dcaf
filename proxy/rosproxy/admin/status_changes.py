"""Waiting for a change of the proxy's state, so that nobody has to ask for it again and again.

The state is in many places, none of which knows who waits. So it is polled while somebody waits: at
most twice a second, and seldom enough to cost a hundredth of a processor.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Callable

from rosproxy.admin.status_document import ProxyStatus
from rosproxy.admin.status_news import version_of

POLL_INTERVAL = 0.5
"""Seconds between two looks at the state, at least."""
SHARE = 0.01
"""Share of a processor that polling may cost for each caller that waits."""
LONGEST = 300.0
"""Seconds that a caller may wait."""
MOST_WAITING = 4
"""Callers that may wait at the same time: operators, one after the other."""


class TooManyWaiting(Exception):
    """Too many wait already."""


class StatusChanges:
    """Lets callers wait until the state differs from the one that they know."""

    def __init__(self, status: Callable[[], ProxyStatus]) -> None:
        self._status = status
        self._waiting = 0
        self._ending = asyncio.Event()

    def end(self) -> None:
        """Let nobody wait any longer."""
        self._ending.set()

    async def after(
        self, since: str, within: float, connected: Callable[[], bool]
    ) -> tuple[str, ProxyStatus]:
        """The state and its version, once that is another one than ``since``.

        Or after ``within`` seconds, or once the caller is no longer ``connected``.
        Raises TooManyWaiting.
        """
        if self._waiting >= MOST_WAITING:
            raise TooManyWaiting
        self._waiting += 1
        try:
            clock = asyncio.get_running_loop().time
            until = clock() + (min(within, LONGEST) if math.isfinite(within) else 0.0)
            while True:
                began = time.perf_counter()
                status = self._status()
                version, took = version_of(status), time.perf_counter() - began
                if version != since or clock() >= until or self._ending.is_set() or not connected():
                    return version, status
                await self._pause(min(max(POLL_INTERVAL, took / SHARE), until - clock()))
        finally:
            self._waiting -= 1

    async def _pause(self, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._ending.wait()
