"""The kind of rule for a reader or writer."""

import pytest

from rosproxy.ros2.policy.rules import rule_about
from rosproxy.ros2.registry.participants import EndpointKind
from rosproxy.shared.policy.rules import RuleKind

READER = EndpointKind.READER
WRITER = EndpointKind.WRITER


@pytest.mark.parametrize(
    ("kind", "topic", "is_inside", "rule", "name"),
    [
        (WRITER, "rt/odom", True, RuleKind.PUBLISH, "/odom"),
        (READER, "rt/odom", False, RuleKind.PUBLISH, "/odom"),
        (READER, "rt/odom", True, RuleKind.SUBSCRIBE, "/odom"),
        (WRITER, "rt/odom", False, RuleKind.SUBSCRIBE, "/odom"),
        (READER, "rq/addRequest", True, RuleKind.SERVE, "/add"),
        (WRITER, "rr/addReply", True, RuleKind.SERVE, "/add"),
        (WRITER, "rq/addRequest", False, RuleKind.SERVE, "/add"),
        (READER, "rr/addReply", False, RuleKind.SERVE, "/add"),
        (WRITER, "rq/addRequest", True, RuleKind.CALL, "/add"),
        (READER, "rr/addReply", True, RuleKind.CALL, "/add"),
        (READER, "rq/addRequest", False, RuleKind.CALL, "/add"),
        (WRITER, "rr/addReply", False, RuleKind.CALL, "/add"),
        (WRITER, "plain", True, RuleKind.PUBLISH, "plain"),
    ],
)
def test_both_ends_of_a_topic_are_a_case_of_the_same_rule(
    kind: EndpointKind, topic: str, is_inside: bool, rule: RuleKind, name: str
) -> None:
    assert rule_about(kind, topic, is_inside) == (rule, name)


def test_the_graph_is_never_denied() -> None:
    assert rule_about(WRITER, "ros_discovery_info", True) is None
