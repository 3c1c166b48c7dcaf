"""Which side a GUID prefix belongs to, if participants on both sides use it.

A prefix is random, and each participant has its own. So one of two participants with the same
prefix has copied it, from an announcement that it has heard. The proxy serves one of the two, best
first:

1. the participant inside, if a former process of the proxy served it (`was_inside`);
2. the participant outside at the address of a configured peer;
3. the participant outside at an address that has proved to receive;
4. the participant inside;
5. the participant outside at any other address.

A participant inside that is served keeps its place, but for `REMEMBERED` seconds from the start: in
these seconds it may have come before the participant outside whose prefix it copied.
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
        """Whether a participant inside uses a prefix; it may wait to be served."""
        return prefix in self.inside.by_prefix or prefix in self.former_ports.waiting

    def yields_to_inside(self, prefix: bytes) -> bool:
        """Whether a prefix that outside may use belongs to a participant inside."""
        outsider = self.outside.by_prefix.get(prefix)
        is_weak = outsider is None or not (outsider.trusted or outsider.proven)
        return is_weak or self.former_ports.was_inside(prefix)

    def yields_to_outside(self, prefix: bytes, source: str, now: float) -> bool:
        """Whether a prefix that inside uses belongs to a participant outside at an address."""
        if not (self.settings.is_peer(source) or self.proofs.has(source)):
            return False
        insider = self.inside.by_prefix.get(prefix)
        if insider is not None:
            return not insider.was_inside and self.inside.mappings.ports.is_restoring(now)
        return not self.former_ports.was_inside(prefix)
