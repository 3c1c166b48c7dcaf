"""For which participants an RTPS message is, and whether the proxy has to read the message.

Both follow from the first bytes of each submessage, without the samples. DATA, HEARTBEAT, ACKNACK
and the like name a reader and a writer by their entity ids. An INFO_DST before such a submessage
names the participant that is to receive it, by its GUID prefix.
"""

from rosproxy.ros2.protocol.rtps import (
    FAST_DDS,
    HEADER_BYTES,
    INFO_DST,
    MAY_BE_EMPTY,
    PREFIX_BYTES,
    STATISTICS,
    Overwrite,
    RtpsError,
    Span,
    SubmessageId,
    apply,
    require_size,
    source_vendor,
    submessages,
    walk_submessages,
)

MOST_UNREAD_SUBMESSAGES = 16
"""The highest number of submessages of a datagram that may pass unread. User data has half a
dozen."""

LONGEST_HEARTBEAT_BYTES = 160
"""A message with more bytes does not count as a single heartbeat. Messages of Fast DDS have 112:
header 20, INFO_DST 16, heartbeat 32, statistics 44."""

_WRITER_AT: dict[int, int] = {
    SubmessageId.DATA: 8,
    SubmessageId.DATA_FRAG: 8,
    SubmessageId.ACKNACK: 4,
    SubmessageId.HEARTBEAT: 4,
    SubmessageId.GAP: 4,
    SubmessageId.NACK_FRAG: 4,
    SubmessageId.HEARTBEAT_FRAG: 4,
}
"""Offset of the writer's entity id in the body of each submessage. The four bytes before are the
reader's entity id."""
_NAMELESS = frozenset(
    kind.value
    for kind in (
        SubmessageId.PAD,
        SubmessageId.INFO_TS,
        SubmessageId.INFO_SRC,
        SubmessageId.INFO_DST,
    )
)
"""Submessages without a reader and a writer. All but PAD qualify the next submessages."""
_NAMELESS_OF = {FAST_DDS: _NAMELESS | {STATISTICS}}
"""Submessages without a reader and a writer, by vendor, for vendors with submessages of their
own."""
LONGEST_WITHOUT_SAMPLES_BYTES = 256
"""A message with more bytes counts as a message with samples: the proxy does not look into it."""
_WITHOUT_SAMPLES = _NAMELESS | frozenset(
    kind.value
    for kind in (
        SubmessageId.ACKNACK,
        SubmessageId.HEARTBEAT,
        SubmessageId.GAP,
        SubmessageId.NACK_FRAG,
        SubmessageId.HEARTBEAT_FRAG,
    )
)
_WITHOUT_SAMPLES_OF = {FAST_DDS: _WITHOUT_SAMPLES | {STATISTICS}}
"""Submessages without a sample, and the same by vendor."""
_ENTITY_ID_BYTES = 4
"""Bytes of an entity id."""
_HEARTBEAT_BYTES = 28
"""Bytes of the body of a heartbeat (DDSI-RTPS 2.5, 9.4.5.7)."""
_BUILT_IN = 0xC0
"""Bits that are set in the last byte of the entity id of each builtin endpoint (9.3.1.2)."""


def destination(datagram: bytes) -> bytes | None:
    """The GUID prefix of the participant that a message is for; None if the message is for all.

    Only the first INFO_DST counts. The submessages after a second INFO_DST are for another
    participant at the same locator. Raises RtpsError.
    """
    for kind, _, body in submessages(datagram):
        if kind == INFO_DST:
            prefix = datagram[body.start : body.start + PREFIX_BYTES]
            return prefix if any(prefix) else None
    return None


def is_destination(datagram: bytes, prefix: bytes) -> bool:
    """Whether a message has an INFO_DST with a participant's GUID prefix. Raises RtpsError.

    A part for all participants does not count. Cyclone DDS puts submessages for several
    participants at the same locator into one message.
    """
    info_dst = (body.start for kind, _, body in submessages(datagram) if kind == INFO_DST)
    return any(datagram[start : start + PREFIX_BYTES] == prefix for start in info_dst)


def says_something(datagram: bytes) -> bool:
    """Whether a message has more than submessages that qualify others. Raises RtpsError."""
    return any(kind not in _NAMELESS for kind, _, _ in submessages(datagram))


def destinations(datagram: bytes) -> set[bytes]:
    """The GUID prefixes of all participants that a message is for; empty if a part is for all.

    Cyclone DDS puts submessages for several participants at the same address into one message.
    Raises RtpsError.
    """
    prefixes = set[bytes]()
    prefix = bytes(PREFIX_BYTES)
    for kind, _, body in submessages(datagram):
        if kind == INFO_DST:
            prefix = datagram[body.start : body.start + PREFIX_BYTES]
        elif kind in _WRITER_AT:
            if not any(prefix):
                return set()
            prefixes.add(prefix)
    return prefixes


