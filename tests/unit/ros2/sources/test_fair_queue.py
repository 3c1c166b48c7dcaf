"""The queue of discovery: the next datagram, and lost datagrams."""

from collections import Counter
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.sources import fair_queue
from rosproxy.ros2.sources.fair_queue import (
    MOST_PROVEN_SOURCES,
    OVERHEAD_BYTES,
    DiscoveryQueue,
    FairQueue,
)
from rosproxy.ros2.sources.rates import Standing
from tests.unit.ros2.discovery.domains import INSIDE, ROBOT, make_domain, prove

SIZES = st.integers(0, 60_000)


def taken(queue: FairQueue[int] | DiscoveryQueue[int], count: int) -> list[str]:
    waiting = (queue.pop() for _ in range(count))
    return [item.source for item in waiting if item]


def test_a_source_with_one_datagram_does_not_wait_for_one_with_many() -> None:
    queue = FairQueue[int](most_sources=10)
    for number in range(100):
        queue.put("many", number, 500)
    queue.put("few", 1, 500)
    assert "few" in taken(queue, 2)


def test_long_datagrams_count_for_more() -> None:
    queue = FairQueue[int](most_sources=10)
    for number in range(50):
        queue.put("long", number, 10 * OVERHEAD_BYTES - OVERHEAD_BYTES)
        queue.put("short", number, 0)
    assert Counter(taken(queue, 22)) == {"long": 2, "short": 20}


def test_a_source_pays_for_what_its_datagrams_lead_to() -> None:
    queue = FairQueue[int](most_sources=10)
    for number in range(50):
        queue.put("announces", number, 0)
        queue.put("other", number, 0)
    sources = []
    for _ in range(22):
        (source,) = taken(queue, 1)
        sources.append(source)
        if source == "announces":
            queue.charge(source, 9 * OVERHEAD_BYTES)
    assert Counter(sources) == {"announces": 2, "other": 20}


def test_a_datagram_may_take_the_place_of_the_one_that_waits_with_its_key() -> None:
    queue = FairQueue[int](most_sources=10)
    assert not queue.replace("key", 0)
    queue.put("robot", 1, 0, "key")
    queue.put("robot", 2, 0)
    assert queue.replace("key", 3)
    taken_items = [waiting.item for waiting in (queue.pop(), queue.pop()) if waiting]
    assert taken_items == [3, 2]
    assert not queue.replace("key", 4)  # no datagram with the key waits any more
    assert queue.pop() is None


def test_what_lost_its_place_to_another_source_is_not_replaced() -> None:
    queue = FairQueue[int](most_sources=10, most_bytes=4 * OVERHEAD_BYTES)
    for number in range(4):
        queue.put("many", number, 0, number)
    assert queue.put("few", 9, 0)
    assert not queue.replace(3, 7)
    assert queue.replace(2, 7)


def test_a_source_that_always_has_one_datagram_is_not_always_next() -> None:
    """A source that comes back goes to the end of the round."""
    queue = FairQueue[int](most_sources=10)
    for number in range(50):
        queue.put("waits", number, 0)
    sources = []
    for number in range(50):
        queue.put("quick", number, 0)
        sources += taken(queue, 1)
    assert Counter(sources)["waits"] >= 24


def test_silence_saves_nothing() -> None:
    queue = FairQueue[int](most_sources=10)
    queue.put("silent", 0, 0)
    for number in range(100):
        queue.put("speaks", number, 0)
    taken(queue, 60)
    for number in range(50):
        queue.put("silent", number, 0)
    assert Counter(taken(queue, 20))["speaks"] >= 9


def test_of_new_sources_the_first_to_arrive_is_the_first_to_be_read() -> None:
    queue = FairQueue[int](most_sources=10)
    for source in ("c", "a", "b"):
        queue.put(source, 0, 0)
    assert taken(queue, 3) == ["c", "a", "b"]


def test_new_sources_that_come_all_the_time_delay_none_that_comes_back() -> None:
    """A forger that makes up sources once kept all others waiting from the second datagram on."""
    queue = FairQueue[int](most_sources=10)
    for number in range(9):
        queue.put(f"forged {number}", number, 500)
    counts = Counter[str]()
    for number in range(9, 209):
        queue.put("newcomer", number, 500)
        queue.put(f"forged {number}", number, 500)
        counts.update(source.partition(" ")[0] for source in taken(queue, 1))
    assert counts["newcomer"] >= 18


def test_new_sources_delay_none_that_comes_back_although_a_crowd_waits() -> None:
    """With more waiting sources than bytes in a datagram, the line of shares stood still."""
    count = 2 * OVERHEAD_BYTES
    queue = FairQueue[int](most_sources=count)
    for number in range(count - 1):
        queue.put(f"new {number}", number, 0)
    queue.put("comes back", 0, 0)
    counts = Counter[str]()
    for number in range(10 * count):
        (source,) = taken(queue, 1)
        kind = source.partition(" ")[0]
        counts[kind] += 1
        queue.put(source if kind == "comes" else f"new {count + number}", number, 0)
    assert 9 <= counts["comes"] <= 11


def test_made_up_sources_are_not_remembered() -> None:
    """The queue remembered all of them, and searched all at each datagram: 1.6 ms with 16,000."""
    queue = FairQueue[int](most_sources=10)
    queue.put("waits", 0, 0)
    for number in range(1000):
        queue.put(f"forged {number}", number, 0)
        queue.put("waits", number, 0)
        taken(queue, 1)
    assert len(queue._next) <= 2 * 10
    assert len(queue._order) == len(queue._waiting)


