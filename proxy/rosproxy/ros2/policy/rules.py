"""Which rule of the policy applies to a reader or writer of DDS (`rosproxy.shared.policy.rules`).

The rules name topics and services as seen from inside. A service has two topics in DDS, for
requests and for replies. Each topic has readers and writers. So the kind of rule follows from the
name of the topic, and from the direction of the data.
"""

from rosproxy.ros2.protocol.ros_names import (
    GRAPH_TOPIC,
    is_of_requests,
    is_of_service,
    ros_name,
)
from rosproxy.ros2.registry.participants import EndpointKind
from rosproxy.shared.policy.rules import RuleKind


def rule_about(kind: EndpointKind, dds_topic: str, is_inside: bool) -> tuple[RuleKind, str] | None:
    """The kind of rule for a reader or writer, and the name to judge; None if no rule applies.

    ``is_inside`` tells whether the participant is inside.
    """
    if dds_topic == GRAPH_TOPIC:
        return None
    name = ros_name(dds_topic)
    outwards = (kind is EndpointKind.WRITER) is is_inside
    if not is_of_service(dds_topic):
        return (RuleKind.PUBLISH if outwards else RuleKind.SUBSCRIBE), name
    return (RuleKind.CALL if is_of_requests(dds_topic) is outwards else RuleKind.SERVE), name
