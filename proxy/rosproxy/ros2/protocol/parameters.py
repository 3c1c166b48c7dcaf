"""Parameter lists: the descriptions of participants, readers and writers.

A list is a row of parameters up to PID_SENTINEL. Each parameter has an id, a length and a value.
The payload of a discovery sample is a list after four bytes, which state the byte order. A DATA may
also have a list before the payload, the *inline QoS*. To remove a parameter, the proxy overwrites
the id with PID_PAD, which receivers skip (DDSI-RTPS 2.5, 9.4.2.11).
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
"""PL_CDR_BE, the encoding of a big-endian parameter list."""
_LITTLE = 0x0003
"""PL_CDR_LE, the encoding of a little-endian parameter list."""


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
    """Parameters of Fast DDS about the machine of a participant, and the memory shared there.

    The meaning of ids from 0x8000 on depends on the vendor (ParameterTypes.hpp).
    """

    MACHINE_ID = 0x8003
    DATA_SHARING = 0x8006
    NETWORK_CONFIGURATION = 0x8007


OLD_LOCATORS = (0x0B, 0x0C, 0x0D, 0x0E, 0x11, 0x45, 0x46)
"""The addresses and ports of locators as separate parameters. RTPS 2.1 had these, and Cyclone DDS
still uses them (ddsi_plist.c)."""


class Parameter(msgspec.Struct, frozen=True):
    """A parameter, with the position of the id (``offset``) and of the value in the datagram."""

    pid: int
    offset: int
    value: Span


class ParameterList(msgspec.Struct, frozen=True):
    """The parameters of a list in a datagram; ``is_little_endian`` is its byte order."""

    is_little_endian: bool
    parameters: tuple[Parameter, ...]

    def all(self, *pids: int) -> list[Parameter]:
        """The parameters with one of these ids, in the order of the list."""
        return [p for p in self.parameters if p.pid in pids]

    def number(self, datagram: bytes, pid: int) -> int | None:
        """The first 32-bit number with an id; None if the list has none of sufficient length."""
        for param in self.all(pid):
            if param.value.end - param.value.start >= 4:
                number: int = struct.unpack_from(self.order + "I", datagram, param.value.start)[0]
                return number
        return None

    def seconds(self, datagram: bytes, pid: int) -> float | None:
        """The first duration with an id, in seconds, or infinite; None if the list has none.

        On the wire, a duration is whole seconds and a number of 2**-32 seconds.
        """
        for param in self.all(pid):
            if param.value.end - param.value.start >= 8:
                whole, fraction = struct.unpack_from(self.order + "iI", datagram, param.value.start)
                return float("inf") if whole == 0x7FFFFFFF else whole + fraction / 2**32
        return None

    def text(self, datagram: bytes, pid: int) -> str | None:
        """The first string with an id; None if the list has none of sufficient length.

        On the wire, a string is a length and so many bytes, of which the last is zero.
        """
        size = self.number(datagram, pid)
        for param in self.all(pid) if size else ():
            start = param.value.start + 4
            if size and start + size <= param.value.end:
                return datagram[start : start + size].split(b"\0")[0].decode("utf-8", "replace")
        return None

    @property
    def order(self) -> str:
        """The byte order in the notation of `struct`."""
        return "<" if self.is_little_endian else ">"

    def removed(self, parameter: Parameter) -> Overwrite:
        """The edit that removes a parameter."""
        return Overwrite(parameter.offset, struct.pack(self.order + "H", Pid.PAD))

    def zeroed(self, parameter: Parameter) -> Overwrite:
        """The edit that sets all bytes of a parameter's value to zero."""
        start = parameter.value.start
        end = parameter.value.end
        return Overwrite(start, bytes(end - start))


def payload_parameters(datagram: bytes, sample: Sample) -> ParameterList | None:
    """The parameter list in a sample's payload; None if the payload is not a parameter list.

    Raises RtpsError if the list has no end, or a length leads outside the list. A DATA_FRAG has to
    carry the whole sample.
    """
    span = sample.payload
    if span is None or span.end - span.start < 4:
        return None
    encoding = int.from_bytes(datagram[span.start : span.start + 2], "big")
    if encoding not in (_BIG, _LITTLE):
        return None
    return _read(datagram, Span(span.start + 4, span.end), encoding == _LITTLE)


def inline_parameters(datagram: bytes, sample: Sample) -> ParameterList | None:
    """The inline QoS of a sample; None if the sample has none. Raises RtpsError."""
    return (
        _read(datagram, sample.inline_qos, sample.is_little_endian) if sample.inline_qos else None
    )


def _read(datagram: bytes, span: Span, is_little_endian: bool) -> ParameterList:
    parameters = tuple(
        Parameter(pid, offset, Span(offset + 4, end))
        for pid, offset, end in walk_parameters(datagram, span, is_little_endian)
        if pid != SENTINEL
    )
    return ParameterList(is_little_endian, parameters)
