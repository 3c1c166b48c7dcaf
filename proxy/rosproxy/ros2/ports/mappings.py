"""The port mappings of a domain: which port of the range leads to which locator inside.

A participant inside gets a port for each locator at the source address of the announcement, and for
no other locator. So no announcement makes the proxy a way to another host. Outside sees these ports
in place of the locators. `rosproxy.ros2.ports.locator_ports` chooses the port.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from rosproxy.ros2.domain_settings import MOST_MAPPINGS, DomainSettings, Refused
from rosproxy.ros2.ports.locator_ports import LocatorPorts
from rosproxy.ros2.registry.participants import (
    InsideParticipant,
    PortMapping,
    PortShortage,
    ShortageKind,
    TrafficKind,
)
from rosproxy.ros2.rewriting.discovery import Announcement
from rosproxy.ros2.sources.address_proofs import AddressProofs
from rosproxy.shared.addresses import HostPort

PART_FOR_PROVEN = 4
"""If at most 1/PART_FOR_PROVEN of the range is free, only participants that have answered get
ports."""
PART_FOR_OTHERS = 8
"""A single address can't get the last 1/PART_FOR_OTHERS of the range. So a container that takes all
available ports leaves some ports to other containers."""

Holder = tuple[InsideParticipant, PortMapping]
"""A participant and a port mapping of the participant."""


@dataclass(slots=True)
class PortMappings:
    """The port mappings of a domain.

    ``by_port`` has each mapping with its participant. ``shortages`` tells by GUID prefix why a
    locator of the participant got no port. ``changes`` counts the changes of the mappings.
    """

    settings: DomainSettings
    ports: LocatorPorts
    refused: Refused
    proofs: AddressProofs
    by_port: dict[int, Holder] = field(default_factory=dict)
    shortages: dict[bytes, PortShortage] = field(default_factory=dict)
    changes: int = 0
    _by_locator: dict[HostPort, dict[int, Holder]] = field(default_factory=dict)
    """The mappings to each locator, by port: participants at an address may share a locator."""
    _count_by_address: Counter[str] = field(default_factory=Counter)

    def must_answer_first(self, prefix: bytes, address: str) -> bool:
        """Whether a participant gets a port only after an answer, because few ports are free."""
        kept = len(self.settings.ports.listen) // PART_FOR_PROVEN
        return self.ports.pool.free <= kept and not self.proofs.has_answered(address, prefix)

    def advertised(
        self,
        participant: InsideParticipant,
        locator: HostPort,
        kind: TrafficKind,
        former_ports: Sequence[int],
        now: float,
    ) -> HostPort | None:
        """Return the address and port at which outside reaches a locator; map a port if necessary.

        None if the locator is at another address than the participant, is a port of the range, or
        gets no port. ``former_ports`` are the known ports of the participant from before the start,
        in the order of the participant's locators.
        """
        if locator.host != participant.address or self._is_own(locator):
            return None
        mapping = participant.mappings.get(locator)
        if mapping is None:
            # The port store keeps the ports in the order of their mapping
            # (`InsideParticipant.ports`).
            index = len(participant.mappings)
            former_port = former_ports[index] if index < len(former_ports) else None
            mapping = self._map(participant, locator, kind, former_port, now)
        if mapping is None:
            return None
        if kind is TrafficKind.METATRAFFIC and mapping.kind is not kind:
            mapping.kind = kind  # Cyclone DDS has one locator for both kinds
            self.mark_read([locator])
        host = self.settings.host_for(locator.host)
        return HostPort(host, self.settings.ports.advertised(mapping.port))

    def add(self, participant: InsideParticipant, mapping: PortMapping) -> None:
        """Add a mapping of a participant."""
        participant.mappings[mapping.target] = mapping
        self.by_port[mapping.port] = participant, mapping
        self._by_locator.setdefault(mapping.target, {})[mapping.port] = participant, mapping
        self._count_by_address[participant.address] += 1
        self.mark_read([mapping.target])

    def end(self, participant: InsideParticipant) -> None:
        """End all mappings of a participant that has gone."""
        for mapping in participant.mappings.values():
            self._take_back(participant.address, mapping)
        self.shortages.pop(participant.prefix, None)
        self.mark_read(participant.mappings)

    def make_room(
        self, participant: InsideParticipant, spdp: Announcement, datagram: bytes
    ) -> None:
        """If a participant has too many mappings, end those that its announcement does not name.

        A forged announcement may have caused these mappings. No mapping ends if the announcement
        itself names more than `MOST_MAPPINGS` locators.
        """
        address = participant.address
        named = {locator for _, locator in spdp.reached_at(datagram) if locator.host == address}
        if len(named) <= MOST_MAPPINGS < len(named | participant.mappings.keys()):
            unnamed = participant.mappings.keys() - named
            for locator in unnamed:
                self._take_back(address, participant.mappings.pop(locator))
            self.shortages.pop(participant.prefix, None)
            self.mark_read(unnamed)

    def mark_read(self, locators: Iterable[HostPort]) -> None:
        """Mark the mappings to those of these locators at which a participant reads discovery.

        A participant may announce the locator of another participant at the same address.
        """
        for locator in locators:
            holders = self._by_locator.get(locator, {}).values()
            is_read = any(p.reads_discovery_at(mapping) for p, mapping in holders)
            for _, mapping in holders:
                mapping.is_read = is_read
        self.changes += 1

    def _map(
        self,
        participant: InsideParticipant,
        locator: HostPort,
        kind: TrafficKind,
        former_port: int | None,
        now: float,
    ) -> PortMapping | None:
        """Map a port to a locator. If no port may be given, note the shortage, and return None."""
        if shortage := self._shortage(participant, locator):
            self.shortages[participant.prefix] = shortage
            return None
        port = self.ports.take(participant.prefix, locator, kind, now, former_port)
        if port is None:
            text = f"{locator} got no port: no port of {self.settings.ports.listen} is free"
            self.shortages[participant.prefix] = PortShortage(ShortageKind.RANGE, text)
            return None
        if former_port not in (None, port) and self.ports.is_restoring(now):
            self._lose_port(participant, former_port, now)
        mapping = PortMapping(port, locator, kind)
        self.add(participant, mapping)
        return mapping

    def _shortage(self, participant: InsideParticipant, locator: HostPort) -> PortShortage | None:
        """Return why a locator may not get a port; None if there is no reason."""
        if len(participant.mappings) >= MOST_MAPPINGS:
            text = f"{locator} got no port: the participant has more than {MOST_MAPPINGS} locators"
            return PortShortage(ShortageKind.BOUND, text)
        ports = self.settings.ports.listen
        if self._has_its_share(participant.address):
            text = f"{locator} got no port: {participant.address} already has as many ports of "
            text += f"{ports} as one address may have"
            return PortShortage(ShortageKind.RANGE, text)
        if self.must_answer_first(participant.prefix, participant.address):
            text = (
                f"{locator} got no port: the participant does not answer the proxy, and the last "
            )
            text += f"free ports of {ports} are for participants that answer"
            return PortShortage(ShortageKind.RANGE, text)
        return None

    def _has_its_share(self, address: str) -> bool:
        """Whether the participants at an address have as many ports as one address may have.

        This limit does not depend on the ports of other addresses. So after a restart all
        participants get the same ports again, in whichever order they come.
        """
        size = len(self.settings.ports.listen)
        return self._count_by_address[address] >= size - size // PART_FOR_OTHERS

    def _is_own(self, locator: HostPort) -> bool:
        """Whether a locator is a port of the range.

        A datagram to this port would circulate without end.
        """
        in_range = locator.port in self.settings.ports.listen
        return in_range and locator.host == self.settings.proxy_address_for(locator.host)

    def _lose_port(
        self, participant: InsideParticipant, former_port: int | None, now: float
    ) -> None:
        """Let all participants outside rediscover a participant that has lost a former port."""
        participant.separation_due_from = now
        text = f"participant {participant.guid_prefix} gets another port than {former_port}, which "
        text += "another participant claims as well; outside discovers the participant anew"
        self.refused("port_claim", participant.address, text)

    def _take_back(self, address: str, mapping: PortMapping) -> None:
        del self.by_port[mapping.port]
        holders = self._by_locator[mapping.target]
        del holders[mapping.port]
        if not holders:
            del self._by_locator[mapping.target]
        self._count_by_address[address] -= 1
        if not self._count_by_address[address]:
            del self._count_by_address[address]
        self.ports.give_back(mapping.port)
