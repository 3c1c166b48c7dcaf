"""Waiting for a change of the proxy's state, so that nobody has to ask for it again and again.

The state is in many places, none of which knows who waits. So it is polled while somebody waits: at
most twice a second, and seldom enough to cost a hundredth of a processor.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import cached_property

from rosproxy.admin.status_bounds import encode
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.admin.status_version import version_of
from rosproxy.net.fair_slots import FairSlots

POLL_INTERVAL = 0.5
"""Seconds between two looks at the state, at least."""
SHARE = 0.01
"""Share of a processor that polling may cost for each caller that waits."""
LONGEST = 1800.0
"""Seconds that a caller may wait."""
MOST_WAITING = 8
"""Callers that may wait at the same time: operators, one after the other."""
MOST_WAITING_EACH = 4
"""The same from one address."""


@dataclass(frozen=True)
class StatusSnapshot:
    """The state at one moment, as JSON, and the seconds that it took to make it."""

    status: ProxyStatus
    body: bytes
    took: float

    @classmethod
    def take(cls, state: Callable[[], ProxyStatus]) -> "StatusSnapshot":
        """The state as it is now."""
        began = time.perf_counter()
        status = state()
        return cls(status, encode(status), time.perf_counter() - began)

    @cached_property
    def version(self) -> str:
        """What callers compare; see `version_of`."""
        return version_of(self.status)


class StatusChanges:
    """Lets callers wait until the state differs from the one that they know.

    ``newest`` gives the state as it is now; ``slots`` is what callers take while they wait.
    """

    def __init__(self, newest: Callable[[], Awaitable[StatusSnapshot]]) -> None:
        self._newest = newest
        self._ending = asyncio.Event()
        self.slots = FairSlots(
            "callers wait for a change", MOST_WAITING, MOST_WAITING_EACH, "ask /status instead"
        )

    def end(self) -> None:
        """Let nobody wait any longer."""
        self._ending.set()

    async def after(
        self, since: str, within: float, connected: Callable[[], bool]
    ) -> StatusSnapshot:
        """The state, once its version is another one than ``since``.

        Or after ``within`` seconds, or once the caller is no longer ``connected``.
        """
        clock = asyncio.get_running_loop().time
        until = clock() + (min(within, LONGEST) if math.isfinite(within) else 0.0)
        while True:
            snapshot = await self._newest()
            is_over = clock() >= until or self._ending.is_set() or not connected()
            if snapshot.version != since or is_over:
                return snapshot
            await self._pause(min(max(POLL_INTERVAL, snapshot.took / SHARE), until - clock()))

    async def _pause(self, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._ending.wait()
