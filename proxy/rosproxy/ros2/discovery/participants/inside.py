"""The participants inside: which of them the proxy serves."""

import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.participants.places import fairer_place, oldest_unproven, surplus
from rosproxy.ros2.domain_settings import (
    MOST_INSIDE,
    MOST_INSIDE_UNPROVEN,
    MOST_PER_ADDRESS,
    DomainSettings,
    Outgoing,
    Refused,
)
from rosproxy.ros2.policy.verdicts import Verdicts
from rosproxy.ros2.ports.mappings import PortMappings
from rosproxy.ros2.protocol.addressing import for_all
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import RtpsError, by_source, source_prefix, source_vendor
from rosproxy.ros2.registry.participants import (
    InsideParticipant,
    ParticipantTable,
    TrafficKind,
)
from rosproxy.ros2.rewriting.announced_participant import (
    first_metatraffic,
    lease_duration,
    note_endpoints,
    traits,
)
from rosproxy.ros2.rewriting.discovery import (
    DiscoveryMessage,
    require_rewritable,
    rewritten,
)
from rosproxy.ros2.sources.address_proofs import AddressProofs


@dataclass(slots=True)
class InsideParticipants(ParticipantTable[InsideParticipant]):
    """The participants inside, with their port mappings and the verdicts of the policy."""

    settings: DomainSettings
    mappings: PortMappings
    refused: Refused
    proofs: AddressProofs
    verdicts: Verdicts

    def meet(self, message: DiscoveryMessage, source: str, now: float) -> InsideParticipant | None:
        """The participant that announces itself from an address; None if it is not accepted.

        One that is on several networks itself is served at the first. Raises RtpsError.
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
            self.mappings.mark_read(source)
        participant.until = now + lease_duration(spdp, datagram)
        participant.next_number = spdp.sample.sequence + 1
        participant.metatraffic = first_metatraffic(spdp, datagram, source)
        participant.traits = traits(spdp, datagram, source)
        return participant

    def gives_place(self, prefix: bytes, source: str) -> InsideParticipant | None:
        """The participant that ends for a new one at an address; None if there is none.

        Either there is room without, or the new one gets no place.
        """
        has_answered = self.proofs.has_answered(source, prefix)
        if self.count_by_address[source] >= MOST_PER_ADDRESS:
            unproven = (p for p in self._answering(False) if p.address == source)
            return next(unproven, None) if has_answered else None
        if has_answered:
            return fairer_place(self._answering(True), MOST_INSIDE, source, str)
        return oldest_unproven(self._answering(False), MOST_INSIDE_UNPROVEN)

    def prove(self) -> list[InsideParticipant]:
        """The participants that end, as more than have room have answered now."""
        return surplus(self._answering(True), MOST_INSIDE, str)

    def _why_no_place(self, prefix: bytes, source: str) -> str:
        """Why a new participant at an address gets no place; empty if it gets one."""
        if self.count_by_address[source] >= MOST_PER_ADDRESS:
            return f"the address already has {MOST_PER_ADDRESS} participants"
        has_answered = self.proofs.has_answered(source, prefix)
        most = MOST_INSIDE if has_answered else MOST_INSIDE_UNPROVEN
        is_full = len(self._answering(has_answered)) >= most
        return f"the proxy already has {most} participants inside" if is_full else ""

    def _answering(self, has_answered: bool) -> list[InsideParticipant]:
        """The participants that have proved to receive, or all others, in the order they came."""
        return [
            p
            for p in self.by_prefix.values()
            if self.proofs.has_answered(p.address, p.prefix) is has_answered
        ]

    def port_keepers(self, participants: Iterable[InsideParticipant]) -> list[InsideParticipant]:
        """The participants that can keep their ports: one of each process of Cyclone DDS.

        The participants of a process have the same locator for metatraffic, and the same number of
        the sample that they expect next of a writer, whichever of them a heartbeat is for
        (ddsi_receive.c, handle_Heartbeat). The first that has answered keeps its ports; one that
        has not may have been forged.
        """
        ordered = list(participants)
        keepers = dict[tuple[str, HostPort | None], InsideParticipant]()
        for participant in ordered:
            if self.proofs.has_answered(participant.address, participant.prefix):
                keepers.setdefault((participant.address, participant.metatraffic), participant)
        return [p for p in ordered if keepers.get((p.address, p.metatraffic), p) is p]

    def exported(
        self,
        participant: InsideParticipant,
        message: DiscoveryMessage,
        now: float,
        kept: Sequence[int] = (),
    ) -> bytes:
        """A message of a participant's, as outside gets it. Raises RtpsError.

        ``kept`` are the ports that it is known to have had before the proxy started, in the order
        of its locators.
        """
        datagram = message.datagram
        note_endpoints(self.notes, participant, datagram, message.announcements)
        return rewritten(
            message,
            partial(self._lead_out, participant, now, kept),
            lambda a: self.verdicts.is_hidden(participant, a, datagram, is_own=True),
        )

    def observed(
        self,
        participant: InsideParticipant,
        message: DiscoveryMessage,
        now: float,
        kept: Sequence[int] = (),
    ) -> bytes:
        """Note what one inside tells the proxy itself: what it has, and where. RtpsError."""
        note_endpoints(self.notes, participant, message.datagram, message.announcements)
        lead = partial(self._lead_out, participant, now, kept)
        # The discovery participant alone gets this: it is rewritten to map the ports. Nothing is
        # hidden, since the discovery participant would ask for that again and again.
        return rewritten(message, lead, lambda _: False)

    def note_in_group(self, datagram: bytes, source: str) -> None:
        """Note the participants that were heard from an address by multicast."""
        with contextlib.suppress(RtpsError):
            for message in by_source(datagram):
                if participant := self.find(source_prefix(message), source):
                    participant.is_in_group = True

    def introduced(self, newcomer: InsideParticipant, message: DiscoveryMessage) -> list[Outgoing]:
        """A participant's announcement for others on its network, if that passes on no multicast.

        It goes on as it is: they reach each other without the proxy. So do those at one address, as
        the processes of a pod are: Fast DDS sends no multicast where it has peers. What one names
        as its own may be where the proxy itself hears announcements: nothing goes there.
        """
        if newcomer.is_in_group:
            return []
        near = newcomer.proxy_address
        settings = self.settings
        own = {HostPort(near, p) for p in (settings.unicast_port, settings.multicast_port)}
        announcement = for_all(message.datagram)
        return [
            Outgoing(p.metatraffic, announcement)
            for p in self.by_prefix.values()
            if p.proxy_address == near
            and p is not newcomer
            # Cyclone DDS has one locator for all participants of a process, which know each other.
            and p.metatraffic
            and p.metatraffic not in {newcomer.metatraffic, *own}
        ]

    def forget(self, participant: InsideParticipant) -> None:
        """Forget a participant that has gone, and take its ports back."""
        self.mappings.end(participant)
        self.remove(participant)
        self.verdicts.forget(participant)

    def _lead_out(
        self,
        participant: InsideParticipant,
        now: float,
        kept: Sequence[int],
        pid: int,
        locator: HostPort,
    ) -> HostPort | None:
        """The address and port at which outside reaches a locator; None if it does not."""
        is_metatraffic = pid == Pid.METATRAFFIC_UNICAST_LOCATOR
        kind = TrafficKind.METATRAFFIC if is_metatraffic else TrafficKind.USER_DATA
        return self.mappings.advertised(participant, locator, kind, kept, now)
