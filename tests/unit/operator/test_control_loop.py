"""When the loop looks, by a clock that jumps."""

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from rosproxy_operator.common.control_loop import ControlLoop, LookFailed, Pace
from rosproxy_operator.common.metrics import DockerMetrics
from tests.unit.operator.fake_time import FakeTimeLoop, run

PACE = Pace("engine", resync=30.0, debounce=0.1, longest=60.0)


class Looks:
    """Notes when there was a look, and does what ``then`` says at each."""

    def __init__(self) -> None:
        self.metrics = DockerMetrics()
        self.loop = ControlLoop(PACE, self.metrics)
        self.start = asyncio.get_running_loop().time()
        self.times: list[float] = []
        self.then: Callable[[], float | None] = lambda: None
        self.takes = 0.0

    async def look(self) -> float | None:
        self.times.append(self.now())
        if self.takes:
            await asyncio.sleep(self.takes)
        return self.then()

    def now(self) -> float:
        return round(asyncio.get_running_loop().time() - self.start, 3)

    def fail(self, *errors: Exception) -> None:
        """Let the next looks fail, one after the other."""
        left = list(errors)

        def then() -> None:
            if left:
                raise left.pop(0)

        self.then = then

    def counted(self, outcome: str) -> float:
        labels = {"outcome": outcome}
        value = self.metrics.registry.get_sample_value("rosproxy_operator_looks_total", labels)
        return value or 0.0


@contextlib.asynccontextmanager
async def looking(**more: Any) -> AsyncIterator[Looks]:
    looks = Looks()
    for name, value in more.items():
        setattr(looks, name, value)
    task = asyncio.create_task(looks.loop.run(looks.look))
    await asyncio.sleep(0)
    yield looks
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def test_it_looks_at_once_and_then_every_resync() -> None:
    async def main() -> None:
        async with looking() as looks:
            await asyncio.sleep(61)
            assert looks.times == [0.0, 30.0, 60.0]

    run(main())


def test_it_looks_sooner_if_the_look_says_so() -> None:
    async def main() -> None:
        async with looking(then=lambda: 5.0) as looks:
            await asyncio.sleep(11)
            assert looks.times == [0.0, 5.0, 10.0]

    run(main())


def test_a_burst_of_events_costs_one_look() -> None:
    async def main() -> None:
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

    run(main())


def test_looks_keep_apart() -> None:
    async def main() -> None:
        async with looking() as looks:
            for _ in range(100):
                looks.loop.wake()
                await asyncio.sleep(0.01)
            apart = [b - a for a, b in zip(looks.times, looks.times[1:], strict=False)]
            assert apart
            assert min(apart) >= 0.099

    run(main())


def test_what_happens_during_a_look_is_looked_at_again() -> None:
    async def main() -> None:
        async with looking(takes=2.0) as looks:
            await asyncio.sleep(1)
            looks.loop.wake()
            await asyncio.sleep(2)
            assert looks.times == [0.0, 2.1]

    run(main())


def test_a_later_look_is_put_off_by_the_next() -> None:
    async def main() -> None:
        async with looking() as looks:
            await asyncio.sleep(1)
            looks.loop.wake_in(0.25)
            await asyncio.sleep(0.2)
            looks.loop.wake_in(0.25)
            await asyncio.sleep(1)
            assert looks.times == [0.0, 1.45]

    run(main())


def test_it_can_be_woken_from_another_thread() -> None:
    async def main() -> None:
        looks = Looks()
        looks.loop.wake_threadsafe()  # nobody looks yet
        task = asyncio.create_task(looks.loop.run(looks.look))
        await asyncio.sleep(1)
        looks.loop.wake_threadsafe()
        await asyncio.sleep(1)
        assert looks.times == [0.0, 1.0]
        task.cancel()

    run(main())


def test_pauses_grow_while_looks_fail_and_events_do_not_shorten_them() -> None:
    async def main() -> None:
        looks = Looks()
        looks.fail(*[LookFailed("no engine", away=True)] * 7)
        task = asyncio.create_task(looks.loop.run(looks.look))
        for _ in range(400):
            looks.loop.wake()
            await asyncio.sleep(0.1)
        assert looks.times[:8] == [0.0, 0.5, 1.5, 3.5, 8.5, 18.5, 28.5, 38.5]
        assert looks.counted("unavailable") == 7
        assert looks.loop.unready() is None
        task.cancel()

    run(main())


