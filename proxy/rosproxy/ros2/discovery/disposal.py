"""The end of participants: the proxy forgets a participant, and informs the other side.

A participant that ends regularly sends a dispose message. This module is for all other ends:

- the process was killed, or the container is gone;
- the proxy gives the place, the ports or the GUID prefix to another participant.

In these cases the proxy sends the dispose message on behalf of the participant. The participant may
still be alive, and come back.
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
    """Ends participants of both sides. The methods return the datagrams for the other side."""

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
        """End the participants of crashed processes at the port that a participant has now.

        A crashed process sends no dispose message, and would stay known until the end of its lease
        duration. A participant that has answered has bound the port, so the former process is gone.
        The proxy also forgets the answer of the former process: if its announcement is repeated,
        the answer must not count. Empty if the participant has not answered.
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
        """Forget a participant inside, and send outside a dispose message.

        The participant may be alive, and come back with other ports. Outside then has to rediscover
        it.
        """
        message = _dispose_message_of(insider)
        self.forget_inside(insider)
        self.former_ports.displace(insider.prefix)
        return self.settings.to_outside(message)

    def end_outside(
        self, outsider: OutsideParticipant, inside: Iterable[InsideParticipant]
    ) -> list[Outgoing]:
        """Forget a participant outside, and send a dispose message to the participants ``inside``.

        Empty if the participant was never announced inside.
        """
        message = _dispose_message_of(outsider)
        receivers = list(inside) if outsider.is_announced else []
        self.forget_outside(outsider)
        return [sent for insider in receivers for sent in sent_to(insider.metatraffic, [message])]

    def give_prefix_to_inside(self, prefix: bytes, source: str) -> list[Outgoing]:
        """End the participant outside, if any, with the prefix of a participant inside.

        ``source`` is the address of the participant inside. Only participants on other networks get
        a dispose message. Participants on the network of ``source`` know the rightful participant,
        and would forget that participant.
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
        """Forget the participant inside, if any, with the prefix of a participant outside.

        ``source`` is the address of the participant outside. Outside gets no dispose message: it
        knows the rightful participant, and would forget that participant.
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

        With its next announcement the participant gets other ports.
        """
        text = (
            f"participant {insider.guid_prefix} loses a port that another participant has claimed"
        )
        self.refused("port_claim", insider.address, text)
        return self.end_inside(insider)

    def forget_inside(self, insider: InsideParticipant) -> None:
        """Forget a participant inside without a dispose message."""
        self.inside.forget(insider)
        self.rediscovery.forget_inside(insider)
        self.proxy_participants.forget(insider.prefix)
        self.fragments.forget(insider.prefix)

    def forget_outside(self, outsider: OutsideParticipant) -> None:
        """Forget a participant outside without a dispose message."""
        self.rediscovery.forget(self.inside.by_prefix.values(), outsider.prefix)
        self.outside.forget(outsider)
        # Former ports belong to a participant inside, which may have the same prefix. So these
        # are not forgotten here.
        self.proxy_participants.discovery_participant.forget(outsider.prefix)
        self.fragments.forget(outsider.prefix)


def _dispose_message_of(participant: Participant) -> bytes:
    """The dispose message for a participant that may come back.

    Its number follows that of the participant's last announcement. Fast DDS ignores older samples
    of the same writer (StatelessReader.cpp), so with a greater number the participant could never
    come back.
    """
    return dispose_message(participant.prefix, participant.vendor, participant.next_number)
