"""The ROS status triple in a reply of the master or a node: status, message and value.

Form: http://wiki.ros.org/ROS/Master_Slave_APIs.
"""

from rosproxy.ros1.protocol.xmlrpc.values import Edit, Value


def ros_triple(value: Value | None) -> Value | None:
    """The value of a reply if it is a ROS status triple, else None."""
    return value if value and value.kind == "array" and len(value.items) == 3 else None


def replace_value(triple: Value, text: str) -> list[Edit]:
    """Edits that replace the value of a reply, also inside the status message."""
    # The messages of rosmaster's lookupService (master_api.py) and of rospy's getMasterUri
    # (masterslave.py) quote the value.
    value = triple.items[2]
    return [value.with_text(text), *replace_in_message(triple, value.text, text)]


def replace_in_message(triple: Value, before: str, after: str) -> list[Edit]:
    """The edit that replaces a text in the status message; empty if the text is not there."""
    text = triple.items[1].string() or ""
    return [triple.items[1].with_text(text.replace(before, after))] if before in text else []
