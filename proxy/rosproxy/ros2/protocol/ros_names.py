"""The ROS 2 names for DDS names.

DDS calls the topic ``/chatter`` ``rt/chatter``. A service has two topics, ``rq/addRequest`` and
``rr/addReply``. An action has services and topics below ``_action``. A DDS type has an additional
namespace, ``dds_``.
"""

from rosproxy.shared.addresses import cached

GRAPH_TOPIC = "ros_discovery_info"
"""The topic on which participants publish their nodes. Without this topic, `ros2 node list` is
empty."""
_TOPIC = "rt/"
_REQUEST = "rq/"
_REPLY = "rr/"
_DDS_NAMESPACE = "::dds_::"
_NODE_SERVICES = {
    "rcl_interfaces::srv::dds_::GetParameters_Request_": "/get_parameters",
    "type_description_interfaces::srv::dds_::GetTypeDescription_Request_": "/get_type_description",
}
"""The DDS types of requests of two services that nodes have by default, and the names of these
services in the namespace of the node. rclcpp and rclpy start the first unless
``start_parameter_services`` is False, and the second since Jazzy (parameter
``start_type_description_service``)."""


def ros_topic(dds_topic: str) -> str | None:
    """The ROS topic for a DDS topic; None if the DDS topic belongs to a service.

    A topic that is not of ROS stays unchanged.
    """
    return None if is_of_service(dds_topic) else ros_name(dds_topic)


def ros_service(dds_topic: str) -> str | None:
    """The ROS service whose requests a DDS topic carries; None for other topics."""
    return ros_name(dds_topic) if is_of_requests(dds_topic) else None


def ros_name(dds_topic: str) -> str:
    """The ROS topic or service to which a DDS topic belongs; other topics unchanged."""
    for prefix, suffix in ((_REQUEST, "Request"), (_REPLY, "Reply")):
        if dds_topic.startswith(prefix):
            return f"/{dds_topic.removeprefix(prefix).removesuffix(suffix)}"
    return f"/{dds_topic.removeprefix(_TOPIC)}" if dds_topic.startswith(_TOPIC) else dds_topic


def is_of_service(dds_topic: str) -> bool:
    """Whether a DDS topic carries requests or replies of a service."""
    return dds_topic.startswith((_REQUEST, _REPLY))


def is_of_requests(dds_topic: str) -> bool:
    """Whether a DDS topic carries the requests of a service."""
    return dds_topic.startswith(_REQUEST)


def ros_node(dds_topic: str, dds_type: str) -> str | None:
    """The ROS node that reads a DDS topic as the requests of a service that each node has.

    ``/arm/driver`` reads ``rq/arm/driver/get_parametersRequest``. None for other topics.
    """
    ending = _NODE_SERVICES.get(dds_type)
    service = ros_service(dds_topic) if ending else None
    if ending is None or service is None or not service.endswith(ending):
        return None
    return service.removesuffix(ending) or None


@cached
def ros_type(dds_type: str) -> str:
    """The ROS type for a DDS type: std_msgs/msg/String for ``std_msgs::msg::dds_::String_``.

    The request and the reply of a service have the same ROS type. Types that are not of ROS stay
    unchanged.
    """
    package, separator, name = dds_type.partition(_DDS_NAMESPACE)
    if not separator:
        return dds_type
    name = name.removesuffix("_")
    if not package.endswith("::msg"):
        name = name.removesuffix("_Request").removesuffix("_Response")
    return f"{package.replace('::', '/')}/{name}"
