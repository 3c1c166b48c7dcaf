"""The share of each source at the LAN relay, while forged sources flood the LAN."""

from rosproxy.ros2.lan_relay.sources import (
    REMEMBERED_S,
    SOURCE_BURST_UNITS,
    SOURCE_UNITS_PER_SECOND,
    UNPROVEN_BURST,
    UNPROVEN_PER_SECOND,
    LanSources,
)
from rosproxy.ros2.sources.address_proofs import MOST_ADDRESSES
from rosproxy.ros2.sources.fair_queue import DiscoveryQueue
from rosproxy.ros2.sources.rates import Standing, cost

LAPTOP = "192.0.2.7"
SIZE = 500
FORGED_A_SECOND = 10_000
READ_A_SECOND = 3000
"""Announcements that a relay can read."""
SECONDS = 20


def flooded(sources: LanSources) -> tuple[int, int]:
    """Announce a laptop each second among forged sources, which are all new.

    Return how many announcements of the laptop are relayed, and how many bytes of all others.
    """
    queue = DiscoveryQueue[float]()
    heard = 0
    forged_bytes = 0
    number = 0
    for second in range(SECONDS):
        now = float(second)
        sources.note_proven([LAPTOP], now)
        arriving = [str(number + offset) for offset in range(FORGED_A_SECOND)]
        number += FORGED_A_SECOND
        arriving.insert(FORGED_A_SECOND // 2, LAPTOP)
        for source in arriving:
            if sources.take(source, SIZE, now):
                queue.put(source, sources.standing(source, now), now, SIZE)
        for _ in range(READ_A_SECOND):
            if waiting := queue.pop():
                heard += waiting.source == LAPTOP
                forged_bytes += 0 if waiting.source == LAPTOP else SIZE
    return heard, forged_bytes


def test_a_proven_source_is_heard_amid_forged_ones() -> None:
    heard, forged_bytes = flooded(LanSources())
    assert heard == SECONDS
    assert 0 < forged_bytes <= SIZE * (UNPROVEN_BURST + SECONDS * UNPROVEN_PER_SECOND)


def test_all_unproven_sources_together_have_one_allowance() -> None:
    sources = LanSources()
    numbers = iter(range(10_000_000))
    read = sum(sources.take(str(next(numbers)), SIZE, 0.0) for _ in range(100_000))
    assert read == UNPROVEN_BURST // cost(SIZE)
    later = sum(sources.take(str(next(numbers)), SIZE, 1.0) for _ in range(100_000))
    assert later <= UNPROVEN_PER_SECOND // cost(SIZE) + 1
    assert not sources.take(LAPTOP, SIZE, 1.0)
    sources.note_proven([LAPTOP], 1.0)
    assert sources.take(LAPTOP, SIZE, 1.0)


def test_a_proven_source_has_a_separate_allowance() -> None:
    """If an attacker forges this address, no other source loses anything."""
    sources = LanSources()
    sources.note_proven([LAPTOP, "192.0.2.8"], 0.0)
    assert sum(sources.take(LAPTOP, 0, 0.0) for _ in range(10_000)) == SOURCE_BURST_UNITS
    assert sum(sources.take(LAPTOP, 0, 1.0) for _ in range(10_000)) == SOURCE_UNITS_PER_SECOND
    assert sources.take("192.0.2.8", 0, 1.0)


def test_what_the_proxy_has_told_is_forgotten() -> None:
    sources = LanSources()
    sources.note_proven([LAPTOP], 0.0)
    assert sources.standing(LAPTOP, REMEMBERED_S - 1) is Standing.PROVEN
    assert sources.standing(LAPTOP, REMEMBERED_S) is Standing.OUTSIDE
    sources.note_proven(map(str, range(2 * MOST_ADDRESSES)), REMEMBERED_S + 1)
    assert len(sources._proven_until) == MOST_ADDRESSES
