"""The policy over discovery: a reader or writer that it denies is not told to the other side.

So the two ends never match, and don't take what is sent to them nevertheless. When the policy
changes, it is applied by having the participant and those of the other side lose sight of each
other, and meet again: only for participants inside for which a verdict has changed.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from rosproxy.access.rules import RuleKind
from rosproxy.ros2.domain_settings import Judge
from rosproxy.ros2.policy.rules import rule_about
from rosproxy.ros2.registry.participants import InsideParticipant
from rosproxy.ros2.rewriting.discovery import Announcement

MOST_VERDICTS = 1024
MOST_VERDICTS_PER_ADDRESS = 16_384
MOST_VERDICTS_IN_ALL = 32_768
"""Verdicts that are remembered of a participant, at an address, and in all; a participant has some
hundreds. One that has more meets others anew with each change of the policy."""
LONGEST_NAME = 256
"""Characters of a name that is remembered with its verdict; all are of ASCII, as in ROS 2. One wide
character would make each take four bytes. A topic of ROS 2 has 255 at most."""


@dataclass(slots=True)
class Verdicts:
    """Judges topics and services of participants inside, and remembers verdicts within bounds."""

    judge: Judge
    count_by_address: Counter[str] = field(default_factory=Counter)

    def is_hidden(
        self, inside: InsideParticipant, announcement: Announcement, datagram: bytes, is_own: bool
    ) -> bool:
        """Whether an announcement is not to be passed on.

        ``inside`` is the participant that makes it, if it ``is_own``, else the one that is to get
        it.
        """
        # An end names the key of a reader or writer, and no topic to judge it by. What names a
        # topic others may not take for an end: they read the last status of several, or another
        # flag.
        topic = announcement.topic(datagram)
        if announcement.kind is None or (announcement.ended and not topic):
            return False
        rule = rule_about(announcement.kind, topic, is_own)
        return rule is not None and not self._is_allowed(inside, rule)

    def review(self, insiders: Iterable[InsideParticipant]) -> Iterator[InsideParticipant | None]:
        """Judge the verdicts of participants again, one with each step.

        Yield each participant of which the policy says something else than before, or may; None
        for each verdict that is the same. One participant may have a thousand verdicts, and each
        may take as many rules.
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
