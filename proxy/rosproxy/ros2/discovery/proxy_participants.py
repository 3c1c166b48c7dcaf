"""The proxy's own participants in a domain: what they send, and what they are told.

The *discovery participant* reads which readers and writers others have, on both sides. The *port
store* has participants inside keep their ports for the next process. Neither has a reader or writer
for a topic, and the proxy announces neither on behalf of the other side: each side discovers them
as participants of its own.
"""

from dataclasses import dataclass

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.announcements.to_inside import ForInside
from rosproxy.ros2.discovery.announcements.to_outside import ForOutside
from rosproxy.ros2.discovery.discovery_participant import DiscoveryParticipant
from rosproxy.ros2.discovery.fragments import FragmentStores, Rewrite
from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.domain_settings import DomainSettings, Outgoing, sent_to
from rosproxy.ros2.ports.former_ports import FormerPorts
from rosproxy.ros2.ports.store import PortStore
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.reliable import acknack, heartbeats
from rosproxy.ros2.registry.participants import InsideParticipant, OutsideParticipant
from rosproxy.ros2.rewriting.announced_participant import first_metatraffic
from rosproxy.ros2.rewriting.discovery import DiscoveryMessage
from rosproxy.ros2.sources.address_proofs import AddressProofs


@dataclass(slots=True)
class ProxyParticipants:
    """The discovery participant and the port store of a domain, and the tables that they fill."""

    settings: DomainSettings
    discovery_participant: DiscoveryParticipant
    inside: InsideParticipants
    outside: OutsideParticipants
    former_ports: FormerPorts
    fragments: FragmentStores
    proofs: AddressProofs

    @property
    def port_store(self) -> PortStore:
        """The port store of the domain."""
        return self.former_ports.port_store

    def is_of_proxy(self, prefix: bytes) -> bool:
        """Whether a GUID prefix is that of one of the proxy's own participants.

        No other participant may use it. The prefix of the port store follows from what all can see.
        A dispose message for the port store makes participants inside forget their ports.
        """
        return prefix in (
            self.discovery_participant.prefix,
            self.port_store.prefix,
            self.port_store.proof_prefix,
        )

    def announced_inside(self, near: str) -> bytes:
        """Announce the discovery participant on a network inside.

        ``near`` is the address of the proxy there.
        """
        return self.discovery_participant.announcement(HostPort(near, self.settings.unicast_port))

    def announced_outside(self) -> list[Outgoing]:
        """The discovery participant's announcement for the LAN relay and the peers."""
        return self.settings.to_outside(
            self.discovery_participant.announcement(*self._reached_from_outside())
        )

    def question_to_outside(self, outsider: OutsideParticipant) -> list[Outgoing]:
        """What asks a participant outside to prove that it receives, if that is to be."""
        if self.proofs.has_answered(outsider.address, outsider.prefix):
            return []
        question = self.proofs.question(
            outsider.address, outsider.prefix, self._reached_from_outside()
        )
        return self.outside.allowed_questions(outsider, [question])

    def question_to_inside(
        self, address: str, prefix: bytes, metatraffic: HostPort | None
    ) -> list[Outgoing]:
        """What asks a participant inside to prove that it receives, if that is to be."""
        if self.proofs.has_answered(address, prefix):
            return []
        near = self.settings.proxy_address_for(address)
        reached_at = [HostPort(near, self.settings.unicast_port)]
        return sent_to(metatraffic, [self.proofs.question(address, prefix, reached_at)])

    def question_to_announced(self, message: DiscoveryMessage, source: str) -> list[Outgoing]:
        """What asks a participant inside that announces itself to prove that it receives."""
        spdp = message.of_participant
        metatraffic = first_metatraffic(spdp, message.datagram, source) if spdp else None
        return self.question_to_inside(source, message.prefix, metatraffic)

    def _reached_from_outside(self) -> list[HostPort]:
        port = self.settings.ports.advertised(self.settings.discovery_port)
        return [HostPort(host, port) for host in self.settings.hosts]

    def first_questions(self, participant: InsideParticipant) -> list[Outgoing]:
        """What asks a participant inside that has announced itself for its readers and writers."""
        return sent_to(
            participant.metatraffic, self.discovery_participant.first_question(participant.prefix)
        )

    def port_store_dispose_message(self, participant: InsideParticipant) -> list[Outgoing]:
        """What makes a participant forget the port store, which it knows at a former address."""
        return sent_to(
            participant.metatraffic, self.port_store.dispose_messages(participant.prefix)
        )

    def port_reminders(self, now: float) -> list[Outgoing]:
        """What makes participants inside keep the ports that they have now."""
        participants = self.former_ports.keepers(self.inside.by_prefix.values())
        return [sent for p in participants for sent in self.former_ports.reminders(p, now)]

    def told_inside(self, message: DiscoveryMessage, source: str, now: float) -> list[Outgoing]:
        """Take in what a participant inside tells the proxy's participants. Raises RtpsError."""
        prefix = message.prefix
        insider = self.inside.find(prefix, source)
        # One that waits to be let in is in no table yet, and its answer is what it waits for.
        is_waiting = self.former_ports.is_waiting(prefix, source)
        if (is_waiting or insider) and self.former_ports.take_answer(
            prefix, source, message.datagram
        ):
            return []
        if insider is None:
            return []
        for_proxy = ForOutside(
            self.inside, insider, now, self.former_ports.of(prefix), is_hiding=False
        )
        questions = self._ask(self.settings.unicast_port, message, for_proxy.rewritten)
        return sent_to(insider.metatraffic, questions)

    def told_outside(self, message: DiscoveryMessage, source: str, received: int) -> list[Outgoing]:
        """Take in what a participant outside tells the discovery participant. Raises RtpsError.

        ``received`` is how many bytes came from the participant.
        """
        outsider = self.outside.find(message.prefix, source)
        if outsider is None:
            return []
        outsider.note_received(message.datagram, received, self.discovery_participant.prefix)
        if not self.outside.may_be_announced(outsider):
            return []
        near = self.settings.proxy_address_for(outsider.address)
        for_proxy = ForInside(self.outside, outsider, near)
        questions = self._ask(self.settings.discovery_port, message, for_proxy.rewritten)
        return self.outside.allowed_questions(outsider, questions)

    def answer_to_proxy(
        self, prefix: bytes, message: DiscoveryMessage, source: str
    ) -> list[Outgoing]:
        """The answer to another proxy that asks a participant to prove that it receives.

        ``prefix`` is the GUID prefix of the discovery participant, or of the participant inside at
        whose port the question came. Nothing is sent if the question is for another
        participant. The participant that asks is announced to no side: two proxies would ask each
        other without end. The answer is shorter than the question. Raises RtpsError.
        """
        spdp = message.of_participant
        target = first_metatraffic(spdp, message.datagram, source) if spdp else None
        asked = next(heartbeats(message.datagram), None)
        if destination(message.datagram) != prefix or asked is None:
            return []
        answer = acknack(prefix, message.prefix, asked.writer, asked.first, (), 1, final=True)
        return sent_to(target, [answer])

    def forget(self, prefix: bytes) -> None:
        """Forget what a participant that has gone has told."""
        self.discovery_participant.forget(prefix)
        self.former_ports.forget_participant(prefix)

    def _ask(self, port: int, message: DiscoveryMessage, rewrite: Rewrite) -> list[bytes]:
        """Give the discovery participant a message that came at a port; what it asks for then."""
        passed, questions = self.fragments.rewritten(
            port, message, self.discovery_participant.prefix, rewrite
        )
        for datagram in passed:
            questions += self.discovery_participant.take(message.prefix, datagram)
        return questions
