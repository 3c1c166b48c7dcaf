"""RTPS messages: the submessages and samples of a datagram, and their positions.

A message is a header and a row of *submessages*. A *sample* is what a writer has written. Two kinds
of submessage carry samples: DATA carries a whole sample, DATA_FRAG a part. The proxy passes all
other submessages unchanged: heartbeats, acknowledgements, and submessages of a vendor.

The proxy never encodes a received message anew. This module returns positions, and an edit
(`Overwrite`) keeps the length of the datagram. So all bytes outside the edits stay, also those of
unknown versions and vendors. There are two exceptions: `by_source` splits a message of several
participants into a message for each, and `FragmentStores` joins the fragments of a sample.

The numbers are bytes:

    header      "RTPS", version 2, vendor 2, GUID prefix 12
    submessage  id 1, flags 1, length 2, body of that length; bit 0 of flags: little-endian
    DATA        extra flags 2, octets to inline QoS 2, reader 4, writer 4, sequence number 8,
                inline QoS if flag 2, payload if flag 4 (or 8: the key alone)
    DATA_FRAG   as DATA up to the sequence number, then first fragment 4, fragments 2,
                fragment size 2, sample size 4, inline QoS if flag 2, a part of the payload
                (flag 4: of the key)
"""

import struct
from collections.abc import Iterable, Iterator
from enum import IntEnum
from functools import lru_cache

import msgspec

MAGIC = b"RTPS"
VERSION = b"\x02\x03"
NO_VENDOR = b"\x00\x00"
RTI = b"\x01\x01"
FAST_DDS = b"\x01\x0f"
CYCLONE_DDS = b"\x01\x10"
HEADER_BYTES = 20
"""Bytes of a message's header."""
ALIGNMENT_BYTES = 4
"""The length of each parameter is a multiple of 4 bytes (9.4.2.11), and so is the length of each
submessage but the last (9.4.1). Fast DDS rounds other lengths up (ParameterList.cpp,
MessageReceiver.cpp). So Fast DDS would find the next parameter at another place than other
implementations."""
PREFIX_BYTES = 12
"""Bytes of a GUID prefix."""
VERSION_TO_PREFIX_BYTES = HEADER_BYTES - len(MAGIC)
"""Bytes of version, vendor and GUID prefix, which both a header and an INFO_SRC contain."""
MOST_SUBMESSAGES = 256
"""Submessages of a datagram that the proxy accepts; real datagrams have a dozen."""

LAST_SEQUENCE_NUMBER = 2**63 - 2
"""The greatest sequence number that the proxy accepts. The proxy can still send the next number.
The least sequence number is 1."""

SENTINEL = 1
"""The id that ends a parameter list. Its length field has no meaning."""
MOST_PARAMETERS = 512
"""Parameters of a list that the proxy accepts, including the sentinel. Real lists have less than
100."""
MOST_INLINE_BYTES = 16 * 1024
"""Bytes of all inline QoS in a datagram. The inline QoS of a discovery sample has 24 to 36
bytes."""
_LITTLE_HEADER = struct.Struct("<HH")
_BIG_HEADER = struct.Struct(">HH")

_LITTLE = 0x01
_QOS = 0x02
_DATA = 0x04
_KEY = 0x08
_FRAGMENT_KEY = 0x04
_CHECKSUM = 0x60
"""Flags of a HEADER_EXTENSION for the kind of checksum; 0: no checksum (DDSI-RTPS 2.5, 9.4.5.2)."""


class RtpsError(ValueError):
    """A datagram that is no RTPS message, or is one that the proxy does not accept."""


class SubmessageId(IntEnum):
    """The submessages that the proxy reads."""

    HEADER_EXTENSION = 0x00
    PAD = 0x01
    ACKNACK = 0x06
    HEARTBEAT = 0x07
    GAP = 0x08
    INFO_TS = 0x09
    INFO_SRC = 0x0C
    INFO_DST = 0x0E
    NACK_FRAG = 0x12
    HEARTBEAT_FRAG = 0x13
    DATA = 0x15
    DATA_FRAG = 0x16


STATISTICS = 0x80
RTI_CRC = 0x80
"""The meaning of submessages from 0x80 on depends on the vendor. Fast DDS ends each message with
a submessage for statistics: the destination, and counts of bytes. RTI Connext sends a checksum."""