def test_an_engine_that_is_back_is_asked_at_once() -> None:
    async def main() -> None:
        looks = Looks()
        looks.fail(*[LookFailed("no engine", away=True)] * 6)
        task = asyncio.create_task(looks.loop.run(looks.look))
        await asyncio.sleep(20)
        assert looks.times[-1] == 18.5
        looks.loop.retry()
        await asyncio.sleep(1)
        assert looks.times[-1] == 20.0
        assert looks.loop.unready() is None
        task.cancel()

    run(main())


def test_a_failure_is_told_once_and_so_is_its_end(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)

    async def main() -> None:
        looks = Looks()
        looks.fail(*[LookFailed("no engine", away=True)] * 3, LookFailed("not allowed"))
        assert looks.loop.unready() == "has not looked yet"
        task = asyncio.create_task(looks.loop.run(looks.look))
        await asyncio.sleep(3)
        assert looks.loop.unready() == "no engine"
        await asyncio.sleep(60)
        assert (looks.counted("unavailable"), looks.counted("failed")) == (3, 1)
        task.cancel()

    run(main())
    told = [(record.levelname, record.message) for record in caplog.records]
    assert told == [
        ("WARNING", "no engine"),
        ("ERROR", "not allowed"),
        ("INFO", "looking works again"),
    ]


def test_a_mistake_of_ours_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    async def main() -> None:
        looks = Looks()
        looks.fail(RuntimeError("oops"), RuntimeError("oops"))
        task = asyncio.create_task(looks.loop.run(looks.look))
        await asyncio.sleep(0.1)
        assert looks.loop.unready() == "the operator failed: RuntimeError('oops')"
        await asyncio.sleep(10)
        assert looks.loop.unready() is None
        assert looks.counted("failed") == 2
        task.cancel()

    run(main())
    assert caplog.text.count("Traceback") == 1


def test_a_look_that_takes_too_long_is_given_up() -> None:
    async def main() -> None:
        async with looking(takes=100.0) as looks:
            await asyncio.sleep(60.2)
            assert looks.loop.unready() == "the engine took more than 60 s"
            looks.takes = 0.0
            await asyncio.sleep(1)
            assert looks.loop.unready() is None

    run(main())


def test_a_look_that_cannot_be_given_up_is_dead() -> None:
    async def main() -> None:
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
        assert loop.dead() == "looking at the engine for 62 s"
        await asyncio.sleep(30)
        assert loop.dead() is None
        task.cancel()

    run(main())


def test_an_event_loop_that_hangs_is_dead() -> None:
    async def main() -> None:
        async with looking() as looks:
            await asyncio.sleep(5.5)
            loop = asyncio.get_running_loop()
            assert isinstance(loop, FakeTimeLoop)
            assert looks.loop.dead() is None
            loop.hang(24.5)
            assert looks.loop.dead() == "the event loop has not run for 25 s"
            await asyncio.sleep(2)
            assert looks.loop.dead() is None

    run(main())


def test_run_until_all_is_settled() -> None:
    async def main() -> None:
        looks = Looks()
        await looks.loop.run_until(looks.look, lambda: len(looks.times) == 3, 60)
        assert looks.times == [0.0, 1.0, 2.0]

    run(main())


def test_run_until_the_time_is_over() -> None:
    async def main() -> None:
        looks = Looks()
        looks.fail(LookFailed("not allowed"))
        await looks.loop.run_until(looks.look, lambda: False, 60)
        assert looks.now() == 60.0
        assert looks.loop.unready() is None

    run(main())


def test_run_until_ends_where_no_engine_is() -> None:
    async def main() -> None:
        looks = Looks()
        looks.fail(LookFailed("no engine", away=True))
        with pytest.raises(LookFailed, match="no engine"):
            await looks.loop.run_until(looks.look, lambda: True, 60)

    run(main())


def test_run_until_tells_mistakes_of_ours() -> None:
    async def main() -> None:
        looks = Looks()
        looks.fail(RuntimeError("oops"))
        with pytest.raises(RuntimeError):
            await looks.loop.run_until(looks.look, lambda: True, 60)

    run(main())
