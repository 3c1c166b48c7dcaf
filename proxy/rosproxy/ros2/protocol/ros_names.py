"""Names of ROS 2 from names of DDS.

Topics are called ``rt/chatter`` in DDS; a service has two topics, ``rq/addRequest`` and
``rr/addReply``; an action has services and topics below ``_action``. Types have a namespace more.
"""

_TOPIC = "rt/"
_REQUEST = "rq/"
_REPLY = "rr/"
_DDS_NAMESPACE = "::dds_::"


def ros_topic(dds_topic: str) -> str | None:
    """The topic of ROS that a topic of DDS carries, others as they are; None if a service's."""
    return None if is_of_service(dds_topic) else ros_name(dds_topic)


def ros_service(dds_topic: str) -> str | None:
    """The service of ROS whose requests a topic of DDS carries; None if it carries none."""
    return ros_name(dds_topic) if is_of_requests(dds_topic) else None


def ros_name(dds_topic: str) -> str:
    """The topic or service of ROS that a topic of DDS belongs to."""
    for prefix, suffix in ((_REQUEST, "Request"), (_REPLY, "Reply")):
        if dds_topic.startswith(prefix):
            return f"/{dds_topic.removeprefix(prefix).removesuffix(suffix)}"
    return f"/{dds_topic.removeprefix(_TOPIC)}" if dds_topic.startswith(_TOPIC) else dds_topic


def is_of_service(dds_topic: str) -> bool:
    """Whether a topic of DDS carries requests or replies."""
    return dds_topic.startswith((_REQUEST, _REPLY))


def is_of_requests(dds_topic: str) -> bool:
    """Whether a topic of DDS carries a service's requests."""
    return dds_topic.startswith(_REQUEST)


def ros_type(dds_type: str) -> str:
    """The type of ROS for one of DDS: ``std_msgs::msg::dds_::String_`` is std_msgs/msg/String.

    A service has the same type for its requests and replies. Other types stay as they are.
    """
    package, separator, name = dds_type.partition(_DDS_NAMESPACE)
    if not separator:
        return dds_type
    name = name.removesuffix("_")
    if not package.endswith("::msg"):
        name = name.removesuffix("_Request").removesuffix("_Response")
    return f"{package.replace('::', '/')}/{name}"
