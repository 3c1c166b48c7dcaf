"""Everybody in a domain: those inside, those outside, those that wait, and the proxy's own.

What is known of them, and what is forgotten once they have gone. What becomes of their datagrams is
decided in `rosproxy.ros2.discovery.domain`.
"""

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Self

from rosproxy.leases.ports import PortPool
from rosproxy.ros2.discovery.address_proofs import AddressProofs
from rosproxy.ros2.discovery.discovery_rates import DiscoveryRates, Standing
from rosproxy.ros2.discovery.domain_settings import DomainSettings, Outgoing, Refused, sent_to
from rosproxy.ros2.discovery.fragments import FragmentStores
from rosproxy.ros2.discovery.hidden_endpoints import Verdicts
from rosproxy.ros2.discovery.inside_participants import InsideParticipants
from rosproxy.ros2.discovery.observer import Observer
from rosproxy.ros2.discovery.outside_participants import OutsideParticipants
from rosproxy.ros2.discovery.own_participants import OwnParticipants
from rosproxy.ros2.discovery.port_keeper import Keeper
from rosproxy.ros2.discovery.prefix_owners import PrefixOwners
from rosproxy.ros2.discovery.rediscovery import Rediscovery
from rosproxy.ros2.discovery.returning_participants import ReturningParticipants
from rosproxy.ros2.protocol.announcement import farewell
from rosproxy.ros2.registry.locator_ports import LocatorPorts, NamedBy
from rosproxy.ros2.registry.participants import (
    InsideParticipant,
    LeaseKind,
    OutsideParticipant,
    Participant,
)

ENDED_AT_ONCE = 64
"""Participants of a side that are forgotten at a time. The proxy looks twice a second."""


