"""Which addresses are proven: a participant there receives the datagrams of the proxy.

Each sender may forge the source of a datagram. So the proxy sends a question to the address alone:
the announcement of a participant whose GUID prefix follows from the address and a secret of this
process. An answer names this prefix (INFO_DST), so the sender of the answer has received the
question. The participant in the question has a writer of SEDP, and each reader answers a heartbeat
of this writer (DDSI-RTPS 2.5, 8.4.9). Other participants forget this participant after
`LEASE_DURATION_S`.

An attacker may forge datagrams from a proven address, too. So each participant inside has to answer
itself: a question names the participant (INFO_DST), and no other participant answers.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from hashlib import blake2b
from itertools import islice
from typing import Any

from rosproxy.ros2.protocol.addressing import is_destination
from rosproxy.ros2.protocol.announcement import WRITER_ENDPOINTS, announcement
from rosproxy.ros2.protocol.reliable import heartbeat, heartbeats
from rosproxy.ros2.protocol.rtps import (
    HEADER_BYTES,
    NO_VENDOR,
    PREFIX_BYTES,
    RtpsError,
    SubmessageId,
    source_prefix,
    source_vendor,
    submessages,
)
from rosproxy.ros2.registry.participants import ParticipantTable
from rosproxy.ros2.rewriting.discovery import BuiltinWriter, DiscoveryMessage
from rosproxy.shared.addresses import HostPort

LEASE_DURATION_S = 12.0
"""Seconds for which a participant remembers the participant in a question. Cyclone DDS announces
itself each 8 s, and gets another question then if it has not answered."""
PROOF_KEPT_S = 60.0
"""Seconds for which an address stays proven after its last participant has gone."""
MOST_ADDRESSES = 4096
"""Proven addresses. Beyond this number, the address that has had no participant for longest
goes."""
ANSWER_KEPT_S = 30.0
"""Seconds for which the answer of a participant counts after the participant has gone."""
MOST_EXPIRED_PER_CALL = 64
"""Addresses whose answers `AddressProofs.expire` looks at in one call. The addresses take turns. So
with 4,096 addresses, an answer is forgotten up to half a minute sooner or later."""
MOST_ANSWERS_PER_ADDRESS = 128
"""Participants at an address whose answers count. Beyond this number, the oldest answer goes."""
LONGEST_ANSWER_BYTES = 256
"""Bytes of a first answer, which is read without an allowance. An answer of Fast DDS has 72."""
_INFO_DST = bytes([SubmessageId.INFO_DST])
_NOT_IN_ANSWERS = (SubmessageId.INFO_SRC, SubmessageId.DATA, SubmessageId.DATA_FRAG)
"""Submessages that a first answer must not have. After an INFO_SRC, the source is another
participant."""


@dataclass(slots=True)
class AddressProofs:
    """The proven addresses; ``secret`` is random, and another one in each process."""

    secret: bytes
    _until: dict[str, float] = field(default_factory=dict)
    _answered: dict[str, dict[bytes, float]] = field(default_factory=dict)
    """The time until which the answer of each participant counts, by address and GUID prefix."""
    _count: int = 0

    def has(self, address: str) -> bool:
        """Whether an address is proven."""
        return address in self._until

    def has_answered(self, address: str, prefix: bytes) -> bool:
        """Whether a participant at an address has answered a question."""
        return prefix in self._answered.get(address, ())

    @property
    def addresses(self) -> list[str]:
        """The proven addresses."""
        return list(self._until)

    def question(self, address: str, prefix: bytes, reached_at: Iterable[HostPort]) -> bytes:
        """The question to a participant at an address.

        ``prefix`` is the GUID prefix of the participant. ``reached_at`` are the locators for the
        answer.
        """
        own = self._prefix(address)
        self._count += 1
        asks = heartbeat(own, prefix, BuiltinWriter.PUBLICATIONS, 1, self._count)
        return (
            announcement(own, reached_at, LEASE_DURATION_S, WRITER_ENDPOINTS) + asks[HEADER_BYTES:]
        )

    def is_first_answer(self, address: str, datagram: bytes) -> bool:
        """Return whether a datagram is the first answer of a participant, and nothing else.

        A flood of forged sources uses up the common allowance of unproven addresses. An answer
        can't be forged, so the first answer of a participant needs no allowance. Later answers need
        an allowance, like all discovery: a proven address could send them without end. An
        announcement in the same datagram needs an allowance, too.
        """
        answered = self._answered.get(address, {})
        return (
            len(answered) < MOST_ANSWERS_PER_ADDRESS
            and datagram[HEADER_BYTES - PREFIX_BYTES : HEADER_BYTES] not in answered
            and len(datagram) <= LONGEST_ANSWER_BYTES
            and datagram[HEADER_BYTES : HEADER_BYTES + 1] == _INFO_DST
            and datagram[HEADER_BYTES + 4 : HEADER_BYTES + 4 + PREFIX_BYTES]
            == self._prefix(address)
            and _announces_nothing(datagram)
        )

    def note(self, address: str, datagram: bytes, now: float) -> bool:
        """Note an answer. Return whether the datagram is an answer. Raises RtpsError."""
        if not is_destination(datagram, self._prefix(address)):
            return False
        self._renew(address, now)
        if len(self._until) > MOST_ADDRESSES:
            first = next(iter(self._until))
            del self._until[first]
            self._answered.pop(first, None)
        answered = self._answered.setdefault(address, {})
        answered[source_prefix(datagram)] = now + ANSWER_KEPT_S
        if len(answered) > MOST_ANSWERS_PER_ADDRESS:
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
        for address in list(islice(self._answered, MOST_EXPIRED_PER_CALL)):
            answered = self._answered.pop(address)
            for prefix, until in list(answered.items()):
                if any(table.find(prefix, address) for table in present):
                    answered[prefix] = now + ANSWER_KEPT_S
                elif until < now:
                    del answered[prefix]
            if answered:
                self._answered[address] = answered  # behind the others

    def _renew(self, address: str, now: float) -> None:
        """Let an address count as proven for `PROOF_KEPT_S` from now."""
        self._until.pop(address, None)
        self._until[address] = now + PROOF_KEPT_S

    def _prefix(self, address: str) -> bytes:
        size = PREFIX_BYTES - len(NO_VENDOR)
        return NO_VENDOR + blake2b(address.encode(), key=self.secret, digest_size=size).digest()


def is_question_of_proxy(message: DiscoveryMessage) -> bool:
    """Whether a message is a question of another proxy (`AddressProofs.question`).

    Raises RtpsError.
    """
    is_of_proxy = source_vendor(message.datagram) == NO_VENDOR
    is_announcement = message.of_participant is not None
    return is_of_proxy and is_announcement and any(heartbeats(message.datagram))


def _announces_nothing(datagram: bytes) -> bool:
    """Whether a message is well-formed, has no samples, and is from a single participant."""
    try:
        return not any(kind in _NOT_IN_ANSWERS for kind, _, _ in submessages(datagram))
    except RtpsError:
        return False
