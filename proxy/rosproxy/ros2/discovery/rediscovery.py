"""Rediscovery: a participant inside and the participants outside discover each other anew.

A writer does not repeat a sample that a reader has confirmed (DDSI-RTPS 2.5, 8.4.9). So before two
participants can exchange all announcements again, each has to forget the other.

Suppose participant A forgets B first. A begins anew, and B confirms the samples of A from memory.
Then B forgets A, but A does not repeat confirmed samples. B never discovers the readers and writers
of A. So the proxy *separates* the two for a moment: it sends both a dispose message for the other,
and passes no discovery between them. Only then the proxy announces each to the other.

The proxy separates participants in three cases: a verdict of the policy has changed, outside knows
other ports or another address of a participant (`FormerPorts`), or the advertised host has moved.
In the second case, the separation waits for the first datagram of the LAN relay, which starts after
the proxy. Before that, outside would not receive the dispose message.

While many participants rediscover each other, datagrams are lost. So the proxy repeats the dispose
message of a participant outside with each of its announcements. The repetition ends when the
participant inside sends a datagram to the present stand-in.

Hundreds of participants inside may have to rediscover hundreds outside, which takes many seconds.
So the proxy makes a few dispose messages and announcements at a time (`next_datagrams`). The
addresses inside take turns.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import inf
from typing import Final

from rosproxy.ros2.discovery.announcements.to_inside import AnnouncementsToInside
from rosproxy.ros2.discovery.participants.inside import InsideParticipants
from rosproxy.ros2.discovery.participants.outside import OutsideParticipants
from rosproxy.ros2.domain_settings import MOST_DATAGRAMS_PER_PART, DomainSettings, Outgoing
from rosproxy.ros2.protocol.announcement import dispose_message
from rosproxy.ros2.protocol.rtps import RtpsError
from rosproxy.ros2.registry.participants import InsideParticipant, OutsideParticipant
from rosproxy.ros2.rewriting.discovery import read_discovery, rewritten
from rosproxy.shared.addresses import HostPort

SEPARATION_S = 0.4
"""Seconds in which a dispose message arrives and takes effect on both sides."""
MOST_VERDICTS_PER_PART = 32
"""Verdicts that the policy judges again at a time. With 1,000 rules a verdict takes 0.7 ms."""
MOST_PAIRS_PER_PART = 32
"""Pairs of a participant inside and one outside that are handled at a time. A pair takes 0.1 ms."""
_NO_VERDICT: Final = "no verdict is left"
LAN_RELAY_TIMEOUT_S = 30.0
"""Seconds for which a separation waits for the LAN relay. If no participant is on its LAN, the
relay sends nothing."""


@dataclass(slots=True)
class Rediscovery:
    """Separates participants inside from all outside, and then announces each to the other."""

    settings: DomainSettings
    inside: InsideParticipants
    outside: OutsideParticipants
    to_inside: AnnouncementsToInside
    lan_relay_heard: bool = False
    _due: deque[InsideParticipant] = field(default_factory=deque)
    """Participants inside that `proceed` has to look at."""
    _waiting: dict[str, dict[bytes, Iterator[list[Outgoing]]]] = field(default_factory=dict)
    """Work for participants inside, by their address and prefix. A step of an iterator makes the
    datagrams of a pair of participants."""
    _review: Iterator[InsideParticipant | None] = field(default_factory=lambda: iter(()))
    _has_verdicts: bool = False
    _now: float = 0.0

    def separate(self, insider: InsideParticipant) -> list[Outgoing]:
        """Let a participant inside and all participants outside forget each other.

        Return the datagrams for outside. `next_datagrams` has the datagrams for inside.
        """
        datagram = dispose_message(insider.prefix, insider.vendor, insider.next_number)
        insider.separation_due_from = None
        insider.separated_until = inf  # until the last dispose message
        insider.dispose_message_times = {}  # no dispose message has been sent yet
        outsiders = [o for o in self.outside.by_prefix.values() if o.is_announced]
        self._put(insider, self._dispose_messages(insider, outsiders))
        return self.settings.to_outside(datagram)

    def review(self) -> None:
        """Start to judge all verdicts again. A changed verdict leads to a separation."""
        self._review = self.inside.verdicts.review(list(self.inside.by_prefix.values()))
        self._has_verdicts = True

    @property
    def is_busy(self) -> bool:
        """Whether participants, verdicts, dispose messages or announcements wait."""
        return self._has_verdicts or bool(self._due) or bool(self._waiting)

    def look_for_due(self) -> None:
        """Start to look for separations that are due or over. Calls come twice a second."""
        self._due = deque(self.inside.by_prefix.values())

    def next_datagrams(self, now: float) -> list[Outgoing]:
        """The datagrams of the next part of the work, for outside and inside."""
        self._now = now
        sent = list[Outgoing]()
        while self._due and len(sent) < MOST_DATAGRAMS_PER_PART:
            sent += self._proceed_known(self._due.popleft())
        sent += self._next_verdicts(MOST_DATAGRAMS_PER_PART - len(sent))
        for _ in range(MOST_PAIRS_PER_PART):
            if not self._waiting or len(sent) >= MOST_DATAGRAMS_PER_PART:
                break
            sent += self._next_pair()
        return sent

    def move(self, insider: InsideParticipant) -> list[Outgoing]:
        """Separate a participant, and announce it later at the present addresses of the proxy.

        Return the datagrams for outside. Raises RtpsError.
        """
        message = read_discovery(insider.announcement)
        insider.announcement = rewritten(message, self._at_present_host, lambda _: False)
        return self.separate(insider)

    def proceed(self, insider: InsideParticipant, now: float) -> list[Outgoing]:
        """Separate a participant if this is due, or announce it after the separation."""
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
        """Note that a participant inside has sent a datagram to a participant outside.

        So the participant inside knows the present stand-in of the participant outside, which has
        the GUID prefix ``prefix``.
        """
        if insider.dispose_message_times is not None and prefix in insider.dispose_message_times:
            insider.dispose_message_times[prefix] = inf

    def forget_inside(self, insider: InsideParticipant) -> None:
        """Drop the work for a participant inside."""
        waiting = self._waiting.get(insider.address, {})
        waiting.pop(insider.prefix, None)
        if not waiting:
            self._waiting.pop(insider.address, None)

    def forget(self, insiders: Iterable[InsideParticipant], prefix: bytes) -> None:
        """Forget the times of dispose messages for a participant outside that has gone."""
        for insider in insiders:
            if insider.dispose_message_times is not None:
                insider.dispose_message_times.pop(prefix, None)

    def _proceed_known(self, insider: InsideParticipant) -> list[Outgoing]:
        """`proceed` with a participant, unless the participant has gone."""
        if self.inside.by_prefix.get(insider.prefix) is not insider:
            return []
        return self.proceed(insider, self._now)

    def _next_verdicts(self, most: int) -> list[Outgoing]:
        """Judge the next verdicts, until changed verdicts lead to at least ``most`` datagrams."""
        sent = list[Outgoing]()
        judged = 0
        while self._has_verdicts and judged < MOST_VERDICTS_PER_PART and len(sent) < most:
            insider = next(self._review, _NO_VERDICT)
            self._has_verdicts = insider is not _NO_VERDICT
            if isinstance(insider, InsideParticipant):
                sent += self._separate_known(insider)
            judged += 1
        return sent

    def _separate_known(self, insider: InsideParticipant) -> list[Outgoing]:
        """Separate a participant and forget its verdicts, unless the participant has gone."""
        if self.inside.by_prefix.get(insider.prefix) is not insider:
            return []
        self.inside.verdicts.forget(insider)
        return self.separate(insider)

    def _next_pair(self) -> list[Outgoing]:
        """The datagrams for the next pair of participants, at the address whose turn it is."""
        address = next(iter(self._waiting))
        waiting = self._waiting.pop(address)
        prefix, steps = next(iter(waiting.items()))
        sent = next(steps, None)
        if sent is None:
            del waiting[prefix]
        if waiting:
            self._waiting[address] = waiting  # at the end: the other addresses have turns first
        return sent or []

    def _put(self, insider: InsideParticipant, steps: Iterator[list[Outgoing]]) -> None:
        self.forget_inside(insider)  # a participant may change its ports again and again
        self._waiting.setdefault(insider.address, {})[insider.prefix] = steps

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
                continue  # the participant has gone meanwhile
            try:
                yield self.to_inside.of_outside([outsider], [insider], self._now)
            except RtpsError as error:
                self.outside.refused("malformed", outsider.address, str(error))

    def _at_present_host(self, _: int, locator: HostPort) -> HostPort:
        return HostPort(self.settings.host_for(locator.host), locator.port)

    def _may_separate(self, waits_from: float, now: float) -> bool:
        no_lan_relay = self.settings.relay is None
        return no_lan_relay or self.lan_relay_heard or now - waits_from >= LAN_RELAY_TIMEOUT_S
