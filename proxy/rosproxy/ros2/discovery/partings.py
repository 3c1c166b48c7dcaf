"""Having a participant inside and those outside meet anew.

A writer sends nobody again what he has confirmed (DDSI-RTPS 2.5, 8.4.9). So where two that know
each other are to learn all of each other once more, both have to forget before either of them hears
of the other. Else the one that still knows confirms what the other begins anew, and is not sent it
when he has forgotten as well: they never find each other's readers and writers. So the two are kept
*apart* for a moment: both are told that the other has ended, nothing of discovery passes, and only
then are they introduced.

This is for those whose policy has changed, and for those that knew the proxy at another address,
as `Returning` says. These wait until the ear has been heard, which starts after the proxy: before
that, outside would not hear that they have ended. And they are told again, with each announcement
from outside, until they send something to where outside is found now: while so many meet, not every
datagram arrives.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf

from rosproxy.ros2.discovery.announced import next_number
from rosproxy.ros2.discovery.domain_settings import DomainSettings, Outgoing
from rosproxy.ros2.discovery.outside import OutsideParticipants
from rosproxy.ros2.protocol.announcement import farewell
from rosproxy.ros2.registry.participants import InsideParticipant

APART = 0.4
"""Seconds in which a farewell arrives, and is taken in, on both sides."""
EAR_TIME = 30.0
"""Seconds that the ear may take to be heard; the wait is in vain if nobody is on its LAN."""


@dataclass(slots=True)
class Partings:
    """Parts participants inside from all outside, and introduces them again."""

    settings: DomainSettings
    outside: OutsideParticipants
    ear_heard: bool = False

    def part(self, one: InsideParticipant, now: float) -> list[Outgoing]:
        """Have one inside and all outside forget each other."""
        one.parting_from, one.apart_until, one.parted = None, now + APART, {}
        told = farewell(one.prefix, one.vendor, next_number(one.announcement))
        everybody = self.outside.by_prefix.values()
        inwards = [sent for there in everybody for sent in self.outside.parting(there, one, now)]
        return inwards + self.settings.to_outside(told)

    def go_on(self, everybody: Iterable[InsideParticipant], now: float) -> list[Outgoing]:
        """Part those that have waited, and introduce those that are apart for long enough."""
        sent = list[Outgoing]()
        for one in everybody:
            if one.parting_from is not None and self._may_part(one.parting_from, now):
                sent += self.part(one, now)
            elif one.apart_until is not None and now >= one.apart_until:
                one.apart_until = None
                sent += self.settings.to_outside(one.announcement)
                sent += self.outside.introduced(self.outside.by_prefix.values(), [one], now)
        return sent

    def note_met(self, one: InsideParticipant, there: bytes) -> None:
        """Note that one inside has sent something to where one outside is found now."""
        if one.parted is not None and there in one.parted:
            one.parted[there] = inf

    def forget(self, everybody: Iterable[InsideParticipant], there: bytes) -> None:
        """Forget whom those inside were told to forget: one outside that has gone."""
        for one in everybody:
            if one.parted is not None:
                one.parted.pop(there, None)

    def _may_part(self, waits_from: float, now: float) -> bool:
        no_ear = self.settings.ear is None
        return no_ear or self.ear_heard or now - waits_from >= EAR_TIME
