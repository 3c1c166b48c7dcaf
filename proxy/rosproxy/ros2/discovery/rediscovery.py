"""Having a participant inside and those outside meet anew.

A writer does not send again what a reader has confirmed (DDSI-RTPS 2.5, 8.4.9). So where two that
know each other are to learn all of each other once more, both have to forget before either hears
of the other. Else the one that still remembers confirms what the other begins anew, and is not sent
it once it has forgotten as well: they never find each other's readers and writers. So the two are
kept *apart* for a moment: both are told that the other has ended, nothing of discovery passes, and
only then are they introduced.

This is for participants whose policy has changed, and for those that knew the proxy at another
address, as `Returning` says. The latter wait until the ear has been heard, which starts after the
proxy: before that, outside would not hear that they have ended. Participants are told again, with
each announcement from outside, until they send something to where outside is found now: while so
many meet, not every datagram arrives.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.announced_participant import next_number
from rosproxy.ros2.discovery.domain_settings import DomainSettings, Outgoing
from rosproxy.ros2.discovery.outside_participants import OutsideParticipants
from rosproxy.ros2.protocol.announcement import farewell
from rosproxy.ros2.registry.participants import InsideParticipant
from rosproxy.ros2.rewriting.discovery import read_discovery, rewritten

APART_TIME = 0.4
"""Seconds in which a farewell arrives, and is taken in, on both sides."""
EAR_TIME = 30.0
"""Seconds that the ear may take to be heard; the wait is in vain if nobody is on its LAN."""


@dataclass(slots=True)
class Rediscovery:
    """Parts participants inside from all outside, and introduces them again."""

    settings: DomainSettings
    outside: OutsideParticipants
    ear_heard: bool = False

    def separate(self, insider: InsideParticipant, now: float) -> list[Outgoing]:
        """Have a participant inside and all outside forget each other. Raises RtpsError."""
        insider.parting_from, insider.apart_until, insider.farewell_times = (
            None,
            now + APART_TIME,
            {},  # it was not told to forget anybody yet
        )
        datagram = farewell(insider.prefix, insider.vendor, next_number(insider.announcement))
        outsiders = [o for o in self.outside.by_prefix.values() if o.is_introduced]
        inwards = [sent for o in outsiders for sent in self.outside.farewell_to(o, insider, now)]
        return inwards + self.settings.to_outside(datagram)

    def move(self, insider: InsideParticipant, now: float) -> list[Outgoing]:
        """Announce a participant at the present addresses of the advertised host. RtpsError.

        All outside have to meet it anew.
        """
        message = read_discovery(insider.announcement)
        insider.announcement = rewritten(message, self._at_present_host, lambda _: False)
        return self.separate(insider, now)

    def proceed(self, insider: InsideParticipant, now: float) -> list[Outgoing]:
        """Part one that has waited, or introduce one that is apart for long enough. RtpsError."""
        if insider.parting_from is not None and self._may_part(insider.parting_from, now):
            return self.separate(insider, now)
        if insider.apart_until is None or now < insider.apart_until:
            return []
        insider.apart_until = None
        sent = self.settings.to_outside(insider.announcement)
        return sent + self.outside.introduced(self.outside.by_prefix.values(), [insider], now)

    def note_met(self, insider: InsideParticipant, prefix: bytes) -> None:
        """Note that a participant inside has sent something to where one outside is found now."""
        if insider.farewell_times is not None and prefix in insider.farewell_times:
            insider.farewell_times[prefix] = inf

    def forget(self, insiders: Iterable[InsideParticipant], prefix: bytes) -> None:
        """Forget that those inside were told to forget a participant outside, which has gone."""
        for insider in insiders:
            if insider.farewell_times is not None:
                insider.farewell_times.pop(prefix, None)

    def _at_present_host(self, _: int, locator: HostPort) -> HostPort:
        return HostPort(self.settings.host_for(locator.host), locator.port)

    def _may_part(self, waits_from: float, now: float) -> bool:
        no_ear = self.settings.relay is None
        return no_ear or self.ear_heard or now - waits_from >= EAR_TIME
