"""Announcements in fragments: they wait until they are whole, and go on as the fragments they were.

A reader or writer with a long description is announced in several DATA_FRAG, each in a datagram of
its own or several in one (Cyclone DDS: of 1,344 bytes each). A locator may begin in one and end in
the next. So the datagrams are held until the announcement is whole; that is rewritten as any other,
and each fragment gets its part of it. Fragments that are sent again later get theirs at once.

Who is asked for an announcement anew sends its first fragment alone, and waits to be asked for the
others. The reader does not know of them as long as that is held: so the proxy asks, in its name.

Each participant has a store of its own, so that it can't push out what others have sent; of all
together the largest goes first.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec

from rosproxy.ros2.protocol.reliable import nack_frag, withheld
from rosproxy.ros2.protocol.rtps import (
    HEADER,
    Fragments,
    Overwrite,
    RtpsError,
    Sample,
    SubmessageId,
    apply,
)
from rosproxy.ros2.rewriting.discovery import DiscoveryMessage, read_discovery

LONGEST, SHORTEST = 60_000, 128
"""Bytes of an announcement, and of a fragment. Real ones have some thousand."""
MOST_BYTES, MOST_OF_ALL = 1024 * 1024, 16 * 1024 * 1024
"""Bytes of a participant's announcements that are remembered, and as many of datagrams that wait;
of more the oldest goes. Bytes of all."""
MOST_FRAGMENTS = 64
"""DATA_FRAG in a datagram: one of 64 KB has as many of Cyclone DDS."""
OVERHEAD = 1024
"""Bytes that are counted for each announcement and each datagram beside its own."""

Rewrite = Callable[[DiscoveryMessage], bytes]
"""Rewrites the whole announcements in a message, and leaves its length."""

_PAYLOAD_AT = HEADER + 24
"""Where the payload of a DATA begins that is a message's first, and has no inline QoS."""

_Key = tuple[int, bytes, int, int]


class Passed(NamedTuple):
    """Datagrams that go on, and those that go back to ask for missing fragments."""

    on: list[bytes]
    back: list[bytes]


@dataclass(slots=True)
class _Gathered:
    """The fragments of a sample, by their numbers; ``whole`` once it is there and rewritten.

    ``whole`` is empty if the announcement is to be hidden.
    """

    total: int
    size: int
    parts: dict[int, bytes] = field(default_factory=dict)
    whole: bytes | None = None

    @property
    def cost(self) -> int:
        """The bytes that it counts for."""
        return self.total + OVERHEAD


class _Held(msgspec.Struct, frozen=True):
    """A datagram that waits, rewritten but for its fragments; ``at`` is where it came."""

    at: int
    fragments: tuple[tuple[Sample, Fragments], ...]
    datagram: bytes

    @property
    def cost(self) -> int:
        """The bytes that it counts for."""
        return len(self.datagram) + len(self.fragments) * OVERHEAD


@dataclass(slots=True)
class FragmentStores:
    """The stores of all participants, by GUID prefix."""

    by_prefix: dict[bytes, "FragmentStore"] = field(default_factory=dict)
    size: int = 0
    _asked: int = 0

    def rewritten(
        self, at: int, message: DiscoveryMessage, reader: bytes, rewrite: Rewrite
    ) -> Passed:
        """The datagrams of a participant that may go on now, rewritten. Raises RtpsError.

        ``at`` is the port where the message came: each way has fragments of its own. ``reader`` is
        the GUID prefix of who is to get them.
        """
        if not message.fragments:
            return Passed([rewrite(message)], [])
        store = self.by_prefix.setdefault(message.prefix, FragmentStore())
        before = store.size
        try:
            missing = store.missing(at, message)
            released = store.rewritten(at, message, rewrite)
        finally:
            self.size += store.size - before
            while self.size > MOST_OF_ALL:
                self.forget(max(self.by_prefix, key=lambda one: self.by_prefix[one].size))
        return Passed(released, [self._question(message, reader, *one) for one in missing])

    def _question(
        self, message: DiscoveryMessage, reader: bytes, sample: Sample, missing: Sequence[int]
    ) -> bytes:
        self._asked += 1
        told = sample.writer, sample.sequence, missing, self._asked
        return nack_frag(reader, message.prefix, *told)

    def forget(self, prefix: bytes) -> None:
        """Forget what a participant has sent."""
        store = self.by_prefix.pop(prefix, None)
        self.size -= store.size if store else 0

    def clear(self) -> None:
        """Forget everything."""
        self.by_prefix.clear()
        self.size = 0


