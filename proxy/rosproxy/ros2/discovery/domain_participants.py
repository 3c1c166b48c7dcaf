"""Everybody in a domain: those inside, those outside, those that wait, and the proxy's own.

What is known of them, and what is forgotten once they have gone. What becomes of their datagrams is
decided in `rosproxy.ros2.discovery.domain`.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Self

from rosproxy.leases.ports import PortPool
from rosproxy.ros2.discovery.address_proofs import AddressProofs
from rosproxy.ros2.discovery.discovery_rates import DiscoveryRates
from rosproxy.ros2.discovery.domain_settings import DomainSettings, Outgoing, Refused
from rosproxy.ros2.discovery.fragments import FragmentStores
from rosproxy.ros2.discovery.inside_participants import InsideParticipants
from rosproxy.ros2.discovery.observer import Observer
from rosproxy.ros2.discovery.outside_participants import OutsideParticipants
from rosproxy.ros2.discovery.own_participants import OwnParticipants
from rosproxy.ros2.discovery.port_keeper import Keeper
from rosproxy.ros2.discovery.rediscovery import Rediscovery
from rosproxy.ros2.discovery.returning_participants import ReturningParticipants
from rosproxy.ros2.protocol.announcement import LAST_SEQUENCE, farewell
from rosproxy.ros2.registry.locator_ports import LocatorPorts
from rosproxy.ros2.registry.participants import InsideParticipant, LeaseKind, OutsideParticipant


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
        ports, refused = LocatorPorts(pool, now), Refused(settings.note)
        proofs = AddressProofs(secret)
        keeper = Keeper.of(settings.host, settings.ports.listen, settings.number, when)
        inside = InsideParticipants(settings, ports, refused, proofs)
        outside = OutsideParticipants(settings, refused, proofs)
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
            Rediscovery(settings, outside),
            proofs,
        )

    def is_kept(self, participant: InsideParticipant) -> bool:
        """Whether a participant inside keeps all the ports that it has, for the next process."""
        return self.own.keeper.keeps(participant.prefix, participant.ports)

    def expire(self, now: float) -> None:
        """Forget those that have not been heard for as long as they said."""
        for insider in [p for p in self.inside.by_prefix.values() if p.until < now]:
            self._forget_inside(insider)
        for outsider in [p for p in self.outside.by_prefix.values() if p.until < now]:
            self._forget_outside(outsider)
        self.proofs.expire(now, self.inside.count_by_address, self.outside.count_by_address)

    def gone(self, addresses: Collection[str]) -> list[Outgoing]:
        """End the participants at addresses inside where nobody is any more; what outside is told.

        They can't say so themselves, and would be believed to be there for many seconds.
        """
        self.returning.forget(addresses)
        sent = list[Outgoing]()
        for leaver in [p for p in self.inside.by_prefix.values() if p.address in addresses]:
            sent += self._end_for(leaver)
        return sent

    def _end_for(self, insider: InsideParticipant) -> list[Outgoing]:
        """End a participant inside on its behalf; what outside is told."""
        self._forget_inside(insider)
        return self.settings.to_outside(farewell(insider.prefix, insider.vendor, LAST_SEQUENCE))

    def _forget_inside(self, insider: InsideParticipant) -> None:
        self.inside.forget(insider)
        self.own.forget(insider.prefix)
        self.fragments.forget(insider.prefix)

    def _forget_outside(self, outsider: OutsideParticipant) -> None:
        self.rediscovery.forget(self.inside.by_prefix.values(), outsider.prefix)
        self.outside.forget(outsider)
        self.own.forget(outsider.prefix)
        self.fragments.forget(outsider.prefix)

    def _drop(self, reason: str, source: str, text: str) -> list[Outgoing]:
        self.refused(reason, source, text)
        return []
