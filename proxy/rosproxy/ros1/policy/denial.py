"""Denials: the reason of a refusal, and the answer to the caller.

Texts and values of the answers: ros_comm/tools/rosmaster/src/rosmaster/master_api.py, and for a
topic that a node does not publish clients/rospy/src/rospy/impl/masterslave.py (requestTopic).
"""

import msgspec

from rosproxy.ros1.rewriting.master_calls import LocalAnswer, refusal


class Denial(msgspec.Struct, frozen=True):
    """The result when a rule refuses: ``reason`` names the rule, ``answer`` is for the caller."""

    reason: str
    answer: LocalAnswer


def denied(reason: str) -> Denial:
    """The denial of a call that fails with ROS status -1."""
    return Denial(reason, refusal(f"rosproxy: {reason}"))


def no_provider(reason: str) -> Denial:
    """The denial of lookupService: the service has no provider."""
    return Denial(reason, LocalAnswer(-1, f"no provider (rosproxy: {with_fix(reason)})", ""))


def no_publisher(topic: str, reason: str) -> Denial:
    """The denial of requestTopic: the node does not publish the topic."""
    text = f"Not a publisher of [{topic}] (rosproxy: {reason})"
    return Denial(reason, LocalAnswer(-1, text, []))


def with_fix(reason: str) -> str:
    """A reason that names a rule, followed by advice."""
    return f"{reason}. Change that rule if the node may have this"
