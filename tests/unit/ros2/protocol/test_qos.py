"""The QoS that readers and writers announce."""

import struct
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol.parameters import Pid, payload_parameters
from rosproxy.ros2.protocol.qos import (
    LONGEST_PARTITION,
    MOST_PARTITIONS,
    Durability,
    EndpointQos,
    Liveliness,
    read_qos,
)
from rosproxy.ros2.protocol.rtps import samples
from tests.unit.ros2.protocol.messages import VALUES, data, message, order, payload

# What Fast DDS 2.14 (Jazzy) announces of a publisher of QoSProfile(depth=10), and Cyclone DDS 11 of
# a reliable reader, without names and locators.
JAZZY = [
    (0x1D, "00000000"),
    (0x1E, "00000000000000000000000001000000ffffffffffffffffffffffff"),
    (0x23, "ffffff7fffffffff"),
    (0x27, "0000000000000000"),
    (0x1B, "00000000ffffff7fffffffff"),
    (0x1A, "02000000000000009a999919"),
    (0x2B, "ffffff7fffffffff"),
    (0x1F, "00000000"),
    (0x25, "00000000"),
    (0x21, "0000000000000000"),
    (0x29, "00000000"),
    (0x73, "0100000000000000"),
]
CYCLONE = [
    (0x1A, "020000000100000000000000"),
    (0x40, "000000000a000000"),
    (0x73, "0200000000000200"),
]
TEXTS = st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=20)
DURATIONS = st.one_of(st.just(float("inf")), st.integers(0, 2**31 - 2).map(float))
QOS = st.builds(
    EndpointQos,
    reliable=st.booleans(),
    durability=st.sampled_from(Durability),
    deadline=DURATIONS,
    liveliness=st.sampled_from(Liveliness),
    liveliness_lease=DURATIONS,
    exclusive=st.booleans(),
    partitions=st.lists(TEXTS, max_size=MOST_PARTITIONS).map(tuple),
    representations=st.lists(st.integers(0, 2), max_size=3).map(tuple),
)


def read(
    parameters: Sequence[tuple[int, bytes]], of_writer: bool, little: bool = True
) -> EndpointQos:
    datagram = message(data(payload(parameters, little)))
    (sample,) = samples(datagram)
    parsed = payload_parameters(datagram, sample)
    assert parsed is not None
    return read_qos(datagram, parsed, of_writer)


def duration(seconds: float, mark: str) -> bytes:
    if seconds == float("inf"):
        return struct.pack(mark + "iI", 0x7FFFFFFF, 0xFFFFFFFF)
    return struct.pack(mark + "iI", int(seconds), 0)


def string(text: str, mark: str) -> bytes:
    raw = text.encode() + b"\0"
    return struct.pack(mark + "I", len(raw)) + raw + bytes(-len(raw) % 4)


def written(qos: EndpointQos, mark: str) -> list[tuple[int, bytes]]:
    partitions = qos.partitions or ()
    kinds = qos.representations
    rows = b"".join(string(name, mark) for name in partitions)
    values = struct.pack(f"{mark}I{len(kinds)}h", len(kinds), *kinds)
    return [
        (Pid.RELIABILITY, struct.pack(mark + "IiI", 2 if qos.reliable else 1, 0, 0)),
        (Pid.DURABILITY, struct.pack(mark + "I", qos.durability)),
        (Pid.DEADLINE, duration(qos.deadline, mark)),
        (
            Pid.LIVELINESS,
            struct.pack(mark + "I", qos.liveliness) + duration(qos.liveliness_lease, mark),
        ),
        (Pid.OWNERSHIP, struct.pack(mark + "I", qos.exclusive)),
        (Pid.PARTITION, struct.pack(mark + "I", len(partitions)) + rows),
        (Pid.DATA_REPRESENTATION, values + bytes(-len(values) % 4)),
    ]


@given(QOS, st.booleans(), st.booleans())
def test_what_is_written_is_read(qos: EndpointQos, of_writer: bool, little: bool) -> None:
    assert read(written(qos, order(little)), of_writer, little) == qos


def test_what_is_left_out_has_its_default() -> None:
    assert read([], of_writer=True) == EndpointQos(reliable=True)
    assert read([], of_writer=False) == EndpointQos(reliable=False)


def test_what_real_ones_announce() -> None:
    parameters = [(pid, bytes.fromhex(value)) for pid, value in JAZZY]
    assert read(parameters, of_writer=True) == EndpointQos(reliable=True, representations=(0,))
    parameters = [(pid, bytes.fromhex(value)) for pid, value in CYCLONE]
    assert read(parameters, of_writer=False) == EndpointQos(reliable=True, representations=(0, 2))


@pytest.mark.parametrize(
    "value",
    [
        struct.pack("<I", MOST_PARTITIONS + 1) + string("a", "<") * (MOST_PARTITIONS + 1),
        struct.pack("<I", 1) + string("a" * LONGEST_PARTITION, "<"),
        struct.pack("<I", 2) + string("a", "<"),
        struct.pack("<II", 1, 2**32 - 1),
        struct.pack("<I", 2**32 - 1),
    ],
    ids=["many", "long", "cut", "outside", "lie"],
)
def test_partitions_that_can_t_be_read_are_unknown(value: bytes) -> None:
    assert read([(Pid.PARTITION, value)], of_writer=True).partitions is None


def test_kinds_that_do_not_exist() -> None:
    parameters = [(pid, struct.pack("<IiI", 99, 0, 0)) for pid in (Pid.DURABILITY, Pid.LIVELINESS)]
    qos = read([*parameters, (Pid.RELIABILITY, b"\3\0\0\0")], of_writer=True)
    assert qos == EndpointQos(
        reliable=True,
        durability=Durability.PERSISTENT,
        liveliness=Liveliness.MANUAL_BY_TOPIC,
        liveliness_lease=0.0,
    )


@given(
    st.lists(
        st.tuples(st.sampled_from([0x1A, 0x1B, 0x1D, 0x1F, 0x23, 0x29, 0x73]), VALUES),
        max_size=10,
    ),
    st.booleans(),
    st.booleans(),
)
def test_whatever_stands_there_is_read(
    parameters: list[tuple[int, bytes]], of_writer: bool, little: bool
) -> None:
    qos = read(parameters, of_writer, little)
    assert len(qos.partitions or ()) <= MOST_PARTITIONS
    assert all(len(name) <= LONGEST_PARTITION for name in qos.partitions or ())
