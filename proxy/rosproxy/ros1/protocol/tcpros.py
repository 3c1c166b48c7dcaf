"""The TCPROS connection header.

Format: a 4-byte little-endian length of everything that follows, then fields, each a 4-byte
little-endian length and ``name=value`` (http://wiki.ros.org/ROS/Connection%20Header).
"""

import struct
from collections.abc import Mapping

MAX_HEADER = 1_000_000
"""Longest header in bytes that is read. A header holds a message definition at most; roscpp's own
bound is 10^9 (connection.cpp), rospy has none."""
MAX_FIELDS = 64
"""Most fields of a header that are read; roscpp and rospy send nine at most."""

_LENGTH = struct.Struct("<I")


class HeaderError(ValueError):
    """Bytes that are not a connection header; the message says why."""


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A complete header with its leading total length."""
    encoded = [f"{name}={value}".encode() for name, value in fields.items()]
    body = b"".join(_LENGTH.pack(len(field)) + field for field in encoded)
    return _LENGTH.pack(len(body)) + body


def decode_header(body: bytes) -> dict[str, str]:
    """The fields of a header, given without its leading total length.

    Names come without blanks around them, as rospy reads them (rosgraph/network.py); roscpp keeps
    the blanks. So that all see the same, none may be there twice. Raises HeaderError if one is, if
    a field's length leads outside the body, a field has no ``=`` or there are more than MAX_FIELDS.
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

    Raises HeaderError if it is more than MAX_HEADER. Four ASCII letters, as at the start of an
    HTTP request, always are: that is how the two protocols share one port.
    """
    length: int = _LENGTH.unpack(first)[0]
    if length > MAX_HEADER:
        text = f"the connection header has {length} bytes, at most {MAX_HEADER} are accepted"
        raise HeaderError(text)
    return length


def speaks_http(first: bytes) -> bool:
    """Whether a connection's first four bytes are the start of an HTTP request."""
    # A method of three letters has a blank behind it ("GET ").
    return len(first) == 4 and first.isascii() and first.replace(b" ", b"A").isalpha()
