"""Names of ROS 2 in DDS."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol.ros_names import (
    is_of_service,
    ros_name,
    ros_node,
    ros_service,
    ros_topic,
    ros_type,
)


@pytest.mark.parametrize(
    ("dds", "topic", "service"),
    [
        ("rt/chatter", "/chatter", None),
        ("rt/robot/scan", "/robot/scan", None),
        ("rq/addRequest", None, "/add"),
        ("rr/addReply", None, None),
        ("ros_discovery_info", "ros_discovery_info", None),
    ],
)
def test_names(dds: str, topic: str | None, service: str | None) -> None:
    assert (ros_topic(dds), ros_service(dds)) == (topic, service)


@pytest.mark.parametrize(
    ("dds", "name", "of_service"),
    [
        ("rt/chatter", "/chatter", False),
        ("rq/addRequest", "/add", True),
        ("rr/addReply", "/add", True),
        ("ros_discovery_info", "ros_discovery_info", False),
    ],
)
def test_what_a_topic_belongs_to(dds: str, name: str, of_service: bool) -> None:
    assert (ros_name(dds), is_of_service(dds)) == (name, of_service)


@pytest.mark.parametrize(
    ("dds", "ros"),
    [
        ("std_msgs::msg::dds_::String_", "std_msgs/msg/String"),
        ("some_msgs::msg::dds_::A_Request_", "some_msgs/msg/A_Request"),
        ("std_srvs::srv::dds_::Trigger_Request_", "std_srvs/srv/Trigger"),
        ("std_srvs::srv::dds_::Trigger_Response_", "std_srvs/srv/Trigger"),
        (
            "test_msgs::action::dds_::Fibonacci_SendGoal_Response_",
            "test_msgs/action/Fibonacci_SendGoal",
        ),
        ("HelloWorld", "HelloWorld"),
    ],
)
def test_types(dds: str, ros: str) -> None:
    assert ros_type(dds) == ros


PARAMETERS = "rcl_interfaces::srv::dds_::GetParameters_Request_"
DESCRIPTION = "type_description_interfaces::srv::dds_::GetTypeDescription_Request_"


@pytest.mark.parametrize(
    ("topic", "kind", "node"),
    [
        ("rq/talker/get_parametersRequest", PARAMETERS, "/talker"),
        ("rq/arm/driver/get_parametersRequest", PARAMETERS, "/arm/driver"),
        ("rq/_ros2cli_7/get_type_descriptionRequest", DESCRIPTION, "/_ros2cli_7"),
        ("rq/talker/get_parametersRequest", DESCRIPTION, None),
        ("rq/talker/get_parametersRequest", "other::srv::dds_::GetParameters_Request_", None),
        ("rr/talker/get_parametersReply", PARAMETERS, None),
        ("rt/talker/get_parameters", PARAMETERS, None),
        ("rq/other_nameRequest", PARAMETERS, None),
        ("rq/get_parametersRequest", PARAMETERS, None),
    ],
)
def test_a_node_is_known_by_a_service_that_each_node_has(
    topic: str, kind: str, node: str | None
) -> None:
    assert ros_node(topic, kind) == node


@given(st.text(), st.sampled_from(["/get_parameters", "/get_type_description", ""]))
def test_any_topic_names_a_node_by_its_start_or_none(name: str, ending: str) -> None:
    for kind in (PARAMETERS, DESCRIPTION):
        node = ros_node(f"rq/{name}{ending}Request", kind)
        assert node is None or f"/{name}{ending}".startswith(f"{node}/get_")
