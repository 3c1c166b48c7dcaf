"""TCPROS on a socket: the connection header, framed blocks, and the few types the demo sends."""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header, encode_header, header_length

_LENGTH = struct.Struct("<I")
MAX_BLOCK = 1 << 20
"""Longest message in bytes that the demo's nodes take; theirs have some twenty."""

ANY_MD5SUM = "*"


class ProtocolError(Exception):
    """The peer doesn't speak TCPROS, or refused the connection; the text says which."""


@dataclass(frozen=True)
class RosType:
    """A message or service type as connection headers name it."""

    name: str
    md5sum: str
    definition: str

    def accepts(self, header: Mapping[str, str]) -> bool:
        """Tell whether the peer's checksum fits this type."""
        return header.get("md5sum") in (self.md5sum, ANY_MD5SUM)

    def fields(self) -> dict[str, str]:
        """Return the header fields that name this type."""
        return {"type": self.name, "md5sum": self.md5sum}


STRING = RosType("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")
# Every ROS node offers this topic; a proxy that starts anew asks nodes for it to find their port.
LOG = RosType("rosgraph_msgs/Log", "acffd30cd6b6de30f120938c17c593fb", "")
ADD_TWO_INTS = RosType("rospy_tutorials/AddTwoInts", "6a2e34150c00229791cc89ff309fff21", "")

_OPERANDS = struct.Struct("<qq")
_SUM = struct.Struct("<q")


def pack_string(text: str) -> bytes:
    """Serialize a std_msgs/String, framed as on the wire."""
    data = text.encode()
    return _LENGTH.pack(len(data) + 4) + _LENGTH.pack(len(data)) + data


def unpack_string(body: bytes) -> str:
    """Read a std_msgs/String; raises ProtocolError."""
    if len(body) < 4 or len(body) != 4 + _LENGTH.unpack_from(body)[0]:
        raise ProtocolError("not a std_msgs/String")
    return body[4:].decode("utf-8", "replace")


def pack_operands(a: int, b: int) -> bytes:
    """Serialize an AddTwoInts request, framed as on the wire."""
    return _LENGTH.pack(_OPERANDS.size) + _OPERANDS.pack(a, b)


def add_operands(body: bytes) -> bytes:
    """Answer an AddTwoInts request with the framed reply; raises ProtocolError."""
    if len(body) != _OPERANDS.size:
        raise ProtocolError("not an AddTwoInts request")
    a, b = _OPERANDS.unpack(body)
    return _LENGTH.pack(_SUM.size) + _SUM.pack(a + b)


def unpack_sum(body: bytes) -> int:
    """Read an AddTwoInts reply; raises ProtocolError."""
    if len(body) != _SUM.size:
        raise ProtocolError("not an AddTwoInts reply")
    return int(_SUM.unpack(body)[0])


def receive(connection: socket.socket, size: int) -> bytes:
    """Read exactly `size` bytes; raises ConnectionError when the peer ends before, or OSError."""
    data = bytearray()
    while len(data) < size:
        chunk = connection.recv(size - len(data))
        if not chunk:
            raise ConnectionResetError("connection closed by peer")
        data += chunk
    return bytes(data)


def receive_block(connection: socket.socket) -> bytes:
    """Read one framed block; raises ProtocolError when it is too long, or OSError."""
    size = int(_LENGTH.unpack(receive(connection, 4))[0])
    if size > MAX_BLOCK:
        raise ProtocolError(f"block of {size} bytes, at most {MAX_BLOCK} are taken")
    return receive(connection, size)


def send_header(connection: socket.socket, fields: Mapping[str, str]) -> None:
    """Send a connection header; raises OSError."""
    connection.sendall(encode_header(fields))


def receive_header(connection: socket.socket) -> dict[str, str]:
    """Read the peer's connection header.

    Raises ProtocolError when it is none or says `error`, OSError when the connection fails.
    """
    try:
        header = decode_header(receive(connection, header_length(receive(connection, 4))))
    except HeaderError as problem:
        raise ProtocolError(str(problem)) from problem
    if "error" in header:
        raise ProtocolError(header["error"])
    return header
