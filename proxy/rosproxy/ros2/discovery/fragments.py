"""Announcements in fragments: they wait until they are whole, and go on as the fragments they were.

A reader or writer with a long description is announced in several DATA_FRAG, each in a datagram of
its own or several in one (Cyclone DDS: of 1,344 bytes each). A locator may begin in one and end in
the next. So the datagrams are held until the announcement is whole; that is rewritten as any other,
and each fragment gets its part of it. Fragments that are sent again later get theirs at once.

A writer that is asked for an announcement anew sends its first fragment alone, and waits to be
asked for the others. The reader, which has not got that one, can't: so the proxy asks in its name.

Each participant has a store of its own, so that it can't push out what others have sent; if all
take too much together, the largest goes first.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
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

LONGEST = 60_000
SHORTEST = 128
"""Bytes of an announcement, and of a fragment. Real ones have some thousand."""
MOST_BYTES = 1024 * 1024
MOST_OF_ALL = 16 * 1024 * 1024
"""Bytes of a participant's announcements that are remembered, and as many of datagrams that wait;
of more the oldest go. Then the bytes of all participants."""
MOST_FRAGMENTS = 64
"""DATA_FRAG in a datagram: one of 64 KB has as many of Cyclone DDS."""
OVERHEAD = 1024
"""Bytes that are counted for each announcement and each datagram beside its own."""

Rewrite = Callable[[DiscoveryMessage], bytes]
"""Rewrites the whole announcements in a message, and leaves its length."""

_PAYLOAD_AT = HEADER + 24
"""Where the payload of a DATA begins that is a message's first, and has no inline QoS."""

_Key = tuple[int, bytes, int, int]


class PassedFragments(NamedTuple):
    """Datagrams that go on, and those that go back to ask for missing fragments."""

    forwarded: list[bytes]
    questions: list[bytes]


@dataclass(slots=True)
class _PendingSample:
    """The fragments of a sample, by their numbers; ``whole`` is its payload once all are there.

    It is rewritten then, and empty if the announcement is to be hidden.
    """

    total: int
    size: int
    fragments: dict[int, bytes] = field(default_factory=dict)
    whole: bytes | None = None

    @property
    def cost(self) -> int:
        """The bytes that it counts for."""
        return self.total + OVERHEAD


class _WaitingDatagram(msgspec.Struct, frozen=True):
    """A datagram that waits, rewritten but for its fragments; ``port`` is where it came."""

    port: int
    fragments: tuple[tuple[Sample, Fragments], ...]
    datagram: bytes

    @property
    def cost(self) -> int:
        """The bytes that it counts for."""
        return len(self.datagram) + len(self.fragments) * OVERHEAD

    @property
    def keys(self) -> set[_Key]:
        """The announcements that it has fragments of."""
        return {_key(self.port, sample) for sample, _ in self.fragments}


