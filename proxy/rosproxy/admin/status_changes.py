"""Waits for changes of the proxy's state, so that callers need not poll.

The state is in many modules, which do not report changes. So the proxy polls the state for each
waiting caller: twice a second at most, and with at most a hundredth of a processor.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import cached_property

from rosproxy.admin.status_version import version_of
from rosproxy.net.fair_slots import FairSlots
from rosproxy.shared.documents.status_bounds import encode
from rosproxy.shared.documents.status_document import ProxyStatus

POLL_INTERVAL = 0.5
"""Shortest time between two polls for a caller, in seconds."""
SHARE = 0.01
"""Share of a processor that polling may take for each waiting caller."""
LONGEST_WAIT_S = 1800.0
"""Longest wait of a caller, in seconds, even if the caller asks for more."""
MOST_WAITING = 8
"""Callers that may wait at the same time: a single operator, or a few while operators restart."""
MOST_WAITING_EACH = 4
"""Callers from one address that may wait at the same time."""


@dataclass(frozen=True)
class StatusSnapshot:
    """The state at one moment, and the same state as JSON. ``took``: seconds to make both."""

    status: ProxyStatus
    body: bytes
    took: float

    @classmethod
    def take(cls, state: Callable[[], ProxyStatus]) -> "StatusSnapshot":
        """A snapshot of the current state."""
        began = time.perf_counter()
        status = state()
        return cls(status, encode(status), time.perf_counter() - began)

    @cached_property
    def version(self) -> str:
        """The version of the state (`version_of`), which callers compare."""
        return version_of(self.status)


class StatusChanges:
    """Lets callers wait until the state has another version.

    ``newest`` returns a snapshot of the current state. Callers take one of ``slots`` while waiting.
    """

    def __init__(self, newest: Callable[[], Awaitable[StatusSnapshot]]) -> None:
        self._newest = newest
        self._ending = asyncio.Event()
        self.slots = FairSlots(
            "callers wait for a change", MOST_WAITING, MOST_WAITING_EACH, "ask /status instead"
        )

    def end(self) -> None:
        """Answer all waiting callers now, and later callers at once."""
        self._ending.set()

    async def after(
        self, since: str, within: float, connected: Callable[[], bool]
    ) -> StatusSnapshot:
        """Return a snapshot once the version of the state differs from ``since``.

        Return earlier after ``within`` seconds, after `end`, or when the caller is no longer
        ``connected``. An infinite or NaN ``within`` counts as 0.
        """
        clock = asyncio.get_running_loop().time
        until = clock() + (min(within, LONGEST_WAIT_S) if math.isfinite(within) else 0.0)
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
