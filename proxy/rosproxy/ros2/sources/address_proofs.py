"""Which addresses have proved that a participant there receives what the proxy sends.

The source of a datagram is what its sender wrote there. So an address gets a question that no other
address hears: the announcement of a participant whose GUID prefix follows from the address and from
a secret of this process. An answer names that prefix (INFO_DST), so its sender has the question.
The participant in the question has a writer of SEDP, whose heartbeat each reader answers
(DDSI-RTPS 2.5, 8.4.9). It is forgotten after `LEASE_DURATION_S`.

An address that has proved to receive may be forged as any other. So each participant inside answers
for itself: a question names the participant (INFO_DST), and no other one answers.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.addressing import is_destination
from rosproxy.ros2.protocol.announcement import WRITER_ENDPOINTS, announcement
from rosproxy.ros2.protocol.reliable import heartbeat, heartbeats
from rosproxy.ros2.protocol.rtps import (
    HEADER,
    NO_VENDOR,
    PREFIX,
    RtpsError,
    SubmessageId,
    source_prefix,
    source_vendor,
    submessages,
)
from rosproxy.ros2.registry.participants import ParticipantTable
from rosproxy.ros2.rewriting.discovery import BuiltinWriter, DiscoveryMessage

LEASE_DURATION_S = 12.0
"""Seconds for which a participant remembers the one in a question. Cyclone DDS announces itself
each 8 s and is asked again then."""
KEPT = 60.0
"""Seconds for which an address has proved to receive, after its last participant has gone."""
MOST_ADDRESSES = 4096
"""Addresses that count as proven; of more, the one goes that has had no participant for longest."""
ANSWER_KEPT = 30.0
"""Seconds for which an answer counts of a participant that has lost its place, or has gone."""
MOST_ANSWERED = 128
"""Participants at an address that have answered; of more, the first one goes."""
LONGEST_ANSWER = 256
"""Bytes of a first answer, which is read at any rate; an answer of Fast DDS has 72."""
_INFO_DST = bytes([SubmessageId.INFO_DST])
_NOT_IN_ANSWERS = (SubmessageId.INFO_SRC, SubmessageId.DATA, SubmessageId.DATA_FRAG)
"""After an INFO_SRC another participant speaks."""


@dataclass(slots=True)
class AddressProofs:
    """The addresses that have proved to receive; ``secret`` is random and of this process."""

    secret: bytes
    _until: dict[str, float] = field(default_factory=dict)
    _answered: dict[str, dict[bytes, float]] = field(default_factory=dict)
    """Until when the answer of each participant counts, by address and GUID prefix."""
    _count: int = 0

    def has(self, address: str) -> bool:
        """Whether an address has proved to receive."""
        return address in self._until

    def has_answered(self, address: str, prefix: bytes) -> bool:
        """Whether a participant at an address has answered a question itself."""
        return prefix in self._answered.get(address, ())

    @property
    def addresses(self) -> list[str]:
        """The addresses that have proved to receive."""
        return list(self._until)

    def question(self, address: str, prefix: bytes, reached_at: Iterable[HostPort]) -> bytes:
        """The datagram that asks a participant at an address.

        ``prefix`` is the GUID prefix of the participant, ``reached_at`` where it answers.
        """
        own = self._prefix(address)
        self._count += 1
        asks = heartbeat(own, prefix, BuiltinWriter.PUBLICATIONS, 1, self._count)
        return announcement(own, reached_at, LEASE_DURATION_S, WRITER_ENDPOINTS) + asks[HEADER:]

    def is_answer(self, address: str, datagram: bytes) -> bool:
        """Return whether a datagram is the first answer of a participant, and nothing else.

        A flood of forged sources uses up what may be read of unproven addresses. Answers can't be
        forged, so the first answer of a participant is taken in nevertheless. Later answers are
        discovery like any other: a proven address could send them without end. An announcement
        beside an answer has to wait.
        """
        answered = self._answered.get(address, {})
        return (
            len(answered) < MOST_ANSWERED
            and datagram[HEADER - PREFIX : HEADER] not in answered
            and len(datagram) <= LONGEST_ANSWER
            and datagram[HEADER : HEADER + 1] == _INFO_DST
            and datagram[HEADER + 4 : HEADER + 4 + PREFIX] == self._prefix(address)
            and _announces_nothing(datagram)
        )

    def note(self, address: str, datagram: bytes, now: float) -> bool:
        """Take in a datagram; return whether the address proves by it to receive. RtpsError."""
        if not is_destination(datagram, self._prefix(address)):
            return False
        self._renew(address, now)
        if len(self._until) > MOST_ADDRESSES:
            first = next(iter(self._until))
            del self._until[first]
            self._answered.pop(first, None)
        answered = self._answered.setdefault(address, {})
        answered[source_prefix(datagram)] = now + ANSWER_KEPT
        if len(answered) > MOST_ANSWERED:
            del answered[next(iter(answered))]
        return True

    def forget(self, address: str, prefix: bytes) -> None:
        """Forget the answer of a participant."""
        self._answered.get(address, {}).pop(prefix, None)

    def expire(self, now: float, *present: ParticipantTable[Any]) -> None:
        """Forget addresses without a participant, and answers of participants that have gone.

        ``present`` are the participants of both sides.
        """
        for address, until in list(self._until.items()):
            if any(address in table.count_by_address for table in present):
                self._renew(address, now)
            elif until < now:
                del self._until[address]
        self._expire_answers(now, present)

    def _expire_answers(self, now: float, present: Iterable[ParticipantTable[Any]]) -> None:
        for address, answered in list(self._answered.items()):
            for prefix, until in list(answered.items()):
                if any(table.find(prefix, address) for table in present):
                    answered[prefix] = now + ANSWER_KEPT
                elif until < now:
                    del answered[prefix]
            if not answered:
                del self._answered[address]

    def _renew(self, address: str, now: float) -> None:
        """Have an address count as proven for longer; it is the last one that goes."""
        self._until.pop(address, None)
        self._until[address] = now + KEPT

    def _prefix(self, address: str) -> bytes:
        size = PREFIX - len(NO_VENDOR)
        return NO_VENDOR + blake2b(address.encode(), key=self.secret, digest_size=size).digest()


def is_question_of_proxy(message: DiscoveryMessage) -> bool:
    """Whether a message is the question of another proxy, as `AddressProofs.question` makes it.

    Raises RtpsError.
    """
    is_of_proxy = source_vendor(message.datagram) == NO_VENDOR
    is_announcement = message.of_participant is not None
    return is_of_proxy and is_announcement and any(heartbeats(message.datagram))


def _announces_nothing(datagram: bytes) -> bool:
    """Whether a message is well-formed, has no sample, and is of one participant alone."""
    try:
        return not any(kind in _NOT_IN_ANSWERS for kind, _, _ in submessages(datagram))
    except RtpsError:
        return False