@dataclass(slots=True)
class FragmentStores:
    """The stores of all participants, by GUID prefix."""

    by_prefix: dict[bytes, "FragmentStore"] = field(default_factory=dict)
    size: int = 0
    _question_count: int = 0

    def rewritten(
        self, port: int, message: DiscoveryMessage, reader: bytes, rewrite: Rewrite
    ) -> PassedFragments:
        """The datagrams of a participant that may go on now, rewritten. Raises RtpsError.

        ``port`` is where the message came: each way has fragments of its own. ``reader`` is the
        GUID prefix of the participant that is to get them.
        """
        if not message.fragments:
            # Most messages announce nothing: acknowledgements and heartbeats.
            is_rewritten = bool(message.announcements)
            return PassedFragments([rewrite(message) if is_rewritten else message.datagram], [])
        store = self.by_prefix.setdefault(message.prefix, FragmentStore())
        before = store.size
        try:
            # Before the message is taken in: then all its fragments would be known ones.
            missing = store.missing(port, message)
            released = store.rewritten(port, message, rewrite)
        finally:
            # Also of a malformed message some fragments may have been kept.
            self.size += store.size - before
            while self.size > MOST_OF_ALL:
                self.forget(max(self.by_prefix, key=lambda prefix: self.by_prefix[prefix].size))
        return PassedFragments(
            released, [self._question(message, reader, *pair) for pair in missing]
        )

    def _question(
        self, message: DiscoveryMessage, reader: bytes, sample: Sample, missing: Sequence[int]
    ) -> bytes:
        self._question_count += 1
        fields = sample.writer, sample.sequence, missing, self._question_count
        return nack_frag(reader, message.prefix, *fields)

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
    """Announcements of a participant of which fragments have come, and the datagrams that wait.

    These have numbers, in the order in which they came; ``_waiting_by_key`` has the numbers of
    those with fragments of an announcement.
    """

    _samples: dict[_Key, _PendingSample] = field(default_factory=dict)
    _waiting_datagrams: dict[int, _WaitingDatagram] = field(default_factory=dict)
    _waiting_by_key: dict[_Key, set[int]] = field(default_factory=dict)
    _last_number: int = 0
    _sample_bytes: int = 0
    _waiting_bytes: int = 0

    @property
    def size(self) -> int:
        """The bytes that are remembered, and those of datagrams that wait."""
        return self._sample_bytes + self._waiting_bytes

    def missing(self, port: int, message: DiscoveryMessage) -> list[tuple[Sample, list[int]]]:
        """Samples of which a fragment comes again, and the numbers of those that are missing."""
        missing_by_key = dict[_Key, tuple[Sample, list[int]]]()
        for sample, frags in message.fragments:
            key = _key(port, sample)
            gathered = self._samples.get(key)
            is_repeated = gathered and gathered.whole is None and frags.first in gathered.fragments
            if gathered and is_repeated and key not in missing_by_key:
                count = -(-gathered.total // gathered.size)
                missing = [n for n in range(1, count + 1) if n not in gathered.fragments]
                missing_by_key[key] = sample, missing
        return list(missing_by_key.values())

    def rewritten(self, port: int, message: DiscoveryMessage, rewrite: Rewrite) -> list[bytes]:
        """As `FragmentStores.rewritten`, for a message with fragments."""
        if len(message.fragments) > MOST_FRAGMENTS:
            raise RtpsError(f"the datagram has more than {MOST_FRAGMENTS} fragments")
        # Whole announcements beside the fragments are rewritten now, fragments in `_filled`.
        arrived = _WaitingDatagram(port, message.fragments, rewrite(message))
        completed = {
            _key(port, sample)
            for sample, frags in message.fragments
            if self._gather(port, message, sample, frags, rewrite)
        }
        released = [self._filled(datagram) for datagram in self._released(completed)]
        if self._is_whole(arrived):  # it may also be of what was whole before, sent again
            return [*released, self._filled(arrived)]
        self._hold(arrived)
        return released

    def _released(self, completed: Iterable[_Key]) -> list[_WaitingDatagram]:
        """The datagrams that waited for announcements that are whole now, and for no others."""
        numbers = set[int]().union(*(self._waiting_by_key.get(key, ()) for key in completed))
        whole = [n for n in sorted(numbers) if self._is_whole(self._waiting_datagrams[n])]
        return [self._let_go(number) for number in whole]

    def _hold(self, datagram: _WaitingDatagram) -> None:
        """Have a datagram wait."""
        self._last_number += 1
        self._waiting_datagrams[self._last_number] = datagram
        self._waiting_bytes += datagram.cost
        for key in datagram.keys:
            self._waiting_by_key.setdefault(key, set()).add(self._last_number)
        while self._waiting_bytes > MOST_BYTES:
            self._let_go(next(iter(self._waiting_datagrams)))

    def _let_go(self, number: int) -> _WaitingDatagram:
        """The datagram with a number, which waits no longer."""
        datagram = self._waiting_datagrams.pop(number)
        self._waiting_bytes -= datagram.cost
        for key in datagram.keys:
            numbers = self._waiting_by_key[key]
            numbers.discard(number)
            if not numbers:
                del self._waiting_by_key[key]
        return datagram

    def _gather(
        self,
        port: int,
        message: DiscoveryMessage,
        sample: Sample,
        frags: Fragments,
        rewrite: Rewrite,
    ) -> bool:
        """Note the fragments of one submessage; whether the sample has become whole by them."""
        gathered = self._gathered(port, sample, frags)
        payloads = dict(_payloads(message.datagram, sample, frags))
        if gathered.whole is not None:
            return False
        gathered.fragments.update(payloads)
        if len(gathered.fragments) < -(-frags.total // frags.size):
            return False
        payload = b"".join(gathered.fragments[number] for number in sorted(gathered.fragments))
        edited = rewrite(read_discovery(_as_data(message.datagram, sample, payload)))
        # What is hidden has become a GAP (`withheld`).
        hidden = edited[HEADER] == SubmessageId.GAP
        gathered.whole = b"" if hidden else edited[_PAYLOAD_AT:]
        gathered.fragments.clear()
        return True

    def _gathered(self, port: int, sample: Sample, frags: Fragments) -> _PendingSample:
        """What has come of a fragment's sample. Raises RtpsError if the fragment can't be one."""
        if frags.size < SHORTEST or not 0 < frags.total <= LONGEST:
            text = f"an announcement has {frags.total} bytes in fragments of {frags.size} bytes"
            raise RtpsError(f"{text}, which is outside the limits")
        gathered = self._samples.get(_key(port, sample))
        if gathered is None:
            gathered = self._samples[_key(port, sample)] = _PendingSample(frags.total, frags.size)
            self._sample_bytes += gathered.cost
            while self._sample_bytes > MOST_BYTES:
                self._sample_bytes -= self._samples.pop(next(iter(self._samples))).cost
        if (gathered.total, gathered.size) != (frags.total, frags.size):
            raise RtpsError("the fragments of an announcement differ in size")
        return gathered

    def _whole(self, port: int, sample: Sample) -> bytes | None:
        gathered = self._samples.get(_key(port, sample))
        return gathered.whole if gathered else None

    def _is_whole(self, datagram: _WaitingDatagram) -> bool:
        return all(self._whole(datagram.port, s) is not None for s, _ in datagram.fragments)

    def _filled(self, datagram: _WaitingDatagram) -> bytes:
        """A datagram with its fragments of the rewritten samples."""
        edits = list[Overwrite]()
        for sample, frags in datagram.fragments:
            whole = self._whole(datagram.port, sample)
            if not whole:
                edits.append(withheld(sample))
            elif sample.payload:
                start = (frags.first - 1) * frags.size
                size = sample.payload.end - sample.payload.start
                edits.append(Overwrite(sample.payload.start, whole[start : start + size]))
        return apply(datagram.datagram, edits)


def _key(port: int, sample: Sample) -> _Key:
    return port, sample.prefix, sample.writer, sample.sequence


def _payloads(datagram: bytes, sample: Sample, frags: Fragments) -> Iterator[tuple[int, bytes]]:
    """The fragments in a DATA_FRAG, each with its number. Raises RtpsError."""
    count = -(-frags.total // frags.size)
    last = frags.first + frags.count - 1
    if sample.payload is None or not 0 < frags.first <= last <= count:
        text = (
            f"an announcement of {count} fragments can't have the fragments {frags.first} to {last}"
        )
        raise RtpsError(text)
    offset = sample.payload.start
    for number in range(frags.first, last + 1):
        size = frags.size if number < count else frags.total - (count - 1) * frags.size
        if offset + size > sample.payload.end:
            raise RtpsError(f"fragment {number} is shorter than {size} bytes")
        yield number, datagram[offset : offset + size]
        offset += size


def _as_data(datagram: bytes, sample: Sample, payload: bytes) -> bytes:
    """The message that would carry a sample in one DATA."""
    payload_flag = 0x08 if sample.is_key_only else 0x04
    head = struct.pack("<BBHHH", SubmessageId.DATA, 0x01 | payload_flag, 0, 0, 16)
    head += struct.pack(">II", sample.reader, sample.writer)
    head += struct.pack("<iI", sample.sequence >> 32, sample.sequence & 0xFFFFFFFF)
    return datagram[:HEADER] + head + payload
