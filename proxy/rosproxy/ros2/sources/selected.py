"""The addresses inside that the operator has selected: the proxy serves only their participants.

The proxy hears the participants of all containers on an inside network, also of containers that did
not ask for a proxy. The operator names the addresses of containers that did. Without an operator,
the proxy serves all addresses. If an operator is expected, the proxy waits some seconds for the
first selection. The proxy holds announcements of other addresses, because the operator may select
such an address soon.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from rosproxy.ros2.protocol.rtps import source_prefix

FIRST_SELECTION_TIMEOUT_S = 3.0
"""Seconds from the start in which the operator has to send the first selection."""
MOST_HELD_ADDRESSES = 256
"""Addresses whose announcements are held."""
MOST_HELD_PER_ADDRESS = 8
"""Participants at an address whose announcements are held."""
LONGEST_HELD_BYTES = 8192
"""Bytes of an announcement that is held."""


@dataclass(slots=True)
class SelectedAddresses:
    """The addresses whose participants are served.

    ``selected`` are the addresses, or None before the first selection. Without a selection, all
    addresses are served from the time ``serve_all_from`` on. ``held_announcements`` has the last
    announcements from each address that is not served, by GUID prefix.
    """

    serve_all_from: float
    selected: frozenset[str] | None = None
    held_announcements: dict[str, dict[bytes, bytes]] = field(default_factory=dict)

    def select(self, addresses: Iterable[str]) -> None:
        """Replace the selected addresses."""
        self.selected = frozenset(addresses)

    def admits(self, address: str, now: float) -> bool:
        """Whether participants at an address are served."""
        return now >= self.serve_all_from if self.selected is None else address in self.selected

    def hold(self, address: str, datagram: bytes) -> None:
        """Hold an announcement from an address that is not served. Raises RtpsError.

        Announcements above a bound are dropped. A further address replaces the oldest address.
        """
        prefix = source_prefix(datagram)
        if len(datagram) > LONGEST_HELD_BYTES:
            return
        if (
            address not in self.held_announcements
            and len(self.held_announcements) >= MOST_HELD_ADDRESSES
        ):
            del self.held_announcements[next(iter(self.held_announcements))]
        by_prefix = self.held_announcements.setdefault(address, {})
        if prefix in by_prefix or len(by_prefix) < MOST_HELD_PER_ADDRESS:
            by_prefix[prefix] = datagram

    def released(self, now: float) -> list[tuple[str, bytes]]:
        """Take out the held announcements of addresses that are served now.

        Return each announcement after the address.
        """
        admitted = [address for address in self.held_announcements if self.admits(address, now)]
        return [
            (a, datagram) for a in admitted for datagram in self.held_announcements.pop(a).values()
        ]
