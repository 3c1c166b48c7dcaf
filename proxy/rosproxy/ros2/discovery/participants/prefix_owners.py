"""Which side a GUID prefix belongs to, if participants on both sides use the same prefix.

A prefix is random, and each participant has a different prefix. So if two participants have the
same, one has copied it from an announcement. The proxy serves only one of the two. The order of
preference is:

1. the participant inside, if a former process of the proxy served this participant (`was_inside`);
2. the participant outside at the address of a configured peer;
3. the participant outside at a proven address;
4. the participant inside;
5. the participant outside at any other address.

A served participant inside keeps its place, except in the first `EVIDENCE_PERIOD_S` after the
start. In these seconds, a copy of the prefix may have come before the participant outside.
"""

from dataclasses import dataclass

from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.domain_settings import DomainSettings
from rosproxy.ros2.ports.former_ports import FormerPorts
from rosproxy.ros2.sources.address_proofs import AddressProofs


@dataclass(frozen=True, slots=True)
class PrefixOwners:
    """Decides between participants on both sides with the same prefix."""

    settings: DomainSettings
    inside: InsideParticipants
    outside: OutsideParticipants
    former_ports: FormerPorts
    proofs: AddressProofs

    def is_inside(self, prefix: bytes) -> bool:
        """Whether a participant inside uses a prefix, or waits for ports with this prefix."""
        return prefix in self.inside.by_prefix or prefix in self.former_ports.waiting

    def yields_to_inside(self, prefix: bytes) -> bool:
        """Whether a participant inside may have a prefix, even if a participant outside uses it."""
        outsider = self.outside.by_prefix.get(prefix)
        is_weak = outsider is None or not (outsider.trusted or outsider.proven)
        return is_weak or self.former_ports.was_inside(prefix)

    def yields_to_outside(self, prefix: bytes, source: str, now: float) -> bool:
        """Whether a participant outside may have a prefix that a participant inside uses.

        ``source`` is the address of the participant outside.
        """
        if not (self.settings.is_peer(source) or self.proofs.has(source)):
            return False
        insider = self.inside.by_prefix.get(prefix)
        if insider is not None:
            return not insider.was_inside and self.inside.mappings.ports.is_restoring(now)
        return not self.former_ports.was_inside(prefix)
