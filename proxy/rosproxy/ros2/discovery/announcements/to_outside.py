"""Announcements to outside: which ports replace the locators of a participant inside.

The proxy replaces each locator of a participant inside by the advertised host and a port of the
range, and removes a locator that has no port. The announcement goes to the peers and the LAN relay.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.domain_settings import MOST_TRIED, NEXT_PORTS, DomainSettings, Outgoing
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.registry.participants import InsideParticipant, TrafficKind
from rosproxy.ros2.rewriting.announced_participant import note_endpoints
from rosproxy.ros2.rewriting.discovery import Announcement, DiscoveryMessage, rewritten
from rosproxy.shared.addresses import HostPort

REPEAT_INTERVAL_S = 0.5
"""Seconds in which the proxy sends the same announcement to outside only once."""


@dataclass(slots=True)
class ForOutside:
    """Rewrites the discovery of a participant inside for outside.

    ``former_ports`` are the ports that the participant had before the proxy started, as far as
    these are known, in the order of its locators. ``is_hiding`` means that the policy applies.
    Nothing is hidden from the discovery participant, which would request hidden announcements again
    and again.
    """

    inside: InsideParticipants
    insider: InsideParticipant
    now: float
    former_ports: Sequence[int] = ()
    is_hiding: bool = True

    def rewritten(self, message: DiscoveryMessage) -> bytes:
        """A message as outside receives it, with its readers and writers noted. Raises RtpsError.

        Maps a port to each locator that has none.
        """
        datagram = message.datagram
        note_endpoints(self.inside.notes, self.insider, datagram, message.announcements)
        return rewritten(
            message,
            self._outside_target,
            lambda announcement: self._is_hidden(announcement, datagram),
        )

    def _outside_target(self, pid: int, locator: HostPort) -> HostPort | None:
        """The address and port at which outside reaches a locator; None if there is no port."""
        is_metatraffic = pid == Pid.METATRAFFIC_UNICAST_LOCATOR
        kind = TrafficKind.METATRAFFIC if is_metatraffic else TrafficKind.USER_DATA
        mappings = self.inside.mappings
        return mappings.advertised(self.insider, locator, kind, self.former_ports, self.now)

    def _is_hidden(self, announcement: Announcement, datagram: bytes) -> bool:
        verdicts = self.inside.verdicts
        return self.is_hiding and verdicts.is_hidden(
            self.insider, announcement, datagram, is_own=True
        )


@dataclass(frozen=True, slots=True)
class AnnouncementsToOutside:
    """The announcements that outside receives."""

    settings: DomainSettings
    outside: OutsideParticipants

    def of_inside(
        self, insider: InsideParticipant, announcement: bytes, now: float
    ) -> list[Outgoing]:
        """The datagrams that announce a participant inside to outside.

        Empty if the same announcement has just been sent (`REPEAT_INTERVAL_S`). While many
        participants discover each other, each repeats its announcement, and each repetition goes to
        many ports of the peers. Empty during a separation, too.
        """
        if announcement == insider.announcement and now - insider.announced_at < REPEAT_INTERVAL_S:
            return []
        is_first = not insider.announcement
        insider.announcement = announcement
        insider.announced_at = now
        if insider.separated_until:
            return []
        if is_first:
            return self.settings.to_outside(announcement)
        return self._to_known_targets(announcement)

    def _to_known_targets(self, datagram: bytes) -> list[Outgoing]:
        """The datagrams for an announcement of a participant inside that is not the first.

        For a peer without a port, the announcement goes to the locators of known participants, and
        to the next well-known ports, which participants bind one after the other (DDSI-RTPS 2.5,
        9.6.2.3). Participants at other ports are discovered all the same, because the discovery
        participant announces itself to all ports of the peers. If no participant of a peer is
        known, the announcement goes to all its well-known ports.
        """
        sent = self.settings.to_lan(datagram)
        for peer in self.settings.peers:
            count = self.outside.count_by_address[peer.host]
            if peer.port:
                targets = [peer]
            elif not count:
                targets = self.settings.well_known_of_peer(peer.host)
            else:
                targets = self._known_targets(peer.host, count)
            sent += [Outgoing(target, datagram) for target in targets]
        return sent

    def _known_targets(self, host: str, count: int) -> list[HostPort]:
        """The next well-known ports of a host, and the locators of its known participants."""
        met = (participant.metatraffic for participant in self.outside.at(host))
        next_ports = self.settings.well_known(host, min(count + NEXT_PORTS, MOST_TRIED))
        return list(dict.fromkeys([*next_ports, *filter(None, met)]))
