"""RTPS messages: what a datagram carries, and where in it.

A message is a header and a row of *submessages*. Two of them carry *samples*, what a writer has
written: DATA a whole one, DATA_FRAG a part. All others (heartbeats, acknowledgements, what a
vendor has of its own) are none of the proxy's business and pass as they are.

Nothing is decoded and encoded again: what is read are positions, and whatever changes has the same
length after as before (`Overwrite`). So every byte that the proxy does not mean to change stays,
those of versions and vendors that it does not know among them.

    header      "RTPS", version 2, vendor 2, GUID prefix 12
    submessage  id 1, flags 1, length 2, then so many bytes; bit 0 of flags: little-endian
    DATA        extra flags 2, octets to inline QoS 2, reader 4, writer 4, sequence number 8,
                inline QoS if flag 2, payload if flag 4 (or 8: the key alone)
    DATA_FRAG   the same up to the sequence number, first fragment 4, fragments 2, fragment size 2,
                sample size 4, inline QoS if flag 2, a part of the payload (flag 4: of the key)
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
HEADER = 20
"""Bytes of a message's header."""
ALIGNMENT = 4
"""The length of a parameter is a multiple of this (9.4.2.11), and that of each submessage but the
last (9.4.1). Fast DDS rounds others up (ParameterList.cpp, MessageReceiver.cpp), so that it finds
what follows elsewhere than who does not."""
PREFIX = 12
"""Bytes of a GUID prefix."""
VERSION_TO_PREFIX = HEADER - len(MAGIC)
"""Bytes of what a header and an INFO_SRC both have: version, vendor, GUID prefix."""
MOST_SUBMESSAGES = 256
"""Submessages of a datagram that are read; real ones have a dozen."""

LAST_NUMBER = 2**63 - 2
"""The greatest sequence number that is accepted: it has a next one. They begin with 1."""

SENTINEL = 1
"""The id that ends a parameter list; its length means nothing."""
MOST_PARAMETERS = 512
"""Parameters of a list that are read, its end among them; real ones have less than a hundred."""
MOST_INLINE_BYTES = 16 * 1024
"""Bytes of all inline QoS in a datagram. A sample of discovery has 24 to 36."""
_LITTLE_HEADER = struct.Struct("<HH")
_BIG_HEADER = struct.Struct(">HH")

_LITTLE = 0x01
_QOS = 0x02
_DATA = 0x04
_KEY = 0x08
_FRAGMENT_KEY = 0x04
_CHECKSUM = 0x60
"""Which checksum a HEADER_EXTENSION has, if any (DDSI-RTPS 2.5, 9.4.5.2)."""


class RtpsError(ValueError):
    """A datagram that is no RTPS message, or one whose lengths lead outside of it."""


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
"""Submessages from 0x80 on have a meaning for each vendor. Of Fast DDS it is at the end of each
message, where that went and how many bytes; of RTI Connext a checksum."""

# Plain numbers: a member of an enumeration is slow to look up, and this is done for each datagram.
_INFO_SRC = SubmessageId.INFO_SRC.value
INFO_DST = SubmessageId.INFO_DST.value
_DATA_FRAG = SubmessageId.DATA_FRAG.value
_WITH_SAMPLE = frozenset({SubmessageId.DATA.value, _DATA_FRAG})
_MAY_BE_EMPTY = frozenset({SubmessageId.PAD.value, SubmessageId.INFO_TS.value})


class Span(msgspec.Struct, frozen=True):
    """A part of a datagram: from ``start`` up to and without ``end``."""

    start: int
    end: int


class Fragments(msgspec.Struct, frozen=True):
    """Which part of a sample a DATA_FRAG carries.

    ``first`` is the number of its first fragment, from 1 on, ``count`` how many it has, ``size``
    the bytes of each but a sample's last, ``total`` those of the whole sample.
    """

    first: int
    count: int
    size: int
    total: int


class Sample(msgspec.Struct, frozen=True):
    """What a DATA or DATA_FRAG carries, and where.

    ``body`` is all of the submessage but its header. ``prefix`` is the GUID prefix of the
    participant that has written it, ``writer`` and ``reader`` are entity ids (0: any reader).
    ``little``: the byte order of the submessage, which is that of ``inline_qos``; the payload has
    one of its own. ``key``: the payload is the key alone, of something that has ended.
    """

    prefix: bytes
    reader: int
    writer: int
    sequence: int
    little: bool
    body: Span
    inline_qos: Span | None
    payload: Span | None
    is_key_only: bool = False
    fragments: Fragments | None = None


