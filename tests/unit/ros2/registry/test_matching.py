"""Writers and readers that match across the boundary, and reasons against it."""

from collections.abc import Callable

import pytest
from hypothesis import given
from msgspec.structs import replace

from rosproxy.ros2.protocol.qos import Durability, EndpointQos, Liveliness
from rosproxy.ros2.registry import matching
from rosproxy.ros2.registry.matching import (
    ITEMS_PER_STEP,
    MOST_COMPARED_ENDPOINTS,
    MOST_COMPARED_PAIRS,
    Comparison,
    Mismatch,
    compare,
    comparison_steps,
    mismatch,
)
from rosproxy.ros2.registry.participants import DdsEndpoint, EndpointKind, Participant
from tests.unit.ros2.protocol.test_qos import QOS

STRING = "std_msgs::msg::dds_::String_"
LOG = "rcl_interfaces::msg::dds_::Log_"
RELIABLE = EndpointQos(reliable=True)


def writer(
    qos: EndpointQos = RELIABLE, topic: str = "rt/chatter", kind: str = STRING
) -> DdsEndpoint:
    return DdsEndpoint(EndpointKind.WRITER, topic, kind, qos)


def reader(
    qos: EndpointQos = RELIABLE, topic: str = "rt/chatter", kind: str = STRING
) -> DdsEndpoint:
    return DdsEndpoint(EndpointKind.READER, topic, kind, qos)


