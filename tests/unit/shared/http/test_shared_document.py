"""A costly document: made once for all waiting callers, seldom, and only on request."""

import asyncio

import pytest

from rosproxy.shared.http.shared_document import LONGEST_PAUSE, SHARE, SharedDocument
from tests.clock import PatientLoop


class Maker:
    """Makes a document of the ``state``, in ``took`` seconds of a separate clock."""

    def __init__(self, took: float = 0.0) -> None:
        self.took = took
        self.state = 0
        self.made_at: list[float] = []
        self._ticks = 0.0
        self.document = SharedDocument(self._make, lambda: self._ticks)

    def _make(self) -> int:
        self.made_at.append(asyncio.get_running_loop().time())
        self._ticks += self.took
        return self.state


async def test_all_that_ask_at_once_get_one_document() -> None:
    maker = Maker()
    assert await asyncio.gather(*(maker.document.newest() for _ in range(8))) == [0] * 8
    assert len(maker.made_at) == 1


async def test_a_caller_sees_what_was_done_before_it_asked() -> None:
    """Also in the pause: a former document is never given again."""
    maker = Maker(took=0.001)
    for state in range(1, 20):
        maker.state = state
        assert await maker.document.newest() == state


@pytest.mark.parametrize("took", [0.01, 5.0])
def test_the_making_takes_no_more_than_its_share(took: float) -> None:
    maker = Maker(took)

    async def ask() -> None:
        for _ in range(5):
            await asyncio.gather(*(maker.document.newest() for _ in range(8)))

    with asyncio.Runner(loop_factory=PatientLoop) as runner:
        runner.run(ask())
    pause = min(took * (1 / SHARE - 1), LONGEST_PAUSE)
    pauses = [
        after - before for before, after in zip(maker.made_at, maker.made_at[1:], strict=False)
    ]
    assert len(pauses) == 4
    assert min(pauses) >= pause * 0.999


async def test_a_caller_that_goes_away_takes_nothing_from_others() -> None:
    maker = Maker()
    asking = [asyncio.create_task(maker.document.newest()) for _ in range(2)]
    await asyncio.sleep(0)
    asking[0].cancel()
    assert await asking[1] == 0


async def test_a_mistake_is_told_and_forgotten() -> None:
    outcomes = iter([0, 7])

    def make() -> int:
        outcome = next(outcomes)
        if not outcome:
            raise ValueError("a mistake")
        return outcome

    document = SharedDocument(make)
    with pytest.raises(ValueError, match="a mistake"):
        await document.newest()
    assert await document.newest() == 7
