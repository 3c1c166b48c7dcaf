"""Announcements in fragments: gather the fragments, and pass on whole announcements alone.

A long announcement of a reader or writer comes in several DATA_FRAG, of one or several datagrams.
Cyclone DDS makes fragments of 1,344 bytes. A locator may begin in one fragment and end in the next.
So the proxy holds the fragments until the announcement is whole. Then the proxy makes a message
with this announcement in one DATA, and rewrites and judges the message like any other.

The proxy passes on no DATA_FRAG of a builtin writer. Otherwise a participant could join fragments
of different announcements with the same sequence number: the sender chooses which fragments reach
the participant. The policy would have judged each announcement, but not the joined one.

If a reader requests an announcement again, the writer sends the first fragment alone, and waits for
requests for the others. But the reader never receives a fragment, and requests nothing. So the
proxy requests the missing fragments on behalf of the reader. If those that have come were for all
readers, the proxy requests all fragments: Cyclone DDS sends requested fragments to one reader alone
(ddsi_receive.c, handle_NackFrag).

Each participant has a store. So a participant can't displace the fragments of another one, until
all stores together are too large. Then the proxy drops the largest store first.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from rosproxy.ros2.protocol.addressing import says_something
from rosproxy.ros2.protocol.reliable import nack_frag
from rosproxy.ros2.protocol.rtps import (
    HEADER_BYTES,
    INFO_DST,
    PREFIX_BYTES,
    Fragments,
    RtpsError,
    Sample,
    SubmessageId,
    info_dst,
    submessages,
)
from rosproxy.ros2.rewriting.discovery import (
    BuiltinWriter,
    ContentCounts,
    DiscoveryMessage,
    read_discovery,
)

LONGEST_ANNOUNCEMENT_BYTES = 60_000
"""Bytes of the longest announcement that the proxy accepts in fragments. Real announcements
have a few thousand. A datagram holds 65,507 bytes, and Fast DDS receives at most 65,500."""
SHORTEST_FRAGMENT_BYTES = 128
"""Bytes of the shortest fragment that the proxy accepts. Real fragments have over 1,000."""
MOST_BYTES_IN_FRONT = 1024
"""The highest number of bytes before an announcement in the proxy's message: the header, the
destination, the time and the inline QoS. Real announcements need about 100."""
MOST_BYTES = 1024 * 1024
"""The highest number of bytes of a participant's announcements in a store. Beyond this number, the
store drops the oldest."""
MOST_BYTES_OF_ALL = 16 * 1024 * 1024
"""The highest number of bytes of all stores together."""
MOST_FRAGMENTS = 64
"""The highest number of DATA_FRAG in a datagram. A datagram of 64 KB holds fewer than 50 of Cyclone
DDS."""
OVERHEAD_BYTES = 1024 + MOST_BYTES_IN_FRONT
"""Bytes that are added to the length of each announcement in a store."""

Rewrite = Callable[[DiscoveryMessage], bytes]
"""Rewrites the whole announcements in a message. The length of the message stays."""

_Key = tuple[int, bytes, bytes, int, int]
"""Identifies an announcement: port of the proxy, destination, GUID prefix, entity id of the writer,
sequence number."""


class PassedFragments(NamedTuple):
    """Datagrams to pass on, and requests for fragments to send back."""

    forwarded: list[bytes]
    questions: list[bytes]


class _Part(NamedTuple):
    """A DATA_FRAG of a message.

    ``info_dst`` and ``info_ts`` are the submessages that state its destination and its time. Each
    is empty if the message states none. Without a destination, the DATA_FRAG is for all readers.
    """

    info_dst: bytes
    info_ts: bytes
    sample: Sample
    fragments: Fragments


@dataclass(slots=True)
class _PendingSample:
    """The fragments of a sample, by their numbers.

    ``total`` is the bytes of the sample, and ``size`` the bytes of each fragment but the last.
    ``front`` is the beginning of the message with the whole sample, up to the payload. The first
    fragment determines this part.
    """

    total: int
    size: int
    front: bytes = b""
    fragments: dict[int, bytes] = field(default_factory=dict)

    @property
    def cost(self) -> int:
        """The bytes that the sample counts for."""
        return self.total + OVERHEAD_BYTES

    @property
    def count(self) -> int:
        """The number of fragments of the sample."""
        return -(-self.total // self.size)

    @property
    def is_whole(self) -> bool:
        """Whether all fragments have come."""
        return len(self.fragments) == self.count

    def to_request(self, part: _Part) -> Sequence[int]:
        """The numbers of the fragments to request, if a part comes again."""
        numbers = range(1, self.count + 1)
        is_for_all = not part.info_dst
        return numbers if is_for_all else [n for n in numbers if n not in self.fragments]

    @property
    def message(self) -> bytes:
        """The message with the whole sample."""
        return self.front + b"".join(self.fragments[number] for number in sorted(self.fragments))


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
            joined, repeated = store.gather(port, message)
        finally:
            # The store may have kept some fragments of a malformed message, too.
            self.size += store.size - before
            while self.size > MOST_BYTES_OF_ALL:
                self.forget(max(self.by_prefix, key=lambda prefix: self.by_prefix[prefix].size))
        return PassedFragments(
            _passed(message, joined, rewrite),
            [self._question(message, reader, *part) for part in repeated],
        )

    def _question(
        self, message: DiscoveryMessage, reader: bytes, sample: Sample, numbers: Sequence[int]
    ) -> bytes:
        """The request for fragments of a sample with these numbers."""
        self._question_count += 1
        fields = sample.writer, sample.sequence, numbers, self._question_count
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
    """The announcements of a participant of which some fragments have come.

    ``size`` is the bytes of the announcements.
    """

    size: int = 0
    _samples: dict[_Key, _PendingSample] = field(default_factory=dict)

    def gather(
        self, port: int, message: DiscoveryMessage
    ) -> tuple[list[bytes], list[tuple[Sample, Sequence[int]]]]:
        """Gather the fragments of a message.

        Return the messages with the announcements that are whole now. Return also the samples that
        are not whole and of which a fragment came again, with the numbers of the fragments to
        request. Raises RtpsError.
        """
        if len(message.fragments) > MOST_FRAGMENTS:
            raise RtpsError(f"the datagram has more than {MOST_FRAGMENTS} fragments")
        parts = list(_parts(message))
        by_key = {_key(port, part): part for part in parts}
        repeated = [_key(port, part) for part in parts if self._has(port, part)]
        for part in parts:
            self._gather(port, message, part)
        kept = {key: self._samples[key] for key in by_key if key in self._samples}
        whole = {key: pending for key, pending in kept.items() if pending.is_whole}
        size = sum(pending.total for pending in whole.values())
        if size > LONGEST_ANNOUNCEMENT_BYTES:
            text = f"more than {LONGEST_ANNOUNCEMENT_BYTES} bytes"
            raise RtpsError(f"the datagram completes announcements of {text}")
        for key in whole:
            self._drop(key)
        # The store may also have dropped an announcement to make room for the next one.
        again = {by_key[key]: self._samples[key] for key in repeated if key in self._samples}
        return (
            [pending.message for pending in whole.values()],
            [(part.sample, pending.to_request(part)) for part, pending in again.items()],
        )

    def _has(self, port: int, part: _Part) -> bool:
        pending = self._samples.get(_key(port, part))
        return pending is not None and part.fragments.first in pending.fragments

    def _gather(self, port: int, message: DiscoveryMessage, part: _Part) -> None:
        """Gather the fragments of a DATA_FRAG. Raises RtpsError."""
        sample = part.sample
        if sample.writer == BuiltinWriter.PARTICIPANTS:
            # The proxy has to notice each announcement and each end of a participant. Cyclone DDS
            # refuses such fragments as well (ddsi_receive.c, handle_DataFrag).
            raise RtpsError("a participant announces itself in fragments")
        pending = self._pending(_key(port, part), part.fragments)
        payloads = dict(_payloads(message.datagram, sample, part.fragments))
        if 1 in payloads:
            pending.front = _front(message.datagram, part)
        pending.fragments.update(payloads)

    def _pending(self, key: _Key, fragments: Fragments) -> _PendingSample:
        """The fragments of a sample.

        Raises RtpsError if the size is outside the limits, or differs from that of a former
        fragment.
        """
        total = fragments.total
        size = fragments.size
        if size < SHORTEST_FRAGMENT_BYTES or not 0 < total <= LONGEST_ANNOUNCEMENT_BYTES:
            text = f"an announcement has {total} bytes in fragments of {size} bytes"
            raise RtpsError(f"{text}, which is outside the limits")
        pending = self._samples.get(key)
        if pending is None:
            pending = self._samples[key] = _PendingSample(total, size)
            self.size += pending.cost
            while self.size > MOST_BYTES:
                self._drop(next(iter(self._samples)))
        if (pending.total, pending.size) != (total, size):
            raise RtpsError("the fragments of an announcement differ in size")
        return pending

    def _drop(self, key: _Key) -> None:
        self.size -= self._samples.pop(key).cost


def _key(port: int, part: _Part) -> _Key:
    return port, part.info_dst, part.sample.prefix, part.sample.writer, part.sample.sequence


def _parts(message: DiscoveryMessage) -> Iterator[_Part]:
    """Yield the DATA_FRAG of a message."""
    by_start = {sample.body.start: (sample, fragments) for sample, fragments in message.fragments}
    to = stamp = b""
    for kind, _, body in submessages(message.datagram):
        if kind == INFO_DST:
            prefix = message.datagram[body.start : body.start + PREFIX_BYTES]
            to = info_dst(prefix) if any(prefix) else b""
        elif kind == SubmessageId.INFO_TS:
            stamp = message.datagram[body.start - 4 : body.end]
        elif body.start in by_start:
            yield _Part(to, stamp, *by_start[body.start])


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


def _front(datagram: bytes, part: _Part) -> bytes:
    """The beginning of the message with the whole sample of a DATA_FRAG, up to the payload.

    Raises RtpsError if this part is too long.
    """
    sample = part.sample
    order, little = ("<", 0x01) if sample.is_little_endian else (">", 0)
    qos = sample.inline_qos
    inline = datagram[qos.start : qos.end] if qos else b""
    flags = little | (0x02 if qos else 0) | (0x08 if sample.is_key_only else 0x04)
    fixed = struct.pack(">II", sample.reader, sample.writer)
    fixed += struct.pack(order + "iI", sample.sequence >> 32, sample.sequence & 0xFFFFFFFF)
    size = 4 + len(fixed) + len(inline) + part.fragments.total
    head = datagram[:HEADER_BYTES] + part.info_dst + part.info_ts
    if len(head) + len(inline) + 24 > MOST_BYTES_IN_FRONT:
        text = f"more than {MOST_BYTES_IN_FRONT} bytes"
        raise RtpsError(f"{text} are in front of an announcement in fragments")
    return (
        head + struct.pack(order + "BBHHH", SubmessageId.DATA, flags, size, 0, 16) + fixed + inline
    )


def _passed(message: DiscoveryMessage, joined: Iterable[bytes], rewrite: Rewrite) -> list[bytes]:
    """The rewritten datagrams of a message with fragments. Raises RtpsError.

    These are the messages ``joined`` with the announcements that are whole now, and the rest of the
    message without its fragments. The rest may have heartbeats, so it comes last. All announcements
    count as part of the datagram, because the proxy reads all of them in one step.
    """
    whole = list(map(read_discovery, joined))
    contents = ContentCounts()
    for each in (message, *whole):
        for announcement in each.announcements:
            contents.add(announcement)
    rest = rewrite(message) if message.announcements else message.datagram
    for sample, _ in reversed(message.fragments):
        rest = rest[: sample.body.start - 4] + rest[sample.body.end :]
    return [*map(rewrite, whole), *([rest] if says_something(rest) else [])]