class Overwrite(msgspec.Struct, frozen=True):
    """Bytes at a position of a datagram that replace as many others."""

    offset: int
    replacement: bytes


def source_prefix(datagram: bytes) -> bytes:
    """The GUID prefix in the header of a message. Raises RtpsError if it is none."""
    if len(datagram) < HEADER or datagram[:4] != MAGIC:
        raise RtpsError("the datagram is not an RTPS message")
    if datagram[4] != 2:
        raise RtpsError(f"the message has RTPS version {datagram[4]}.{datagram[5]}, not 2")
    return datagram[8:HEADER]


def message_header(prefix: bytes, vendor: bytes = NO_VENDOR) -> bytes:
    """The header of a message that the proxy makes; its own have no vendor (VENDORID_UNKNOWN)."""
    return MAGIC + VERSION + vendor + prefix


def source_vendor(datagram: bytes) -> bytes:
    """The vendor id in the header of a message. Raises RtpsError if it is none."""
    source_prefix(datagram)
    return datagram[6:8]


def has_checksum(datagram: bytes) -> bool:
    """Whether a message carries a checksum of itself. Raises RtpsError."""
    is_of_rti = source_vendor(datagram) == RTI
    return any(
        (kind == SubmessageId.HEADER_EXTENSION and flags & _CHECKSUM)
        or (kind == RTI_CRC and is_of_rti)
        for kind, flags, _ in submessages(datagram)
    )


def samples(datagram: bytes) -> list[Sample]:
    """All samples in a message, in their order.

    Raises RtpsError if a length leads outside, or the inline QoS is longer than MOST_INLINE_BYTES.
    """
    all_samples = list[Sample]()
    prefix = source_prefix(datagram)
    inline_bytes = 0
    for kind, flags, body in submessages(datagram):
        if kind == _INFO_SRC:
            require_size(body, 20)
            prefix = datagram[body.start + 8 : body.start + 20]
        elif kind in _WITH_SAMPLE:
            sample = _sample(datagram, prefix, flags, body, kind == _DATA_FRAG)
            if sample.inline_qos is not None:
                inline_bytes += sample.inline_qos.end - sample.inline_qos.start
            # Reading a parameter takes a microsecond, and the shortest has four bytes.
            if inline_bytes > MOST_INLINE_BYTES:
                raise RtpsError(
                    f"the datagram has more than {MOST_INLINE_BYTES} bytes of inline QoS"
                )
            all_samples.append(sample)
    return all_samples


def by_source(datagram: bytes) -> list[bytes]:
    """Split a message into one for each participant that sends in it, in their order.

    Cyclone DDS has the participants of a program share a message (INFO_SRC, 8.3.8.9). A destination
    holds until the message names another one, so each part repeats the destination: 16 bytes, where
    the INFO_SRC had 24 with its header. All parts together are at most half as long again as the
    message. Raises RtpsError if a length leads outside.
    """
    source_prefix(datagram)
    header = datagram[:HEADER]
    start = HEADER
    info_dst = b""
    messages = list[bytes]()
    for kind, _, body in submessages(datagram):
        if kind == _INFO_SRC:
            require_size(body, 4 + VERSION_TO_PREFIX)
            if body.start - 4 > start:
                messages.append(header + datagram[start : body.start - 4])
            source_offset = body.start + 4
            header = MAGIC + datagram[source_offset : source_offset + VERSION_TO_PREFIX] + info_dst
            start = body.end
        elif kind == INFO_DST:
            # The prefix alone: an INFO_DST may be longer, and each part repeats it.
            info_dst = _info_dst(datagram[body.start : body.start + PREFIX])
    if not messages and start == HEADER:
        return [datagram]
    return [*messages, header + datagram[start:]] if start < len(datagram) else messages


def _info_dst(prefix: bytes) -> bytes:
    """A submessage that says for which participant the next ones are."""
    return struct.pack("<BBH", INFO_DST, _LITTLE, PREFIX) + prefix


def apply(datagram: bytes, edits: Iterable[Overwrite]) -> bytes:
    """The datagram with all edits made. Raises ValueError if one leads outside of it."""
    changed = bytearray(datagram)
    for edit in edits:
        end = edit.offset + len(edit.replacement)
        if not 0 <= edit.offset <= end <= len(changed):
            raise ValueError(f"an edit of bytes {edit.offset} to {end} of {len(changed)}")
        changed[edit.offset : end] = edit.replacement
    return bytes(changed)


@lru_cache(maxsize=4)
def submessages(datagram: bytes) -> tuple[tuple[int, int, Span], ...]:
    """Each submessage's id, flags and body. Raises RtpsError as `walk_submessages` does.

    Discovery is looked at ten times in a row, so the last results are kept.
    """
    return tuple(walk_submessages(datagram))


