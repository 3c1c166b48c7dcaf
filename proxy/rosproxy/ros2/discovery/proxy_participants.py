"""The proxy's own participants in a domain: datagrams from and to these participants.

The *discovery participant* learns the readers and writers of all participants, on both sides. With
the *port store*, participants inside keep their ports for the next process of the proxy. Neither
has a reader or writer for a topic. Each side discovers these participants directly. The proxy does
not pass on an announcement of these participants between the sides.
"""

from collections.abc import Iterator
from dataclasses import dataclass

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
from rosproxy.shared.addresses import HostPort


@dataclass(slots=True)
class ProxyParticipants:
    """The discovery participant and the port store of a domain."""

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
        """Whether a GUID prefix is that of a participant of the proxy.

        No other participant may use such a prefix. The prefix of the port store follows from public
        data, and a dispose message for the port store makes participants inside forget their ports.
        """
        return prefix in (
            self.discovery_participant.prefix,
            self.port_store.prefix,
            self.port_store.proof_prefix,
        )

    def announced_inside(self, near: str) -> bytes:
        """The announcement of the discovery participant for a network inside.

        ``near`` is the address of the proxy there.
        """
        return self.discovery_participant.announcement(HostPort(near, self.settings.unicast_port))

    def announced_outside(self) -> list[Outgoing]:
        """The datagrams that announce the discovery participant to the LAN relay and the peers."""
        return self.settings.to_outside(
            self.discovery_participant.announcement(*self._reached_from_outside())
        )

    def question_to_outside(self, outsider: OutsideParticipant) -> list[Outgoing]:
        """The question by which a participant outside proves an address.

        Empty if the participant has answered, or has too little credit.
        """
        if self.proofs.has_answered(outsider.address, outsider.prefix):
            return []
        question = self.proofs.question(
            outsider.address, outsider.prefix, self._reached_from_outside()
        )
        return self.outside.allowed_questions(outsider, [question])

    def question_to_inside(
        self, address: str, prefix: bytes, metatraffic: HostPort | None
    ) -> list[Outgoing]:
        """The question by which a participant inside proves an address.

        Empty if the participant has answered, or if ``metatraffic`` is None.
        """
        if self.proofs.has_answered(address, prefix):
            return []
        near = self.settings.proxy_address_for(address)
        reached_at = [HostPort(near, self.settings.unicast_port)]
        return sent_to(metatraffic, [self.proofs.question(address, prefix, reached_at)])

    def question_to_announced(self, message: DiscoveryMessage, source: str) -> list[Outgoing]:
        """The question to a participant inside, at the metatraffic locator of an announcement."""
        spdp = message.of_participant
        metatraffic = first_metatraffic(spdp, message.datagram, source) if spdp else None
        return self.question_to_inside(source, message.prefix, metatraffic)

    def _reached_from_outside(self) -> list[HostPort]:
        port = self.settings.ports.advertised(self.settings.discovery_port)
        return [HostPort(host, port) for host in self.settings.hosts]

    def first_questions(self, participant: InsideParticipant) -> list[Outgoing]:
        """The requests for the readers and writers of a participant inside."""
        return sent_to(
            participant.metatraffic, self.discovery_participant.first_question(participant.prefix)
        )

    def port_store_dispose_message(self, participant: InsideParticipant) -> list[Outgoing]:
        """The dispose messages with which a participant forgets the port store.

        The participant knows the port store at a former address of the proxy.
        """
        return sent_to(
            participant.metatraffic, self.port_store.dispose_messages(participant.prefix)
        )

    def port_reminders(self, now: float) -> Iterator[Outgoing]:
        """Yield the datagrams with which participants inside keep their present ports.

        The datagrams of a participant are made when the first of these is taken. So the caller can
        do other work in between, and participants may end meanwhile.
        """
        for participant in self.former_ports.keepers(self.inside.by_prefix.values()):
            if self.inside.by_prefix.get(participant.prefix) is participant:
                yield from self.former_ports.reminders(participant, now)

    def handle_from_inside(
        self, message: DiscoveryMessage, source: str, now: float
    ) -> list[Outgoing]:
        """Handle a message from a participant inside to the proxy's participants.

        Return the answers. Raises RtpsError.
        """
        prefix = message.prefix
        insider = self.inside.find(prefix, source)
        # A participant that waits for ports is in no table yet. The answer ends the wait.
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

    def handle_from_outside(
        self, message: DiscoveryMessage, source: str, received: int
    ) -> list[Outgoing]:
        """Handle a message from a participant outside to the discovery participant.

        Return the answers. ``received`` is the number of bytes that came from the participant.
        Raises RtpsError.
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
        """The answer to another proxy whose question proves the address of a participant.

        ``prefix`` is the GUID prefix of the discovery participant, or of the participant inside at
        whose port the question came. The result is empty if the question is for another
        participant. The proxy does not announce the participant of the question, or two proxies
        would question each other without end. The answer is shorter than the question. Raises
        RtpsError.
        """
        spdp = message.of_participant
        target = first_metatraffic(spdp, message.datagram, source) if spdp else None
        asked = next(heartbeats(message.datagram), None)
        if destination(message.datagram) != prefix or asked is None:
            return []
        answer = acknack(prefix, message.prefix, asked.writer, asked.first, (), 1, final=True)
        return sent_to(target, [answer])

    def forget(self, prefix: bytes) -> None:
        """Forget the samples and ports of a participant that has gone."""
        self.discovery_participant.forget(prefix)
        self.former_ports.forget_participant(prefix)

    def _ask(self, port: int, message: DiscoveryMessage, rewrite: Rewrite) -> list[bytes]:
        """Pass a message at a port to the discovery participant. Return its requests."""
        passed, questions = self.fragments.rewritten(
            port, message, self.discovery_participant.prefix, rewrite
        )
        for datagram in passed:
            questions += self.discovery_participant.take(message.prefix, datagram)
        return questions
