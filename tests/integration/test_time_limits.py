"""Many time limits with one timer."""

import asyncio

import pytest

from rosproxy.net.time_limits import LOOK_INTERVAL_S, TimeLimit, TimeLimits
from tests.clock import pass_time


@pytest.fixture
def limits() -> TimeLimits:
    return TimeLimits()


async def wait(limits: TimeLimits, seconds: float) -> str:
    """Wait for what never comes."""
    try:
        with TimeLimit(limits, seconds):
            await asyncio.Event().wait()
    except TimeoutError:
        return "run out"
    return ""


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 2, 1)])
async def test_each_limit_runs_out_at_its_own_time(limits, order):
    waits = {seconds: asyncio.create_task(wait(limits, seconds)) for seconds in order}
    await asyncio.sleep(0)
    await pass_time(1.5)
    assert [seconds for seconds in sorted(order) if waits[seconds].done()] == [1]
    await pass_time(1)
    assert [seconds for seconds in sorted(order) if waits[seconds].done()] == [1, 2]
    assert await asyncio.gather(*waits.values()) == ["run out"] * 3


async def test_many_limits_are_looked_at_together(limits, monkeypatch):
    """A look at all limits for each that runs out costs the square of their number."""
    looks = list[int]()
    look = TimeLimits._look

    def count(limits, loop):
        looks.append(len(limits.running))
        look(limits, loop)

    monkeypatch.setattr(TimeLimits, "_look", count)
    waits = [asyncio.create_task(wait(limits, 1 + number / 100)) for number in range(100)]
    await asyncio.sleep(0)
    await pass_time(3)
    assert await asyncio.gather(*waits) == ["run out"] * 100
    assert len(looks) <= 1 + 1 / LOOK_INTERVAL_S + 1


async def test_what_ends_in_time_is_left_alone(limits):
    with TimeLimit(limits, 1):
        await asyncio.sleep(0.5)
    await pass_time(2)
    with TimeLimit(limits, 1):
        await asyncio.sleep(0.5)


async def test_a_task_that_is_cancelled_has_not_run_out(limits):
    task = asyncio.create_task(wait(limits, 1))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
