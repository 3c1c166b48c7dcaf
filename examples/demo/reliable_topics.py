"""Both halves of a reliable topic of DDS (DDSI-RTPS 2.5, 8.4): nothing is lost while both live.

A writer keeps its samples, and says by heartbeats what it has, until its readers have acknowledged
all. A reader answers with what it lacks, and takes samples in their order. Each knows the others by
their GUIDs, and is given what these have told; it gives what is to be sent (:mod:`.rtps_messages`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from examples.demo.rtps_messages import Told, acknack, data, heartbeat


@dataclass
class ReliableWriter:
    """Keeps samples; `acknowledged` is up to which number each of its readers has them.

    One that is `durable` keeps all, for whoever comes; of others a reader gets what is written from
    its coming on.
    """

    entity: int
    durable: bool
    samples: dict[int, bytes] = field(default_factory=dict)
    acknowledged: dict[bytes, int] = field(default_factory=dict)
    last: int = 0
    _count: int = 0

    def match(self, reader: bytes) -> None:
        """Have a reader from now on."""
        self.acknowledged.setdefault(reader, 0 if self.durable else self.last)

    def write(self, payload: bytes) -> None:
        """Write a sample; without readers it is nobody's."""
        self.last += 1
        if self.durable or self.acknowledged:
            self.samples[self.last] = payload

    def sample(self, reader: bytes, number: int) -> bytes:
        """What tells a reader a sample."""
        return data(_entity(reader), self.entity, number, self.samples[number])

    def heartbeat(self, reader: bytes) -> bytes:
        """What tells a reader which samples there are."""
        self._count += 1
        first = next(iter(self.samples), self.last + 1)
        return heartbeat(_entity(reader), self.entity, first, self.last, self._count)

    def heed(self, reader: bytes, submessage: Told) -> list[bytes]:
        """Take in what a reader has got; what it lacks."""
        if reader not in self.acknowledged:
            return []
        self.acknowledged[reader] = max(self.acknowledged[reader], submessage.first - 1)
        got_by_all = 0 if self.durable else min(self.acknowledged.values())
        self.samples = {n: sample for n, sample in self.samples.items() if n > got_by_all}
        return [self.sample(reader, n) for n in submessage.missing if n in self.samples]


@dataclass
class ReliableReader:
    """Takes samples in their order: of each writer only the next one, whose number is `expected`.

    Any other that comes is let go; it is asked for when its turn has come.
    """

    entity: int
    expected: dict[bytes, int] = field(default_factory=dict)
    _count: int = 0

    def match(self, writer: bytes) -> None:
        """Have a writer from now on."""
        self.expected.setdefault(writer, 1)

    def take(self, writer: bytes, number: int) -> bool:
        """Whether it is a sample's turn."""
        if number != self.expected.get(writer):
            return False
        self.expected[writer] += 1
        return True

    def skip(self, writer: bytes, first: int, last: int) -> None:
        """Expect none of the samples from `first` to `last`: there are none."""
        if first <= self.expected[writer] <= last:
            self.expected[writer] = last + 1

    def answer(self, writer: bytes, last: int) -> bytes:
        """What tells a writer with samples up to `last` what this reader has and lacks."""
        self._count += 1
        base = self.expected[writer]
        return acknack(self.entity, _entity(writer), base, range(base, last + 1), self._count)


def _entity(guid: bytes) -> int:
    return int.from_bytes(guid[12:], "big")