# Plain numbers, because members of an enumeration are slow to look up for each datagram.
_INFO_SRC = SubmessageId.INFO_SRC.value
INFO_DST = SubmessageId.INFO_DST.value
_DATA_FRAG = SubmessageId.DATA_FRAG.value
_WITH_SAMPLE = frozenset({SubmessageId.DATA.value, _DATA_FRAG})
MAY_BE_EMPTY = frozenset({SubmessageId.PAD.value, SubmessageId.INFO_TS.value})
"""Submessages for which length 0 means an empty body, not the rest of the message (9.4.5.1.3)."""


class Span(msgspec.Struct, frozen=True):
    """The bytes of a datagram from ``start`` up to, but not including, ``end``."""

    start: int
    end: int


class Fragments(msgspec.Struct, frozen=True):
    """The part of a sample that a DATA_FRAG carries.

    ``first`` is the number of the first fragment, from 1 on. ``count`` is the number of fragments.
    ``size`` is the bytes of each fragment except a sample's last, and ``total`` the bytes of the
    whole sample.
    """

    first: int
    count: int
    size: int
    total: int


class Sample(msgspec.Struct, frozen=True):
    """A sample, or a part of one, in a DATA or DATA_FRAG, with its positions in the datagram.

    ``body`` is the submessage without its header. ``prefix`` is the GUID prefix of the participant
    that has written the sample. ``writer`` and ``reader`` are entity ids (0: any reader).
    ``is_little_endian`` is the byte order of the submessage and ``inline_qos``; the payload states
    its own byte order. ``is_key_only`` tells whether the payload is the key alone, which names an
    instance that has ended. ``fragments`` is None for DATA.
    """

    prefix: bytes
    reader: int
    writer: int
    sequence: int
    is_little_endian: bool
    body: Span
    inline_qos: Span | None
    payload: Span | None
    is_key_only: bool = False
    fragments: Fragments | None = None


class Overwrite(msgspec.Struct, frozen=True):
    """Bytes that replace as many bytes at a position of a datagram."""

    offset: int
    replacement: bytes


def source_prefix(datagram: bytes) -> bytes:
    """The GUID prefix in the header of a message.

    Raises RtpsError if the datagram is no message of RTPS version 2.
    """
    if len(datagram) < HEADER_BYTES or datagram[:4] != MAGIC:
        raise RtpsError("the datagram is not an RTPS message")
    if datagram[4] != 2:
        raise RtpsError(f"the message has RTPS version {datagram[4]}.{datagram[5]}, not 2")
    return datagram[8:HEADER_BYTES]


def message_header(prefix: bytes, vendor: bytes = NO_VENDOR) -> bytes:
    """The header of a message that the proxy makes, by default with VENDORID_UNKNOWN."""
    return MAGIC + VERSION + vendor + prefix


def source_vendor(datagram: bytes) -> bytes:
    """The vendor id in the header of a message. Raises RtpsError as `source_prefix` does."""
    source_prefix(datagram)
    return datagram[6:8]


def has_checksum(datagram: bytes) -> bool:
    """Whether a message contains a checksum of the message. Raises RtpsError."""
    is_of_rti = source_vendor(datagram) == RTI
    return any(
        (submessage_id == SubmessageId.HEADER_EXTENSION and flags & _CHECKSUM)
        or (submessage_id == RTI_CRC and is_of_rti)
        for submessage_id, flags, _ in submessages(datagram)
    )


def samples(datagram: bytes) -> list[Sample]:
    """All samples in a message, in their order.

    Raises RtpsError if a length leads outside the datagram, if a sequence number is not from 1 to
    LAST_SEQUENCE_NUMBER, or if all inline QoS together is longer than MOST_INLINE_BYTES.
    """
    all_samples = list[Sample]()
    prefix = source_prefix(datagram)
    inline_bytes = 0
    for submessage_id, flags, body in submessages(datagram):
        if submessage_id == _INFO_SRC:
            require_size(body, 20)
            prefix = datagram[body.start + 8 : body.start + 20]
        elif submessage_id in _WITH_SAMPLE:
            sample = _sample(datagram, prefix, flags, body, submessage_id == _DATA_FRAG)
            if sample.inline_qos is not None:
                inline_bytes += sample.inline_qos.end - sample.inline_qos.start
            # Reading a parameter takes a microsecond, and the shortest has four bytes. So the
            # inline QoS of a datagram takes at most 4 ms.
            if inline_bytes > MOST_INLINE_BYTES:
                raise RtpsError(
                    f"the datagram has more than {MOST_INLINE_BYTES} bytes of inline QoS"
                )
            all_samples.append(sample)
    return all_samples


