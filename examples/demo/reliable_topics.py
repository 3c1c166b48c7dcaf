"""Writer and reader of a reliable DDS topic (DDSI-RTPS 2.5, 8.4): no sample is lost.

A writer keeps samples and sends heartbeats until all readers have acknowledged the samples. A
reader takes samples in order, and asks for missing samples. Both are known by GUID, process parsed
submessages, and return the submessages to send (:mod:`.rtps_messages`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from examples.demo.rtps_messages import Told, acknack, data, heartbeat


@dataclass
class ReliableWriter:
    """Keeps samples. `acknowledged` has the last acknowledged number for each reader.

    A `durable` writer keeps all samples for later readers. Otherwise a reader gets only the samples
    that are written after the match.
    """

    entity: int
    durable: bool
    samples: dict[int, bytes] = field(default_factory=dict)
    acknowledged: dict[bytes, int] = field(default_factory=dict)
    last: int = 0
    _count: int = 0

    def match(self, reader: bytes) -> None:
        """Add a reader."""
        self.acknowledged.setdefault(reader, 0 if self.durable else self.last)

    def write(self, payload: bytes) -> None:
        """Write a sample. Without readers, only a durable writer keeps the sample."""
        self.last += 1
        if self.durable or self.acknowledged:
            self.samples[self.last] = payload

    def sample(self, reader: bytes, number: int) -> bytes:
        """The DATA submessage with a sample for a reader."""
        return data(_entity(reader), self.entity, number, self.samples[number])

    def heartbeat(self, reader: bytes) -> bytes:
        """The HEARTBEAT submessage for a reader."""
        self._count += 1
        first = next(iter(self.samples), self.last + 1)
        return heartbeat(_entity(reader), self.entity, first, self.last, self._count)

    def heed(self, reader: bytes, submessage: Told) -> list[bytes]:
        """Process an ACKNACK. Return the samples that the reader lacks."""
        if reader not in self.acknowledged:
            return []
        self.acknowledged[reader] = max(self.acknowledged[reader], submessage.first - 1)
        got_by_all = 0 if self.durable else min(self.acknowledged.values())
        self.samples = {n: sample for n, sample in self.samples.items() if n > got_by_all}
        return [self.sample(reader, n) for n in submessage.missing if n in self.samples]


@dataclass
class ReliableReader:
    """Takes samples in order: from each writer only the `expected` number.

    The reader drops any other sample, and asks for the sample again later.
    """

    entity: int
    expected: dict[bytes, int] = field(default_factory=dict)
    _count: int = 0

    def match(self, writer: bytes) -> None:
        """Add a writer."""
        self.expected.setdefault(writer, 1)

    def take(self, writer: bytes, number: int) -> bool:
        """Take the next sample of a writer; False for any other sample."""
        if number != self.expected.get(writer):
            return False
        self.expected[writer] += 1
        return True

    def skip(self, writer: bytes, first: int, last: int) -> None:
        """Skip the samples from `first` to `last`, which do not exist."""
        if first <= self.expected[writer] <= last:
            self.expected[writer] = last + 1

    def answer(self, writer: bytes, last: int) -> bytes:
        """The ACKNACK for a writer with samples up to `last`."""
        self._count += 1
        base = self.expected[writer]
        return acknack(self.entity, _entity(writer), base, range(base, last + 1), self._count)


def _entity(guid: bytes) -> int:
    return int.from_bytes(guid[12:], "big")
