"""Discovery is read a little in each round of the event loop, and everything else comes first.

The time is a fake: only the tests and the datagrams that they read let time pass.
"""

import asyncio
from collections.abc import Callable, Sequence

import pytest

from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.servers.discovery_scheduler import (
    LONGEST_ROUND_S,
    SHORTEST_ROUND_S,
    DiscoveryScheduler,
)
from rosproxy.ros2.sources.fair_queue import MOST_BYTES_PER_SOURCE, OVERHEAD_BYTES
from rosproxy.ros2.sources.rates import Standing
from rosproxy.shared.addresses import HostPort


class Time:
    """A clock that stands still until it is told to go on. ``now`` is in seconds."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def reading(
    names: list[str],
    source: str,
    sent: Sequence[Outgoing] = (),
    takes: tuple[Time, float] | None = None,
) -> Callable[[], Sequence[Outgoing]]:
    """A datagram that is read. ``takes`` is the clock, and the seconds that reading takes."""

    def read() -> Sequence[Outgoing]:
        names.append(source)
        if takes:
            takes[0].now += takes[1]
        return sent

    return read


async def until_read(names: list[str], count: int) -> None:
    while len(names) < count:
        await asyncio.sleep(0)


async def test_something_else_runs_between_two_long_datagrams() -> None:
    clock = Time()
    reader = DiscoveryScheduler(clock)
    names = list[str]()
    long = clock, SHORTEST_ROUND_S
    for _ in range(3):
        reader.put("robot", Standing.PROVEN, 0, reading(names, "robot", takes=long))
    for count in (1, 2, 3):
        asyncio.get_running_loop().call_soon(names.append, f"else {count}")
        await until_read(names, 2 * count)
    assert names == ["robot", "else 1", "robot", "else 2", "robot", "else 3"]


async def test_what_a_datagram_leads_to_counts_as_well() -> None:
    reader = DiscoveryScheduler(Time())
    names = list[str]()
    copies = [Outgoing(HostPort("10.0.0.9", 7410), bytes(1000))] * 32
    for _ in range(3):
        reader.put("announces", Standing.PROVEN, 0, reading(names, "announces", copies))
        reader.put("other", Standing.PROVEN, 0, reading(names, "other"))
    await until_read(names, 6)
    assert names == ["announces", "other", "other", "other", "announces", "announces"]


async def test_the_last_of_datagrams_that_say_the_same_is_read() -> None:
    reader = DiscoveryScheduler(Time())
    names = list[str]()
    reader.put("robot", Standing.PROVEN, 0, reading(names, "first"), "stream")
    assert reader.is_behind
    assert reader.replace("stream", reading(names, "last"))
    reader.put("robot", Standing.PROVEN, 0, reading(names, "other"))
    await until_read(names, 2)
    assert names == ["last", "other"]
    assert not reader.replace("stream", reading(names, "too late"))


async def test_short_datagrams_share_a_round() -> None:
    clock = Time()
    reader = DiscoveryScheduler(clock)
    names = list[str]()
    for _ in range(20):
        short = clock, SHORTEST_ROUND_S / 20
        reader.put("robot", Standing.PROVEN, 0, reading(names, "robot", takes=short))
    await asyncio.sleep(0)
    assert len(names) == 20


@pytest.mark.parametrize(("others", "length"), [(0.011, 0.011), (60, LONGEST_ROUND_S)])
async def test_a_round_takes_as_long_as_everything_else_since_the_last(others, length) -> None:
    """With rounds of the same length, receiving from a crowd takes all the time."""
    clock = Time()
    reader = DiscoveryScheduler(clock)
    names = list[str]()
    for _ in range(1000):
        short = clock, 0.001
        reader.put("robot", Standing.PROVEN, 0, reading(names, "robot", takes=short))
    clock.now += others
    await asyncio.sleep(0)
    assert len(names) == pytest.approx(length * 1000, abs=1)


async def test_what_comes_while_none_waits_is_read_at_once() -> None:
    reader = DiscoveryScheduler(Time())
    names = list[str]()
    for name in ("robot", "laptop"):
        assert reader.read(name, Standing.PROVEN, 0, reading(names, name))
    assert names == ["robot", "laptop"]


async def test_what_comes_after_a_full_round_waits_for_its_turn() -> None:
    clock = Time()
    reader = DiscoveryScheduler(clock)
    names = list[str]()
    copies = [Outgoing(HostPort("10.0.0.9", 7410), bytes(1000))] * 8
    long = clock, SHORTEST_ROUND_S
    reader.read("announces", Standing.PROVEN, 0, reading(names, "announces", copies, long))
    reader.read("announces", Standing.PROVEN, 0, reading(names, "announces"))
    reader.read("robot", Standing.PROVEN, 0, reading(names, "robot"))
    assert names == ["announces"]
    await until_read(names, 3)
    assert names == ["announces", "announces", "robot"]
    reader.read("robot", Standing.PROVEN, 0, reading(names, "robot"))
    assert len(names) == 4


async def test_what_comes_behind_a_datagram_that_waits_waits_as_well() -> None:
    reader = DiscoveryScheduler(Time())
    names = list[str]()
    reader.put("robot", Standing.PROVEN, 0, reading(names, "first"))
    reader.read("robot", Standing.PROVEN, 0, reading(names, "second"))
    assert names == []
    await until_read(names, 2)
    assert names == ["first", "second"]


async def test_a_datagram_that_raises_an_error_does_not_end_the_scheduler() -> None:
    reader = DiscoveryScheduler(Time())
    names = list[str]()
    failures = list[str]()
    asyncio.get_running_loop().set_exception_handler(
        lambda _, context: failures.append(str(context["exception"]))
    )

    def fail() -> Sequence[Outgoing]:
        raise RuntimeError("evil datagram")

    reader.put("evil", Standing.PROVEN, 0, fail)
    reader.put("robot", Standing.PROVEN, 0, reading(names, "robot"))
    await until_read(names, 1)
    assert failures == ["evil datagram"]
    with pytest.raises(RuntimeError, match="evil datagram"):
        reader.read("evil", Standing.PROVEN, 0, fail)
    reader.read("robot", Standing.PROVEN, 0, reading(names, "robot"))
    assert names == ["robot", "robot"]


async def test_nothing_is_read_after_the_end() -> None:
    reader = DiscoveryScheduler(Time())
    names = list[str]()
    reader.put("robot", Standing.PROVEN, 0, reading(names, "robot"))
    reader.close()
    for _ in range(3):
        await asyncio.sleep(0)
    assert names == []


async def test_what_has_no_room_is_told() -> None:
    size = 8 * 1024
    count = MOST_BYTES_PER_SOURCE // (size + OVERHEAD_BYTES)
    reader = DiscoveryScheduler(Time())
    names = list[str]()
    has_room = [
        reader.put("many", Standing.PROVEN, size, reading(names, "many")) for _ in range(200)
    ]
    assert has_room == [True] * count + [False] * (200 - count)
    await until_read(names, count)