def by_source(datagram: bytes) -> list[bytes]:
    """Split a message at each INFO_SRC, so that each part has a single source participant.

    With Cyclone DDS, the participants of a process share a message (INFO_SRC, 8.3.8.9). A
    destination holds until the message names another one, so each part repeats the destination. A
    part has 36 bytes of header and destination in place of an INFO_SRC of 24 bytes. All parts
    together are at most 1.5 times as long as the message. Raises RtpsError if a length leads
    outside the datagram.
    """
    source_prefix(datagram)
    header = datagram[:HEADER_BYTES]
    start = HEADER_BYTES
    named = b""
    messages = list[bytes]()
    for submessage_id, _, body in submessages(datagram):
        if submessage_id == _INFO_SRC:
            require_size(body, 4 + VERSION_TO_PREFIX_BYTES)
            if body.start - 4 > start:
                messages.append(header + datagram[start : body.start - 4])
            source_offset = body.start + 4
            header = (
                MAGIC + datagram[source_offset : source_offset + VERSION_TO_PREFIX_BYTES] + named
            )
            start = body.end
        elif submessage_id == INFO_DST:
            # Only the prefix: an INFO_DST may be longer, and each part repeats this submessage.
            named = info_dst(datagram[body.start : body.start + PREFIX_BYTES])
    if not messages and start == HEADER_BYTES:
        return [datagram]
    return [*messages, header + datagram[start:]] if start < len(datagram) else messages


def by_source_if_sound(datagram: bytes) -> list[bytes]:
    """Split a message as `by_source`; a malformed message stays whole, for its reader to refuse."""
    try:
        return by_source(datagram)
    except RtpsError:
        return [datagram]


def info_dst(prefix: bytes) -> bytes:
    """The submessage that names the destination of the next submessages."""
    return struct.pack("<BBH", INFO_DST, _LITTLE, PREFIX_BYTES) + prefix


def apply(datagram: bytes, edits: Iterable[Overwrite]) -> bytes:
    """The datagram after all edits. Raises ValueError if an edit leads outside the datagram."""
    changed = bytearray(datagram)
    for edit in edits:
        end = edit.offset + len(edit.replacement)
        if not 0 <= edit.offset <= end <= len(changed):
            raise ValueError(
                f"edit of bytes {edit.offset} to {end}: the datagram has only {len(changed)} bytes"
            )
        changed[edit.offset : end] = edit.replacement
    return bytes(changed)


@lru_cache(maxsize=4)
def submessages(datagram: bytes) -> tuple[tuple[int, int, Span], ...]:
    """The id, flags and body of each submessage. Raises RtpsError as `walk_submessages` does.

    The cache holds the last datagrams, because the proxy looks at a datagram of discovery ten times
    in a row.
    """
    return tuple(walk_submessages(datagram))


def walk_submessages(datagram: bytes) -> Iterator[tuple[int, int, Span]]:
    """Yield the id, flags and body of each submessage.

    Raises RtpsError if a length leads outside the datagram, if an INFO_DST is too short, or if a
    length is no multiple of 4, which implementations read differently. If one call raises nothing
    for a message, later calls raise nothing either.
    """
    offset = HEADER_BYTES
    count = 0
    size = len(datagram)
    while offset < size:
        body = offset + 4
        if body > size:
            raise RtpsError("the message ends inside a submessage's header")
        if (count := count + 1) > MOST_SUBMESSAGES:
            raise RtpsError(f"the message has more than {MOST_SUBMESSAGES} submessages")
        submessage_id, flags, first, second = datagram[offset:body]
        length = first + (second << 8) if flags & _LITTLE else (first << 8) + second
        offset = body + length
        if length == 0 and submessage_id not in MAY_BE_EMPTY:
            offset = size  # length 0: the last submessage, up to the end (9.4.5.1.3)
        if offset > size:
            raise RtpsError(f"submessage {submessage_id:#x} is longer than the message")
        if (offset - body) % ALIGNMENT_BYTES and offset < size:
            text = f"submessage {submessage_id:#x} has {offset - body} bytes, no multiple of"
            raise RtpsError(f"{text} {ALIGNMENT_BYTES}, and is not the last")
        if submessage_id == INFO_DST and offset - body < PREFIX_BYTES:
            raise RtpsError(f"a destination has {offset - body} bytes and needs {PREFIX_BYTES}")
        yield submessage_id, flags, Span(body, offset)