def addressed_to_all(datagram: bytes) -> bytes:
    """The message without its destinations, so that all participants accept the message.

    Raises RtpsError.
    """
    destinations = [body for kind, _, body in submessages(datagram) if kind == INFO_DST]
    # GUIDPREFIX_UNKNOWN, which is all zero, addresses all participants.
    return apply(datagram, [Overwrite(body.start, bytes(PREFIX_BYTES)) for body in destinations])


def of_built_in_writer(datagram: bytes) -> bool | None:
    """Whether a message is from or to a builtin writer; None if the message names no writer.

    All discovery is from or to a builtin writer. The first submessage with a writer counts. Raises
    RtpsError.
    """
    for kind, _, body in submessages(datagram):
        offset = _WRITER_AT.get(kind)
        if offset is not None:
            require_size(body, offset + 4)
            return bool(datagram[body.start + offset + 3] & _BUILT_IN == _BUILT_IN)
    return None


def heartbeat_stream(datagram: bytes) -> bytes | None:
    """The stream of a message that is a single heartbeat; None if the message is anything else.

    A stream is the sender, the destination, the reader, the writer and the flags. A later heartbeat
    of the same stream replaces an earlier one (8.3.8.6). The flags say whether the writer wants an
    answer, and whether the writer is alive.
    """
    if len(datagram) > LONGEST_HEARTBEAT_BYTES:
        return None
    stream = b""
    try:
        nameless = _NAMELESS_OF.get(source_vendor(datagram), _NAMELESS)
        for kind, flags, body in walk_submessages(datagram):
            if kind == INFO_DST and len(stream) <= PREFIX_BYTES:
                stream = datagram[body.start : body.start + PREFIX_BYTES]
            elif kind == SubmessageId.HEARTBEAT and len(stream) <= PREFIX_BYTES:
                require_size(body, _HEARTBEAT_BYTES)
                entities = datagram[body.start : body.start + 2 * _ENTITY_ID_BYTES]
                stream = stream.ljust(PREFIX_BYTES, b"\0") + entities + bytes([flags])
            elif kind not in nameless or kind == SubmessageId.INFO_SRC:
                return None
    except RtpsError:
        return None
    return (
        datagram[HEADER_BYTES - PREFIX_BYTES : HEADER_BYTES] + stream
        if len(stream) > PREFIX_BYTES
        else None
    )


def carries_samples(datagram: bytes) -> bool:
    """Whether a message has samples, or may have samples that the proxy can't see.

    Messages without samples acknowledge samples, or report the numbers of samples. A reliable
    subscriber sends such messages to each publisher.
    """
    size = len(datagram)
    if not HEADER_BYTES < size <= LONGEST_WITHOUT_SAMPLES_BYTES:
        return True
    # The proxy does this for each small datagram. `walk_submessages` takes three times as long.
    kinds = _WITHOUT_SAMPLES_OF.get(datagram[6:8], _WITHOUT_SAMPLES)
    offset = HEADER_BYTES
    while offset < size:
        kind = datagram[offset]
        if kind not in kinds or offset + 4 > size:
            return True
        first = datagram[offset + 2]
        second = datagram[offset + 3]
        length = first + (second << 8) if datagram[offset + 1] & 1 else (first << 8) + second
        # Length 0: the last submessage, up to the end, except PAD and INFO_TS (9.4.5.1.3).
        offset = offset + 4 + length if length or kind in MAY_BE_EMPTY else size
    return offset > size


def only_acknowledges(datagram: bytes) -> bool:
    """Whether a message of any length, of one or several participants, is without samples.

    False for a malformed message.
    """
    kinds = _WITHOUT_SAMPLES | {SubmessageId.INFO_SRC}
    try:
        return all(kind in kinds for kind, _, _ in walk_submessages(datagram))
    except RtpsError:
        return False


def may_be_discovery(datagram: bytes) -> bool:
    """Whether the proxy has to read a message: a builtin reader or writer may be named there.

    The proxy also has to read a datagram that is malformed, that has more than
    MOST_UNREAD_SUBMESSAGES submessages, or that has submessages of an unknown kind. The submessages
    of DDS Security are of an unknown kind.
    """
    try:
        nameless = _NAMELESS_OF.get(source_vendor(datagram), _NAMELESS)
        for count, (kind, _, body) in enumerate(walk_submessages(datagram)):
            if count >= MOST_UNREAD_SUBMESSAGES or (
                kind not in nameless and _names_built_in(datagram, kind, body)
            ):
                return True
    except RtpsError:
        return True
    return False


def _names_built_in(datagram: bytes, kind: int, body: Span) -> bool:
    """Whether a submessage may name a builtin reader or writer. Raises RtpsError."""
    offset = _WRITER_AT.get(kind)
    if offset is None:
        return True
    require_size(body, offset + 4)
    reader = datagram[body.start + offset - 1]
    writer = datagram[body.start + offset + 3]
    return _BUILT_IN in (reader & _BUILT_IN, writer & _BUILT_IN)
