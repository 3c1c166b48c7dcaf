"""RTPS messages of the demonstration, and the submessages that the proxy does not parse.

A message is for a single participant, and is a row of submessages: samples (DATA), the numbers that
a writer has (HEARTBEAT), and the numbers that a reader has and lacks (ACKNACK). The sample of an
announcement is a parameter list, the sample of a talker a `std_msgs/String`. Layouts and names are
from DDSI-RTPS 2.5, 8.3 and 9.4. All numbers are little-endian. `rosproxy.ros2.protocol` parses
everything else, locators too.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from rosproxy.ros2.protocol.rtps import MAGIC, SENTINEL, VERSION, SubmessageId, submessages

VENDOR = b"\x01\xff"
"""A vendor id that is not in OMG's list."""
MOST_ASKED = 32
"""Samples that an ACKNACK asks for at once: a single word of bits, of at most eight (9.4.2.6)."""
_LITTLE = 0x01
_FINAL = 0x02
_PAYLOAD = 0x04
_CDR = b"\x00\x01\x00\x00"
_PARAMETER_LIST = b"\x00\x03\x00\x00"
"""Encodings of a payload: CDR_LE, PL_CDR_LE."""


@dataclass(frozen=True)
class Told:
    """A HEARTBEAT, GAP or ACKNACK submessage.

    HEARTBEAT: the writer has the numbers from `first` to `last`; with `asks`, the writer wants an
    answer. GAP: the numbers from `first` to `last` do not exist. ACKNACK: the reader has all
    numbers before `first`, and asks for `missing`.
    """

    kind: int
    reader: int
    writer: int
    first: int
    last: int = 0
    asks: bool = False
    missing: tuple[int, ...] = ()


def message(prefix: bytes, to: bytes, *parts: bytes) -> bytes:
    """A message for the participant with the prefix `to`; bytes(12) for all participants."""
    meant = _submessage(SubmessageId.INFO_DST, 0, to)
    return MAGIC + VERSION + VENDOR + prefix + meant + b"".join(parts)


def data(reader: int, writer: int, sequence: int, payload: bytes) -> bytes:
    """A sample for a reader; for all readers with reader 0."""
    body = struct.pack("<HH", 0, 16) + struct.pack(">II", reader, writer) + _number(sequence)
    return _submessage(SubmessageId.DATA, _PAYLOAD, body + payload)


def heartbeat(reader: int, writer: int, first: int, last: int, count: int) -> bytes:
    """A heartbeat that wants an answer. If `first` exceeds `last`, the writer has no samples."""
    body = struct.pack(">II", reader, writer) + _number(first) + _number(last)
    return _submessage(SubmessageId.HEARTBEAT, 0, body + struct.pack("<i", count))


def acknack(reader: int, writer: int, base: int, missing: range, count: int) -> bytes:
    """An ACKNACK that wants no answer: the reader has all before `base`, and lacks `missing`."""
    bits = min(len(missing), MOST_ASKED)
    bitmap = 2**MOST_ASKED - 2 ** (MOST_ASKED - bits)  # the first number is the highest bit
    asked = struct.pack("<II", bits, bitmap) if bits else struct.pack("<I", 0)
    body = struct.pack(">II", reader, writer) + _number(base) + asked
    return _submessage(SubmessageId.ACKNACK, _FINAL, body + struct.pack("<i", count))


def told(datagram: bytes) -> Iterator[Told]:
    """All heartbeats, gaps and ACKNACKs in a message. Raises RtpsError, or struct.error."""
    for kind, flags, body in submessages(datagram):
        if kind not in (SubmessageId.HEARTBEAT, SubmessageId.GAP, SubmessageId.ACKNACK):
            continue
        mark = "<" if flags & _LITTLE else ">"
        reader, writer = struct.unpack_from(">II", datagram, body.start)
        (first, *more) = _numbers(mark, datagram[body.start + 8 : body.end])
        if kind == SubmessageId.HEARTBEAT:
            yield Told(kind, reader, writer, first, more[0], asks=not flags & _FINAL)
        elif kind == SubmessageId.GAP:
            yield Told(kind, reader, writer, first, more[0] - 1)
        else:
            missing = _missing(mark, datagram[body.start + 8 : body.end])
            yield Told(kind, reader, writer, first, missing=missing)


def parameter_list(parameters: Iterable[tuple[int, bytes]]) -> bytes:
    """A payload of discovery."""
    padded = ((pid, value + bytes(-len(value) % 4)) for pid, value in parameters)
    encoded = b"".join(struct.pack("<HH", pid, len(value)) + value for pid, value in padded)
    return _PARAMETER_LIST + encoded + struct.pack("<HH", SENTINEL, 0)


def string(text: str) -> bytes:
    """A string of CDR."""
    encoded = text.encode() + b"\0"
    return struct.pack("<I", len(encoded)) + encoded


def pack_string(text: str) -> bytes:
    """A `std_msgs/String` as a payload."""
    return _CDR + string(text)


def unpack_string(payload: bytes) -> str:
    """The text of a `std_msgs/String`. Raises struct.error, UnicodeDecodeError."""
    (size,) = struct.unpack_from("<I" if payload[1] & 1 else ">I", payload, 4)
    return payload[8 : 8 + size].rstrip(b"\0").decode()


def _submessage(kind: int, flags: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)  # the next submessage begins at a multiple of four
    return struct.pack("<BBH", kind, flags | _LITTLE, len(body)) + body


def _number(value: int) -> bytes:
    return struct.pack("<iI", value >> 32, value & 0xFFFFFFFF)


def _numbers(mark: str, body: bytes) -> list[int]:
    """The sequence numbers in a body. A remainder of less than 8 bytes is ignored."""
    whole = struct.iter_unpack(mark + "iI", body[: len(body) // 8 * 8])
    return [(high << 32) + low for high, low in whole]


def _missing(mark: str, numbers: bytes) -> tuple[int, ...]:
    """The members of a set of sequence numbers (9.4.2.6): a base, and a bit for each number."""
    (base,) = _numbers(mark, numbers[:8])
    (bits,) = struct.unpack_from(mark + "I", numbers, 8)
    words = struct.unpack_from(f"{mark}{-(-bits // 32)}I", numbers, 12)
    return tuple(base + bit for bit in range(bits) if words[bit // 32] >> (31 - bit % 32) & 1)
