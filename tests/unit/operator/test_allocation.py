"""Ranges are the former ports if possible, otherwise the first free ports in a row."""

from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.port_ranges import (
    FormerRange,
    Move,
    PortsExhausted,
    RangeRequest,
    advice_after_move,
    assign_ranges,
    first_free_range,
    is_free,
    kept_ranges,
    new_moves,
    overlap,
    within,
)

WINDOW = PortRange(100, 139)
PORTS = st.integers(90, 150)
BLOCKED = st.frozensets(PORTS, max_size=12)
RANGE = st.builds(lambda first, more: PortRange(first, first + more), PORTS, st.integers(0, 9))
RANGES = st.lists(RANGE, max_size=4)
COUNTS = st.integers(1, 12)


def every(count: int) -> list[PortRange]:
    """All ranges of so many ports in the window, in order."""
    last = WINDOW.last - count + 1
    return [PortRange(first, first + count - 1) for first in range(WINDOW.first, last + 1)]


def free(ports: PortRange, blocked: frozenset[int], ranges: list[PortRange]) -> bool:
    """A slow and simple version of is_free."""
    return not any(port in blocked or any(port in r for r in ranges) for port in ports.ports())


@given(COUNTS, BLOCKED, RANGES)
@example(1, frozenset(), [])
@example(40, frozenset(), [])
@example(41, frozenset(), [])
def test_the_first_range_that_is_free(
    count: int, blocked: frozenset[int], ranges: list[PortRange]
) -> None:
    fitting = [ports for ports in every(count) if free(ports, blocked, ranges)]
    if fitting:
        assert first_free_range(count, WINDOW, blocked, ranges) == fitting[0]
        return
    with pytest.raises(PortsExhausted) as error:
        first_free_range(count, WINDOW, blocked, ranges)
    singles = sum(free(ports, blocked, ranges) for ports in every(1))
    assert f"{singles} of 40 are free" in str(error.value)
    longest = next(
        (n for n in range(count, 0, -1) if any(free(r, blocked, ranges) for r in every(n))), 0
    )
    assert str(error.value).endswith(f", the longest free stretch has {longest}")


@given(COUNTS, BLOCKED, RANGES, RANGE)
def test_a_range_is_never_made_shorter_and_its_own_ports_do_not_matter(
    count: int, blocked: frozenset[int], ranges: list[PortRange], ports: PortRange
) -> None:
    request = RangeRequest(count, WINDOW, blocked, ranges)
    more = assign_ranges({"proxy": request}, {"proxy": ports})[0]["proxy"]
    added = PortRange(ports.last + 1, ports.first + count - 1)
    if len(ports) >= count:
        assert more == ports
    elif free(added, blocked, ranges) and added.last <= WINDOW.last:
        assert more == PortRange(ports.first, added.last)
    else:
        assert more == ports


@given(BLOCKED, RANGES, RANGE)
def test_free_means_that_no_port_is_held(
    blocked: frozenset[int], ranges: list[PortRange], ports: PortRange
) -> None:
    assert is_free(ports, blocked, ranges) == free(ports, blocked, ranges)


@given(RANGE, RANGE)
def test_overlap(first: PortRange, second: PortRange) -> None:
    assert overlap(first, second) == bool(set(first.ports()) & set(second.ports()))
    assert within(first, second) == (set(first.ports()) <= set(second.ports()))


@given(COUNTS, BLOCKED, RANGES)
def test_room_is_left_where_there_is_some(
    count: int, blocked: frozenset[int], ranges: list[PortRange]
) -> None:
    request = RangeRequest(count, WINDOW, blocked, (), growing=ranges, room=2)
    given_ranges, exhausted = assign_ranges({"proxy": request}, {})
    if exhausted:
        assert not any(free(ports, blocked, ranges) for ports in every(count))
        return
    given = given_ranges["proxy"]
    assert free(given, blocked, ranges)
    assert len(given) == count
    doubled = [PortRange(r.first, r.last + len(r)) for r in ranges]
    roomy = [ports for ports in every(2 * count) if free(ports, blocked, doubled)]
    assert not roomy or given.first == roomy[0].first


def test_a_range_that_two_proxies_had_is_for_the_first() -> None:
    had = PortRange(100, 109)
    request = RangeRequest(10, WINDOW, (), former=(FormerRange(had, ()),))
    assert kept_ranges({"first": request, "second": request}) == {"first": had}
    assert kept_ranges({"first": request, "second": replace(request, held=had)}) == {
        "first": had,
        "second": had,
    }
    taken = replace(request, former=(FormerRange(had, {105}), FormerRange(had, (), [had])))
    assert kept_ranges({"first": taken}) == {}


def test_a_range_that_another_had_is_avoided_if_possible() -> None:
    request = RangeRequest(10, WINDOW, (), avoided=[PortRange(100, 109)])
    assert assign_ranges({"first": request}, {}) == ({"first": PortRange(110, 119)}, {})
    narrow = replace(request, window=PortRange(100, 109))
    assert assign_ranges({"first": narrow}, {}) == ({"first": PortRange(100, 109)}, {})


def test_a_range_that_grows_or_shrinks_at_its_end_is_the_same() -> None:
    former = {"grown": PortRange(100, 109), "shrunk": PortRange(110, 119), "gone": WINDOW}
    given = {"grown": PortRange(100, 119), "shrunk": PortRange(110, 112)}
    assert new_moves(former, given, 1.0) == {}
    assert new_moves(former, {"grown": PortRange(101, 109)}, 1.0) == {
        "grown": Move(PortRange(100, 109), 1.0)
    }


def test_the_error_says_how_many_there_are() -> None:
    with pytest.raises(PortsExhausted) as error:
        first_free_range(4, PortRange(11400, 11409), {11402, 11406}, [PortRange(11408, 20000)])
    assert str(error.value) == (
        "no 4 free ports in a row between 11400 and 11409: 6 of 10 are free, "
        "the longest free stretch has 3"
    )


def test_the_range_of_a_usual_host() -> None:
    ephemeral = PortRange(32768, 60999)
    listening = {22, 80, 11311, 11405}
    window = PortRange(11400, 65535)
    assert first_free_range(32, window, listening, [ephemeral]) == PortRange(11406, 11437)
    assert first_free_range(32, PortRange(32000, 65535), (), [ephemeral]) == PortRange(32000, 32031)
    assert first_free_range(1000, PortRange(32000, 65535), (), [ephemeral]) == PortRange(
        61000, 61999
    )


@pytest.mark.parametrize(("ros1", "ros2"), [(True, False), (False, True), (True, True)])
def test_what_to_do_after_a_move_is_told(ros1: bool, ros2: bool) -> None:
    told = advice_after_move(ros1, ros2)
    assert ("nodes that registered" in told, "ROS 2" in told) == (ros1, ros2)
    assert "Restart" in told
