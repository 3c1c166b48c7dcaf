"""The stand-ins of a domain: ports of the proxy through which inside reaches locators outside.

The discovery of a participant outside always passes the proxy, through a stand-in. User data passes
a stand-in only if the direction is both. The port follows from the locator, so that the next
process of the proxy opens the same port. A stand-in may serve several locators.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import islice

from rosproxy.ros2.domain_settings import MOST_MAPPINGS, DomainSettings, Refused
from rosproxy.ros2.ports.locator_ports import order_for
from rosproxy.ros2.registry.participants import OutsideParticipant, PortMapping, TrafficKind
from rosproxy.ros2.sources.claimed_addresses import is_proxy_port
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import STAND_IN_PORTS

MOST_PORTS_TRIED = 32
"""The highest number of ports that are tried for a locator outside."""
MOST_SHARING = 3
"""The highest number of locators outside that a stand-in may serve. For a known participant, the
locators of unknown participants do not count."""

StandInUser = tuple[OutsideParticipant, PortMapping]
"""A participant outside that a stand-in serves, and the mapping of the participant's locator."""


@dataclass(slots=True)
class LocatorStandIns:
    """The stand-ins of a domain, ``by_port``, each with the participants that it serves.

    ``blocked`` are ports of other programs. ``changes`` counts the changes of ``by_port``.
    """

    settings: DomainSettings
    refused: Refused
    by_port: dict[int, list[StandInUser]] = field(default_factory=dict)
    blocked: set[int] = field(default_factory=set)
    changes: int = 0

    def open(
        self, outsider: OutsideParticipant, locator: HostPort, kind: TrafficKind
    ) -> PortMapping | None:
        """Return the stand-in for a locator, and open one if necessary; None if no port is left.

        Cyclone DDS has one locator for metatraffic and user data. Such a stand-in counts as one for
        metatraffic.
        """
        mapping = outsider.mappings.get(locator)
        if mapping is None and len(outsider.mappings) < MOST_MAPPINGS:
            users = partial(self._users, outsider.is_known)
            port = stand_in_port(f"{outsider.prefix.hex()} {locator}", users, self._is_taken)
            if port is not None:
                mapping = outsider.mappings[locator] = PortMapping(port, locator, kind)
                self.by_port.setdefault(port, []).append((outsider, mapping))
                self.changes += 1
        if mapping is None:
            text = f"participant {outsider.guid_prefix}: no stand-in port is left for {locator}"
            self.refused("stand_ins", outsider.address, text)
        elif kind is TrafficKind.METATRAFFIC:
            mapping.kind = kind
        return mapping

    def close(self, outsider: OutsideParticipant) -> None:
        """Close the stand-ins of a participant that has gone."""
        for locator in list(outsider.mappings):
            self._close(outsider, locator)

    def block(self, port: int, for_good: bool = True) -> None:
        """Note that a port can't be opened. The next announcement opens a stand-in again.

        ``for_good`` means that another program has the port: the next stand-in has another port.
        Otherwise the process lacks sockets, and the same port may be opened later.
        """
        if for_good:
            self.blocked.add(port)
        for outsider, mapping in list(self.by_port.get(port, ())):
            self._close(outsider, mapping.target)

    def is_own_port(self, locator: HostPort) -> bool:
        """Whether a locator is a port of the proxy. Its stand-in would lead inside."""
        return is_proxy_port(locator, self.by_port, self.settings)

    def _users(self, for_known: bool, port: int) -> int:
        """The number of participants at a port that count for a new participant (`MOST_SHARING`).

        ``for_known`` means that the new participant is known. Then only known participants count. A
        forger can choose prefixes that lead to the port of another participant. If that participant
        lost the port after a restart, Fast DDS inside would go on sending there (PDPListener.cpp).
        """
        users = self.by_port.get(port, ())
        return sum(outsider.is_known or not for_known for outsider, _ in users)

    def _is_taken(self, port: int) -> bool:
        return port in self.blocked or port in self.settings.ports.listen

    def _close(self, outsider: OutsideParticipant, locator: HostPort) -> None:
        mapping = outsider.mappings.pop(locator)
        outsider.announcements_inside.clear()
        remaining = [user for user in self.by_port.pop(mapping.port) if user[1] is not mapping]
        if remaining:
            self.by_port[mapping.port] = remaining
        self.changes += 1


def stand_in_port(key: str, users: Callable[[int], int], busy: Callable[[int], bool]) -> int | None:
    """The port for a locator outside; None if too many locators share the ports that are tried.

    ``users`` returns the number of locators at a port. Several locators may share a port: so the
    port follows from the locator alone, and the next process of the proxy chooses the same port.
    Each participant at a shared port receives the user data of the others as well, and ignores this
    data, as with multicast. ``busy`` returns whether a port is not available. Such ports do not
    count as tries, because there may be many.
    """
    order = (port for port in order_for(key, STAND_IN_PORTS) if not busy(port))
    return next(
        (port for port in islice(order, MOST_PORTS_TRIED) if users(port) < MOST_SHARING), None
    )
