"""The loop of an operator, for any engine: look, act, and wait for a reason to look again.

A reason is an event (`wake`), a time (`wake_in`, or the result of the look), or the end of the
resync interval (`Pace`). A look is level-triggered: each look reads the whole state. So an event
needs no content, and a burst of events costs a single look.

After a failed look, the loop pauses (`RETRY_PAUSES_S`). Events do not shorten the pause, because
more requests do not help an engine that does not answer. `retry` ends the pause: the engine is
back.

The loop does not depend on the engine. All times are times of the event loop's clock, so tests can
advance the clock.
"""

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass

from rosproxy_operator.common.operator_metrics import CommonMetrics

log = logging.getLogger(__name__)

RETRY_PAUSES_S = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Seconds from a failed look to the next look; the last value repeats."""
BEAT_INTERVAL_S = 1.0
"""Seconds between two beats. A beat notes that the event loop runs."""
HANGING_AFTER_S = 20.0
"""Seconds without a beat after which the event loop counts as hanging."""

UNSETTLED_RECHECK_S = 1.0
"""Seconds from a successful look of `ControlLoop.run_until` to the next look without an event."""

Look = Callable[[], Awaitable[float | None]]
"""Looks and acts. Returns the longest time in seconds to the next look; None: the resync interval.

Raises LookFailed."""


class LookFailed(Exception):
    """A look failed; the message has one line. ``is_engine_away``: the engine does not answer."""

    def __init__(self, message: str, away: bool = False) -> None:
        super().__init__(message)
        self.is_engine_away = away


class LookImpossible(LookFailed):
    """No look of this process can succeed any more, so the process must end."""


@dataclass(frozen=True, slots=True)
class Pace:
    """The times of a loop, in seconds, and the name of the engine.

    After a successful look, ``resync`` is the longest time to the next look. ``debounce`` is the
    shortest time between two looks. After ``timeout`` the loop cancels a look. ``engine`` is the
    word for the engine in messages.
    """

    engine: str
    resync: float
    debounce: float
    timeout: float


class ControlLoop:
    """Looks again and again. Call `wake`, `wake_in` and `retry` only in the event loop's thread."""

    def __init__(self, pace: Pace, metrics: CommonMetrics) -> None:
        self._pace = pace
        self._metrics = metrics
        self._woken = asyncio.Event()
        self._back = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._failures = 0
        self._error: str | None = f"the operator has not looked at the {pace.engine} yet"
        self._again_in: float | None = None
        self._looking_since: float | None = None
        self._looked_at = self._beat_at = 0.0
        self._awaiting_look: list[asyncio.Future[None]] = []

    async def run(self, look: Look) -> None:
        """Look until cancelled. Raises LookImpossible.

        The loop goes on after an unexpected error, because a bug must not end the operator.
        """
        async with self._alive():
            while True:
                try:
                    await self._try(look)
                except LookImpossible:
                    raise
                except Exception as error:
                    if not self._failures:
                        log.exception("look failed by an internal error, the operator goes on")
                    self._failed(LookFailed(f"the operator failed: {error!r}"))
                await self._pause(self._pace.resync)

    async def run_until(self, look: Look, settled: Callable[[], bool], seconds: float) -> None:
        """Look until a look succeeds and ``settled()`` is true, for at most ``seconds``.

        Raises LookFailed if a look reports that the engine is away, and LookImpossible.
        """
        async with self._alive():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    while not (await self._try(look, patient=False) and settled()):
                        await self._pause(UNSETTLED_RECHECK_S)

    @property
    def woken(self) -> bool:
        """Whether there is a reason for another look."""
        return self._woken.is_set()

    def wake(self) -> None:
        """Look again soon."""
        self._woken.set()

    def wake_threadsafe(self) -> None:
        """Look again soon. Any thread may call this; before `run`, it has no effect."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the event loop has ended
                self._loop.call_soon_threadsafe(self._woken.set)

    def wake_in(self, seconds: float) -> None:
        """Look again in ``seconds``. A further call replaces the time of the previous call."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(seconds, self._woken.set)

    def retry(self) -> None:
        """Look again soon, also after a failed look: the engine is back."""
        self._woken.set()
        self._back.set()

    async def look_anew(self) -> None:
        """Wait for the end of a look that begins after this call.

        Raises LookFailed if this look fails. Also raises LookFailed, at once, if the previous look
        failed: the loop may then pause for up to 10 s before the next look.
        """
        if self._failures:
            raise LookFailed(self._error or "")
        ended = asyncio.get_running_loop().create_future()
        self._awaiting_look.append(ended)
        self.wake()
        await ended
        if self._error is not None:
            raise LookFailed(self._error)

    def dead(self) -> str | None:
        """Return why the loop hangs; None if it is alive or not started. Works in any thread."""
        if self._loop is None:
            return None
        now = self._loop.time()
        since = self._looking_since
        if now - self._beat_at > HANGING_AFTER_S:
            return f"the event loop has not run for {now - self._beat_at:.0f} s"
        if since is not None and now - since > self._pace.timeout:
            return f"a look at the {self._pace.engine} has lasted for {now - since:.0f} s"
        return None

    def unready(self) -> str | None:
        """Return why the last look failed, or that no look has ended; None after a success."""
        return self._error

    async def _try(self, look: Look, patient: bool = True) -> bool:
        """Look once. Return whether the look succeeded.

        Raises LookImpossible. Without ``patient``, also raises LookFailed if the look reports that
        the engine is away. A look that takes too long only counts as failed.
        """
        self._woken.clear()
        self._back.clear()
        awaiting = self._awaiting_look  # later callers wait for the next look
        self._awaiting_look = []
        self._looking_since = asyncio.get_running_loop().time()
        try:
            async with asyncio.timeout(self._pace.timeout):
                self._again_in = await look()
        except TimeoutError:
            reason = f"a look at the {self._pace.engine} took more than {self._pace.timeout:.0f} s"
            self._failed(LookFailed(reason, away=True))
        except LookFailed as error:
            is_final = isinstance(error, LookImpossible)
            if is_final or (error.is_engine_away and not patient):
                raise  # the caller reports the error
            self._failed(error)
        else:
            if self._failures:
                log.info("looks succeed again")
            self._failures = 0
            self._error = None
            self._metrics.looks.labels("ok").inc()
            self._metrics.up.set(1)
        finally:
            self._looking_since = None
            self._looked_at = asyncio.get_running_loop().time()
            for ended in awaiting:
                if not ended.done():  # a caller may have stopped waiting
                    ended.set_result(None)
        return not self._failures

    def _failed(self, error: LookFailed) -> None:
        if str(error) != self._error:
            log.log(logging.WARNING if error.is_engine_away else logging.ERROR, "%s", error)
        self._failures += 1
        self._error = str(error)
        self._metrics.looks.labels("unavailable" if error.is_engine_away else "failed").inc()
        self._metrics.up.set(0 if error.is_engine_away else 1)

    async def _pause(self, resync: float) -> None:
        """Wait until the next look is due."""
        if self._failures:
            reason = self._back
            seconds = RETRY_PAUSES_S[min(self._failures, len(RETRY_PAUSES_S)) - 1]
        else:
            reason = self._woken
            seconds = resync if self._again_in is None else min(resync, self._again_in)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await reason.wait()
        now = asyncio.get_running_loop().time()
        # Events during this sleep cause no further look: `_try` clears `_woken` before the look.
        await asyncio.sleep(self._looked_at + self._pace.debounce - now)

    @contextlib.asynccontextmanager
    async def _alive(self) -> AsyncIterator[None]:
        self._loop = asyncio.get_running_loop()
        self._beat_at = self._loop.time()
        beating = asyncio.create_task(self._beat(self._loop))
        try:
            yield
        finally:
            beating.cancel()
            if self._timer is not None:
                self._timer.cancel()

    async def _beat(self, loop: asyncio.AbstractEventLoop) -> None:
        while True:
            self._beat_at = loop.time()
            await asyncio.sleep(BEAT_INTERVAL_S)
