"""Growth of the nodes' counts between two answers, and the sums."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.bus_stats import MOST_CONNECTIONS, read_bus_stats
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.upkeep.decisions.topic_growth import (
    MOST_NAMES,
    OTHERS,
    TopicSums,
    growth,
    registered_stats,
)
from tests.unit.builders import add_node, add_registration, make_addressing

ROSPY = [[["/image", 500, [[1, 5000, 50, "1"], [2, 3000, 30, "1"]]]],
         [["/scan", [[3, 700, 7, -1, "1"], [4, 100, 1, -1, "1"]]]], []]  # fmt: skip
ROSCPP = [[["/image", 500, [[1, 5000, 4900, 50, 1], [2, 3000, 2900, 30, 1]]]],
          [["/scan", [[3, 700, 7, 0, 1], [4, 100, 1, 0, 1]]]]]  # fmt: skip
IMAGE = ("o", "/image")
SCAN = ("i", "/scan")


@pytest.mark.parametrize("stats", [ROSPY, ROSCPP])
def test_both_libraries_are_read(stats: object) -> None:
    assert read_bus_stats(stats) == {
        IMAGE: {1: (5000, 50), 2: (3000, 30)},
        SCAN: {3: (700, 7), 4: (100, 1)},
    }


def test_a_message_to_two_subscribers_counts_once_and_its_bytes_twice() -> None:
    former = {IMAGE: {1: (100, 10), 2: (100, 10)}}
    newest = {IMAGE: {1: (150, 15), 2: (150, 15), 3: (20, 2)}}
    assert growth(former, newest) == {IMAGE: (120, 5)}


def test_what_comes_from_several_publishers_is_added_up() -> None:
    former = {SCAN: {1: (100, 10)}}
    assert growth(former, {SCAN: {1: (120, 12), 2: (30, 3)}}) == {SCAN: (50, 5)}


@pytest.mark.parametrize(
    ("former", "newest", "grown"),
    [
        (1000, 40, 40),
        (2**31 - 10, -(2**31) + 10, 20),
        (-(2**31), -(2**31) + 500, 500),
        (-5, 5, 10),
        (-5, -7, 0),
    ],
    ids=["another process", "beyond 2 GiB", "below zero", "at zero", "another process, below zero"],
)
def test_numbers_that_begin_anew(former: int, newest: int, grown: int) -> None:
    stats = [{IMAGE: {1: (value, value)}} for value in (former, newest)]
    assert growth(*stats) == {IMAGE: (grown, grown)}


def test_a_subscriber_of_roscpp_that_connects_again_is_not_counted_anew() -> None:
    """Two answers of a real subscriber, before and after a lost connection."""
    before, after = (
        read_bus_stats([[], [["/rosout", connections]]])
        for connections in ([[0, 4100, 100, 0, 0]], [[1, 4223, 103, 0, 0]])
    )
    assert growth(before, after) == {("i", "/rosout"): (123, 3)}


def test_who_connects_again_is_not_taken_for_two() -> None:
    former = {SCAN: {1: (100, 10), 2: (50, 5)}}
    newest = {SCAN: {3: (110, 11), 4: (120, 12), 5: (8, 1)}}
    assert growth(former, newest) == {SCAN: (10 + 70 + 8, 1 + 7 + 1)}


def test_another_subscriber_begins_with_nothing() -> None:
    former = {IMAGE: {1: (100, 10)}}
    assert growth(former, {IMAGE: {2: (200, 20)}}) == {IMAGE: (200, 20)}


def test_a_connection_that_is_being_made_hides_no_other() -> None:
    """Of roscpp both have the number 0 until the header has come."""
    stats = [[], [["/rosout", [[0, 4100, 100, 0, 0], [0, 0, 0, 0, 0]]]]]
    assert read_bus_stats(stats) == {("i", "/rosout"): {0: (4100, 100)}}


def test_numbers_that_nobody_can_send_are_left_out() -> None:
    row = [["/image", 0, [[1, 2**31, 5, 1], [2, 5, -(2**31) - 1, 1], [10**400, 1, 1, 1]]]]
    assert read_bus_stats([row, []]) == {IMAGE: {}}


def test_connections_of_a_topic_are_bounded() -> None:
    rows = [[number, 1, 1, 1] for number in range(2 * MOST_CONNECTIONS)]
    assert len(read_bus_stats([[["/image", 0, rows]], []])[IMAGE]) == MOST_CONNECTIONS


@given(
    st.recursive(
        st.none() | st.integers() | st.text(max_size=3) | st.sampled_from(["/image"]),
        lambda inner: st.lists(inner, max_size=5),
        max_leaves=30,
    )
)
def test_nothing_that_a_node_answers_is_too_odd(answer: object) -> None:
    stats = read_bus_stats(answer)
    for sums in (growth({}, stats), growth(stats, {}), growth({IMAGE: {1: (7, 7)}}, stats)):
        assert all(size >= 0 and messages >= 0 for size, messages in sums.values())
    assert all(count == (0, 0) for count in growth(stats, stats).values())


def test_only_what_a_node_has_registered_counts() -> None:
    """A node may answer with any name, or as the publisher of a topic that it only
    subscribes to.
    """
    addressing = make_addressing()
    endpoint = add_node(addressing, "http://10.0.0.5:40000/")
    add_registration(addressing, endpoint, Kind.PUBLISHER, "/image", "/camera")
    stats = {key: {1: (1, 1)} for key in (IMAGE, ("i", "/image"), ("o", "/made_up"), SCAN)}
    assert registered_stats(endpoint, stats) == {IMAGE: {1: (1, 1)}}


def test_names_are_bounded() -> None:
    sums = TopicSums()
    for number in range(MOST_NAMES + 5):
        sums.add(f"/topic_{number}", "published", (10, 1))
    sums.add("/topic_0", "published", (10, 1))
    assert len(sums.by_topic) == MOST_NAMES + 1
    assert sums.by_topic["/topic_0", "published"] == (20, 2)
    assert sums.by_topic[OTHERS, "published"] == (50, 5)
