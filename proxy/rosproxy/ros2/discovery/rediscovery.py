"""Rediscovery: a participant inside and the participants outside discover each other anew.

A writer does not send again what a reader has confirmed (DDSI-RTPS 2.5, 8.4.9). So before two
participants can learn all of each other once more, both have to forget the other. If one of the two
forgets later, it confirms from memory what the other begins anew, and is not sent it again once it
has forgotten as well. The two then never find each other's readers and writers. So the proxy
*separates* them for a moment: it tells both that the other has ended, and passes no discovery
between them. Only then it announces each to the other.

The proxy does so if a verdict of the policy has changed, if outside knows a participant by other
ports or at another address (`FormerPorts`), and if the advertised host has moved. The separation
waits for the first datagram of the LAN relay, which starts after the proxy: before that, outside
would not hear that the participant has ended. While so many participants discover each other, not
every datagram arrives. So a participant inside is told again to forget one outside, with each
announcement of the latter, until it sends something to where the proxy announces this one now.

Hundreds inside may have to rediscover hundreds outside, which takes many seconds. So dispose
messages and announcements wait, and are made a few at a time (`next_datagrams`). Addresses inside
take turns.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from math import inf

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery.announcements.to_inside import AnnouncementsToInside
from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.domain_settings import DomainSettings, Outgoing
from rosproxy.ros2.protocol.announcement import dispose_message
from rosproxy.ros2.protocol.rtps import RtpsError
from rosproxy.ros2.registry.participants import InsideParticipant, OutsideParticipant
from rosproxy.ros2.rewriting.discovery import read_discovery, rewritten

SEPARATION_S = 0.4
"""Seconds in which a dispose message arrives, and is taken in, on both sides."""
VERDICTS_AT_ONCE = 32
"""Verdicts that are judged again at a time. With 1,000 rules one takes 0.7 ms."""
PAIRS_AT_ONCE = 32
"""Participants outside that participants inside are told of at a time. One takes 0.1 ms."""
LAN_RELAY_TIME = 30.0
"""Seconds that the LAN relay may take to be heard. Without a participant on its LAN it is not."""


@dataclass(slots=True)
class Rediscovery:
    """Separates participants inside from all outside, and announces them to each other again."""

    settings: DomainSettings
    inside: InsideParticipants
    outside: OutsideParticipants
    to_inside: AnnouncementsToInside
    lan_relay_heard: bool = False
    _waiting: dict[str, deque[Iterator[list[Outgoing]]]] = field(default_factory=dict)
    """What is sent inwards, by the address of the participant inside."""
    _review: Iterator[InsideParticipant | None] = field(default_factory=lambda: iter(()))
    _has_verdicts: bool = False
    _now: float = 0.0

    def separate(self, insider: InsideParticipant) -> list[Outgoing]:
        """Have a participant inside and all outside forget each other."""
        datagram = dispose_message(insider.prefix, insider.vendor, insider.next_number)
        insider.separation_due_from = None
        insider.separated_until = inf  # until the last dispose message
        insider.dispose_message_times = {}  # it was told to forget no participant yet
        outsiders = [o for o in self.outside.by_prefix.values() if o.is_announced]
        self._put(insider, self._dispose_messages(insider, outsiders))
        return self.settings.to_outside(datagram)

    def review(self) -> None:
        """Separate the participants inside of which the policy says something else than before."""
        self._review = self.inside.verdicts.review(list(self.inside.by_prefix.values()))
        self._has_verdicts = True

    @property
    def is_busy(self) -> bool:
        """Whether verdicts, dispose messages or announcements wait."""
        return self._has_verdicts or bool(self._waiting)

    def next_datagrams(self, now: float) -> list[Outgoing]:
        """What the next part of what waits leads to."""
        self._now = now
        verdicts = list(islice(self._review, VERDICTS_AT_ONCE))
        self._has_verdicts = len(verdicts) == VERDICTS_AT_ONCE
        sent = [out for insider in filter(None, verdicts) for out in self._separate_known(insider)]
        for _ in range(PAIRS_AT_ONCE):
            if not self._waiting:
                break
            sent += self._next_pair()
        return sent

    def move(self, insider: InsideParticipant) -> list[Outgoing]:
        """Announce a participant at the present addresses of the advertised host. RtpsError.

        All outside have to meet it anew.
        """
        message = read_discovery(insider.announcement)
        insider.announcement = rewritten(message, self._at_present_host, lambda _: False)
        return self.separate(insider)

    def proceed(self, insider: InsideParticipant, now: float) -> list[Outgoing]:
        """Separate a participant if that is due, or announce it after the separation."""
        if insider.separation_due_from is not None and self._may_separate(
            insider.separation_due_from, now
        ):
            return self.separate(insider)
        if insider.separated_until is None or now < insider.separated_until:
            return []
        insider.separated_until = None
        self._put(insider, self._announcements(insider, list(self.outside.by_prefix.values())))
        return self.settings.to_outside(insider.announcement)

    def note_met(self, insider: InsideParticipant, prefix: bytes) -> None:
        """Note that a participant inside has sent something to where one outside is found now."""
        if insider.dispose_message_times is not None and prefix in insider.dispose_message_times:
            insider.dispose_message_times[prefix] = inf

    def forget(self, insiders: Iterable[InsideParticipant], prefix: bytes) -> None:
        """Forget that those inside were told to forget a participant outside, which has gone."""
        for insider in insiders:
            if insider.dispose_message_times is not None:
                insider.dispose_message_times.pop(prefix, None)

    def _separate_known(self, insider: InsideParticipant) -> list[Outgoing]:
        """Separate a participant unless it has gone. The policy is asked about it anew then."""
        if self.inside.by_prefix.get(insider.prefix) is not insider:
            return []
        self.inside.verdicts.forget(insider)
        return self.separate(insider)

    def _next_pair(self) -> list[Outgoing]:
        """What the next participant outside leads to, for one at the address whose turn it is."""
        address = next(iter(self._waiting))
        waiting = self._waiting.pop(address)
        sent = next(waiting[0], None)
        if sent is None:
            waiting.popleft()
        if waiting:
            self._waiting[address] = waiting  # the other addresses have their turns first
        return sent or []

    def _put(self, insider: InsideParticipant, steps: Iterator[list[Outgoing]]) -> None:
        self._waiting.setdefault(insider.address, deque()).append(steps)

    def _dispose_messages(
        self, insider: InsideParticipant, outsiders: Iterable[OutsideParticipant]
    ) -> Iterator[list[Outgoing]]:
        for outsider in outsiders:
            yield self.to_inside.dispose_message(outsider, insider, self._now)
        if insider.separated_until == inf:
            insider.separated_until = self._now + SEPARATION_S

    def _announcements(
        self, insider: InsideParticipant, outsiders: Iterable[OutsideParticipant]
    ) -> Iterator[list[Outgoing]]:
        for outsider in outsiders:
            if self.outside.by_prefix.get(outsider.prefix) is not outsider:
                continue  # it has gone meanwhile
            try:
                yield self.to_inside.of_outside([outsider], [insider], self._now)
            except RtpsError as error:
                self.outside.refused("malformed", outsider.address, str(error))

    def _at_present_host(self, _: int, locator: HostPort) -> HostPort:
        return HostPort(self.settings.host_for(locator.host), locator.port)

    def _may_separate(self, waits_from: float, now: float) -> bool:
        no_lan_relay = self.settings.relay is None
        return no_lan_relay or self.lan_relay_heard or now - waits_from >= LAN_RELAY_TIME
