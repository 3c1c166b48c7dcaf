"""The allowance of each source."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.sources.rates import (
    BURST,
    BYTES_PER_UNIT,
    MOST_SOURCES,
    PER_SECOND,
    DiscoveryRates,
    Standing,
    cost,
)


@given(st.lists(st.tuples(st.floats(0, 0.01), st.integers(0, 2000)), max_size=60))
def test_no_source_gets_more_than_its_allowance(heard: list[tuple[float, int]]) -> None:
    rates = DiscoveryRates()
    now = 0.0
    used = 0
    last = 0
    for pause, led_to in heard:
        now += pause
        if rates.take("a", 100, now):
            rates.charge("a", led_to)
            used = used + 1 + led_to
            last = led_to
    assert used - last <= BURST + now * PER_SECOND + 1
    assert rates.take("b", 100, now)


def test_a_source_that_was_quiet_may_go_on() -> None:
    rates = DiscoveryRates()
    assert rates.take("a", 100, 0.0)
    rates.charge("a", int(BURST))
    assert not rates.take("a", 100, 0.0)
    assert rates.take("a", 100, 1.0)


def test_so_many_sources_are_remembered_and_no_more() -> None:
    rates = DiscoveryRates()
    rates.take("first", 100, 0.0)
    rates.charge("first", int(BURST))
    for number in range(MOST_SOURCES):
        rates.take(str(number), 100, 0.0)
    assert rates.take("first", 100, 0.0)


@given(st.lists(st.integers(0, 65_536), min_size=1, max_size=50))
def test_what_is_charged_follows_from_the_bytes(sizes: list[int]) -> None:
    assert (
        sum(sizes) / BYTES_PER_UNIT
        <= sum(map(cost, sizes))
        <= sum(sizes) / BYTES_PER_UNIT + len(sizes)
    )


def test_a_long_datagram_is_charged_as_several() -> None:
    rates = DiscoveryRates()
    longest = sum(rates.take("a", 64_000, 0.0) for _ in range(1000))
    assert longest == pytest.approx(BURST * BYTES_PER_UNIT / 64_000, abs=1)


def test_forged_sources_have_one_allowance_together() -> None:
    """Otherwise an attacker gets a new allowance with each new source."""
    rates = DiscoveryRates()
    assert rates.take("evil", 100, 0.0, Standing.OUTSIDE)
    rates.charge("evil", int(BURST), Standing.OUTSIDE)
    taken = [rates.take(str(n), 100, 0.1, Standing.OUTSIDE) for n in range(2 * MOST_SOURCES)]
    assert sum(taken) <= 0.1 * PER_SECOND
    assert not rates.take("evil", 100, 0.1, Standing.OUTSIDE)
    assert rates.take("robot", 100, 0.1)
    assert rates.take("node", 100, 0.1, Standing.INSIDE)


def test_forged_sources_give_no_new_allowance_to_a_proven_one() -> None:
    """A container that made up 4,096 sources got a new burst twice a second."""
    rates = DiscoveryRates()
    assert rates.take("container", 100, 0.0)
    rates.charge("container", int(BURST))
    taken = [rates.take(str(n), 100, 0.0, Standing.INSIDE) for n in range(2 * MOST_SOURCES)]
    assert all(taken)
    assert not rates.take("container", 100, 0.0)
    assert rates._by_source.keys() == {"container", *rates._unproven}
    assert len(rates._by_source) == MOST_SOURCES
