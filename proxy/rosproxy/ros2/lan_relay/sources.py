"""How much the LAN relay reads of each source on the LAN.

The source of a datagram may be forged, unless its address is proven, and a forger may use any
number of sources. The relay has no participant, and sends no questions. So the proxy tells the
relay every few seconds which addresses are proven (`rosproxy.ros2.sources.address_proofs`). All
other sources share one allowance, as at the proxy.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from rosproxy.ros2.discovery.discovery_participant import ANNOUNCE_INTERVAL_S
from rosproxy.ros2.sources.address_proofs import MOST_ADDRESSES
from rosproxy.ros2.sources.rates import DiscoveryRates, Standing

SOURCE_UNITS_PER_SECOND = 500.0
"""The highest charge of a source in a second, in units of 256 bytes. A participant sends an
announcement every three seconds, and the proxy sends the announcements of all participants
inside."""
SOURCE_BURST_UNITS = 2000.0
"""The highest charge of a source at once."""
UNPROVEN_PER_SECOND = 2500.0
"""The highest charge of all unproven sources together in a second: a thousand announcements. With
10,000 forged datagrams a second, the relay then takes a fifth of a processor."""
UNPROVEN_BURST = 10_000.0
"""The highest charge of all unproven sources together at once."""
REMEMBERED_S = 10 * ANNOUNCE_INTERVAL_S
"""Seconds for which an address counts as proven after the proxy has listed the address. A proxy
that has just started knows no proven addresses."""


@dataclass(slots=True)
class LanSources:
    """The standing and the allowance of each source."""

    rates: DiscoveryRates = field(
        default_factory=lambda: DiscoveryRates(
            SOURCE_UNITS_PER_SECOND, SOURCE_BURST_UNITS, UNPROVEN_PER_SECOND, UNPROVEN_BURST
        )
    )
    _proven_until: dict[str, float] = field(default_factory=dict)

    def note_proven(self, addresses: Iterable[str], now: float) -> None:
        """Note the proven addresses in a list of the proxy."""
        self._proven_until = {a: until for a, until in self._proven_until.items() if until >= now}
        for address in addresses:
            if address in self._proven_until or len(self._proven_until) < MOST_ADDRESSES:
                self._proven_until[address] = now + REMEMBERED_S

    def standing(self, source: str, now: float) -> Standing:
        """The standing of a source: PROVEN or OUTSIDE."""
        is_proven = self._proven_until.get(source, now) > now
        return Standing.PROVEN if is_proven else Standing.OUTSIDE

    def take(self, source: str, size: int, now: float) -> bool:
        """Charge a source for a datagram of ``size`` bytes.

        Return False if the allowance is used up.
        """
        return self.rates.take(source, size, now, self.standing(source, now))
