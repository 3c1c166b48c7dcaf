"""Announcements in fragments: hold the fragments until all have come, then rewrite and pass on.

A long announcement of a reader or writer comes in several DATA_FRAG, of one or several datagrams.
Cyclone DDS makes fragments of 1,344 bytes. A locator may begin in one fragment and end in the next.
So the proxy holds the datagrams until the announcement is whole, and rewrites the announcement like
any other. Then each fragment gets its part of the result. Fragments that the writer repeats later
pass at once.

If a reader requests an announcement again, the writer sends the first fragment alone, and waits for
requests for the others. But the reader has not received the first fragment, which the proxy holds,
and requests nothing. So the proxy requests the other fragments on behalf of the reader.

Each participant has a store. So a participant can't displace the fragments of another one, until
all stores together are too large. Then the proxy drops the largest store first.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec

from rosproxy.ros2.protocol.reliable import nack_frag, withheld
from rosproxy.ros2.protocol.rtps import (
    HEADER_BYTES,
    Fragments,
    Overwrite,
    RtpsError,
    Sample,
    SubmessageId,
    apply,
)
from rosproxy.ros2.rewriting.discovery import ContentCounts, DiscoveryMessage, read_discovery

LONGEST_ANNOUNCEMENT_BYTES = 60_000
"""Bytes of the longest announcement that the proxy accepts in fragments. Real announcements
have a few thousand."""
SHORTEST_FRAGMENT_BYTES = 128
"""Bytes of the shortest fragment that the proxy accepts. Real fragments have over 1,000."""
MOST_BYTES = 1024 * 1024
"""The highest number of bytes of a participant's announcements in a store, and of its waiting
datagrams. Beyond either bound, the store drops the oldest."""
MOST_BYTES_OF_ALL = 16 * 1024 * 1024
"""The highest number of bytes of all stores together."""
MOST_FRAGMENTS = 64
"""The highest number of DATA_FRAG in a datagram. A datagram of 64 KB holds fewer than 50 of Cyclone
DDS."""
OVERHEAD_BYTES = 1024
"""Bytes that are added to the length of each announcement, and of each DATA_FRAG that waits."""

Rewrite = Callable[[DiscoveryMessage], bytes]
"""Rewrites the whole announcements in a message. The length of the message stays."""

_PAYLOAD_AT = HEADER_BYTES + 24
"""Offset of the payload of a DATA without inline QoS that is the first submessage of a message."""

_Key = tuple[int, bytes, int, int]
"""Identifies an announcement: port of the proxy, GUID prefix, entity id of the writer, sequence
number."""


class PassedFragments(NamedTuple):
    """Datagrams to pass on, and requests for missing fragments to send back."""

    forwarded: list[bytes]
    questions: list[bytes]


@dataclass(slots=True)
class _PendingSample:
    """The fragments of a sample, by their numbers.

    ``total`` is the bytes of the sample, and ``size`` the bytes of each fragment but the last.
    ``whole`` is the rewritten payload when all fragments have come; empty if the announcement is
    hidden.
    """

    total: int
    size: int
    fragments: dict[int, bytes] = field(default_factory=dict)
    whole: bytes | None = None

    @property
    def cost(self) -> int:
        """The bytes that the sample counts for."""
        return self.total + OVERHEAD_BYTES


class _WaitingDatagram(msgspec.Struct, frozen=True):
    """A datagram that waits, rewritten except for the fragments.

    ``port`` is the port of the proxy at which the datagram came.
    """

    port: int
    fragments: tuple[tuple[Sample, Fragments], ...]
    datagram: bytes

    @property
    def cost(self) -> int:
        """The bytes that the datagram counts for."""
        return len(self.datagram) + len(self.fragments) * OVERHEAD_BYTES

    @property
    def keys(self) -> set[_Key]:
        """The keys of the announcements of which the datagram has fragments."""
        return {_key(self.port, sample) for sample, _ in self.fragments}


@dataclass(slots=True)
class FragmentStores:
    """The stores of all participants, by GUID prefix; ``size`` is the bytes of all stores."""

    by_prefix: dict[bytes, "FragmentStore"] = field(default_factory=dict)
    size: int = 0
    _question_count: int = 0

    def rewritten(
        self, port: int, message: DiscoveryMessage, reader: bytes, rewrite: Rewrite
    ) -> PassedFragments:
        """The rewritten datagrams of a participant that may pass now. Raises RtpsError.

        ``port`` is the port of the proxy at which the message came. Each port has separate
        fragments, because the rewritten announcements differ. ``reader`` is the GUID prefix of the
        participant that is to receive the datagrams.
        """
        if not message.fragments:
            # Most messages announce nothing: acknowledgements and heartbeats.
            is_rewritten = bool(message.announcements)
            return PassedFragments([rewrite(message) if is_rewritten else message.datagram], [])
        store = self.by_prefix.setdefault(message.prefix, FragmentStore())
        before = store.size
        try:
            # Before the store gathers these fragments, or each would count as repeated.
            missing = store.missing(port, message)
            released = store.rewritten(port, message, rewrite)
        finally:
            # The store may have kept some fragments of a malformed message, too.
            self.size += store.size - before
            while self.size > MOST_BYTES_OF_ALL:
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
        """Forget the fragments of a participant."""
        store = self.by_prefix.pop(prefix, None)
        self.size -= store.size if store else 0

    def clear(self) -> None:
        """Forget all fragments."""
        self.by_prefix.clear()
        self.size = 0


@dataclass(slots=True)
class FragmentStore:
    """The announcements of a participant that came in fragments, and the datagrams that wait.

    The waiting datagrams have ascending numbers. ``_waiting_by_key`` has the numbers of the
    datagrams with fragments of an announcement.
    """

    _samples: dict[_Key, _PendingSample] = field(default_factory=dict)
    _waiting_datagrams: dict[int, _WaitingDatagram] = field(default_factory=dict)
    _waiting_by_key: dict[_Key, set[int]] = field(default_factory=dict)
    _last_number: int = 0
    _sample_bytes: int = 0
    _waiting_bytes: int = 0

    @property
    def size(self) -> int:
        """The bytes of the announcements, and of the datagrams that wait."""
        return self._sample_bytes + self._waiting_bytes

    def missing(self, port: int, message: DiscoveryMessage) -> list[tuple[Sample, list[int]]]:
        """The samples of which a fragment came again, and the numbers of the missing fragments."""
        missing_by_key = dict[_Key, tuple[Sample, list[int]]]()
        for sample, frags in message.fragments:
            key = _key(port, sample)
            gathered = self._samples.get(key)
            is_repeated = gathered and gathered.whole is None and frags.first in gathered.fragments
            if gathered and is_repeated and key not in missing_by_key:
                count = -(-gathered.total // gathered.size)
                missing = [n for n in range(1, count + 1) if n not in gathered.fragments]
                if missing:
                    missing_by_key[key] = sample, missing
        return list(missing_by_key.values())

    def rewritten(self, port: int, message: DiscoveryMessage, rewrite: Rewrite) -> list[bytes]:
        """Gather the fragments of a message, and return the rewritten datagrams that may pass now.

        See `FragmentStores.rewritten`.
        """
        if len(message.fragments) > MOST_FRAGMENTS:
            raise RtpsError(f"the datagram has more than {MOST_FRAGMENTS} fragments")
        # This rewrites the whole announcements of the datagram; `_filled` rewrites the fragments.
        arrived = _WaitingDatagram(port, message.fragments, rewrite(message))
        completed = self._gather_all(port, message, rewrite)
        released = [self._filled(datagram) for datagram in self._released(completed)]
        if self._is_whole(arrived):  # also if the fragments repeat whole announcements
            return [*released, self._filled(arrived)]
        self._hold(arrived)
        return released

    def _released(self, completed: Iterable[_Key]) -> list[_WaitingDatagram]:
        """The waiting datagrams whose announcements are all whole now, in order of arrival.

        ``completed`` are the announcements that have just become whole.
        """
        numbers = set[int]().union(*(self._waiting_by_key.get(key, ()) for key in completed))
        whole = [n for n in sorted(numbers) if self._is_whole(self._waiting_datagrams[n])]
        return [self._let_go(number) for number in whole]

    def _hold(self, datagram: _WaitingDatagram) -> None:
        """Let a datagram wait. Drop the oldest datagrams beyond MOST_BYTES."""
        self._last_number += 1
        self._waiting_datagrams[self._last_number] = datagram
        self._waiting_bytes += datagram.cost
        for key in datagram.keys:
            self._waiting_by_key.setdefault(key, set()).add(self._last_number)
        while self._waiting_bytes > MOST_BYTES:
            self._let_go(next(iter(self._waiting_datagrams)))

    def _let_go(self, number: int) -> _WaitingDatagram:
        """Take a datagram out of those that wait."""
        datagram = self._waiting_datagrams.pop(number)
        self._waiting_bytes -= datagram.cost
        for key in datagram.keys:
            numbers = self._waiting_by_key[key]
            numbers.discard(number)
            if not numbers:
                del self._waiting_by_key[key]
        return datagram

    def _gather_all(self, port: int, message: DiscoveryMessage, rewrite: Rewrite) -> set[_Key]:
        """Gather the fragments of a message, and return the announcements that are whole now.

        All announcements that a message completes count as one announcement, and as part of the
        datagram, because the proxy reads all of them in one step. Raises RtpsError.
        """
        completed = set[_Key]()
        size = 0
        contents = ContentCounts()
        for announcement in message.announcements:
            contents.add(announcement)
        for sample, frags in message.fragments:
            gathered = self._gather(port, message, sample, frags)
            if gathered is not None:
                size += gathered.total
                if size > LONGEST_ANNOUNCEMENT_BYTES:
                    text = f"more than {LONGEST_ANNOUNCEMENT_BYTES} bytes"
                    raise RtpsError(f"the datagram completes announcements of {text}")
                _complete(gathered, message, sample, rewrite, contents)
                completed.add(_key(port, sample))
        return completed

    def _gather(
        self, port: int, message: DiscoveryMessage, sample: Sample, frags: Fragments
    ) -> _PendingSample | None:
        """Gather the fragments of a DATA_FRAG. Return the sample if all its fragments have come.

        Raises RtpsError.
        """
        gathered = self._gathered(port, sample, frags)
        payloads = dict(_payloads(message.datagram, sample, frags))
        if gathered.whole is not None:
            return None
        gathered.fragments.update(payloads)
        is_complete = len(gathered.fragments) == -(-frags.total // frags.size)
        return gathered if is_complete else None

    def _gathered(self, port: int, sample: Sample, frags: Fragments) -> _PendingSample:
        """The gathered fragments of a sample.

        Raises RtpsError if the size is outside the limits, or differs from that of a former
        fragment.
        """
        if (
            frags.size < SHORTEST_FRAGMENT_BYTES
            or not 0 < frags.total <= LONGEST_ANNOUNCEMENT_BYTES
        ):
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
        """The datagram with its parts of the rewritten announcements."""
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


def _complete(
    gathered: _PendingSample,
    message: DiscoveryMessage,
    sample: Sample,
    rewrite: Rewrite,
    contents: ContentCounts,
) -> None:
    """Rewrite an announcement of which all fragments have come. Raises RtpsError.

    ``contents`` counts what the announcements of the datagram contain.
    """
    payload = b"".join(gathered.fragments[number] for number in sorted(gathered.fragments))
    whole = read_discovery(_as_data(message.datagram, sample, payload))
    for announcement in whole.announcements:
        contents.add(announcement)
    edited = rewrite(whole)
    # `rewrite` has turned a hidden announcement into a GAP (`withheld`).
    hidden = edited[HEADER_BYTES] == SubmessageId.GAP
    gathered.whole = b"" if hidden else edited[_PAYLOAD_AT:]
    gathered.fragments.clear()


def _payloads(datagram: bytes, sample: Sample, frags: Fragments) -> Iterator[tuple[int, bytes]]:
    """Yield the number and the bytes of each fragment in a DATA_FRAG. Raises RtpsError."""
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
    """The message that carries the whole payload of a sample in a DATA."""
    payload_flag = 0x08 if sample.is_key_only else 0x04
    head = struct.pack("<BBHHH", SubmessageId.DATA, 0x01 | payload_flag, 0, 0, 16)
    head += struct.pack(">II", sample.reader, sample.writer)
    head += struct.pack("<iI", sample.sequence >> 32, sample.sequence & 0xFFFFFFFF)
    return datagram[:HEADER_BYTES] + head + payload
