"""The proxy's own participant: it reads which readers and writers others have, on both sides.

It announces itself, and has the readers of discovery alone. So whoever has announced itself
before the proxy started does it again, at once; and what a participant has said of its readers and
writers long ago, to others, the proxy learns as well: which locators they have, and which topics.

It is a reliable reader in the plainest form: what a writer has by its heartbeat, and was not got,
is asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.announcement import READS, announcement, farewell
from rosproxy.ros2.protocol.reliable import MOST_ASKED, Heartbeat, acknack, heartbeats
from rosproxy.ros2.protocol.rtps import samples
from rosproxy.ros2.rewriting.discovery import BuiltinWriter

LEASE = 12.0
"""Seconds after which others forget it that do not hear it: a proxy that was killed."""
ANNOUNCE_INTERVAL = 3.0
OBSERVED = (BuiltinWriter.PUBLICATIONS, BuiltinWriter.SUBSCRIPTIONS)
MOST_SAMPLES = 1000
"""Samples of a writer that are remembered as got; a participant has some tens."""


@dataclass(slots=True)
class Observer:
    """What the proxy's participant has got; ``prefix`` is its own, which is random."""

    prefix: bytes
    _got: dict[tuple[bytes, int], set[int]] = field(default_factory=dict)
    _count: int = 0

    def announcement(self, *reached_at: HostPort) -> bytes:
        """The datagram by which it announces itself; ``reached_at`` is where it is answered."""
        return announcement(self.prefix, reached_at, LEASE, READS)

    def farewell(self) -> bytes:
        """The datagram by which it says that it has ended."""
        return farewell(self.prefix)

    def first_question(self, of: bytes) -> list[bytes]:
        """What asks a participant's writers what they have."""
        return [
            self._ask(of, writer, 1, ()) for writer in OBSERVED if (of, writer) not in self._got
        ]

    def take(self, of: bytes, datagram: bytes) -> list[bytes]:
        """Take in a participant's message; what to ask it for. Raises RtpsError.

        Of samples in fragments the last comes when all are there (`FragmentStore`).
        """
        for sample in samples(datagram):
            if sample.writer in OBSERVED and sample.prefix == of:
                got = self._got.setdefault((of, sample.writer), set())
                if len(got) < MOST_SAMPLES:
                    got.add(sample.sequence)
        answers = []
        for heartbeat in heartbeats(datagram):
            if heartbeat.writer in OBSERVED:
                self._got.setdefault((of, heartbeat.writer), set())
                if heartbeat.last > 0:  # who has nothing would take an answer for a question
                    answers.append(self._answer(of, heartbeat))
        return answers

    def forget(self, of: bytes) -> None:
        """Forget a participant that has gone."""
        for writer in OBSERVED:
            self._got.pop((of, writer), None)

    def _answer(self, of: bytes, heartbeat: Heartbeat) -> bytes:
        got = self._got[of, heartbeat.writer]
        first = max(heartbeat.first, 1)
        base = next((n for n in range(first, heartbeat.last + 1) if n not in got), None)
        if base is None or len(got) >= MOST_SAMPLES:
            return self._ask(of, heartbeat.writer, max(heartbeat.last, 0) + 1, ())
        last = min(heartbeat.last, base + MOST_ASKED - 1)
        missing = [number for number in range(base, last + 1) if number not in got]
        return self._ask(of, heartbeat.writer, base, missing)

    def _ask(self, of: bytes, writer: int, base: int, missing: Sequence[int]) -> bytes:
        self._count += 1
        question = base == 1 and not missing
        return acknack(self.prefix, of, writer, base, missing, self._count, final=not question)
