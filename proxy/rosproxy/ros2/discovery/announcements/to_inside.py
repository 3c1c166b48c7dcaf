"""Announcements to inside: which locators of a participant outside a participant inside receives.

The proxy replaces each locator for metatraffic by a stand-in, so that all discovery passes the
proxy. A locator for user data stays, and inside sends there directly. With the direction both, a
stand-in replaces this locator as well, and inside needs no route.

Of several addresses, inside receives only the source of the participant's announcement. The other
addresses of a machine may mean another machine inside: the address of a container network may be
that of the receiver's gateway.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from math import inf

from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.domain_settings import DomainSettings, Outgoing, sent_to
from rosproxy.ros2.protocol.addressing import addressed_to_all
from rosproxy.ros2.protocol.announcement import dispose_message
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.registry.participants import InsideParticipant, OutsideParticipant, TrafficKind
from rosproxy.ros2.rewriting.announced_participant import note_endpoints
from rosproxy.ros2.rewriting.discovery import (
    LONGEST_SPDP_DATAGRAM_BYTES,
    Announcement,
    DiscoveryMessage,
    read_discovery,
    rewritten,
)
from rosproxy.shared.addresses import HostPort, is_ipv6_link_local, is_loopback

DISPOSE_MESSAGE_INTERVAL_S = 2.0
"""Seconds from a dispose message to the next, for the same participant inside and the same
participant outside. The proxy repeats the message until the two have rediscovered each other."""


@dataclass(slots=True)
class ForInside:
    """Rewrites the discovery of a participant outside for inside.

    ``near`` is the address at which inside reaches the proxy. ``insider`` is the participant whose
    policy applies; with None nothing is hidden. Nothing is hidden from the discovery participant,
    which would request hidden announcements again and again.
    """

    outside: OutsideParticipants
    outsider: OutsideParticipant
    near: str
    insider: InsideParticipant | None = None

    def rewritten(self, message: DiscoveryMessage) -> bytes:
        """A message as inside receives it, with its readers and writers noted. Raises RtpsError."""
        datagram = message.datagram
        note_endpoints(self.outside.notes, self.outsider, datagram, message.announcements)
        has_source = self.outsider.address in set(_user_data_hosts(message))
        return rewritten(
            message,
            lambda pid, locator: self._inside_target(pid, locator, has_source),
            lambda announcement: self._is_hidden(announcement, datagram),
        )

    def _inside_target(self, pid: int, locator: HostPort, has_source: bool) -> HostPort | None:
        """The address at which inside reaches a locator of the participant; None if there is none.

        ``has_source`` means that the message has a locator for user data at the source address of
        the participant.
        """
        stand_ins = self.outside.stand_ins
        if pid == Pid.METATRAFFIC_UNICAST_LOCATOR:
            # All metatraffic goes to the locator at the source address of the participant.
            mapping = self.outsider.metatraffic and stand_ins.open(
                self.outsider, self.outsider.metatraffic, TrafficKind.METATRAFFIC
            )
        elif not self.outside.settings.both_ways:
            return None if self._means_another(locator, has_source) else locator
        else:
            may_open = locator.host == self.outsider.address and not stand_ins.is_own_port(locator)
            mapping = (
                stand_ins.open(self.outsider, locator, TrafficKind.USER_DATA) if may_open else None
            )
        return HostPort(self.near, mapping.port) if mapping else None

    def _means_another(self, locator: HostPort, has_source: bool) -> bool:
        """Whether a locator may lead inside to another machine.

        Without a locator at its source (``has_source``), the participant seems to be behind NAT,
        and its locators stay. Locators of the address family in which the participant was not heard
        stay, too. Loopback and link-local addresses never stay, unless both participants run on the
        proxy's machine.
        """
        source = self.outsider.address
        host = locator.host
        if has_source and (":" in host) == (":" in source) and host != source:
            return True
        # These addresses lead to the machine or the link of the receiver.
        is_same_host = is_loopback(self.near) and is_loopback(source)
        return not is_same_host and (is_loopback(host) or is_ipv6_link_local(host))

    def _is_hidden(self, announcement: Announcement, datagram: bytes) -> bool:
        if self.insider is None:
            return False
        verdicts = self.outside.verdicts
        return verdicts.is_hidden(self.insider, announcement, datagram, is_own=False)


@dataclass(frozen=True, slots=True)
class AnnouncementsToInside:
    """The announcements and dispose messages that participants inside receive."""

    settings: DomainSettings
    inside: InsideParticipants
    outside: OutsideParticipants

    def of_outside(
        self,
        outside: Iterable[OutsideParticipant],
        inside: Collection[InsideParticipant],
        now: float,
    ) -> list[Outgoing]:
        """The announcements of participants outside for participants inside.

        Left out are separated participants inside, and participants outside that the proxy does not
        announce (`OutsideParticipants.may_be_announced`). If a participant inside has to forget a
        participant outside, a dispose message precedes the announcement.
        """
        sent = list[Outgoing]()
        outsiders = list(filter(self.outside.may_be_announced, outside))
        by_near = dict[str, list[InsideParticipant]]()
        for insider in inside if outsiders else ():
            if insider.metatraffic and not insider.is_separated:
                near = self.settings.proxy_address_for(insider.address)
                by_near.setdefault(near, []).append(insider)
        for outsider in outsiders:
            for near, receivers in by_near.items():
                datagram = self._announcement(outsider, near)
                for insider in receivers:
                    sent += self.dispose_message(outsider, insider, now)
                    sent += sent_to(insider.metatraffic, [datagram])
        return sent

    def dispose_message(
        self, outsider: OutsideParticipant, insider: InsideParticipant, now: float
    ) -> list[Outgoing]:
        """The dispose message with which a participant inside forgets a participant outside.

        Empty without a rediscovery, and if the last such message is more recent than
        `DISPOSE_MESSAGE_INTERVAL_S`.
        """
        if (
            insider.dispose_message_times is None
            or now - insider.dispose_message_times.get(outsider.prefix, -inf)
            < DISPOSE_MESSAGE_INTERVAL_S
        ):
            return []
        insider.dispose_message_times[outsider.prefix] = now
        datagram = dispose_message(outsider.prefix, outsider.vendor, outsider.next_number)
        return sent_to(insider.metatraffic, [datagram])

    def of_neighbour(
        self, newcomer: InsideParticipant, message: DiscoveryMessage
    ) -> list[Outgoing]:
        """The unchanged announcement of a participant inside, for others on the same network.

        Empty if the announcement came by multicast: these participants reach each other without the
        proxy. The processes of a pod share an address and need this announcement, because Fast DDS
        sends no multicast if it has peers. A participant may announce an address of the proxy as a
        locator. So nothing goes to the ports at which the proxy itself receives announcements.
        """
        if newcomer.is_in_group:
            return []
        near = newcomer.proxy_address
        settings = self.settings
        own = {HostPort(near, p) for p in (settings.unicast_port, settings.multicast_port)}
        announcement = addressed_to_all(message.datagram)
        return [
            Outgoing(p.metatraffic, announcement)
            for p in self.inside.by_prefix.values()
            if p.proxy_address == near
            and p is not newcomer
            # The participants of a Cyclone DDS process share a locator, and know each other.
            and p.metatraffic
            and p.metatraffic not in {newcomer.metatraffic, *own}
        ]

    def _announcement(self, outsider: OutsideParticipant, near: str) -> bytes:
        """The announcement of a participant for receivers that reach the proxy at ``near``.

        The result is kept for all these receivers, because rewriting many parameters takes a
        millisecond. Of all results, at most LONGEST_SPDP_DATAGRAM_BYTES are kept. Raises RtpsError.
        """
        kept = outsider.announcements_inside
        datagram = kept.get(near)
        if datagram is None:
            for_inside = ForInside(self.outside, outsider, near)
            datagram = for_inside.rewritten(read_discovery(outsider.announcement))
            if sum(map(len, kept.values())) + len(datagram) > LONGEST_SPDP_DATAGRAM_BYTES:
                kept.clear()
            kept[near] = datagram
        return datagram


def _user_data_hosts(message: DiscoveryMessage) -> Iterator[str]:
    """Yield the hosts of all locators for user data in a message."""
    for announcement in message.announcements:
        for pid, locator in announcement.reached_at(message.datagram):
            if pid != Pid.METATRAFFIC_UNICAST_LOCATOR:
                yield locator.host