def test_a_source_has_so_much_room() -> None:
    queue = FairQueue[int](most_sources=2, most_bytes_per_source=10 * OVERHEAD_BYTES)
    assert [queue.put("one", number, 0) for number in range(11)] == [True] * 10 + [False]
    assert queue.put("another", 0, 0)
    assert not queue.put("a third", 0, 0)


def test_the_source_with_most_loses_what_does_not_fit() -> None:
    queue = FairQueue[int](most_sources=10, most_bytes=10 * OVERHEAD_BYTES)
    for number in range(9):
        queue.put("many", number, 0)
    assert [queue.put("few", number, 0) for number in range(9)] == [True] * 5 + [False] * 4
    assert Counter(taken(queue, 20)) == {"many": 5, "few": 5}


@given(st.lists(st.tuples(st.sampled_from("abcd"), SIZES, st.booleans(), SIZES), max_size=60))
def test_what_was_put_is_taken_in_its_order(steps: list[tuple[str, int, bool, int]]) -> None:
    queue = FairQueue[int](most_sources=3, most_bytes_per_source=150_000, most_bytes=200_000)
    last = Counter[str]()
    for number, (source, size, takes, led_to) in enumerate(steps, 1):
        queue.put(source, number, size)
        assert queue._size == sum(queue._sizes.values()) <= 200_000
        waiting = queue.pop() if takes else None
        if waiting:
            assert waiting.item > last[waiting.source]
            last[waiting.source] = waiting.item
            queue.charge(waiting.source, led_to)
    while waiting := queue.pop():
        assert waiting.item > last[waiting.source]
        last[waiting.source] = waiting.item
    assert (queue._size, queue._sizes, queue._next) == (0, {}, {})
    assert not queue


def test_a_thousand_forged_sources_get_their_share_alone() -> None:
    queue = DiscoveryQueue[int]()
    for number in range(1000):
        queue.put(f"forged {number}", Standing.OUTSIDE, number, 500)
        queue.put("robot", Standing.PROVEN, number, 500)
        queue.put("node", Standing.INSIDE, number, 500)
    counts = Counter(source.partition(" ")[0] for source in taken(queue, 300))
    assert counts == {"robot": 100, "forged": 100, "node": 100}


def test_a_stranger_with_many_addresses_keeps_no_peer_from_being_read() -> None:
    """Peers and strangers have separate places in the queue."""
    domain = make_domain()
    strangers = [f"2001:db8::{number:x}" for number in range(MOST_PROVEN_SOURCES)]
    prove(domain, INSIDE, *strangers)
    queue = DiscoveryQueue[int]()
    for number, stranger in enumerate(strangers):
        assert queue.put(stranger, domain.standing(stranger), number, 500)
    for known in (ROBOT, INSIDE):
        assert queue.put(known, domain.standing(known), 0, 500)
    assert {ROBOT, INSIDE} <= set(taken(queue, 4))


def test_a_standing_that_has_nothing_to_read_leaves_its_time() -> None:
    queue = DiscoveryQueue[int]()
    for number in range(100):
        queue.put("forged", Standing.OUTSIDE, number, 500)
    assert len(taken(queue, 50)) == 50
    for number in range(100):
        queue.put("robot", Standing.PROVEN, number, 500)
    assert Counter(taken(queue, 40)) == {"robot": 20, "forged": 20}
    assert len(taken(queue, 200)) == 110
    assert not queue


def test_a_standing_pays_for_what_its_datagrams_lead_to() -> None:
    queue = DiscoveryQueue[int]()
    for number in range(50):
        queue.put("announces", Standing.OUTSIDE, number, 0)
        queue.put("other", Standing.INSIDE, number, 0)
    sources = []
    for _ in range(22):
        (source,) = taken(queue, 1)
        sources.append(source)
        if source == "announces":
            queue.charge(source, 9 * OVERHEAD_BYTES)
    assert Counter(sources) == {"announces": 2, "other": 20}


def test_of_few_sources_always_the_largest_loses() -> None:
    """A node lost half of its discovery, because others at their bound had filled the queue."""
    queue = FairQueue[int](100, most_bytes=400 * OVERHEAD_BYTES)
    for number in range(80):
        assert queue.put(f"little {number}", number, 0)
    for number in range(160):
        assert queue.put("much", number, 0)
        assert queue.put("as much", number, 0)
    assert all(queue.put("node", number, 0) for number in range(50))


def test_a_full_queue_looks_for_the_largest_source_only_for_a_smaller_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The search among 2,048 sources took 0.1 ms for each datagram that had no room."""
    searches = list[str]()

    def searched(*sizes: Any, **options: Any) -> Any:
        searches.extend(["largest"] if options else [])
        return max(*sizes, **options)

    monkeypatch.setattr(fair_queue, "MOST_SEARCHED", 6)
    queue = FairQueue[int](8, most_bytes=24 * OVERHEAD_BYTES)
    for number in range(24):
        assert queue.put(str(number % 7), number, 0)
    monkeypatch.setattr(fair_queue, "max", searched, raising=False)
    assert not any(queue.put(str(number), 0, 0) for number in range(7))
    assert not searches
    assert queue.put("a smaller one", 0, 0)
    assert searches == ["largest"]


def test_a_standing_owes_nothing_for_what_was_read_while_no_other_waited() -> None:
    """After a busy day, forged sources alone were read for minutes, and proven sources waited."""
    queue = DiscoveryQueue[int]()
    for number in range(100):
        queue.put("busy", Standing.PROVEN, number, 0)
        queue.pop()
        queue.charge("busy", 1000 * OVERHEAD_BYTES)
    for number in range(10):
        queue.put("forged", Standing.OUTSIDE, number, 0)
        queue.put("busy", Standing.PROVEN, number, 0)
    sources = [waiting.source for _ in range(10) if (waiting := queue.pop())]
    assert Counter(sources) == {"busy": 5, "forged": 5}