def walk_parameters(
    datagram: bytes, span: Span, is_little_endian: bool
) -> Iterator[tuple[int, int, int]]:
    """Yield the id, the offset of the header, and the end of each parameter in a list.

    The value begins 4 bytes after the offset. The last parameter is the sentinel, which ends after
    its header. Raises RtpsError if the list has no sentinel or more than MOST_PARAMETERS, if a
    length leads outside the list, or if a length is no multiple of 4.
    """
    unpack = (_LITTLE_HEADER if is_little_endian else _BIG_HEADER).unpack_from
    offset = span.start
    last = span.end - 4
    for _ in range(MOST_PARAMETERS):
        if offset > last:
            raise RtpsError("a parameter list has no sentinel")
        parameter_id, length = unpack(datagram, offset)
        if parameter_id == SENTINEL:
            yield parameter_id, offset, offset + 4
            return
        end = offset + 4 + length
        if end > span.end:
            raise RtpsError(f"parameter {parameter_id:#x} is longer than its list")
        if length % ALIGNMENT_BYTES:
            text = (
                f"parameter {parameter_id:#x} has {length} bytes, no multiple of {ALIGNMENT_BYTES}"
            )
            raise RtpsError(text)
        yield parameter_id, offset, end
        offset = end
    raise RtpsError(f"a list has more than {MOST_PARAMETERS} parameters")


def _sample(datagram: bytes, prefix: bytes, flags: int, body: Span, is_fragment: bool) -> Sample:
    fixed_size = 32 if is_fragment else 20
    require_size(body, fixed_size)
    start = body.start
    is_little_endian = bool(flags & _LITTLE)
    to_qos = _unpack("H", datagram, start + 2, flags)
    high = _unpack("i", datagram, start + 12, flags)
    low = _unpack("I", datagram, start + 16, flags)
    sequence = (high << 32) + low
    if not 0 < sequence <= LAST_SEQUENCE_NUMBER:
        raise RtpsError(
            f"a sample has the sequence number {sequence}, not 1 to {LAST_SEQUENCE_NUMBER}"
        )
    offset = start + 4 + to_qos
    if not start + fixed_size <= offset <= body.end:
        raise RtpsError(f"octetsToInlineQos is {to_qos}, which leads outside the submessage")
    qos = None
    if flags & _QOS:
        *_, (_, _, end) = walk_parameters(datagram, Span(offset, body.end), is_little_endian)
        qos = Span(offset, end)
        offset = end
    key = bool(flags & (_FRAGMENT_KEY if is_fragment else _KEY))
    # DATA_FRAG has no flag for a payload, because each DATA_FRAG has one (9.4.5.4).
    has_payload = is_fragment or bool(flags & (_DATA | _KEY))
    return Sample(
        prefix=prefix,
        # Entity ids are arrays of octets, without a byte order.
        reader=int.from_bytes(datagram[start + 4 : start + 8], "big"),
        writer=int.from_bytes(datagram[start + 8 : start + 12], "big"),
        sequence=sequence,
        is_little_endian=is_little_endian,
        body=body,
        inline_qos=qos,
        payload=Span(offset, body.end) if has_payload and offset < body.end else None,
        is_key_only=key,
        fragments=_fragments(datagram, start + 20, flags) if is_fragment else None,
    )


def _fragments(datagram: bytes, offset: int, flags: int) -> Fragments:
    return Fragments(
        _unpack("I", datagram, offset, flags),
        _unpack("H", datagram, offset + 4, flags),
        _unpack("H", datagram, offset + 6, flags),
        _unpack("I", datagram, offset + 8, flags),
    )


def require_size(body: Span, size: int) -> None:
    """Raise RtpsError if the body of a submessage has fewer than ``size`` bytes."""
    if body.end - body.start < size:
        raise RtpsError(f"a submessage has {body.end - body.start} bytes and needs {size}")


def _unpack(form: str, datagram: bytes, offset: int, flags: int) -> int:
    number: int = struct.unpack_from(("<" if flags & _LITTLE else ">") + form, datagram, offset)[0]
    return number
