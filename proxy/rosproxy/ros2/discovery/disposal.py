"""The end of participants: the proxy forgets a participant, and tells the other side that it ended.

A participant that ends itself says so by a dispose message. In the cases here the proxy sends this
message on behalf of the participant: its process was killed, its container is gone, or the proxy
gives its place, its ports or its GUID prefix to another participant. The participant may live all
the same, and come back.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from rosproxy.ros2.discovery.fragments import FragmentStores
from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.discovery.proxy_participants import ProxyParticipants
from rosproxy.ros2.discovery.rediscovery import Rediscovery
from rosproxy.ros2.domain_settings import DomainSettings, Outgoing, Refused, sent_to
from rosproxy.ros2.ports.former_ports import FormerPorts
from rosproxy.ros2.protocol.announcement import dispose_message
from rosproxy.ros2.registry.participants import InsideParticipant, OutsideParticipant, Participant
from rosproxy.ros2.sources.address_proofs import AddressProofs


@dataclass(frozen=True, slots=True)
class Disposal:
    """Ends participants of both sides; the methods return what the other side is told."""

    settings: DomainSettings
    inside: InsideParticipants
    outside: OutsideParticipants
    proxy_participants: ProxyParticipants
    former_ports: FormerPorts
    rediscovery: Rediscovery
    fragments: FragmentStores
    proofs: AddressProofs
    refused: Refused

    def end_former_processes(self, prefix: bytes, source: str) -> list[Outgoing]:
        """End the participants of crashed processes at the port of a participant.

        A crashed process sends no dispose message, and would be known until its lease duration is
        over. A participant that has answered has bound the port, so the former process has gone.
        The answer of the former process counts no longer: its announcement may be repeated.
        """
        if not self.proofs.has_answered(source, prefix):
            return []
        sent = list[Outgoing]()
        for insider in self.inside.former_processes(prefix, source):
            self.proofs.forget(source, insider.prefix)
            sent += self.end_inside(insider)
        for outsider in self.outside.former_processes(prefix, source):
            self.proofs.forget(source, outsider.prefix)
            sent += self.end_outside(outsider, self.inside.by_prefix.values())
        return sent

    def end_inside(self, insider: InsideParticipant) -> list[Outgoing]:
        """End a participant inside on its behalf.

        It may live, and come back by other ports. Outside has to rediscover it then.
        """
        ended = _dispose_message_of(insider)
        self.forget_inside(insider)
        self.former_ports.displace(insider.prefix)
        return self.settings.to_outside(ended)

    def end_outside(
        self, outsider: OutsideParticipant, inside: Iterable[InsideParticipant]
    ) -> list[Outgoing]:
        """Forget a participant outside, and tell some inside that it has ended."""
        ended = _dispose_message_of(outsider)
        told = list(inside) if outsider.is_announced else []
        self.forget_outside(outsider)
        return [sent for insider in told for sent in sent_to(insider.metatraffic, [ended])]

    def give_prefix_to_inside(self, prefix: bytes, source: str) -> list[Outgoing]:
        """End the participant outside, if any, with the prefix of one at an address inside.

        Only participants on other networks are told of the end. Those on the network of the address
        know the rightful participant, and would forget it.
        """
        outsider = self.outside.by_prefix.get(prefix)
        if outsider is None:
            return []
        text = f"GUID prefix {outsider.guid_prefix} belongs to a participant inside, at {source}"
        self.refused("prefix", outsider.address, text)
        near = self.settings.proxy_address_for(source)
        elsewhere = [p for p in self.inside.by_prefix.values() if p.proxy_address != near]
        return self.end_outside(outsider, elsewhere)

    def give_prefix_to_outside(self, prefix: bytes, source: str) -> None:
        """Forget the participant inside, if any, with the prefix of one at an address outside.

        Outside is told of no end: it knows the rightful participant, and would forget it.
        """
        insider = self.inside.by_prefix.get(prefix)
        if insider is not None:
            text = (
                f"GUID prefix {insider.guid_prefix} belongs to a participant outside, at {source}"
            )
            self.refused("prefix", insider.address, text)
            self.forget_inside(insider)

    def give_up_ports(self, insider: InsideParticipant) -> list[Outgoing]:
        """End a participant inside that has ports of another participant.

        It is let in again with its next announcement, and gets other ports.
        """
        text = (
            f"participant {insider.guid_prefix} loses a port that another participant has claimed"
        )
        self.refused("port_claim", insider.address, text)
        return self.end_inside(insider)

    def forget_inside(self, insider: InsideParticipant) -> None:
        """Forget a participant inside, and tell nothing."""
        self.inside.forget(insider)
        self.proxy_participants.forget(insider.prefix)
        self.fragments.forget(insider.prefix)

    def forget_outside(self, outsider: OutsideParticipant) -> None:
        """Forget a participant outside, and tell nothing."""
        self.rediscovery.forget(self.inside.by_prefix.values(), outsider.prefix)
        self.outside.forget(outsider)
        # What is known of ports belongs to a participant inside, which may have the same prefix.
        self.proxy_participants.discovery_participant.forget(outsider.prefix)
        self.fragments.forget(outsider.prefix)


def _dispose_message_of(participant: Participant) -> bytes:
    """The dispose message of a participant that may come back.

    The number is the next one after that of its last announcement: Fast DDS takes no older sample
    of the same writer (StatelessReader.cpp), so a greater one would keep it out for good.
    """
    return dispose_message(participant.prefix, participant.vendor, participant.next_number)
