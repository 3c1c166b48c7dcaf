"""The ROS nodes of a participant, in a sample of the topic ``ros_discovery_info``.

The type is rmw_dds_common/msg/ParticipantEntitiesInfo, in CDR. A GUID has 16 bytes; until Humble,
24:

    header 4, GUID of the participant, number of nodes 4
    of each node: namespace and name (length 4, text and a zero byte, padding to 4 bytes)
                  readers and writers (number 4, GUIDs)
"""

import re
import struct
from collections.abc import Callable

from rosproxy.ros2.protocol.rtps import RtpsError

MOST_NODES = 128
"""Nodes of a participant that the proxy reads. Large containers of components have some dozens."""
MOST_NAME_BYTES = 255
"""Bytes of a namespace, and of a name."""
MOST_BYTES = 4096
"""Bytes of all full names of a participant."""
_GUID_SIZES = (16, 24)
_NODE = re.compile(rb"(/[A-Za-z0-9_]+)+")
_Number = Callable[[bytes, int], tuple[int]]


def node_names(payload: bytes) -> tuple[str, ...]:
    """The full names of the nodes in a sample, such as ``/arm/driver``.

    Raises RtpsError if the payload is no such sample, has more than MOST_NODES or MOST_BYTES, or
    has a name that is not valid in ROS.
    """
    number = struct.Struct("<I" if payload[1:2] == b"\x01" else ">I").unpack_from
    for guid_size in _GUID_SIZES:
        try:
            names, end = _read(payload, guid_size, number)
        except struct.error:
            continue  # the sample ends before the last node
        if end == len(payload) and sum(map(len, names)) <= MOST_BYTES:
            return names
    raise RtpsError("no sample of ros_discovery_info, or one with too long names")


def _read(payload: bytes, guid_size: int, number: _Number) -> tuple[tuple[str, ...], int]:
    """The names, and the end of the last node. Raises RtpsError, struct.error."""
    offset = 4 + guid_size
    (count,) = number(payload, offset)
    if count > MOST_NODES:
        raise RtpsError(f"a sample of ros_discovery_info has {count} nodes")
    offset += 4
    names = []
    for _ in range(count):
        namespace, offset = _text(payload, offset, number)
        name, offset = _text(payload, offset, number)
        full_name = namespace.rstrip(b"/") + b"/" + name
        if not _NODE.fullmatch(full_name):
            raise RtpsError("a sample of ros_discovery_info has an impossible name")
        names.append(full_name.decode())
        for _ in ("readers", "writers"):
            (guids,) = number(payload, offset)
            offset += 4 + guids * guid_size
    return tuple(names), offset


def _text(payload: bytes, offset: int, number: _Number) -> tuple[bytes, int]:
    """The text at an offset, and the offset after the text and its padding."""
    (length,) = number(payload, offset)
    if not 0 < length <= MOST_NAME_BYTES + 1:
        raise RtpsError(f"a sample of ros_discovery_info has a name of {length} bytes")
    start = offset + 4
    return payload[start : start + length - 1], start + -(-length // 4) * 4