def walk_submessages(datagram: bytes) -> Iterator[tuple[int, int, Span]]:
    """Each submessage's id, flags and body, one after the other.

    Raises RtpsError if a length leads outside, is none that all read alike, or an INFO_DST is too
    short: so what is kept of a message can be read again later.
    """
    offset = HEADER
    count = 0
    size = len(datagram)
    while offset < size:
        body = offset + 4
        if body > size:
            raise RtpsError("the message ends inside a submessage's header")
        if (count := count + 1) > MOST_SUBMESSAGES:
            raise RtpsError(f"the message has more than {MOST_SUBMESSAGES} submessages")
        kind, flags, first, second = datagram[offset:body]
        length = first + (second << 8) if flags & _LITTLE else (first << 8) + second
        offset = body + length
        if length == 0 and kind not in _MAY_BE_EMPTY:
            offset = size  # the last one may say so (9.4.5.1.3)
        if offset > size:
            raise RtpsError(f"submessage {kind:#x} is longer than the message")
        if (offset - body) % ALIGNMENT and offset < size:
            text = f"submessage {kind:#x} has {offset - body} bytes, no multiple of {ALIGNMENT}"
            raise RtpsError(f"{text}, and is not the last")
        if kind == INFO_DST and offset - body < PREFIX:
            raise RtpsError(f"a destination has {offset - body} bytes and needs {PREFIX}")
        yield kind, flags, Span(body, offset)


def walk_parameters(datagram: bytes, span: Span, little: bool) -> Iterator[tuple[int, int, int]]:
    """Each parameter of a list: its id, where that stands, and where its value ends.

    The last is the sentinel, which ends with its header. Raises RtpsError if there is none, a
    length leads outside or is none that all read alike, or there are too many.
    """
    unpack = (_LITTLE_HEADER if little else _BIG_HEADER).unpack_from
    offset = span.start
    last = span.end - 4
    for _ in range(MOST_PARAMETERS):
        if offset > last:
            raise RtpsError("a parameter list has no end")
        pid, length = unpack(datagram, offset)
        if pid == SENTINEL:
            yield pid, offset, offset + 4
            return
        end = offset + 4 + length
        if end > span.end:
            raise RtpsError(f"parameter {pid:#x} is longer than its list")
        if length % ALIGNMENT:
            raise RtpsError(f"parameter {pid:#x} has {length} bytes, no multiple of {ALIGNMENT}")
        yield pid, offset, end
        offset = end
    raise RtpsError(f"a list has more than {MOST_PARAMETERS} parameters")


def _sample(datagram: bytes, prefix: bytes, flags: int, body: Span, is_fragment: bool) -> Sample:
    fixed_size = 32 if is_fragment else 20
    require_size(body, fixed_size)
    start = body.start
    little = bool(flags & _LITTLE)
    to_qos = _unpack("H", datagram, start + 2, flags)
    high = _unpack("i", datagram, start + 12, flags)
    low = _unpack("I", datagram, start + 16, flags)
    sequence = (high << 32) + low
    if not 0 < sequence <= LAST_NUMBER:
        raise RtpsError(f"a sample has the impossible number {sequence}")
    offset = start + 4 + to_qos
    if not start + fixed_size <= offset <= body.end:
        raise RtpsError(f"the inline QoS is {to_qos} octets on, outside of the submessage")
    qos = None
    if flags & _QOS:
        *_, (_, _, end) = walk_parameters(datagram, Span(offset, body.end), little)
        qos = Span(offset, end)
        offset = end
    key = bool(flags & (_FRAGMENT_KEY if is_fragment else _KEY))
    # DATA_FRAG has no flag for it: it always carries some (9.4.5.4).
    has_payload = is_fragment or bool(flags & (_DATA | _KEY))
    return Sample(
        prefix=prefix,
        # Entity ids are octets: their order does not depend on the flag.
        reader=int.from_bytes(datagram[start + 4 : start + 8], "big"),
        writer=int.from_bytes(datagram[start + 8 : start + 12], "big"),
        sequence=sequence,
        little=little,
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
    """Raise RtpsError unless a submessage has so many bytes."""
    if body.end - body.start < size:
        raise RtpsError(f"a submessage has {body.end - body.start} bytes and needs {size}")


def _unpack(form: str, datagram: bytes, offset: int, flags: int) -> int:
    number: int = struct.unpack_from(("<" if flags & _LITTLE else ">") + form, datagram, offset)[0]
    return number
