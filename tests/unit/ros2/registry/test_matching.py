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


def participant(number: int, *ends: DdsEndpoint) -> Participant:
    one = Participant(bytes([number] * 12), f"10.0.0.{number}", b"\x01\x0f", 0.0)
    for index, end in enumerate(ends):
        one.endpoints[bytes([0, 0, index // 256, index % 256])] = end
    return one


@pytest.mark.parametrize(
    ("offered", "requested", "found"),
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
def test_what_does_not_match(offered: EndpointQos, requested: EndpointQos, found: Mismatch) -> None:
    assert mismatch(writer(offered), reader(requested)) == found


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
    for one, other in ((mine, theirs), (theirs, mine)):
        ends = writer(EndpointQos(partitions=one)), reader(EndpointQos(partitions=other))
        assert mismatch(*ends) is None


def test_two_patterns_do_not_match() -> None:
    ends = writer(EndpointQos(partitions=("a*",))), reader(EndpointQos(partitions=("*",)))
    assert mismatch(*ends) == Mismatch("partition", "a*", "*")


def test_the_type_comes_first() -> None:
    found = mismatch(writer(EndpointQos(), kind=LOG), reader(kind=STRING))
    assert found == Mismatch("type", "rcl_interfaces/msg/Log", "std_msgs/msg/String")


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
    found = mismatch(writer(more), reader(requested))
    policies = {"ownership", "partition", "data representation"}
    assert found is None or found.policy in policies
    if mismatch(writer(offered), reader(requested)) is None:
        assert found is None


def test_only_pairs_across_the_boundary_are_looked_at() -> None:
    here = participant(1, writer(EndpointQos()), reader(RELIABLE))
    assert mismatched_pairs([here], []) == []
    there = participant(2, reader(RELIABLE), writer(RELIABLE), reader(RELIABLE, "rt/other"))
    (found,) = mismatched_pairs([here], [there])
    assert (found.writer, found.reader, found.mismatch.policy) == (here, there, "reliability")
    (found,) = mismatched_pairs([there], [here])
    assert (found.writer, found.reader) == (here, there)


def test_a_service_is_told_once() -> None:
    latched = EndpointQos(reliable=True, durability=Durability.TRANSIENT_LOCAL)
    server = participant(1, reader(RELIABLE, "rq/addRequest"), writer(RELIABLE, "rr/addReply"))
    client = participant(
        2, writer(EndpointQos(), "rq/addRequest"), reader(EndpointQos(), "rr/addReply")
    )
    assert len(mismatched_pairs([server], [client])) == 1
    other = participant(3, writer(latched, "rq/addRequest"), reader(latched, "rr/addReply"))
    (found,) = mismatched_pairs([server], [other])
    assert (found.topic, found.mismatch.policy) == ("rr/addReply", "durability")


def test_so_many_are_compared_and_no_more() -> None:
    """Whoever has two hundred readers has as many pairs with two hundred writers of one topic."""

    def many(number: int, make: Callable[[EndpointQos], DdsEndpoint]) -> Participant:
        ends = (make(EndpointQos(deadline=float(index))) for index in range(200))
        return participant(number, *ends)

    last = participant(3, writer(kind=LOG))
    assert len(mismatched_pairs([last], [many(2, reader)])) == 1
    found = mismatched_pairs([many(1, writer), last], [many(2, reader)])
    assert [one.writer.address for one in found] == ["10.0.0.1"]
