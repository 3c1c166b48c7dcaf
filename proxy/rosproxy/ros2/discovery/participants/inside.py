"""The participants inside that the proxy serves."""

import contextlib
from dataclasses import dataclass

from rosproxy.ros2.discovery.participants.places import fairer_place, oldest_unproven, surplus
from rosproxy.ros2.domain_settings import (
    MOST_ANNOUNCED_UNPROVEN,
    MOST_INSIDE,
    MOST_INSIDE_UNPROVEN,
    MOST_PER_ADDRESS,
    DomainSettings,
    Refused,
)
from rosproxy.ros2.policy.verdicts import Verdicts
from rosproxy.ros2.ports.mappings import PortMappings
from rosproxy.ros2.protocol.rtps import RtpsError, by_source, source_prefix, source_vendor
from rosproxy.ros2.registry.participants import (
    InsideParticipant,
    ParticipantTable,
)
from rosproxy.ros2.rewriting.announced_participant import (
    first_metatraffic,
    lease_duration,
    traits,
)
from rosproxy.ros2.rewriting.discovery import (
    DiscoveryMessage,
    require_rewritable,
)
from rosproxy.ros2.sources.address_proofs import AddressProofs


@dataclass(slots=True)
class InsideParticipants(ParticipantTable[InsideParticipant]):
    """The participants inside, with port mappings and the verdicts of the policy."""

    settings: DomainSettings
    mappings: PortMappings
    refused: Refused
    proofs: AddressProofs
    verdicts: Verdicts

    def meet(self, message: DiscoveryMessage, source: str, now: float) -> InsideParticipant | None:
        """The participant in an announcement, added if necessary; None if refused.

        A participant on several networks is served at the first. Raises RtpsError.
        """
        prefix = message.prefix
        datagram = message.datagram
        spdp = message.of_participant
        participant = self.find(prefix, source)
        if spdp is None:
            return participant
        require_rewritable(message)
        if participant is None:
            if prefix in self.by_prefix:
                return None
            if reason := self._why_no_place(prefix, source):
                self.refused("participants", source, reason)
                return None
            participant = InsideParticipant(prefix, source, source_vendor(datagram), now)
            participant.proxy_address = self.settings.proxy_address_for(source)
            self.add(participant)
            self.settings.settled(source)
        self.mappings.make_room(participant, spdp, datagram)
        if participant.note_vendor(source_vendor(datagram)):
            self.mappings.mark_read(participant.mappings)
        participant.until = now + lease_duration(spdp, datagram)
        participant.next_number = spdp.sample.sequence + 1
        participant.metatraffic = first_metatraffic(spdp, datagram, source)
        participant.traits = traits(spdp, datagram, source)
        return participant

    def participant_to_end(self, prefix: bytes, source: str) -> InsideParticipant | None:
        """The participant that ends in favour of a new participant; None if none has to end.

        Then there is room for the new participant, or the new participant gets no place.
        """
        has_answered = self.proofs.has_answered(source, prefix)
        if self.count_by_address[source] >= MOST_PER_ADDRESS:
            unproven = (p for p in self._answering(False) if p.address == source)
            return next(unproven, None) if has_answered else None
        if has_answered:
            return fairer_place(self._answering(True), MOST_INSIDE, source, str)
        return oldest_unproven(self._answering(False), MOST_INSIDE_UNPROVEN)

    def must_answer_first(self, prefix: bytes, source: str) -> bool:
        """Whether the proxy serves a new participant only after an answer.

        This is so if few ports are free, or if many participants have not answered. A forger may
        have invented these, and each would be announced to all peers and to all neighbours. The
        unproven sources share an allowance, and nothing would be left of it for others.
        """
        if self.mappings.must_answer_first(prefix, source):
            return True
        may_be_many = len(self.by_prefix) >= MOST_ANNOUNCED_UNPROVEN
        has_to_answer = may_be_many and not self.proofs.has_answered(source, prefix)
        return has_to_answer and len(self._answering(False)) >= MOST_ANNOUNCED_UNPROVEN

    def over_limit(self) -> list[InsideParticipant]:
        """The participants that end because more have answered than may have a place."""
        return surplus(self._answering(True), MOST_INSIDE, str)

    def _why_no_place(self, prefix: bytes, source: str) -> str:
        """Why a new participant at an address gets no place; empty if there is a place."""
        if self.count_by_address[source] >= MOST_PER_ADDRESS:
            return f"the address already has {MOST_PER_ADDRESS} participants"
        has_answered = self.proofs.has_answered(source, prefix)
        most = MOST_INSIDE if has_answered else MOST_INSIDE_UNPROVEN
        is_full = len(self._answering(has_answered)) >= most
        return f"the proxy already has {most} participants inside" if is_full else ""

    def _answering(self, has_answered: bool) -> list[InsideParticipant]:
        """The participants that have answered a question, or all others, in order of arrival."""
        return [
            p
            for p in self.by_prefix.values()
            if self.proofs.has_answered(p.address, p.prefix) is has_answered
        ]

    def note_in_group(self, datagram: bytes, source: str) -> None:
        """Note that the participants in a datagram were heard by multicast."""
        with contextlib.suppress(RtpsError):
            for message in by_source(datagram):
                if participant := self.find(source_prefix(message), source):
                    participant.is_in_group = True

    def forget(self, participant: InsideParticipant) -> None:
        """Forget a participant that has gone, and take back the ports of the participant."""
        self.mappings.end(participant)
        self.remove(participant)
        self.verdicts.forget(participant)
