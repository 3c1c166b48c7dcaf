"""The participant by which the proxy takes part in discovery, on both sides.

The discovery participant announces itself, and has the readers of SPDP and SEDP alone. So
participants that announced themselves before the proxy started do so again at once. The proxy also
learns what they told others long ago of their readers and writers: the locators and the topics.

It reads reliably in the plainest form: it asks for each sample that a writer has by its heartbeat
and that has not come.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.announcement import READER_ENDPOINTS, announcement, dispose_message
from rosproxy.ros2.protocol.reliable import MOST_ASKED, Heartbeat, acknack, heartbeats
from rosproxy.ros2.protocol.rtps import samples
from rosproxy.ros2.rewriting.discovery import BuiltinWriter

LEASE_DURATION_S = 12.0
"""Seconds after which others that do not hear it forget it: the proxy may have been killed."""
ANNOUNCE_INTERVAL = 3.0
SEDP_WRITERS = (BuiltinWriter.PUBLICATIONS, BuiltinWriter.SUBSCRIPTIONS)


@dataclass(slots=True)
class _Received:
    """Which samples of a writer have come: all before ``base``, and some of those that follow.

    A sample has a bit in ``later``, of `MOST_ASKED` bits. Those further ahead are asked for later.
    ``behind`` counts the last heartbeats in a row that told of no sample from ``base`` on.
    """

    base: int = 1
    later: int = 0
    behind: int = 0

    def note(self, number: int) -> None:
        """Note that a sample has come."""
        if 0 <= number - self.base < MOST_ASKED:
            self.later |= 1 << number - self.base
            self._pass_over_received()

    def note_range(self, first: int, last: int) -> None:
        """Note which samples the writer has."""
        self.behind = self.behind + 1 if last < self.base - 1 else 0
        # One heartbeat may be late; two in a row mean that a forged one told of greater numbers.
        if self.behind > 1:
            self.base = 1
            self.later = 0
        if first > self.base:
            self.later >>= min(first - self.base, MOST_ASKED)
            self.base = first
            self._pass_over_received()

    def missing(self, last: int) -> list[int]:
        """The samples up to ``last`` that have not come, at most `MOST_ASKED`."""
        end = min(last + 1, self.base + MOST_ASKED)
        return [n for n in range(self.base, end) if not self.later >> n - self.base & 1]

    def _pass_over_received(self) -> None:
        while self.later & 1:
            self.later >>= 1
            self.base += 1


@dataclass(slots=True)
class DiscoveryParticipant:
    """Asks participants for their readers and writers; ``prefix`` is its GUID prefix, random."""

    prefix: bytes
    _received: dict[tuple[bytes, int], _Received] = field(default_factory=dict)
    _count: int = 0

    def announcement(self, *reached_at: HostPort) -> bytes:
        """The datagram by which it announces itself; ``reached_at`` is where it is answered."""
        return announcement(self.prefix, reached_at, LEASE_DURATION_S, READER_ENDPOINTS)

    def dispose_message(self) -> bytes:
        """The datagram by which it says that it has ended."""
        return dispose_message(self.prefix)

    def first_question(self, prefix: bytes) -> list[bytes]:
        """What asks a participant's writers what they have."""
        return [
            self._ask(prefix, w, 1, ()) for w in SEDP_WRITERS if (prefix, w) not in self._received
        ]

    def take(self, prefix: bytes, datagram: bytes) -> list[bytes]:
        """Note a participant's message; what to ask it for. Raises RtpsError.

        Of samples in fragments the last comes when all are there (`FragmentStore`).
        """
        for sample in samples(datagram):
            if sample.writer in SEDP_WRITERS and sample.prefix == prefix:
                self._of_writer(prefix, sample.writer).note(sample.sequence)
        # One answer to each writer: a datagram has room for 256 heartbeats, all of one writer.
        by_writer = {heartbeat.writer: heartbeat for heartbeat in heartbeats(datagram)}
        answers = []
        for writer, heartbeat in by_writer.items():
            if writer in SEDP_WRITERS:
                received = self._of_writer(prefix, writer)
                if heartbeat.last > 0:  # an empty writer would take an answer for a question
                    answers.append(self._answer(prefix, heartbeat, received))
        return answers

    def forget(self, prefix: bytes) -> None:
        """Forget a participant that has gone."""
        for writer in SEDP_WRITERS:
            self._received.pop((prefix, writer), None)

    def _of_writer(self, prefix: bytes, writer: int) -> _Received:
        return self._received.setdefault((prefix, writer), _Received())

    def _answer(self, prefix: bytes, heartbeat: Heartbeat, received: _Received) -> bytes:
        received.note_range(heartbeat.first, heartbeat.last)
        missing = received.missing(heartbeat.last)
        base = missing[0] if missing else heartbeat.last + 1
        return self._ask(prefix, heartbeat.writer, base, missing)

    def _ask(self, prefix: bytes, writer: int, base: int, missing: Sequence[int]) -> bytes:
        self._count += 1
        question = base == 1 and not missing
        return acknack(self.prefix, prefix, writer, base, missing, self._count, final=not question)
