"""Announcements to inside: which locators of a participant outside a participant inside gets.

A locator for metatraffic is replaced by a stand-in, so that all discovery passes the proxy. A
locator for user data stays, and inside sends there without the proxy. With the direction both a
stand-in replaces this locator as well, and inside needs no route.

Of several addresses inside gets the one that the participant was heard from. Each machine has
other addresses that mean another machine inside: the address of a container network may be that of
the gateway of the reader.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from math import inf

from rosproxy.net.addresses import HostPort, is_loopback, is_of_link
from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.domain_settings import DomainSettings, Outgoing, sent_to
from rosproxy.ros2.protocol.addressing import for_all
from rosproxy.ros2.protocol.announcement import dispose_message
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.registry.participants import InsideParticipant, OutsideParticipant, TrafficKind
from rosproxy.ros2.rewriting.announced_participant import note_endpoints
from rosproxy.ros2.rewriting.discovery import (
    Announcement,
    DiscoveryMessage,
    read_discovery,
    rewritten,
)

DISPOSE_MESSAGE_INTERVAL = 2.0
"""Seconds after which a participant inside is told again to forget one outside, until they meet."""


@dataclass(slots=True)
class ForInside:
    """Rewrites the discovery of a participant outside for inside.

    ``near`` is the address at which inside reaches the proxy. ``insider`` is the participant that
    the policy judges; with None nothing is hidden. The discovery participant is given all: it would
    ask for hidden announcements again and again.
    """

    outside: OutsideParticipants
    outsider: OutsideParticipant
    near: str
    insider: InsideParticipant | None = None

    def rewritten(self, message: DiscoveryMessage) -> bytes:
        """A message as inside gets it; its readers and writers are noted. Raises RtpsError."""
        datagram = message.datagram
        note_endpoints(self.outside.notes, self.outsider, datagram, message.announcements)
        has_source = self.outsider.address in set(_user_data_hosts(message))
        return rewritten(
            message,
            lambda pid, locator: self._led(pid, locator, has_source),
            lambda announcement: self._is_hidden(announcement, datagram),
        )

    def _led(self, pid: int, locator: HostPort, has_source: bool) -> HostPort | None:
        """Where inside reaches a locator of the participant; None if it does not.

        ``has_source``: the message has a locator for user data at the source of the participant.
        """
        stand_ins = self.outside.stand_ins
        if pid == Pid.METATRAFFIC_UNICAST_LOCATOR:
            # Whichever locator it is, discovery goes to the one at the address that it sends from.
            mapping = self.outsider.metatraffic and stand_ins.open(
                self.outsider, self.outsider.metatraffic, TrafficKind.METATRAFFIC
            )
        elif not self.outside.settings.both_ways:
            return None if self._means_another(locator, has_source) else locator
        else:
            is_led = locator.host == self.outsider.address and not stand_ins.is_own_port(locator)
            mapping = (
                stand_ins.open(self.outsider, locator, TrafficKind.USER_DATA) if is_led else None
            )
        return HostPort(self.near, mapping.port) if mapping else None

    def _means_another(self, locator: HostPort, has_source: bool) -> bool:
        """Whether a locator may mean another machine where inside reaches the proxy.

        Without a locator at its source (``has_source``) the participant is behind NAT, as it seems,
        and may be reached by those that it has. So it may be by those of the other family, in which
        it was not heard.
        """
        source = self.outsider.address
        host = locator.host
        if has_source and (":" in host) == (":" in source) and host != source:
            return True
        # These addresses mean the reader's own machine or link, unless all is on one machine.
        is_same_host = is_loopback(self.near) and is_loopback(source)
        return not is_same_host and (is_loopback(host) or is_of_link(host))

    def _is_hidden(self, announcement: Announcement, datagram: bytes) -> bool:
        if self.insider is None:
            return False
        verdicts = self.outside.verdicts
        return verdicts.is_hidden(self.insider, announcement, datagram, is_own=False)


@dataclass(frozen=True, slots=True)
class AnnouncementsToInside:
    """What participants inside are told of others."""

    settings: DomainSettings
    inside: InsideParticipants
    outside: OutsideParticipants

    def of_outside(
        self,
        outside: Iterable[OutsideParticipant],
        inside: Collection[InsideParticipant],
        now: float,
    ) -> list[Outgoing]:
        """The announcements of participants outside for some inside, as far as these may know."""
        sent = list[Outgoing]()
        by_near = dict[str, list[InsideParticipant]]()
        for insider in inside:
            if insider.metatraffic and not insider.is_separated:
                near = self.settings.proxy_address_for(insider.address)
                by_near.setdefault(near, []).append(insider)
        for outsider in filter(self.outside.may_be_announced, outside):
            for near, told in by_near.items():
                datagram = self._announcement(outsider, near)
                for insider in told:
                    sent += self.dispose_message(outsider, insider, now)
                    sent += sent_to(insider.metatraffic, [datagram])
        return sent

    def dispose_message(
        self, outsider: OutsideParticipant, insider: InsideParticipant, now: float
    ) -> list[Outgoing]:
        """What makes one inside forget one outside, if it has to and was not told just now."""
        if (
            insider.dispose_message_times is None
            or now - insider.dispose_message_times.get(outsider.prefix, -inf)
            < DISPOSE_MESSAGE_INTERVAL
        ):
            return []
        insider.dispose_message_times[outsider.prefix] = now
        datagram = dispose_message(outsider.prefix, outsider.vendor, outsider.next_number)
        return sent_to(insider.metatraffic, [datagram])

    def of_neighbour(
        self, newcomer: InsideParticipant, message: DiscoveryMessage
    ) -> list[Outgoing]:
        """A participant's announcement for others on its network, if that passes on no multicast.

        It goes on as it is: they reach each other without the proxy. So do those at one address, as
        the processes of a pod are: Fast DDS sends no multicast where it has peers. What one names
        as its own may be where the proxy itself hears announcements: nothing goes there.
        """
        if newcomer.is_in_group:
            return []
        near = newcomer.proxy_address
        settings = self.settings
        own = {HostPort(near, p) for p in (settings.unicast_port, settings.multicast_port)}
        announcement = for_all(message.datagram)
        return [
            Outgoing(p.metatraffic, announcement)
            for p in self.inside.by_prefix.values()
            if p.proxy_address == near
            and p is not newcomer
            # Cyclone DDS has one locator for all participants of a process, which know each other.
            and p.metatraffic
            and p.metatraffic not in {newcomer.metatraffic, *own}
        ]

    def _announcement(self, outsider: OutsideParticipant, near: str) -> bytes:
        """The announcement of a participant for those that reach the proxy at ``near``. RtpsError.

        It is made once for all of them: with many parameters that takes a millisecond.
        """
        if outsider.announcement_inside is None or outsider.announcement_inside[0] != near:
            for_inside = ForInside(self.outside, outsider, near)
            message = read_discovery(outsider.announcement)
            outsider.announcement_inside = near, for_inside.rewritten(message)
        return outsider.announcement_inside[1]


def _user_data_hosts(message: DiscoveryMessage) -> Iterator[str]:
    """The hosts at which a message says that user data is received."""
    for announcement in message.announcements:
        for pid, locator in announcement.reached_at(message.datagram):
            if pid != Pid.METATRAFFIC_UNICAST_LOCATOR:
                yield locator.host
