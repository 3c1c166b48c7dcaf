"""The policy over discovery: a reader or writer that it denies is not told to the other side.

So the two ends never match, and whatever is sent to them nevertheless they don't take. A policy
that changes is applied by having the participant and those of the other side lose sight of each
other, and meet again: only for participants inside of which a verdict is another one now.
"""

from rosproxy.ros2.discovery.domain_settings import Judge
from rosproxy.ros2.registry.participants import InsideParticipant
from rosproxy.ros2.rewriting.discovery import Announcement
from rosproxy.ros2.rewriting.policing import rule_about

MOST_VERDICTS = 1024
"""Verdicts that are remembered of a participant; real ones have some hundreds. One that has more
meets others anew with each change of the policy."""


def is_hidden(
    judge: Judge, inside: InsideParticipant, told: Announcement, datagram: bytes, is_own: bool
) -> bool:
    """Whether an announcement is not to be passed on.

    ``inside`` is whose it is, if it ``is_own``, or who is to get it.
    """
    if told.kind is None or told.ended:
        return False
    asked = rule_about(told.kind, told.topic(datagram), is_own)
    if asked is None:
        return False
    if asked not in inside.verdicts and len(inside.verdicts) < MOST_VERDICTS:
        inside.verdicts[asked] = judge(*asked, inside.address)
    found = inside.verdicts.get(asked)
    return not (judge(*asked, inside.address) if found is None else found)


def has_changed(judge: Judge, inside: InsideParticipant) -> bool:
    """Whether the policy says something else of a participant than it did, or may do."""
    if len(inside.verdicts) >= MOST_VERDICTS:
        return True
    return any(
        judge(*asked, inside.address) is not allowed for asked, allowed in inside.verdicts.items()
    )