@dataclass(slots=True)
class FragmentStore:
    """Announcements of a participant of which fragments have come, and the datagrams that wait."""

    _samples: dict[_Key, _Gathered] = field(default_factory=dict)
    _held: list[_Held] = field(default_factory=list)
    _bytes: int = 0
    _waiting: int = 0

    @property
    def size(self) -> int:
        """The bytes that are remembered, and those of datagrams that wait."""
        return self._bytes + self._waiting

    def missing(self, at: int, message: DiscoveryMessage) -> list[tuple[Sample, list[int]]]:
        """The samples of which a fragment comes again while others are missing, and which."""
        found = dict[_Key, tuple[Sample, list[int]]]()
        for sample, part in message.fragments:
            key = _key(at, sample)
            gathered = self._samples.get(key)
            again = gathered and gathered.whole is None and part.first in gathered.parts
            if gathered and again and key not in found:
                count = -(-gathered.total // gathered.size)
                left = [one for one in range(1, count + 1) if one not in gathered.parts]
                found[key] = sample, left
        return list(found.values())

    def rewritten(self, at: int, message: DiscoveryMessage, rewrite: Rewrite) -> list[bytes]:
        """As `FragmentStores.rewritten`, for a message with fragments."""
        if len(message.fragments) > MOST_FRAGMENTS:
            raise RtpsError(f"more than {MOST_FRAGMENTS} fragments in a datagram")
        one = _Held(at, message.fragments, rewrite(message))
        gathered = [self._gather(at, message, *part, rewrite) for part in message.fragments]
        if not any(gathered):
            if self._is_whole(one):
                return [self._filled(one)]
            self._hold(one)
            return []
        waiting = [*self._held, one]
        self._held, self._waiting = [], 0
        for still in waiting:
            if not self._is_whole(still):
                self._hold(still)
        return [self._filled(whole) for whole in waiting if self._is_whole(whole)]

    def _hold(self, one: _Held) -> None:
        """Have a datagram wait."""
        self._held.append(one)
        self._waiting += one.cost
        while self._waiting > MOST_BYTES:
            self._waiting -= self._held.pop(0).cost

    def _gather(
        self,
        at: int,
        message: DiscoveryMessage,
        sample: Sample,
        part: Fragments,
        rewrite: Rewrite,
    ) -> bool:
        """Take in the fragments of one submessage; whether the sample has become whole by them."""
        gathered, parts = self._of(at, sample, part), dict(_parts(message.datagram, sample, part))
        if gathered.whole is not None:
            return False
        gathered.parts.update(parts)
        if len(gathered.parts) < -(-part.total // part.size):
            return False
        payload = b"".join(gathered.parts[number] for number in sorted(gathered.parts))
        edited = rewrite(read_discovery(_as_data(message.datagram, sample, payload)))
        hidden = edited[HEADER] == SubmessageId.GAP
        gathered.whole = b"" if hidden else edited[_PAYLOAD_AT:]
        gathered.parts.clear()
        return True

    def _of(self, at: int, sample: Sample, part: Fragments) -> _Gathered:
        """What there is of a fragment's sample. Raises RtpsError if it can't be one."""
        if part.size < SHORTEST or not 0 < part.total <= LONGEST:
            raise RtpsError(f"an announcement of {part.total} bytes in fragments of {part.size}")
        gathered = self._samples.get(_key(at, sample))
        if gathered is None:
            gathered = self._samples[_key(at, sample)] = _Gathered(part.total, part.size)
            self._bytes += gathered.cost
            while self._bytes > MOST_BYTES:
                self._bytes -= self._samples.pop(next(iter(self._samples))).cost
        if (gathered.total, gathered.size) != (part.total, part.size):
            raise RtpsError("fragments of the same announcement that differ in size")
        return gathered

    def _whole(self, at: int, sample: Sample) -> bytes | None:
        gathered = self._samples.get(_key(at, sample))
        return gathered.whole if gathered else None

    def _is_whole(self, one: _Held) -> bool:
        return all(self._whole(one.at, sample) is not None for sample, _ in one.fragments)

    def _filled(self, one: _Held) -> bytes:
        """A datagram with the rewritten parts of its fragments."""
        edits = list[Overwrite]()
        for sample, part in one.fragments:
            whole = self._whole(one.at, sample)
            if not whole:
                edits.append(withheld(sample))
            elif sample.payload:
                start = (part.first - 1) * part.size
                size = sample.payload.end - sample.payload.start
                edits.append(Overwrite(sample.payload.start, whole[start : start + size]))
        return apply(one.datagram, edits)


def _key(at: int, sample: Sample) -> _Key:
    return at, sample.prefix, sample.writer, sample.sequence


def _parts(datagram: bytes, sample: Sample, part: Fragments) -> Iterator[tuple[int, bytes]]:
    """The fragments in a DATA_FRAG, each with its number. Raises RtpsError."""
    count, last = -(-part.total // part.size), part.first + part.count - 1
    if sample.payload is None or not 0 < part.first <= last <= count:
        raise RtpsError(f"fragments {part.first} to {last} of {count}")
    at = sample.payload.start
    for number in range(part.first, last + 1):
        size = part.size if number < count else part.total - (count - 1) * part.size
        if at + size > sample.payload.end:
            raise RtpsError(f"fragment {number} is shorter than {size} bytes")
        yield number, datagram[at : at + size]
        at += size


def _as_data(datagram: bytes, sample: Sample, payload: bytes) -> bytes:
    """The message that would carry a sample as one."""
    key = 0x08 if sample.key else 0x04
    head = struct.pack("<BBHHH", SubmessageId.DATA, 0x01 | key, 0, 0, 16)
    head += struct.pack(">II", sample.reader, sample.writer)
    head += struct.pack("<iI", sample.sequence >> 32, sample.sequence & 0xFFFFFFFF)
    return datagram[:HEADER] + head + payload
