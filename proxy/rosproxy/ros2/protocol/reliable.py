"""The submessages of the reliable protocol: heartbeats, acknowledgements and gaps.

    HEARTBEAT  reader 4, writer 4, first number 8, last number 8, count 4
    ACKNACK    reader 4, writer 4, a set of numbers (base 8, bits 4, words), count 4
    GAP        reader 4, writer 4, first number 8, a set of numbers
    NACK_FRAG  reader 4, writer 4, number 8, a set of fragments (base 4, bits 4, words), count 4

A HEARTBEAT of a writer states which samples the writer has. The reader answers with an ACKNACK,
which names the missing samples and confirms all samples before these (DDSI-RTPS 2.5, 8.3.8.1 and
8.3.8.6). A GAP of a writer states that samples are not for the reader. The reader then continues
without these samples (8.3.8.4).
"""

import struct
from collections.abc import Collection, Iterator, Sequence

import msgspec

from rosproxy.ros2.protocol.rtps import (
    LAST_SEQUENCE_NUMBER,
    PREFIX_BYTES,
    Overwrite,
    RtpsError,
    Sample,
    SubmessageId,
    message_header,
    submessages,
)

MOST_ASKED = 256
"""The highest number of samples that a reader may request at once: the bits of a set (9.4.2.6)."""
_LITTLE = 0x01
_FINAL = 0x02
_GAP_SIZE = 28
"""Bytes of a GAP with one number."""
_READER_ID_OFFSET = 5
"""The entity id of a builtin writer (…c2) plus this is the entity id of its reader (…c7)."""


class Heartbeat(msgspec.Struct, frozen=True):
    """The numbers of the first and last sample of a writer. The writer has none if first > last."""

    writer: int
    first: int
    last: int


def heartbeats(datagram: bytes) -> Iterator[Heartbeat]:
    """Yield all heartbeats in a message. Raises RtpsError for an impossible length or number."""
    for kind, flags, body in submessages(datagram):
        if kind == SubmessageId.HEARTBEAT and body.end - body.start >= 28:
            order = "<" if flags & _LITTLE else ">"
            numbers = struct.unpack_from(order + "iIiI", datagram, body.start + 8)
            writer = int.from_bytes(datagram[body.start + 4 : body.start + 8], "big")
            first = _number(*numbers[:2])
            last = _number(*numbers[2:])
            if last > LAST_SEQUENCE_NUMBER:
                raise RtpsError(f"a heartbeat has the impossible last number {last}")
            yield Heartbeat(writer, first, last)


def heartbeat(own: bytes, to: bytes, writer: int, first: int, count: int) -> bytes:
    """The message in which a builtin writer tells a participant that the writer has no sample.

    ``first`` is the number of the writer's next sample. The reader answers with the number of the
    sample that the reader expects.
    """
    body = struct.pack(">II", writer + _READER_ID_OFFSET, writer)
    last = first - 1
    body += struct.pack("<iIiI", first >> 32, first & 0xFFFFFFFF, last >> 32, last & 0xFFFFFFFF)
    return _directed(own, to, SubmessageId.HEARTBEAT, _LITTLE, body + _packed_count(count))


def acknowledged(datagram: bytes, prefix: bytes, writer: int) -> list[int]:
    """The next numbers that the readers in a message expect from a writer of a participant.

    ``prefix`` is the GUID prefix of the participant. Cyclone DDS puts answers to several
    participants at one locator into one message. Each answer is for the participant of the last
    INFO_DST before the answer. Raises RtpsError if a length leads outside the datagram.
    """
    numbers = []
    addressee = b""
    for kind, flags, body in submessages(datagram):
        if kind == SubmessageId.INFO_DST:
            addressee = datagram[body.start : body.start + PREFIX_BYTES]
        is_answer = kind == SubmessageId.ACKNACK and addressee == prefix
        if is_answer and body.end - body.start >= 16:
            acked_writer = int.from_bytes(datagram[body.start + 4 : body.start + 8], "big")
            order = "<" if flags & _LITTLE else ">"
            base = _number(*struct.unpack_from(order + "iI", datagram, body.start + 8))
            numbers += [base] if acked_writer == writer else []
    return numbers


