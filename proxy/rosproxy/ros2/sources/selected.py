"""Which addresses inside are let in, where an operator says so.

Participants of all containers on an inside network are heard, also of those that did not ask for a
proxy. An operator tells the addresses of those that did. Until it has, all are let in; but where an
operator is expected, announcements are first held back for some seconds. Those of an address that
is not selected (yet) are held too, since the operator may select it in a moment.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from rosproxy.ros2.protocol.rtps import source_prefix

UPDATE_TIMEOUT = 3.0
"""Seconds from the start that an operator has to tell the first time."""
MOST_HELD = 256
MOST_HELD_EACH = 8
LONGEST_HELD = 8192
"""Addresses of which announcements are held, participants at each, and bytes of each."""


@dataclass(slots=True)
class SelectedAddresses:
    """Which addresses are let in: ``selected``, or from ``until`` on all, if no operator names any.

    ``held_announcements`` are the last announcements of each address that is not let in, by GUID
    prefix.
    """

    until: float
    selected: frozenset[str] | None = None
    held_announcements: dict[str, dict[bytes, bytes]] = field(default_factory=dict)

    def select(self, addresses: Iterable[str]) -> None:
        """Take in which addresses an operator has selected, instead of those before."""
        self.selected = frozenset(addresses)

    def admits(self, address: str, now: float) -> bool:
        """Whether participants at an address are let in."""
        return now >= self.until if self.selected is None else address in self.selected

    def hold(self, address: str, datagram: bytes) -> None:
        """Keep an announcement from an address that is not let in. Raises RtpsError."""
        prefix = source_prefix(datagram)
        if len(datagram) > LONGEST_HELD:
            return
        if address not in self.held_announcements and len(self.held_announcements) >= MOST_HELD:
            del self.held_announcements[next(iter(self.held_announcements))]
        by_prefix = self.held_announcements.setdefault(address, {})
        if prefix in by_prefix or len(by_prefix) < MOST_HELD_EACH:
            by_prefix[prefix] = datagram

    def released(self, now: float) -> list[tuple[str, bytes]]:
        """Announcements held of addresses that are let in now, each with its address."""
        admitted = [address for address in self.held_announcements if self.admits(address, now)]
        return [
            (a, datagram) for a in admitted for datagram in self.held_announcements.pop(a).values()
        ]