@dataclass(slots=True)
class DomainParticipants:
    """The participants of one domain, and what the proxy knows of them.

    ``own`` are the proxy's own participants; ``passed`` counts bytes, by kind and whether inwards.
    """

    settings: DomainSettings
    ports: LocatorPorts
    own: OwnParticipants
    inside: InsideParticipants
    outside: OutsideParticipants
    returning: ReturningParticipants
    refused: Refused
    fragments: FragmentStores
    rediscovery: Rediscovery
    proofs: AddressProofs
    owners: PrefixOwners
    rates: DiscoveryRates = field(default_factory=DiscoveryRates)
    passed: Counter[tuple[LeaseKind, bool]] = field(default_factory=Counter)

    @classmethod
    def starting(
        cls,
        settings: DomainSettings,
        pool: PortPool,
        own: bytes,
        secret: bytes,
        now: float,
        when: float = 0.0,
    ) -> Self:
        """A domain without participants.

        ``own`` is a random prefix, ``secret`` random bytes, ``when`` Unix time.
        """
        pool.claim(settings.discovery_port)  # where outside announces itself: nobody gets it
        ports = LocatorPorts(pool, now)
        refused = Refused(settings.note)
        proofs = AddressProofs(secret)
        keeper = Keeper.of(
            settings.host, settings.ports.listen, settings.number, when - now, settings.keeper_key
        )
        verdicts = Verdicts(settings.judge)
        inside = InsideParticipants(settings, ports, refused, proofs, verdicts)
        outside = OutsideParticipants(settings, refused, proofs, verdicts)
        settings.participants_at = outside.count_by_address.__getitem__
        returning = ReturningParticipants(settings, ports, keeper, proofs)
        fragments = FragmentStores()
        participants = OwnParticipants(
            settings, Observer(own), keeper, inside, outside, returning, fragments, proofs
        )
        return cls(
            settings,
            ports,
            participants,
            inside,
            outside,
            returning,
            refused,
            fragments,
            Rediscovery(settings, inside, outside),
            proofs,
            PrefixOwners(settings, inside, outside, returning, proofs),
        )

    @property
    def is_busy(self) -> bool:
        """Whether `Domain.go_on` has more to do: hundreds may have to meet hundreds."""
        return self.rediscovery.is_busy

    def standing(self, source: str) -> Standing:
        """How far an address has proved to be what it claims; its rate of discovery follows."""
        if self.settings.is_peer(source):
            return Standing.PROVEN
        is_proven = self.proofs.has(source)
        if self.settings.is_inside(source):
            return Standing.PROVEN if is_proven else Standing.INSIDE
        return Standing.STRANGER if is_proven else Standing.OUTSIDE

    def _named_by(self, source: str) -> NamedBy:
        """How much it counts that an address outside names a participant."""
        if self.settings.is_peer(source):
            return NamedBy.PEER
        # A participant inside proves its address, too, and sends to ports of the range.
        is_proven = self.proofs.has(source) and not self.settings.is_inside(source)
        return NamedBy.PROVEN if is_proven else NamedBy.OTHERS

    def is_kept(self, participant: InsideParticipant) -> bool:
        """Whether a participant inside keeps all the ports that it has, for the next process."""
        return self.own.keeper.keeps(participant.prefix, participant.ports)

    def expire(self, now: float) -> list[Outgoing]:
        """Forget participants that have not been heard for as long as they said.

        Return what outside is told. A participant on two networks may have lost the one at which it
        was served, and is let in again at the other.
        """
        sent = list[Outgoing]()
        insiders = [p for p in self.inside.by_prefix.values() if p.until < now]
        for insider in insiders[:ENDED_AT_ONCE]:
            sent += self._end_for(insider)
        outsiders = [p for p in self.outside.by_prefix.values() if p.until < now]
        for outsider in outsiders[:ENDED_AT_ONCE]:
            self._forget_outside(outsider)
        self.proofs.expire(now, self.inside, self.outside)
        return sent

    def gone(self, addresses: Collection[str]) -> list[Outgoing]:
        """End the participants at addresses inside where nobody is any more; what outside is told.

        They can't say so themselves, and would be believed to be there for many seconds.
        """
        self.returning.forget(addresses)
        sent = list[Outgoing]()
        for leaver in [p for p in self.inside.by_prefix.values() if p.address in addresses]:
            sent += self._end_for(leaver)
        return sent

    def _end_former_processes(self, prefix: bytes, source: str) -> list[Outgoing]:
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
            sent += self._end_for(insider)
        for outsider in self.outside.former_processes(prefix, source):
            self.proofs.forget(source, outsider.prefix)
            sent += self._end_outside(outsider, self.inside.by_prefix.values())
        return sent

    def _end_for(self, insider: InsideParticipant) -> list[Outgoing]:
        """End a participant inside on its behalf; what outside is told.

        It may live, and come back by other ports. Outside has to meet it anew then.
        """
        ended = _farewell_of(insider)
        self._forget_inside(insider)
        self.returning.displace(insider.prefix)
        return self.settings.to_outside(ended)

    def _end_outside(
        self, outsider: OutsideParticipant, inside: Iterable[InsideParticipant]
    ) -> list[Outgoing]:
        """Forget a participant outside, and tell some inside that it has ended."""
        ended = _farewell_of(outsider)
        told = list(inside) if outsider.is_introduced else []
        self._forget_outside(outsider)
        return [sent for insider in told for sent in sent_to(insider.metatraffic, [ended])]

    def _give_prefix_to_inside(self, prefix: bytes, source: str) -> list[Outgoing]:
        """Forget the participant outside, if any, whose prefix is that of one at an address inside.

        Only participants on other networks are told of the end: those on its own know the rightful
        one, and would forget it.
        """
        outsider = self.outside.by_prefix.get(prefix)
        if outsider is None:
            return []
        text = f"GUID prefix {outsider.guid_prefix} belongs to a participant inside, at {source}"
        self.refused("prefix", outsider.address, text)
        near = self.settings.proxy_address_for(source)
        elsewhere = [p for p in self.inside.by_prefix.values() if p.proxy_address != near]
        return self._end_outside(outsider, elsewhere)

    def _give_prefix_to_outside(self, prefix: bytes, source: str) -> None:
        """Forget the participant inside, if any, whose prefix is that of one at an address outside.

        Outside is told of no end: it knows the rightful one, and would forget it.
        """
        insider = self.inside.by_prefix.get(prefix)
        if insider is not None:
            text = (
                f"GUID prefix {insider.guid_prefix} belongs to a participant outside, at {source}"
            )
            self.refused("prefix", insider.address, text)
            self._forget_inside(insider)

    def _give_up_ports(self, insider: InsideParticipant) -> list[Outgoing]:
        """End a participant inside for the ports that are another one's; what outside is told.

        It is let in again with its next announcement, and gets other ports.
        """
        text = f"{insider.guid_prefix} gives back a port that another participant has claimed"
        self.refused("port_claim", insider.address, text)
        return self._end_for(insider)

    def _forget_inside(self, insider: InsideParticipant) -> None:
        self.inside.forget(insider)
        self.own.forget(insider.prefix)
        self.fragments.forget(insider.prefix)

    def _forget_outside(self, outsider: OutsideParticipant) -> None:
        self.rediscovery.forget(self.inside.by_prefix.values(), outsider.prefix)
        self.outside.forget(outsider)
        # What is known of ports belongs to a participant inside, which may have the same prefix.
        self.own.observer.forget(outsider.prefix)
        self.fragments.forget(outsider.prefix)

    def _drop(self, reason: str, source: str, text: str) -> list[Outgoing]:
        self.refused(reason, source, text)
        return []


def _farewell_of(participant: Participant) -> bytes:
    """The dispose message of a participant that may come back.

    The number is the next one after that of its last announcement: Fast DDS takes no older sample
    of the same writer (StatelessReader.cpp), so a greater one would keep it out for good.
    """
    return farewell(participant.prefix, participant.vendor, participant.next_number)
