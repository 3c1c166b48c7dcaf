"""Questions to the master for publishers: one at a time, and an answer for each caller."""

import asyncio
from collections.abc import Iterable
from typing import Any

import pytest

from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.stand_ins.publisher_lookup import LONGEST_PAUSE_S, PublisherLookup

TOPICS = ("/a", "/b", "/c", "/d")


class SlowMaster:
    """A master that answers when a test allows it. ``questions`` are the nodes looked up."""

    def __init__(self) -> None:
        self.questions: list[set[str]] = []
        self.answers = asyncio.Semaphore(0)
        self.is_down = False
        self.processor_time = 0.0
        self.cost = 0.0

    async def read_changes(self, _: bytes) -> tuple[bytes, dict[str, list[Registration]]]:
        await self.answers.acquire()
        self.processor_time += self.cost
        if self.is_down:
            raise Unreachable("down")
        rows = {f"/of{topic}": [Registration(Kind.PUBLISHER, topic, "/n")] for topic in TOPICS}
        return b"", rows

    async def look_up(self, _: str, names: Iterable[str]) -> dict[str, str]:
        self.questions.append(set(names))
        return {name: uri(name.removeprefix("/of")) for name in self.questions[-1]}


def uri(topic: str) -> str:
    return f"http://robot:4000{TOPICS.index(topic)}/"


async def settle() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


@pytest.fixture
def master() -> SlowMaster:
    return SlowMaster()


@pytest.fixture
def lookup(master: Any) -> PublisherLookup:
    return PublisherLookup(master, lambda: master.processor_time)


async def start(lookup: PublisherLookup, *topics: str) -> list[asyncio.Task[set[str]]]:
    """Calls that have begun to wait."""
    tasks = [asyncio.create_task(lookup.publishers_of(topic)) for topic in topics]
    await settle()
    return tasks


async def answer(master: SlowMaster, count: int) -> None:
    for _ in range(count):
        master.answers.release()
        await settle()


async def test_callers_that_wait_at_the_same_time_share_a_question(
    lookup: PublisherLookup, master: SlowMaster
) -> None:
    calls = await start(lookup, "/a", "/b", "/c", "/x")
    await answer(master, 2)
    assert await asyncio.gather(*calls) == [{uri("/a")}, {uri("/b")}, {uri("/c")}, set()]
    assert master.questions == [{"/of/a"}, {"/of/b", "/of/c"}]


async def test_a_later_question_for_one_topic_keeps_the_answer_for_the_others(
    lookup: PublisherLookup, master: SlowMaster
) -> None:
    calls = await start(lookup, "/c", "/a", "/b", "/d")
    await answer(master, 1)  # the answer for /c; the question for /a, /b and /d begins
    calls += await start(lookup, "/b")
    await answer(master, 3)
    topics = ("/c", "/a", "/b", "/d", "/b")
    assert await asyncio.gather(*calls) == [{uri(topic)} for topic in topics]
    assert len(master.questions) <= 3


async def test_a_caller_that_gives_up_takes_no_answer_from_the_others(
    lookup: PublisherLookup, master: SlowMaster
) -> None:
    first, second, third = await start(lookup, "/a", "/b", "/c")
    await answer(master, 1)
    assert await first == {uri("/a")}
    second.cancel()
    await settle()
    await answer(master, 2)
    assert await third == {uri("/c")}


async def test_a_master_that_is_down_knows_no_publishers(
    lookup: PublisherLookup, master: SlowMaster
) -> None:
    calls = await start(lookup, "/a", "/a")
    master.is_down = True
    await answer(master, 2)
    assert await asyncio.gather(*calls) == [set(), set()]


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The pauses, which take no time in these tests."""
    made: list[float] = []
    real_sleep = asyncio.sleep

    async def sleep(seconds: float) -> None:
        if seconds > 0:
            made.append(seconds)
        await real_sleep(0)

    monkeypatch.setattr(asyncio, "sleep", sleep)
    return made


async def test_the_proxy_pauses_after_a_costly_question(
    lookup: PublisherLookup, master: SlowMaster, pauses: list[float]
) -> None:
    master.cost = 10.0
    calls = await start(lookup, "/a", "/b")
    await answer(master, 1)
    assert len(pauses) == 1
    assert pauses[0] <= LONGEST_PAUSE_S
    calls += await start(lookup, "/c")  # in the pause
    await answer(master, 2)
    assert await asyncio.gather(*calls) == [{uri("/a")}, {uri("/b")}, {uri("/c")}]


async def test_no_pause_delays_a_first_question(
    lookup: PublisherLookup, master: SlowMaster, pauses: list[float]
) -> None:
    master.cost = 10.0
    calls = await start(lookup, "/a")
    await answer(master, 1)
    assert await asyncio.gather(*calls) == [{uri("/a")}]
    assert pauses == []
