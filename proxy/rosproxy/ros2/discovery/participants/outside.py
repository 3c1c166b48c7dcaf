"""The participants outside that the proxy knows, and those that it announces inside."""

from collections.abc import Iterable
from dataclasses import dataclass

from rosproxy.ros2.discovery.participants.places import fairer_place, oldest_unproven, surplus
from rosproxy.ros2.domain_settings import (
    MOST_ANNOUNCED_UNPROVEN,
    MOST_AT_PEERS,
    MOST_OUTSIDE,
    MOST_OUTSIDE_UNPROVEN,
    MOST_PER_HOST,
    MOST_PER_UNPROVEN,
    DomainSettings,
    Outgoing,
    Refused,
)
from rosproxy.ros2.policy.verdicts import Verdicts
from rosproxy.ros2.ports.stand_ins import LocatorStandIns
from rosproxy.ros2.protocol.addressing import is_destination
from rosproxy.ros2.protocol.rtps import source_vendor
from rosproxy.ros2.registry.participants import (
    OutsideParticipant,
    ParticipantTable,
)
from rosproxy.ros2.rewriting.announced_participant import (
    first_metatraffic,
    lease_duration,
    traits,
)
from rosproxy.ros2.rewriting.discovery import (
    DiscoveryMessage,
    participant_alone,
    require_rewritable,
)
from rosproxy.ros2.sources.address_proofs import AddressProofs
from rosproxy.shared.addresses import subnet

HIDDEN_SOURCE = (
    "this address is the gateway of the proxy's own network: the engine forwards datagrams from "
    "outside with this address, so the proxy does not know the real sender"
)


