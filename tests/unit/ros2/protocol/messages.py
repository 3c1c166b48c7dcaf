"""RTPS messages made by hand, for tests."""

import struct
from collections.abc import Sequence

from hypothesis import strategies as st

PREFIX = bytes(range(12))
VENDOR = b"\x01\x0f"
SPDP_WRITER = 0x000100C2
VALUES = st.binary(max_size=40).map(lambda value: value + bytes(-len(value) % 4))
"""Values of parameters, whose length is a multiple of four."""


def order(little: bool) -> str:
    return "<" if little else ">"


def message(*submessages: bytes, prefix: bytes = PREFIX) -> bytes:
    return b"RTPS\x02\x03" + VENDOR + prefix + b"".join(submessages)


def submessage(kind: int, flags: int, body: bytes, little: bool = True) -> bytes:
    flags |= little
    return bytes([kind, flags]) + struct.pack(order(little) + "H", len(body)) + body


def parameter(pid: int, value: bytes, little: bool = True) -> bytes:
    return struct.pack(order(little) + "HH", pid, len(value)) + value


def parameter_list(parameters: Sequence[tuple[int, bytes]], little: bool = True) -> bytes:
    end = parameter(1, b"", little)
    return b"".join(parameter(pid, value, little) for pid, value in parameters) + end


def payload(parameters: Sequence[tuple[int, bytes]], little: bool = True) -> bytes:
    return bytes([0, 3 if little else 2, 0, 0]) + parameter_list(parameters, little)


def data(
    payload: bytes = b"",
    *,
    writer: int = SPDP_WRITER,
    sequence: int = 1,
    qos: bytes = b"",
    little: bool = True,
    key: bool = False,
) -> bytes:
    """A DATA submessage; ``qos`` is a whole parameter list."""
    mark = order(little)
    body = struct.pack(mark + "HH", 0, 16) + bytes(4) + writer.to_bytes(4, "big")
    body += struct.pack(mark + "iI", sequence >> 32, sequence & 0xFFFFFFFF) + qos + payload
    flags = (0x02 if qos else 0) | ((0x08 if key else 0x04) if payload else 0)
    return submessage(0x15, flags, body, little)


def fragment(
    chunk: bytes,
    first: int,
    size: int,
    total: int,
    *,
    writer: int = SPDP_WRITER,
    sequence: int = 1,
    qos: bytes = b"",
    little: bool = True,
) -> bytes:
    """A DATA_FRAG submessage with as many fragments as the part has; ``qos`` as in `data`."""
    mark = order(little)
    body = struct.pack(mark + "HH", 0, 28) + bytes(4) + writer.to_bytes(4, "big")
    body += struct.pack(mark + "iI", sequence >> 32, sequence & 0xFFFFFFFF)
    body += struct.pack(mark + "IHHI", first, -(-len(chunk) // size), size, total) + qos + chunk
    return submessage(0x16, 0x02 if qos else 0, body, little)
