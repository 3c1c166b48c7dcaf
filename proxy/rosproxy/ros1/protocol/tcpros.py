"""The TCPROS connection header.

Format: a 4-byte little-endian length of everything that follows, then fields, each a 4-byte
little-endian length and ``name=value`` (http://wiki.ros.org/ROS/Connection%20Header).
"""

import struct
from collections.abc import Mapping

MAX_HEADER = 1_000_000
"""The highest length of a header in bytes. The longest field is a message definition. roscpp's own
bound is 10^9 (connection.cpp), rospy has no bound."""
MAX_FIELDS = 64
"""The highest number of fields in a header. roscpp and rospy send nine at most."""

_LENGTH = struct.Struct("<I")


class HeaderError(ValueError):
    """Bytes that are not a connection header; the message says why."""


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A complete header with its leading total length."""
    encoded = [f"{name}={value}".encode() for name, value in fields.items()]
    body = b"".join(_LENGTH.pack(len(field)) + field for field in encoded)
    return _LENGTH.pack(len(body)) + body


def decode_header(body: bytes) -> dict[str, str]:
    """The fields of a header; ``body`` is the header without its leading total length.

    Names lose the blanks around them, as in rospy (rosgraph/network.py). roscpp keeps the blanks. A
    repeated name is refused, so that all readers find the same fields. Raises HeaderError for a
    repeated name, a length that leads outside the body, a field without ``=``, or more than
    MAX_FIELDS fields.
    """
    fields = dict[str, str]()
    position = 0
    while position < len(body):
        if len(fields) == MAX_FIELDS:
            raise HeaderError(f"the connection header has more than {MAX_FIELDS} fields")
        start = position + 4
        if start > len(body):
            raise HeaderError("the connection header ends inside the length of a field")
        position = start + _LENGTH.unpack_from(body, position)[0]
        if position > len(body):
            raise HeaderError("the connection header ends inside a field")
        name, equals, value = body[start:position].decode("utf-8", "replace").partition("=")
        if not equals:
            raise HeaderError("the connection header has a field without '='")
        name = name.strip()
        if name in fields:
            raise HeaderError("the connection header has the same field twice")
        fields[name] = value
    return fields


def header_length(first: bytes) -> int:
    """The length in bytes that the first four bytes of a connection announce.

    Raises HeaderError for more than MAX_HEADER. Four ASCII letters, as at the start of an HTTP
    request, always mean more. So the two protocols can share a port.
    """
    length: int = _LENGTH.unpack(first)[0]
    if length > MAX_HEADER:
        text = f"the connection header has {length} bytes, at most {MAX_HEADER} are accepted"
        raise HeaderError(text)
    return length


def speaks_http(first: bytes) -> bool:
    """Whether a connection's first four bytes are the start of an HTTP request."""
    # A method of three letters has a blank as the fourth byte ("GET ").
    return len(first) == 4 and first.isascii() and first.replace(b" ", b"A").isalpha()
