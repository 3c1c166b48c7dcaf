"""What the LAN relay reads of each source on the LAN.

A source that has not proved to receive may be forged, and a forger has as many sources as it likes.
The relay has no participant, and asks nothing. So the proxy tells the relay every few seconds which
addresses have proved to receive (`rosproxy.ros2.sources.address_proofs`). All other sources share
one allowance, as they do at the proxy.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from rosproxy.ros2.discovery.discovery_participant import ANNOUNCE_INTERVAL
from rosproxy.ros2.sources.address_proofs import MOST_ADDRESSES
from rosproxy.ros2.sources.rates import DiscoveryRates, Standing

PER_SECOND = 500.0
BURST = 2000.0
"""Datagrams of one source that are read in a second, and at once, each of 256 bytes. A participant
makes one in three seconds, and the proxy makes those of all participants inside."""
UNPROVEN_PER_SECOND = 2500.0
UNPROVEN_BURST = 10_000.0
"""The same for all sources together that are not proven: a thousand announcements in a second. The
relay then takes a fifth of a processor amid 10,000 forged datagrams a second."""
REMEMBERED_S = 10 * ANNOUNCE_INTERVAL
"""Seconds for which an address counts as proven after the proxy has told so. A proxy that starts
anew knows no proven address at first."""


@dataclass(slots=True)
class LanSources:
    """The standing and the allowance of each source."""

    rates: DiscoveryRates = field(
        default_factory=lambda: DiscoveryRates(
            PER_SECOND, BURST, UNPROVEN_PER_SECOND, UNPROVEN_BURST
        )
    )
    _proven_until: dict[str, float] = field(default_factory=dict)

    def note_proven(self, addresses: Iterable[str], now: float) -> None:
        """Take in addresses that have proved to receive."""
        self._proven_until = {a: until for a, until in self._proven_until.items() if until >= now}
        for address in addresses:
            if address in self._proven_until or len(self._proven_until) < MOST_ADDRESSES:
                self._proven_until[address] = now + REMEMBERED_S

    def standing(self, source: str, now: float) -> Standing:
        """What is known of a source."""
        is_proven = self._proven_until.get(source, now) > now
        return Standing.PROVEN if is_proven else Standing.OUTSIDE

    def take(self, source: str, size: int, now: float) -> bool:
        """Charge a source for a datagram of so many bytes. Return False if it may not be read."""
        return self.rates.take(source, size, now, self.standing(source, now))
