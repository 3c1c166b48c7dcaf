"""What each source holds: an address, and the IPv6 network of the address.

A machine may have any number of addresses in an IPv6 network (/64). So a bound for each address
alone bounds no machine. But containers and pods of different users may share such a network, too.
So a network gets more than an address, and bounds in all leave a part for other networks.
"""

from collections import Counter

from rosproxy.shared.addresses import subnet

NETWORK_FACTOR = 1.5
"""The share of an IPv6 network, in shares of an address."""


class SourceShares:
    """Amounts that sources hold. An IPv4 address, or another text, is its own network."""

    def __init__(self) -> None:
        self._held: Counter[str] = Counter()

    def __bool__(self) -> bool:
        """Whether a source holds anything."""
        return bool(self._held)

    def of(self, address: str) -> int:
        """The amount that an address holds."""
        return self._held[address]

    def of_network(self, address: str) -> int:
        """The amount that the network of an address holds."""
        return self._held[subnet(address)]

    def has_room(self, address: str, share: float, amount: int = 1) -> bool:
        """Whether a source may hold another amount, if each address may hold ``share``."""
        network = subnet(address)
        if network != address and self._held[network] + amount > share * NETWORK_FACTOR:
            return False
        return self._held[address] + amount <= share

    def add(self, address: str, amount: int = 1) -> None:
        """Count an amount that a source takes; a negative amount if the source gives back."""
        for key in {address, subnet(address)}:
            self._held[key] += amount
            if not self._held[key]:
                del self._held[key]
