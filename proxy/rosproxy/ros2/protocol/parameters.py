"""Parameter lists: what a participant and its readers and writers say of themselves.

A list is a row of parameters, each an id, a length and a value, up to PID_SENTINEL. The samples of
discovery have one as their payload, after four bytes that tell its byte order; DATA may have one in
front as *inline QoS*. A parameter is taken out by giving it the id PID_PAD, which everybody skips
(DDSI-RTPS 2.5, 9.4.2.11).
"""

import struct
from enum import IntEnum

import msgspec

from rosproxy.ros2.protocol.rtps import (
    SENTINEL,
    Overwrite,
    Sample,
    Span,
    walk_parameters,
)

_BIG = 0x0002
_LITTLE = 0x0003
"""PL_CDR_BE and PL_CDR_LE, the encodings of a parameter list."""


class Pid(IntEnum):
    """The parameters that the proxy reads."""

    PAD = 0x00
    PARTICIPANT_LEASE_DURATION = 0x02
    TOPIC_NAME = 0x05
    TYPE_NAME = 0x07
    DOMAIN_ID = 0x0F
    PROTOCOL_VERSION = 0x15
    VENDOR_ID = 0x16
    RELIABILITY = 0x1A
    LIVELINESS = 0x1B
    DURABILITY = 0x1D
    OWNERSHIP = 0x1F
    DEADLINE = 0x23
    PARTITION = 0x29
    UNICAST_LOCATOR = 0x2F
    MULTICAST_LOCATOR = 0x30
    DEFAULT_UNICAST_LOCATOR = 0x31
    METATRAFFIC_UNICAST_LOCATOR = 0x32
    METATRAFFIC_MULTICAST_LOCATOR = 0x33
    DEFAULT_MULTICAST_LOCATOR = 0x48
    PARTICIPANT_GUID = 0x50
    BUILTIN_ENDPOINT_SET = 0x58
    ENDPOINT_GUID = 0x5A
    ENTITY_NAME = 0x62
    KEY_HASH = 0x70
    STATUS_INFO = 0x71
    DATA_REPRESENTATION = 0x73
    IDENTITY_TOKEN = 0x1001
    PERMISSIONS_TOKEN = 0x1002
    PARTICIPANT_SECURITY_INFO = 0x1005


class FastDdsPid(IntEnum):
    """Parameters of Fast DDS that tell what it shares with others on its machine.

    Ids from 0x8000 on have a meaning for each vendor (ParameterTypes.hpp).
    """

    MACHINE_ID = 0x8003
    DATA_SHARING = 0x8006
    NETWORK_CONFIGURATION = 0x8007


OLD_LOCATORS = (0x0B, 0x0C, 0x0D, 0x0E, 0x11, 0x45, 0x46)
"""Addresses and ports of locators, each a parameter of its own: RTPS 2.1 had them, and Cyclone DDS
still goes by them (ddsi_plist.c)."""


class Parameter(msgspec.Struct, frozen=True):
    """A parameter: its id, where that stands in the datagram, and where its value is."""

    pid: int
    offset: int
    value: Span


class ParameterList(msgspec.Struct, frozen=True):
    """The parameters of a list in a datagram; ``little`` tells their byte order."""

    little: bool
    parameters: tuple[Parameter, ...]

    def all(self, *pids: int) -> list[Parameter]:
        """The parameters with one of these ids, in their order."""
        return [p for p in self.parameters if p.pid in pids]

    def number(self, datagram: bytes, pid: int) -> int | None:
        """The first 32-bit number with an id; None if there is none, or it is too short."""
        for param in self.all(pid):
            if param.value.end - param.value.start >= 4:
                number: int = struct.unpack_from(self.order + "I", datagram, param.value.start)[0]
                return number
        return None

    def seconds(self, datagram: bytes, pid: int) -> float | None:
        """The first duration with an id: whole seconds and 2**-32 of them; it may be infinite."""
        for param in self.all(pid):
            if param.value.end - param.value.start >= 8:
                whole, fraction = struct.unpack_from(self.order + "iI", datagram, param.value.start)
                return float("inf") if whole == 0x7FFFFFFF else whole + fraction / 2**32
        return None

    def text(self, datagram: bytes, pid: int) -> str | None:
        """The first string with an id: its length, and so many bytes, the last of them zero."""
        size = self.number(datagram, pid)
        for param in self.all(pid) if size else ():
            start = param.value.start + 4
            if size and start + size <= param.value.end:
                return datagram[start : start + size].split(b"\0")[0].decode("utf-8", "replace")
        return None

    @property
    def order(self) -> str:
        """The byte order as `struct` has it."""
        return "<" if self.little else ">"

    def removed(self, parameter: Parameter) -> Overwrite:
        """The edit that takes a parameter out."""
        return Overwrite(parameter.offset, struct.pack(self.order + "H", Pid.PAD))

    def zeroed(self, parameter: Parameter) -> Overwrite:
        """The edit that leaves nothing of a parameter's value."""
        start = parameter.value.start
        end = parameter.value.end
        return Overwrite(start, bytes(end - start))


def payload_parameters(datagram: bytes, sample: Sample) -> ParameterList | None:
    """The list that is a sample's payload; None if its payload is something else.

    Raises RtpsError if the list has no end, or a length leads outside. A DATA_FRAG can be read only
    if it carries the whole sample.
    """
    span = sample.payload
    if span is None or span.end - span.start < 4:
        return None
    encoding = int.from_bytes(datagram[span.start : span.start + 2], "big")
    if encoding not in (_BIG, _LITTLE):
        return None
    return _read(datagram, Span(span.start + 4, span.end), encoding == _LITTLE)


def inline_parameters(datagram: bytes, sample: Sample) -> ParameterList | None:
    """The list in front of a sample's payload; None if it has none. Raises RtpsError."""
    return _read(datagram, sample.inline_qos, sample.little) if sample.inline_qos else None


def _read(datagram: bytes, span: Span, little: bool) -> ParameterList:
    parameters = tuple(
        Parameter(pid, offset, Span(offset + 4, end))
        for pid, offset, end in walk_parameters(datagram, span, little)
        if pid != SENTINEL
    )
    return ParameterList(little, parameters)