@dataclass(slots=True)
class OutsideParticipants(ParticipantTable[OutsideParticipant]):
    """The participants outside, with their stand-ins."""

    settings: DomainSettings
    stand_ins: LocatorStandIns
    refused: Refused
    proofs: AddressProofs
    verdicts: Verdicts

    def meet(self, message: DiscoveryMessage, source: str, now: float) -> OutsideParticipant | None:
        """The participant in an announcement, added if necessary; None if the proxy refuses it.

        An announcement of the end adds no participant. Raises RtpsError.
        """
        require_rewritable(message)
        prefix = message.prefix
        datagram = message.datagram
        spdp = message.of_participant
        participant = self.find(prefix, source)
        if spdp is None or spdp.ended or (participant is None and prefix in self.by_prefix):
            if participant is not None:
                # `AnnouncementsToInside` passes on an end like any other announcement.
                self._keep(participant, message)
            return participant
        metatraffic = first_metatraffic(spdp, datagram, source)
        if metatraffic is None:
            fault = traits(spdp, datagram, source).locator_fault
            text = f"the participant announces no locator for discovery at {source} ({fault})"
            self.refused("no_locator", source, text)
            return None
        if self.stand_ins.is_own_port(metatraffic):
            text = (
                f"the participant announces {metatraffic} for discovery, a port of the proxy itself"
            )
            self.refused("own_port", source, text)
            return None
        participant = participant or self._add(prefix, datagram, source, now)
        if participant is not None:
            participant.heard_at = now
            participant.until = now + lease_duration(spdp, datagram)
            participant.metatraffic = metatraffic
            self._keep(participant, message)
            participant.traits = traits(spdp, datagram, source)
        return participant

    def claimant(
        self, message: DiscoveryMessage, source: str, received: int, now: float
    ) -> OutsideParticipant | None:
        """A participant outside that announces itself with a prefix of inside, not added.

        None if the message reports an end. None also if the announced locator is a port of the
        proxy: the LAN relay hears the proxy's own announcements. ``received`` is the number of
        bytes that came. Raises RtpsError.
        """
        require_rewritable(message)
        spdp = message.of_participant
        if spdp is None or spdp.ended:
            return None
        metatraffic = first_metatraffic(spdp, message.datagram, source)
        if metatraffic is None or self.stand_ins.is_own_port(metatraffic):
            return None
        claimant = OutsideParticipant(
            message.prefix, source, source_vendor(message.datagram), now, metatraffic=metatraffic
        )
        claimant.proven = self.proofs.has(source)
        claimant.credit = received
        return claimant

    def prove(self, address: str) -> tuple[list[OutsideParticipant], list[OutsideParticipant]]:
        """Note that an address is proven.

        Return two lists: the participants to announce inside now, and the participants that end
        because more are proven than may have a place.
        """
        for outsider in self.at(address):
            outsider.proven = True
        ended = surplus(self._proven_strangers(), MOST_OUTSIDE, subnet)
        to_announce = [p for p in self.at(address) if not p.is_announced and p not in ended]
        return to_announce, ended

    def may_be_announced(self, outsider: OutsideParticipant) -> bool:
        """Whether the proxy announces a participant inside.

        If many participants are at unproven addresses, the proxy announces no more of these: a
        forger may have invented them, and each participant inside would remember all. A participant
        that was announced once stays announced.
        """
        if not outsider.is_announced:
            outsider.is_announced = (
                outsider.is_known or len(self._unproven_strangers()) <= MOST_ANNOUNCED_UNPROVEN
            )
        return outsider.is_announced

    def is_met(self, source: str) -> bool:
        """Whether a participant is known at an address, or the address is that of a peer."""
        return source in self.count_by_address or self.settings.is_peer(source)

    def refuses_source(self, source: str) -> bool:
        """Whether the proxy ignores a source, because no participant is known at this address.

        If so, report a refusal.
        """
        if self.is_met(source):
            return False
        text = "the address is not a peer, and no participant there has announced itself"
        self.refuse_stranger(source, text)
        return True

    def refuse_stranger(self, source: str, text: str) -> None:
        """Refuse discovery from an address at which no participant is known.

        Docker's userland proxy and RootlessKit's port driver `builtin` forward datagrams with the
        address of the network's gateway.
        """
        if source in self.settings.gateways:
            self.refused("hidden_source", source, HIDDEN_SOURCE)
        else:
            self.refused("not_a_peer", source, text)

    def may_announce(self, message: DiscoveryMessage, source: str, asked_by: bytes) -> bool:
        """Whether a participant outside may announce itself directly at the discovery port.

        Allowed are known participants, peers, and messages to ``asked_by``, the GUID prefix of the
        discovery participant. Such a message answers an announcement, which goes only to peers and
        the LAN relay.
        """
        is_met = self.find(message.prefix, source) is not None
        is_named = is_destination(message.datagram, asked_by)
        return is_met or is_named or self.settings.is_peer(source)

    def allowed_questions(
        self, outsider: OutsideParticipant, questions: Iterable[bytes]
    ) -> list[Outgoing]:
        """Requests to a participant about its discovery, as many as its credit allows."""
        target = outsider.metatraffic
        allowed = [q for q in questions if target and outsider.take_credit(len(q))]
        return [Outgoing(target, question) for question in allowed] if target else []

    def forget(self, participant: OutsideParticipant) -> None:
        """Forget a participant that has gone."""
        self.remove(participant)
        self.stand_ins.close(participant)

    def participant_to_end(self, source: str) -> OutsideParticipant | None:
        """The participant that ends in favour of a new one; None if no participant has to end.

        Then there is room for the new participant, or the new participant gets no place.
        """
        if self.settings.is_peer(source) or self._is_full(source):
            return None
        if self.proofs.has(source):
            return fairer_place(self._proven_strangers(), MOST_OUTSIDE, source, subnet)
        return oldest_unproven(self._unproven_strangers(), MOST_OUTSIDE_UNPROVEN)

    def _why_no_place(self, source: str) -> str:
        """Why a new participant at an address gets no place; empty if it gets a place."""
        if self._is_full(source):
            return f"the address already has {self.count_by_address[source]} participants"
        if self.settings.is_peer(source):
            most = MOST_AT_PEERS
            present = [p for p in self.by_prefix.values() if p.trusted]
        elif self.proofs.has(source):
            most = MOST_OUTSIDE
            present = self._proven_strangers()
        else:
            most = MOST_OUTSIDE_UNPROVEN
            present = self._unproven_strangers()
        return f"the proxy already has {most} participants outside" if len(present) >= most else ""

    def _is_full(self, source: str) -> bool:
        """Whether an address has as many participants as it may have."""
        is_proven = self.settings.is_peer(source) or self.proofs.has(source)
        return self.count_by_address[source] >= (MOST_PER_HOST if is_proven else MOST_PER_UNPROVEN)

    def _proven_strangers(self) -> list[OutsideParticipant]:
        return [p for p in self.by_prefix.values() if p.proven and not p.trusted]

    def _unproven_strangers(self) -> list[OutsideParticipant]:
        return [p for p in self.by_prefix.values() if not p.proven and not p.trusted]

    def _add(
        self, prefix: bytes, datagram: bytes, source: str, now: float
    ) -> OutsideParticipant | None:
        if reason := self._why_no_place(source):
            self.refused("participants", source, reason)
            return None
        outsider = OutsideParticipant(prefix, source, source_vendor(datagram), now)
        outsider.met_at = now
        outsider.trusted = self.settings.is_peer(source)
        outsider.proven = self.proofs.has(source)
        self.add(outsider)
        self.settings.settled(source)
        return outsider

    def _keep(self, outsider: OutsideParticipant, message: DiscoveryMessage) -> None:
        """Keep the announcement of a participant, for participants inside that come later."""
        announcement = participant_alone(message)
        if announcement != outsider.announcement:
            outsider.announcement = announcement
            outsider.announcements_inside.clear()
        if message.of_participant is not None:
            outsider.next_number = message.of_participant.sample.sequence + 1
