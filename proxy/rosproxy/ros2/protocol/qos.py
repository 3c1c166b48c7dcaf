"""The QoS of a reader or writer, limited to the policies that decide matching.

SEDP carries a parameter for each policy. A policy that is left out has its default (DDSI-RTPS 2.5,
9.6.3.2). Fast DDS sends all policies, Cyclone DDS only those with another value. A malformed policy
counts as left out: the proxy uses QoS only for reports to the user.

    reliability          kind 4 (1 best effort, 2 reliable), the longest blocking 8
    durability           kind 4 (0 volatile, 1 transient local, 2 transient, 3 persistent)
    liveliness           kind 4 (0 automatic, 1 by participant, 2 by topic), lease duration 8
    deadline             period 8
    ownership            kind 4 (0 shared, 1 exclusive)
    partition            count 4, so many strings
    data representation  count 4, so many kinds of 2 (0 XCDR, 1 XML, 2 XCDR2; XTypes 1.3, 7.6.3.1)
"""

import struct
from collections.abc import Iterator
from enum import IntEnum

import msgspec

from rosproxy.ros2.protocol.parameters import Parameter, ParameterList, Pid

MOST_PARTITIONS = 4
"""Partitions of a reader or writer that the proxy reads. ROS 2 itself uses no partitions."""
LONGEST_PARTITION = 64
"""Bytes of a partition's name that the proxy reads."""
MOST_REPRESENTATIONS = 3
"""Data representations of a reader or writer that the proxy reads."""
_RELIABLE = 2
_EXCLUSIVE = 1


class Durability(IntEnum):
    """Whether a reader receives samples from before its start. A greater kind offers more."""

    VOLATILE = 0
    TRANSIENT_LOCAL = 1
    TRANSIENT = 2
    PERSISTENT = 3


class Liveliness(IntEnum):
    """What asserts that a writer is alive. A greater kind is more exact."""

    AUTOMATIC = 0
    MANUAL_BY_PARTICIPANT = 1
    MANUAL_BY_TOPIC = 2


class EndpointQos(msgspec.Struct, frozen=True):
    """The QoS that a writer offers, or that a reader requests. Times are in seconds.

    ``partitions`` is None if the endpoint has more or longer partitions than the proxy reads.
    ``representations`` are kinds; an empty tuple means XCDR alone.
    """

    reliable: bool = False
    durability: Durability = Durability.VOLATILE
    deadline: float = float("inf")
    liveliness: Liveliness = Liveliness.AUTOMATIC
    liveliness_lease: float = float("inf")
    exclusive: bool = False
    partitions: tuple[str, ...] | None = ()
    representations: tuple[int, ...] = ()


def read_qos(datagram: bytes, parameters: ParameterList, is_writer: bool) -> EndpointQos:
    """The QoS in the announcement of a reader or writer. Never raises.

    By default a writer is reliable, and a reader is not (DDS 1.4, 2.2.3.14).
    """
    # If an id is repeated, the first parameter counts.
    by_pid = {p.pid: p for p in reversed(parameters.parameters)}

    def kind(pid: Pid, default: int) -> int:
        numbers = _unpacked(datagram, parameters, by_pid.get(pid), "I")
        return numbers[0] if numbers else default

    def seconds(pid: Pid, leading: str = "") -> float:
        numbers = _unpacked(datagram, parameters, by_pid.get(pid), f"{leading}iI")
        if not numbers or numbers[-2] == 0x7FFFFFFF:  # DURATION_INFINITE
            return float("inf")
        return numbers[-2] + numbers[-1] / 2**32

    return EndpointQos(
        reliable=kind(Pid.RELIABILITY, _RELIABLE if is_writer else 0) >= _RELIABLE,
        durability=Durability(min(kind(Pid.DURABILITY, 0), max(Durability))),
        deadline=seconds(Pid.DEADLINE),
        liveliness=Liveliness(min(kind(Pid.LIVELINESS, 0), max(Liveliness))),
        liveliness_lease=seconds(Pid.LIVELINESS, "I"),
        exclusive=kind(Pid.OWNERSHIP, 0) == _EXCLUSIVE,
        partitions=_partitions(datagram, parameters, by_pid.get(Pid.PARTITION)),
        representations=_representations(datagram, parameters, by_pid.get(Pid.DATA_REPRESENTATION)),
    )


def _unpacked(
    datagram: bytes, parameters: ParameterList, parameter: Parameter | None, layout: str
) -> tuple[int, ...]:
    """The numbers at the start of a parameter; empty if the parameter is too short or None."""
    if parameter is None:
        return ()
    start = parameter.value.start
    size = struct.calcsize(f"={layout}")
    if parameter.value.end - start < size:
        return ()
    return struct.unpack_from(parameters.order + layout, datagram, start)


def _partitions(
    datagram: bytes, parameters: ParameterList, parameter: Parameter | None
) -> tuple[str, ...] | None:
    (count,) = _unpacked(datagram, parameters, parameter, "I") or (0,)
    if parameter is None or not count:
        return ()
    if count > MOST_PARTITIONS:
        return None
    partitions = list(_strings(datagram, parameters, parameter, count))
    return tuple(partitions) if len(partitions) == count else None


def _strings(
    datagram: bytes, parameters: ParameterList, parameter: Parameter, count: int
) -> Iterator[str]:
    """Yield the strings of a sequence, up to the first malformed one.

    On the wire, a string is a length and so many bytes, padded to a multiple of four.
    """
    offset = parameter.value.start + 4
    end = parameter.value.end
    for _ in range(count):
        if offset + 4 > end:
            return
        (size,) = struct.unpack_from(parameters.order + "I", datagram, offset)
        if size > LONGEST_PARTITION or offset + 4 + size > end:
            return
        yield datagram[offset + 4 : offset + 4 + size].split(b"\0")[0].decode("utf-8", "replace")
        offset += 4 + size + -size % 4


def _representations(
    datagram: bytes, parameters: ParameterList, parameter: Parameter | None
) -> tuple[int, ...]:
    (count,) = _unpacked(datagram, parameters, parameter, "I") or (0,)
    return _unpacked(datagram, parameters, parameter, f"I{min(count, MOST_REPRESENTATIONS)}h")[1:]
