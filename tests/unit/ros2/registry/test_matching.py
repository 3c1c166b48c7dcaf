"""Which writer and reader match across the boundary, and why not."""

from collections.abc import Callable

import pytest
from hypothesis import given
from msgspec.structs import replace

from rosproxy.ros2.protocol.qos import Durability, EndpointQos, Liveliness
from rosproxy.ros2.registry.matching import Mismatch, mismatch, mismatched_pairs
from rosproxy.ros2.registry.participants import DdsEndpoint, EndpointKind, Participant
from tests.unit.ros2.protocol.test_qos import QOS

STRING, LOG = "std_msgs::msg::dds_::String_", "rcl_interfaces::msg::dds_::Log_"
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
    assert mismatched_pairs([publisher], []) == []
    subscriber = make_participant(
        2, reader(RELIABLE), writer(RELIABLE), reader(RELIABLE, "rt/other")
    )
    (pair,) = mismatched_pairs([publisher], [subscriber])
    assert (pair.writer, pair.reader, pair.mismatch.policy) == (
        publisher,
        subscriber,
        "reliability",
    )
    (pair,) = mismatched_pairs([subscriber], [publisher])
    assert (pair.writer, pair.reader) == (publisher, subscriber)


def test_a_service_is_told_once() -> None:
    latched = EndpointQos(reliable=True, durability=Durability.TRANSIENT_LOCAL)
    server = make_participant(1, reader(RELIABLE, "rq/addRequest"), writer(RELIABLE, "rr/addReply"))
    client = make_participant(
        2, writer(EndpointQos(), "rq/addRequest"), reader(EndpointQos(), "rr/addReply")
    )
    assert len(mismatched_pairs([server], [client])) == 1
    other = make_participant(3, writer(latched, "rq/addRequest"), reader(latched, "rr/addReply"))
    (pair,) = mismatched_pairs([server], [other])
    assert (pair.topic, pair.mismatch.policy) == ("rr/addReply", "durability")


def test_so_many_are_compared_and_no_more() -> None:
    """Whoever has two hundred readers has as many pairs with two hundred writers of one topic."""

    def many(number: int, make: Callable[[EndpointQos], DdsEndpoint]) -> Participant:
        ends = (make(EndpointQos(deadline=float(index))) for index in range(200))
        return make_participant(number, *ends)

    last = make_participant(3, writer(kind=LOG))
    assert len(mismatched_pairs([last], [many(2, reader)])) == 1
    pairs = mismatched_pairs([many(1, writer), last], [many(2, reader)])
    assert [pair.writer.address for pair in pairs] == ["10.0.0.1"]
