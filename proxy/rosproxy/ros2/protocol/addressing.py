"""Whom a message is for, and whether it has to be read: known without reading its samples.

Each submessage but those that only tell of the others names a reader and a writer by their entity
ids, and INFO_DST in front of it whose they are.
"""

from rosproxy.ros2.protocol.rtps import (
    FAST_DDS,
    HEADER,
    INFO_DST,
    PREFIX,
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

MOST_OF_USERS = 16
"""Submessages of a datagram that may pass unread; of users' data there are half a dozen."""

LONGEST_HEARTBEAT = 160
"""Bytes of a message that may count as a heartbeat alone. Those of Fast DDS have 112: header 20,
INFO_DST 16, heartbeat 32, statistics 44."""

_WRITER_AT: dict[int, int] = {
    SubmessageId.DATA: 8,
    SubmessageId.DATA_FRAG: 8,
    SubmessageId.ACKNACK: 4,
    SubmessageId.HEARTBEAT: 4,
    SubmessageId.GAP: 4,
    SubmessageId.NACK_FRAG: 4,
    SubmessageId.HEARTBEAT_FRAG: 4,
}
"""Where in its body a submessage has the writer's entity id; in front of it stands the reader's."""
_NAMELESS = frozenset(
    kind.value
    for kind in (
        SubmessageId.PAD,
        SubmessageId.INFO_TS,
        SubmessageId.INFO_SRC,
        SubmessageId.INFO_DST,
    )
)
"""Submessages that are from no writer, and only tell of those that follow."""
_NAMELESS_OF = {FAST_DDS: _NAMELESS | {STATISTICS}}
"""The same of vendors that have others."""
_ENTITY_ID = 4
_HEARTBEAT = 28
"""Bytes of an entity id, and of the body of a heartbeat (9.4.5.7)."""
_BUILT_IN = 0xC0
"""The bits of an entity id's last byte that built-in readers and writers have (9.3.1.2)."""


def destination(datagram: bytes) -> bytes | None:
    """The GUID prefix of whom a message is for; None if it is for all. Raises RtpsError.

    The first INFO_DST counts: what follows may be for others, who are then at the same locator.
    """
    for kind, _, body in submessages(datagram):
        if kind == INFO_DST:
            prefix = datagram[body.start : body.start + PREFIX]
            return prefix if any(prefix) else None
    return None


def is_destination(datagram: bytes, prefix: bytes) -> bool:
    """Whether some of a message is for the participant with a GUID prefix. Raises RtpsError.

    Cyclone DDS puts into one message what goes to several participants at one locator.
    """
    info_dst = (body.start for kind, _, body in submessages(datagram) if kind == INFO_DST)
    return any(datagram[start : start + PREFIX] == prefix for start in info_dst)


def destinations(datagram: bytes) -> set[bytes]:
    """The GUID prefixes of all whom a message is for; none if some of it is for all. RtpsError.

    Cyclone DDS puts into one message what goes to one address, whoever is there.
    """
    prefixes = set[bytes]()
    prefix = bytes(PREFIX)
    for kind, _, body in submessages(datagram):
        if kind == INFO_DST:
            prefix = datagram[body.start : body.start + PREFIX]
        elif kind in _WRITER_AT:
            if not any(prefix):
                return set()
            prefixes.add(prefix)
    return prefixes


def for_all(datagram: bytes) -> bytes:
    """The message without its destinations, so that everybody takes it. Raises RtpsError."""
    destinations = [body for kind, _, body in submessages(datagram) if kind == INFO_DST]
    # GUIDPREFIX_UNKNOWN, which is all zero, means everybody.
    return apply(datagram, [Overwrite(body.start, bytes(PREFIX)) for body in destinations])


def of_built_in_writer(datagram: bytes) -> bool | None:
    """Whether a message is from or to a built-in writer, as discovery is; None if to no writer.

    The first submessage that names a writer counts. Raises RtpsError.
    """
    for kind, _, body in submessages(datagram):
        offset = _WRITER_AT.get(kind)
        if offset is not None:
            require_size(body, offset + 4)
            return bool(datagram[body.start + offset + 3] & _BUILT_IN == _BUILT_IN)
    return None


def heartbeat_stream(datagram: bytes) -> bytes | None:
    """From and to whom a message is that is a heartbeat and nothing else; None if it is another.

    A later heartbeat of the same stream says all that an earlier one did (8.3.8.6). The flags are
    part of the stream: they say whether an answer is wanted, and whether the writer is alive.
    """
    if len(datagram) > LONGEST_HEARTBEAT:
        return None
    stream = b""
    try:
        nameless = _NAMELESS_OF.get(source_vendor(datagram), _NAMELESS)
        for kind, flags, body in walk_submessages(datagram):
            if kind == INFO_DST and not stream:
                stream = datagram[body.start : body.start + PREFIX]
            elif kind == SubmessageId.HEARTBEAT and len(stream) <= PREFIX:
                require_size(body, _HEARTBEAT)
                entities = datagram[body.start : body.start + 2 * _ENTITY_ID]
                stream = stream.ljust(PREFIX, b"\0") + entities + bytes([flags])
            elif kind not in nameless or kind == SubmessageId.INFO_SRC:
                return None
    except RtpsError:
        return None
    return datagram[HEADER - PREFIX : HEADER] + stream if len(stream) > PREFIX else None


def may_be_discovery(datagram: bytes) -> bool:
    """Whether a message has to be read: whether a built-in writer or reader may be named in it.

    So it may where it is no message, has more submessages than users' data has, or such as nobody
    can look into: those of DDS Security, and unknown ones.
    """
    try:
        nameless = _NAMELESS_OF.get(source_vendor(datagram), _NAMELESS)
        for count, (kind, _, body) in enumerate(walk_submessages(datagram)):
            if count >= MOST_OF_USERS or (
                kind not in nameless and _names_built_in(datagram, kind, body)
            ):
                return True
    except RtpsError:
        return True
    return False


def _names_built_in(datagram: bytes, kind: int, body: Span) -> bool:
    """Whether a submessage names a built-in reader or writer, or may. Raises RtpsError."""
    offset = _WRITER_AT.get(kind)
    if offset is None:
        return True
    require_size(body, offset + 4)
    reader = datagram[body.start + offset - 1]
    writer = datagram[body.start + offset + 3]
    return _BUILT_IN in (reader & _BUILT_IN, writer & _BUILT_IN)
