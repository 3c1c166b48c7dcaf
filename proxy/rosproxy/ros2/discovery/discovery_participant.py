"""The discovery participant: the proxy's participant that reads discovery on both sides.

The discovery participant announces itself, and has no endpoints but the readers of SPDP and SEDP.
So participants that announced themselves before the proxy started announce themselves again at
once. They also repeat the announcements of their readers and writers, from which the proxy learns
locators and topics.

The reliable protocol is reduced to one rule: request each sample that a heartbeat of the writer
names, and that has not come.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from rosproxy.ros2.protocol.announcement import READER_ENDPOINTS, announcement, dispose_message
from rosproxy.ros2.protocol.reliable import MOST_ASKED, Heartbeat, acknack, heartbeats
from rosproxy.ros2.protocol.rtps import samples
from rosproxy.ros2.rewriting.discovery import BuiltinWriter
from rosproxy.shared.addresses import HostPort

LEASE_DURATION_S = 12.0
"""Seconds after the last announcement until others forget the discovery participant. The duration
is short because the proxy may be killed."""
ANNOUNCE_INTERVAL_S = 3.0
"""Seconds between announcements of the discovery participant."""
SEDP_WRITERS = (BuiltinWriter.PUBLICATIONS, BuiltinWriter.SUBSCRIPTIONS)
"""The writers whose samples the discovery participant requests."""


@dataclass(slots=True)
class _Received:
    """The samples of a writer that have come: all before ``base``, and some of the following.

    ``later`` has a bit for each of the `MOST_ASKED` samples from ``base`` on. Samples beyond these
    are requested later. ``behind`` counts the latest heartbeats in a row whose last number is less
    than the last received number.
    """

    base: int = 1
    later: int = 0
    behind: int = 0

    def note(self, number: int) -> None:
        """Note the number of a sample that has come."""
        if 0 <= number - self.base < MOST_ASKED:
            self.later |= 1 << number - self.base
            self._pass_over_received()

    def note_range(self, first: int, last: int) -> None:
        """Note the first and the last number in a heartbeat of the writer."""
        self.behind = self.behind + 1 if last < self.base - 1 else 0
        # A single such heartbeat may be late. Two in a row mean that a forged heartbeat has named
        # greater numbers before.
        if self.behind > 1:
            self.base = 1
            self.later = 0
        if first > self.base:
            self.later >>= min(first - self.base, MOST_ASKED)
            self.base = first
            self._pass_over_received()

    def missing(self, last: int) -> list[int]:
        """The numbers up to ``last`` of samples that have not come, at most `MOST_ASKED`."""
        end = min(last + 1, self.base + MOST_ASKED)
        return [n for n in range(self.base, end) if not self.later >> n - self.base & 1]

    def _pass_over_received(self) -> None:
        while self.later & 1:
            self.later >>= 1
            self.base += 1


@dataclass(slots=True)
class DiscoveryParticipant:
    """Requests the announcements of readers and writers; ``prefix`` is its random GUID prefix."""

    prefix: bytes
    _received: dict[tuple[bytes, int], _Received] = field(default_factory=dict)
    _count: int = 0

    def announcement(self, *reached_at: HostPort) -> bytes:
        """The announcement of the discovery participant, with its locators ``reached_at``."""
        return announcement(self.prefix, reached_at, LEASE_DURATION_S, READER_ENDPOINTS)

    def dispose_message(self) -> bytes:
        """The dispose message of the discovery participant."""
        return dispose_message(self.prefix)

    def first_question(self, prefix: bytes) -> list[bytes]:
        """The requests for heartbeats to the SEDP writers of a participant.

        Writers that have sent something already are left out.
        """
        return [
            self._ask(prefix, w, 1, ()) for w in SEDP_WRITERS if (prefix, w) not in self._received
        ]

    def take(self, prefix: bytes, datagram: bytes) -> list[bytes]:
        """Note a message of a participant. Return the requests for missing samples.

        A fragment counts as the whole sample: `FragmentStore` releases fragments only when all have
        come. Raises RtpsError.
        """
        for sample in samples(datagram):
            if sample.writer in SEDP_WRITERS and sample.prefix == prefix:
                self._of_writer(prefix, sample.writer).note(sample.sequence)
        # A single answer to each writer: a datagram may have 256 heartbeats of the same writer.
        by_writer = {heartbeat.writer: heartbeat for heartbeat in heartbeats(datagram)}
        answers = []
        for writer, heartbeat in by_writer.items():
            if writer in SEDP_WRITERS:
                received = self._of_writer(prefix, writer)
                if heartbeat.last > 0:  # an answer to a writer without samples would be a request
                    answers.append(self._answer(prefix, heartbeat, received))
        return answers

    def forget(self, prefix: bytes) -> None:
        """Forget the samples of a participant that has gone."""
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