def make_participant(number: int, *ends: DdsEndpoint) -> Participant:
    participant = Participant(bytes([number] * 12), f"10.0.0.{number}", b"\x01\x0f", 0.0)
    for index, end in enumerate(ends):
        participant.endpoints[bytes([0, 0, index // 256, index % 256])] = end
    return participant


@pytest.mark.parametrize(
    ("offered", "requested", "expected"),
    [
        (
            EndpointQos(),
            EndpointQos(reliable=True),
            Mismatch("reliability", "BEST_EFFORT", "RELIABLE"),
        ),
        (
            EndpointQos(),
            EndpointQos(durability=Durability.TRANSIENT_LOCAL),
            Mismatch("durability", "VOLATILE", "TRANSIENT_LOCAL"),
        ),
        (
            EndpointQos(),
            EndpointQos(deadline=0.5),
            Mismatch("deadline", "infinite", "0.5 s"),
        ),
        (
            EndpointQos(liveliness_lease=3.0),
            EndpointQos(liveliness_lease=2.0),
            Mismatch("liveliness lease duration", "3 s", "2 s"),
        ),
        (
            EndpointQos(),
            EndpointQos(liveliness=Liveliness.MANUAL_BY_TOPIC),
            Mismatch("liveliness", "AUTOMATIC", "MANUAL_BY_TOPIC"),
        ),
        (
            EndpointQos(exclusive=True),
            EndpointQos(),
            Mismatch("ownership", "EXCLUSIVE", "SHARED"),
        ),
        (
            EndpointQos(partitions=("a", "b")),
            EndpointQos(),
            Mismatch("partition", "a b", "none"),
        ),
        (
            EndpointQos(representations=(2, 0)),
            EndpointQos(representations=(0,)),
            Mismatch("data representation", "XCDR2", "XCDR"),
        ),
    ],
)
def test_what_does_not_match(
    offered: EndpointQos, requested: EndpointQos, expected: Mismatch
) -> None:
    assert mismatch(writer(offered), reader(requested)) == expected


@pytest.mark.parametrize(
    ("mine", "theirs"),
    [
        ((), ("",)),
        ((), ("*",)),
        (("robot",), ("other", "rob*")),
        (("r?bot",), ("robot",)),
        (None, ("robot",)),
        (("a*",), ("a*",)),
    ],
)
def test_partitions_that_match(
    mine: tuple[str, ...] | None, theirs: tuple[str, ...] | None
) -> None:
    for offered, requested in ((mine, theirs), (theirs, mine)):
        ends = writer(EndpointQos(partitions=offered)), reader(EndpointQos(partitions=requested))
        assert mismatch(*ends) is None


def test_two_patterns_do_not_match() -> None:
    ends = writer(EndpointQos(partitions=("a*",))), reader(EndpointQos(partitions=("*",)))
    assert mismatch(*ends) == Mismatch("partition", "a*", "*")


def test_the_type_comes_first() -> None:
    difference = mismatch(writer(EndpointQos(), kind=LOG), reader(kind=STRING))
    assert difference == Mismatch("type", "rcl_interfaces/msg/Log", "std_msgs/msg/String")


@given(QOS)
def test_what_is_requested_as_it_is_offered_matches(qos: EndpointQos) -> None:
    assert mismatch(writer(qos), reader(qos)) is None


@given(QOS, QOS)
def test_more_offered_never_hurts(offered: EndpointQos, requested: EndpointQos) -> None:
    more = replace(
        offered,
        reliable=True,
        durability=Durability.PERSISTENT,
        deadline=0.0,
        liveliness=Liveliness.MANUAL_BY_TOPIC,
        liveliness_lease=0.0,
    )
    difference = mismatch(writer(more), reader(requested))
    policies = {"ownership", "partition", "data representation"}
    assert difference is None or difference.policy in policies
    if mismatch(writer(offered), reader(requested)) is None:
        assert difference is None


def test_only_pairs_across_the_boundary_are_looked_at() -> None:
    publisher = make_participant(1, writer(EndpointQos()), reader(RELIABLE))
    assert compare([publisher], []) == Comparison()
    subscriber = make_participant(
        2, reader(RELIABLE), writer(RELIABLE), reader(RELIABLE, "rt/other")
    )
    (pair,) = compare([publisher], [subscriber]).mismatched
    assert (pair.writer, pair.reader, pair.mismatch.policy) == (
        publisher,
        subscriber,
        "reliability",
    )
    (pair,) = compare([subscriber], [publisher]).mismatched
    assert (pair.writer, pair.reader) == (publisher, subscriber)


def test_a_service_is_told_once() -> None:
    latched = EndpointQos(reliable=True, durability=Durability.TRANSIENT_LOCAL)
    server = make_participant(1, reader(RELIABLE, "rq/addRequest"), writer(RELIABLE, "rr/addReply"))
    client = make_participant(
        2, writer(EndpointQos(), "rq/addRequest"), reader(EndpointQos(), "rr/addReply")
    )
    assert len(compare([server], [client]).mismatched) == 1
    other = make_participant(3, writer(latched, "rq/addRequest"), reader(latched, "rr/addReply"))
    (pair,) = compare([server], [other]).mismatched
    assert (pair.topic, pair.mismatch.policy) == ("rr/addReply", "durability")


def many(
    number: int, count: int, make: Callable[..., DdsEndpoint], topic: str = "rt/chatter"
) -> Participant:
    ends = (make(EndpointQos(deadline=float(index)), topic) for index in range(count))
    return make_participant(number, *ends)


HONEST = make_participant(3, writer(kind=LOG))
LISTENER = make_participant(4, reader())
FLOODS: dict[str, tuple[list[Participant], list[Participant]]] = {
    "inside": ([many(1, 300, writer)], [many(2, 300, reader)]),
    "outside": ([], [many(2, MOST_COMPARED_PAIRS + 100, reader)]),
    "of other topics": (
        [many(1, MOST_COMPARED_ENDPOINTS + 100, writer, "rt/other")],
        [many(2, MOST_COMPARED_ENDPOINTS + 100, reader, "rt/other")],
    ),
}


@pytest.mark.parametrize("where", FLOODS)
@pytest.mark.parametrize("is_turned", [False, True])
def test_an_address_with_many_pairs_hides_no_other(where: str, is_turned: bool) -> None:
    """A participant with thousands of readers or writers must not use up all comparisons."""
    flooding_inside, flooding_outside = FLOODS[where]
    inside = [*flooding_inside, HONEST]
    outside = [*flooding_outside, LISTENER]
    comparison = compare(outside, inside) if is_turned else compare(inside, outside)
    assert (HONEST, LISTENER) in [(pair.writer, pair.reader) for pair in comparison.mismatched]
    assert comparison.left_out > 0


def test_so_many_are_compared_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """A participant with 200 readers has 40,000 pairs with 200 writers of the same topic."""
    compared = list[tuple[DdsEndpoint, DdsEndpoint]]()
    monkeypatch.setattr(matching, "mismatch", lambda *pair: compared.append(pair))
    comparison = compare([many(1, 200, writer)], [many(2, 200, reader), many(5, 7, writer)])
    assert len(compared) == MOST_COMPARED_PAIRS
    assert comparison.left_out == 200 * 200 - MOST_COMPARED_PAIRS


def test_a_comparison_has_small_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    done = [0]
    real = matching.mismatch

    def counting(one: DdsEndpoint, other: DdsEndpoint) -> Mismatch | None:
        done[-1] += 1
        return real(one, other)

    monkeypatch.setattr(matching, "mismatch", counting)
    steps = comparison_steps([many(1, 200, writer)], [many(2, 200, reader)])
    for _ in steps:
        done.append(0)  # noqa: PERF401 - `counting` uses the list meanwhile
    assert sum(done) == MOST_COMPARED_PAIRS
    assert max(done) == ITEMS_PER_STEP


def test_the_sides_may_change_between_the_steps_of_a_comparison() -> None:
    inside = many(1, 2 * ITEMS_PER_STEP, writer)
    outside = many(2, ITEMS_PER_STEP, reader)
    steps = comparison_steps([inside], [outside])
    next(steps)
    inside.endpoints.clear()
    outside.endpoints.clear()
    assert len([*steps]) > 1


def test_readers_and_writers_that_are_not_looked_at_are_counted() -> None:
    comparison = compare([many(1, MOST_COMPARED_ENDPOINTS + 5, writer)], [LISTENER])
    assert comparison.left_out == 5


def test_each_name_of_a_partition_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """All pairs of names were: 20,000 writers and readers with four names each took 1.2 s."""
    looked_at = list[str]()

    def is_pattern(partition: str) -> bool:
        looked_at.append(partition)
        return False

    monkeypatch.setattr(matching, "_is_pattern", is_pattern)
    ends = writer(EndpointQos(partitions=(*"abcd",))), reader(EndpointQos(partitions=(*"efgh",)))
    assert mismatch(*ends) == Mismatch("partition", "a b c d", "e f g h")
    assert looked_at == [*"abcdefgh"]
