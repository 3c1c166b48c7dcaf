"""The stand-ins of a domain: ports of the proxy through which inside reaches locators outside.

The discovery of a participant outside always passes the proxy, through a stand-in. User data passes
a stand-in only if the direction is both. The port follows from the locator, so that the next
process of the proxy opens the same one. A stand-in may serve several locators.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import islice

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.domain_settings import MOST_MAPPINGS, DomainSettings, Refused
from rosproxy.ros2.ports.locator_ports import order_for
from rosproxy.ros2.registry.participants import OutsideParticipant, PortMapping, TrafficKind
from rosproxy.ros2.sources.claimed_addresses import is_proxy_port

STAND_INS = PortRange(20_000, 32_767)
"""Where ports for participants outside are chosen from: below those that Linux gives away."""
TRIES = 32
"""How many ports are tried for a locator outside."""
MOST_SHARING = 3
"""Locators outside that one port may stand for; as many of forged participants do not count."""

StandInUser = tuple[OutsideParticipant, PortMapping]
"""A participant outside that a stand-in leads to, with the mapping of its locator."""


@dataclass(slots=True)
class LocatorStandIns:
    """The stand-ins, ``by_port``, each with the participants that it leads to.

    ``blocked`` are ports that other programs hold. ``changes`` counts the changes of ``by_port``.
    """

    settings: DomainSettings
    refused: Refused
    by_port: dict[int, list[StandInUser]] = field(default_factory=dict)
    blocked: set[int] = field(default_factory=set)
    changes: int = 0

    def open(
        self, outsider: OutsideParticipant, locator: HostPort, kind: TrafficKind
    ) -> PortMapping | None:
        """Return the stand-in for a locator, which is opened if necessary; None if none is left.

        Cyclone DDS has one locator for both kinds: the stand-in is for metatraffic then.
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
        """Note that a port can't be opened; its locators get one by the next announcement.

        It is another one if this is ``for_good``, not where the process has no more sockets.
        """
        if for_good:
            self.blocked.add(port)
        for outsider, mapping in list(self.by_port.get(port, ())):
            self._close(outsider, mapping.target)

    def is_own_port(self, locator: HostPort) -> bool:
        """Whether a locator is a port of the proxy itself: a stand-in there would lead inside."""
        return is_proxy_port(locator, self.by_port, self.settings)

    def _users(self, for_known: bool, port: int) -> int:
        """How many participants keep one more from a port; ``for_known`` is what that one is.

        A forger can choose prefixes that lead to the port of another participant. If that one lost
        the port after a restart, Fast DDS inside would go on sending there (PDPListener.cpp).
        """
        users = self.by_port.get(port, ())
        return sum(outsider.is_known or not for_known for outsider, _ in users)

    def _is_taken(self, port: int) -> bool:
        return port in self.blocked or port in self.settings.ports.listen

    def _close(self, outsider: OutsideParticipant, locator: HostPort) -> None:
        mapping = outsider.mappings.pop(locator)
        outsider.announcement_inside = None
        remaining = [user for user in self.by_port.pop(mapping.port) if user[1] is not mapping]
        if remaining:
            self.by_port[mapping.port] = remaining
        self.changes += 1


def stand_in_port(key: str, users: Callable[[int], int], busy: Callable[[int], bool]) -> int | None:
    """A port for a locator outside; None if there are too many of them.

    ``users`` tells how many locators a port stands for already. It may be several: so the port
    follows from the locator alone, and a proxy that starts again chooses the same. Each of these
    gets users' data that is meant for the others as well, and skips it, as with multicast.
    ``busy`` tells which ports can't be had; they don't count as tries, as there may be many.
    """
    order = (port for port in order_for(key, STAND_INS) if not busy(port))
    return next((port for port in islice(order, TRIES) if users(port) < MOST_SHARING), None)
