"""The policy in discovery: the proxy hides denied readers and writers from the other side.

So a denied reader or writer never matches, and ignores data that is sent to it. When the policy
changes, the participants inside with a changed verdict rediscover the participants outside.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from rosproxy.ros2.domain_settings import Judge
from rosproxy.ros2.policy.rules import rule_about
from rosproxy.ros2.registry.participants import InsideParticipant
from rosproxy.ros2.rewriting.discovery import Announcement
from rosproxy.shared.policy.rules import RuleKind

MOST_VERDICTS = 1024
"""The highest number of remembered verdicts of a participant; a participant has some hundreds. A
participant with more verdicts is rediscovered after each change of the policy."""
MOST_VERDICTS_PER_ADDRESS = 16_384
"""The highest number of remembered verdicts of all participants at an address."""
MOST_VERDICTS_IN_ALL = 32_768
"""The highest number of remembered verdicts of all participants."""
LONGEST_NAME = 256
"""The highest number of characters of a name whose verdict is remembered. A topic of ROS 2 has at
most 255. The name must be ASCII, as names of ROS 2 are: one wide character makes all characters
take four bytes."""


@dataclass(slots=True)
class Verdicts:
    """Judges topics and services for participants inside. Remembers the verdicts within bounds."""

    judge: Judge
    count_by_address: Counter[str] = field(default_factory=Counter)

    def is_hidden(
        self, inside: InsideParticipant, announcement: Announcement, datagram: bytes, is_own: bool
    ) -> bool:
        """Whether the policy hides an announcement.

        ``inside`` is the participant inside: the sender of the announcement if ``is_own`` is set,
        and the receiver otherwise.
        """
        # An end has the key of a reader or writer, and no topic, so no rule applies. If there is a
        # topic, the policy applies, because a receiver may not consider the announcement an end: a
        # receiver may read another one of several statuses, or another flag.
        topic = announcement.topic(datagram)
        if announcement.kind is None or (announcement.ended and not topic):
            return False
        rule = rule_about(announcement.kind, topic, is_own)
        return rule is not None and not self._is_allowed(inside, rule)

    def review(self, insiders: Iterable[InsideParticipant]) -> Iterator[InsideParticipant | None]:
        """Judge the verdicts of participants again, one in each step.

        Yield each participant with a changed verdict, or with more verdicts than are remembered.
        Yield None for each unchanged verdict. The steps are small, because a participant may have a
        thousand verdicts, and a policy a thousand rules.
        """
        for insider in insiders:
            if insider.has_more_verdicts:
                yield insider
                continue
            for rule, allowed in list(insider.verdicts.items()):
                if self.judge(*rule, insider.address) is not allowed:
                    yield insider
                    break
                yield None

    def forget(self, inside: InsideParticipant) -> None:
        """Forget all verdicts of a participant."""
        self.count_by_address -= Counter({inside.address: len(inside.verdicts)})
        inside.verdicts.clear()
        inside.has_more_verdicts = False

    def _is_allowed(self, inside: InsideParticipant, rule: tuple[RuleKind, str]) -> bool:
        known = inside.verdicts.get(rule)
        if known is not None:
            return known
        allowed = self.judge(*rule, inside.address)
        _, name = rule
        if len(name) <= LONGEST_NAME and name.isascii() and self._has_room(inside):
            inside.verdicts[rule] = allowed
            self.count_by_address[inside.address] += 1
        else:
            inside.has_more_verdicts = True
        return allowed

    def _has_room(self, inside: InsideParticipant) -> bool:
        return (
            len(inside.verdicts) < MOST_VERDICTS
            and self.count_by_address[inside.address] < MOST_VERDICTS_PER_ADDRESS
            and self.count_by_address.total() < MOST_VERDICTS_IN_ALL
        )
