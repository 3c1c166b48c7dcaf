"""The times of looks, by a clock that jumps to the next awaited time.

``await asyncio.sleep(3600)`` takes no time then. Nothing may happen in threads or on sockets.
"""

import asyncio
import contextlib
import functools
import logging
import selectors
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import pytest

from rosproxy_operator.common.control_loop import ControlLoop, LookFailed, LookImpossible, Pace
from rosproxy_operator.common.operator_metrics import DockerMetrics

PACE = Pace("engine", resync=30.0, debounce=0.1, timeout=60.0)
AWAY = LookFailed("no engine", away=True)


class JumpingSelector(selectors.DefaultSelector):
    """Adds to ``now`` what would be waited for nothing."""

    now = 1000.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready and timeout:
            self.now += timeout
        return ready


class JumpingLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self.jumping = JumpingSelector()
        super().__init__(self.jumping)

    def time(self) -> float:
        return self.jumping.now


def in_jumping_time(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    @functools.wraps(test)
    def run(*given: Any, **named: Any) -> None:
        with asyncio.Runner(loop_factory=JumpingLoop) as runner:
            runner.run(test(*given, **named))

    return run


class Looks:
    """Notes the time of each look. The first looks raise ``errors`` in turn."""

    def __init__(
        self,
        *errors: Exception,
        then: Callable[[], float | None] = lambda: None,
        takes: float = 0.0,
    ) -> None:
        self.errors = list(errors)
        self.then = then
        self.takes = takes
        self.metrics = DockerMetrics()
        self.loop = ControlLoop(PACE, self.metrics)
        self.start = asyncio.get_running_loop().time()
        self.times: list[float] = []

    async def look(self) -> float | None:
        self.times.append(self.now())
        await asyncio.sleep(self.takes)
        if self.errors:
            raise self.errors.pop(0)
        return self.then()

    def now(self) -> float:
        return round(asyncio.get_running_loop().time() - self.start, 3)

    def counted(self, outcome: str) -> float:
        labels = {"outcome": outcome}
        value = self.metrics.registry.get_sample_value("rosproxy_operator_looks_total", labels)
        return value or 0.0


@contextlib.asynccontextmanager
async def looking(*errors: Exception, **more: Any) -> AsyncIterator[Looks]:
    looks = Looks(*errors, **more)
    looks.loop.wake_threadsafe()  # the loop does not run yet
    assert looks.loop.unready() == "the operator has not looked at the engine yet"
    task = asyncio.create_task(looks.loop.run(looks.look))
    await asyncio.sleep(0)
    yield looks
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


@in_jumping_time
async def test_it_looks_at_once_and_then_every_resync() -> None:
    async with looking() as looks:
        await asyncio.sleep(61)
        assert looks.times == [0.0, 30.0, 60.0]


@in_jumping_time
async def test_it_ends_where_no_look_can_succeed() -> None:
    looks = Looks(AWAY, LookImpossible("a former engine", away=True))
    with pytest.raises(LookImpossible):
        await looks.loop.run(looks.look)
    assert len(looks.times) == 2


@in_jumping_time
async def test_it_looks_sooner_if_the_look_says_so() -> None:
    async with looking(then=lambda: 5.0) as looks:
        await asyncio.sleep(11)
        assert looks.times == [0.0, 5.0, 10.0]


@in_jumping_time
async def test_a_burst_of_events_costs_one_look() -> None:
    async with looking() as looks:
        await asyncio.sleep(1)
        for _ in range(50):
            looks.loop.wake()
            await asyncio.sleep(0.001)
        await asyncio.sleep(1)
        assert len(looks.times) == 3  # at once, and once more for what came after that look
        looks.times.clear()
        looks.loop.wake()
        looks.loop.wake()
        await asyncio.sleep(1)
        assert len(looks.times) == 1


@in_jumping_time
async def test_looks_keep_apart() -> None:
    async with looking() as looks:
        for _ in range(100):
            looks.loop.wake()
            await asyncio.sleep(0.01)
        apart = [b - a for a, b in zip(looks.times, looks.times[1:], strict=False)]
        assert apart
        assert min(apart) >= 0.099


@in_jumping_time
async def test_what_happens_during_a_look_is_looked_at_again() -> None:
    async with looking(takes=2.0) as looks:
        await asyncio.sleep(1)
        looks.loop.wake()
        await asyncio.sleep(2)
        assert looks.times == [0.0, 2.1]


@in_jumping_time
async def test_a_later_look_is_put_off_by_the_next() -> None:
    async with looking() as looks:
        await asyncio.sleep(1)
        looks.loop.wake_in(0.25)
        await asyncio.sleep(0.2)
        looks.loop.wake_in(0.25)
        await asyncio.sleep(1)
        assert looks.times == [0.0, 1.45]


@in_jumping_time
async def test_it_can_be_woken_from_another_thread() -> None:
    async with looking() as looks:
        await asyncio.sleep(1)
        looks.loop.wake_threadsafe()
        await asyncio.sleep(1)
        assert looks.times == [0.0, 1.0]


@in_jumping_time
async def test_pauses_grow_while_looks_fail_and_events_do_not_shorten_them() -> None:
    async with looking(*[AWAY] * 7) as looks:
        for _ in range(400):
            looks.loop.wake()
            await asyncio.sleep(0.1)
        assert looks.times[:8] == [0.0, 0.5, 1.5, 3.5, 8.5, 18.5, 28.5, 38.5]
        assert looks.counted("unavailable") == 7
        assert looks.loop.unready() is None


@in_jumping_time
async def test_an_engine_that_is_back_is_asked_at_once() -> None:
    async with looking(*[AWAY] * 6) as looks:
        await asyncio.sleep(20)
        assert looks.times[-1] == 18.5
        looks.loop.retry()
        await asyncio.sleep(1)
        assert looks.times[-1] == 20.0
        assert looks.loop.unready() is None


@in_jumping_time
async def test_a_failure_is_told_once_and_so_is_its_end(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with looking(*[AWAY] * 3, LookFailed("not allowed")) as looks:
        await asyncio.sleep(3)
        assert looks.loop.unready() == "no engine"
        await asyncio.sleep(60)
        assert (looks.counted("unavailable"), looks.counted("failed")) == (3, 1)
        told = [(record.levelname, record.message) for record in caplog.records]
        assert told == [
            ("WARNING", "no engine"),
            ("ERROR", "not allowed"),
            ("INFO", "looks succeed again"),
        ]


@in_jumping_time
async def test_a_mistake_of_ours_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    async with looking(RuntimeError("oops"), RuntimeError("oops")) as looks:
        await asyncio.sleep(0.1)
        assert looks.loop.unready() == "the operator failed: RuntimeError('oops')"
        await asyncio.sleep(10)
        assert looks.loop.unready() is None
        assert looks.counted("failed") == 2
        assert caplog.text.count("Traceback") == 1


@in_jumping_time
async def test_a_look_that_takes_too_long_is_given_up() -> None:
    async with looking(takes=100.0) as looks:
        await asyncio.sleep(60.2)
        assert looks.loop.unready() == "a look at the engine took more than 60 s"
        looks.takes = 0.0
        await asyncio.sleep(1)
        assert looks.loop.unready() is None


@in_jumping_time
async def test_a_look_that_cannot_be_given_up_is_dead() -> None:
    async def stubborn() -> float | None:
        for _ in range(80):
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.sleep(1)
        return None

    loop = ControlLoop(PACE, DockerMetrics())
    task = asyncio.create_task(loop.run(stubborn))
    await asyncio.sleep(59.5)
    assert loop.dead() is None
    await asyncio.sleep(3)
    assert loop.dead() == "a look at the engine has lasted for 62 s"
    await asyncio.sleep(30)
    assert loop.dead() is None
    task.cancel()


@in_jumping_time
async def test_an_event_loop_that_hangs_is_dead() -> None:
    async with looking() as looks:
        await asyncio.sleep(5.5)
        loop = asyncio.get_running_loop()
        assert isinstance(loop, JumpingLoop)
        assert looks.loop.dead() is None
        loop.jumping.now += 24.5
        assert looks.loop.dead() == "the event loop has not run for 25 s"
        await asyncio.sleep(2)
        assert looks.loop.dead() is None


@in_jumping_time
async def test_run_until_all_is_settled() -> None:
    looks = Looks()
    await looks.loop.run_until(looks.look, lambda: len(looks.times) == 3, 60)
    assert looks.times == [0.0, 1.0, 2.0]


@in_jumping_time
async def test_run_until_the_time_is_over() -> None:
    looks = Looks(LookFailed("not allowed"))
    await looks.loop.run_until(looks.look, lambda: False, 60)
    assert looks.now() == 60.0
    assert looks.loop.unready() is None


@in_jumping_time
async def test_run_until_ends_where_no_engine_is() -> None:
    looks = Looks(AWAY)
    with pytest.raises(LookFailed, match="no engine"):
        await looks.loop.run_until(looks.look, lambda: True, 60)


@in_jumping_time
async def test_run_until_tells_mistakes_of_ours() -> None:
    looks = Looks(RuntimeError("oops"))
    with pytest.raises(RuntimeError):
        await looks.loop.run_until(looks.look, lambda: True, 60)


@in_jumping_time
async def test_who_wants_a_new_look_gets_one_that_began_afterwards() -> None:
    async with looking(takes=2.0) as looks:
        await asyncio.sleep(1)
        await looks.loop.look_anew()
        assert (looks.times, looks.now()) == ([0.0, 2.1], 4.1)


@in_jumping_time
async def test_all_who_want_a_new_look_share_it() -> None:
    async with looking() as looks:
        await asyncio.sleep(1)
        given_up = asyncio.create_task(looks.loop.look_anew())
        await asyncio.sleep(0)
        given_up.cancel()
        await asyncio.gather(looks.loop.look_anew(), looks.loop.look_anew())
        assert looks.times == [0.0, 1.0]


@in_jumping_time
async def test_a_new_look_that_fails_is_told() -> None:
    async with looking() as looks:
        await asyncio.sleep(1)
        looks.errors.append(AWAY)
        with pytest.raises(LookFailed, match="no engine"):
            await looks.loop.look_anew()


@in_jumping_time
async def test_nobody_waits_for_an_engine_that_is_away() -> None:
    async with looking(*[AWAY] * 20) as looks:
        await asyncio.sleep(30)
        with pytest.raises(LookFailed, match="no engine"):
            await looks.loop.look_anew()
        assert looks.now() == 30.0
