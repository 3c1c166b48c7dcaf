"""The policy over discovery: a reader or writer that it denies is not told to the other side.

So the two ends never match, and don't take what is sent to them nevertheless. When the policy
changes, it is applied by having the participant and those of the other side lose sight of each
other, and meet again: only for participants inside for which a verdict has changed.
"""

from collections.abc import Iterable, Iterator

from rosproxy.ros2.discovery.domain_settings import Judge
from rosproxy.ros2.registry.participants import InsideParticipant
from rosproxy.ros2.rewriting.discovery import Announcement
from rosproxy.ros2.rewriting.policing import rule_about

MOST_VERDICTS = 1024
"""Verdicts that are remembered of a participant; real ones have some hundreds. One that has more
meets others anew with each change of the policy."""


def is_hidden(
    judge: Judge,
    inside: InsideParticipant,
    announcement: Announcement,
    datagram: bytes,
    is_own: bool,
) -> bool:
    """Whether an announcement is not to be passed on.

    ``inside`` is the participant that makes it, if it ``is_own``, else the one that is to get it.
    """
    # An end names the key of a reader or writer, and no topic to judge it by. What names a topic
    # others may not take for an end: they read the last status of several, or another flag.
    topic = announcement.topic(datagram)
    if announcement.kind is None or (announcement.ended and not topic):
        return False
    rule = rule_about(announcement.kind, topic, is_own)
    if rule is None:
        return False
    if rule not in inside.verdicts and len(inside.verdicts) < MOST_VERDICTS:
        inside.verdicts[rule] = judge(*rule, inside.address)
    # Those that are not remembered are judged each time.
    verdict = inside.verdicts.get(rule)
    return not (judge(*rule, inside.address) if verdict is None else verdict)


def reviewed(
    judge: Judge, insiders: Iterable[InsideParticipant]
) -> Iterator[InsideParticipant | None]:
    """Judge the verdicts of participants again, one with each step.

    Yield each participant of which the policy says something else than before, or may; None for
    each verdict that is the same. One participant may have a thousand verdicts, and each may take
    as many rules.
    """
    for insider in insiders:
        if len(insider.verdicts) >= MOST_VERDICTS:
            yield insider
            continue
        for rule, allowed in list(insider.verdicts.items()):
            if judge(*rule, insider.address) is not allowed:
                yield insider
                break
            yield None
