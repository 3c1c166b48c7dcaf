"""The proxy's own participant: it reads which readers and writers others have, on both sides.

It announces itself, and has the readers of discovery alone. So participants that announced
themselves before the proxy started do it again, at once; and the proxy learns as well what they
have told others long ago of their readers and writers: which locators they have, and which topics.

It is a reliable reader in the plainest form: it asks for the samples that a writer has by its
heartbeat, and that it has not got.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.announcement import READER_ENDPOINTS, announcement, farewell
from rosproxy.ros2.protocol.reliable import MOST_ASKED, Heartbeat, acknack, heartbeats
from rosproxy.ros2.protocol.rtps import samples
from rosproxy.ros2.rewriting.discovery import BuiltinWriter

LEASE = 12.0
"""Seconds after which others that do not hear it forget it: the proxy may have been killed."""
ANNOUNCE_INTERVAL = 3.0
OBSERVED = (BuiltinWriter.PUBLICATIONS, BuiltinWriter.SUBSCRIPTIONS)
MOST_SAMPLES = 1000
"""Samples of a writer that are remembered as got; a participant has some tens."""


@dataclass(slots=True)
class Observer:
    """The samples that the proxy's participant has got; ``prefix`` is its own, which is random."""

    prefix: bytes
    _received: dict[tuple[bytes, int], set[int]] = field(default_factory=dict)
    _count: int = 0

    def announcement(self, *reached_at: HostPort) -> bytes:
        """The datagram by which it announces itself; ``reached_at`` is where it is answered."""
        return announcement(self.prefix, reached_at, LEASE, READER_ENDPOINTS)

    def farewell(self) -> bytes:
        """The datagram by which it says that it has ended."""
        return farewell(self.prefix)

    def first_question(self, prefix: bytes) -> list[bytes]:
        """What asks a participant's writers what they have."""
        return [self._ask(prefix, w, 1, ()) for w in OBSERVED if (prefix, w) not in self._received]

    def take(self, prefix: bytes, datagram: bytes) -> list[bytes]:
        """Note a participant's message; what to ask it for. Raises RtpsError.

        Of samples in fragments the last comes when all are there (`FragmentStore`).
        """
        for sample in samples(datagram):
            if sample.writer in OBSERVED and sample.prefix == prefix:
                received = self._received.setdefault((prefix, sample.writer), set())
                if len(received) < MOST_SAMPLES:
                    received.add(sample.sequence)
        # One answer to each writer: a datagram has room for 256 heartbeats, all of one writer.
        by_writer = {heartbeat.writer: heartbeat for heartbeat in heartbeats(datagram)}
        answers = []
        for writer, heartbeat in by_writer.items():
            if writer in OBSERVED:
                self._received.setdefault((prefix, writer), set())
                if heartbeat.last > 0:  # an empty writer would take an answer for a question
                    answers.append(self._answer(prefix, heartbeat))
        return answers

    def forget(self, prefix: bytes) -> None:
        """Forget a participant that has gone."""
        for writer in OBSERVED:
            self._received.pop((prefix, writer), None)

    def _answer(self, prefix: bytes, heartbeat: Heartbeat) -> bytes:
        received = self._received[prefix, heartbeat.writer]
        first = max(heartbeat.first, 1)
        base = next((n for n in range(first, heartbeat.last + 1) if n not in received), None)
        # Confirm all: it has them, or can't remember more and would ask for them without end.
        if base is None or len(received) >= MOST_SAMPLES:
            return self._ask(prefix, heartbeat.writer, max(heartbeat.last, 0) + 1, ())
        last = min(heartbeat.last, base + MOST_ASKED - 1)
        missing = [number for number in range(base, last + 1) if number not in received]
        return self._ask(prefix, heartbeat.writer, base, missing)

    def _ask(self, prefix: bytes, writer: int, base: int, missing: Sequence[int]) -> bytes:
        self._count += 1
        question = base == 1 and not missing
        return acknack(self.prefix, prefix, writer, base, missing, self._count, final=not question)
