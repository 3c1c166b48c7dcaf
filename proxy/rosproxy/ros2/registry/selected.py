"""Which addresses inside are let in, where an operator says so.

Whoever is on an inside network is heard, also who did not ask for a proxy. An operator tells which
addresses are those of containers that did. Until it has, all are let in; but where one is to be
expected, what they announce is held back for some seconds. What one announces that is not selected
(yet) is held too, since its container may be known in a moment.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from rosproxy.ros2.protocol.rtps import source_prefix

NEWS_TIMEOUT = 3.0
"""Seconds from the start that an operator has for its first word."""
MOST_HELD, MOST_HELD_EACH, LONGEST_HELD = 256, 8, 8192
"""Addresses of which announcements are held, participants at each, and bytes of each."""


@dataclass(slots=True)
class SelectedAddresses:
    """Lets addresses in. ``until``: when all are let in if no operator has told any till then.

    ``held`` are the last announcements of each address that is not let in, by GUID prefix.
    """

    until: float
    told: frozenset[str] | None = None
    held: dict[str, dict[bytes, bytes]] = field(default_factory=dict)

    def select(self, addresses: Iterable[str]) -> None:
        """Take in which addresses an operator has selected, instead of those before."""
        self.told = frozenset(addresses)

    def admits(self, address: str, now: float) -> bool:
        """Whether participants at an address are let in."""
        return now >= self.until if self.told is None else address in self.told

    def hold(self, address: str, datagram: bytes) -> None:
        """Keep what an address announces that is not let in. Raises RtpsError."""
        prefix = source_prefix(datagram)
        if len(datagram) > LONGEST_HELD:
            return
        if address not in self.held and len(self.held) >= MOST_HELD:
            del self.held[next(iter(self.held))]
        mine = self.held.setdefault(address, {})
        if prefix in mine or len(mine) < MOST_HELD_EACH:
            mine[prefix] = datagram

    def released(self, now: float) -> list[tuple[str, bytes]]:
        """What was held of addresses that are let in now; it is held no more."""
        free = [address for address in self.held if self.admits(address, now)]
        return [(one, datagram) for one in free for datagram in self.held.pop(one).values()]