def acknack(
    own: bytes, to: bytes, writer: int, base: int, missing: Collection[int], count: int, final: bool
) -> bytes:
    """The message in which a builtin reader requests samples from a participant's writer.

    The reader has all samples before ``base``. ``missing`` are at most MOST_ASKED numbers from
    ``base`` on. Unless ``final`` is set, the writer answers with a heartbeat.
    """
    # Cyclone DDS ignores an ACKNACK without a reader (ddsi_receive.c, validate_AckNack).
    body = struct.pack(">II", writer + _READER_ID_OFFSET, writer)
    body += struct.pack("<iI", base >> 32, base & 0xFFFFFFFF)
    body += _bits([number - base for number in missing]) + _packed_count(count)
    flags = _LITTLE | (_FINAL if final else 0)
    return _directed(own, to, SubmessageId.ACKNACK, flags, body)


def nack_frag(
    own: bytes, to: bytes, writer: int, sequence: int, missing: Sequence[int], count: int
) -> bytes:
    """The message in which a builtin reader requests fragments of a sample (8.3.8.10).

    ``missing`` are the numbers of the fragments, in ascending order and at least one. Numbers that
    are MOST_ASKED or more above the first are left out.
    """
    body = struct.pack(">II", writer + _READER_ID_OFFSET, writer)
    body += struct.pack("<iII", sequence >> 32, sequence & 0xFFFFFFFF, missing[0])
    body += _bits([number - missing[0] for number in missing]) + _packed_count(count)
    return _directed(own, to, SubmessageId.NACK_FRAG, _LITTLE, body)


def withheld(sample: Sample) -> Overwrite:
    """The edit that turns a DATA or DATA_FRAG into a GAP: the sample is not for this reader.

    The other bytes of the submessage become a PAD of zeros. Raises RtpsError if the submessage is
    too short for a GAP. Announcements of readers and writers are long enough.
    """
    order, flag = ("<", _LITTLE) if sample.is_little_endian else (">", 0)
    size = sample.body.end - sample.body.start
    next_sequence = sample.sequence + 1
    if size < _GAP_SIZE + 4:
        raise RtpsError(f"a sample of discovery has {size} bytes, which is too short")
    # A PAD may have the length 0. Here 0 does not mean "up to the end" (9.4.5.1.3).
    pad = size - _GAP_SIZE - 4
    gap = struct.pack(order + "BBH", SubmessageId.GAP, flag, _GAP_SIZE)
    gap += struct.pack(">II", sample.reader, sample.writer)
    for number in (sample.sequence, next_sequence):
        gap += struct.pack(order + "iI", number >> 32, number & 0xFFFFFFFF)
    gap += struct.pack(order + "IBBH", 0, SubmessageId.PAD, flag, pad)
    return Overwrite(sample.body.start - 4, gap + bytes(pad))


def _directed(own: bytes, to: bytes, kind: int, flags: int, body: bytes) -> bytes:
    """A message of the proxy with one submessage for one participant."""
    info_dst = struct.pack("<BBH", SubmessageId.INFO_DST, _LITTLE, len(to)) + to
    return message_header(own) + info_dst + struct.pack("<BBH", kind, flags, len(body)) + body


def _bits(numbers: Collection[int]) -> bytes:
    """The set of these numbers: the count of bits, and the bits in 32-bit words (9.4.2.6, 9.4.2.8).

    Numbers below 0 and from MOST_ASKED on are left out.
    """
    requested = [n for n in numbers if 0 <= n < MOST_ASKED]
    bit_count = max(requested, default=-1) + 1
    bitmap = [0] * -(-bit_count // 32)
    for number in requested:
        bitmap[number // 32] |= 1 << (31 - number % 32)
    return struct.pack(f"<I{len(bitmap)}I", bit_count, *bitmap)


def _packed_count(count: int) -> bytes:
    """A count modulo 2**32. Receivers use the count to recognise repeated submessages."""
    return struct.pack("<I", count & 0xFFFFFFFF)


def _number(high: int, low: int) -> int:
    return (high << 32) + low
