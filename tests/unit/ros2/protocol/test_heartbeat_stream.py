"""Heartbeats with the same content, of which only the last has to be read."""

import struct

import pytest

from rosproxy.ros2.protocol.addressing import LONGEST_HEARTBEAT_BYTES, heartbeat_stream
from tests.unit.ros2.protocol.messages import data, message, payload, submessage

HERE = bytes(range(12))
THERE = bytes(range(12, 24))
PUBLICATIONS = 0x000003C2


def info_dst(prefix: bytes) -> bytes:
    return submessage(0x0E, 0, prefix)


def heartbeat(writer: int = PUBLICATIONS, last: int = 5, count: int = 1, flags: int = 0) -> bytes:
    body = struct.pack(">II", writer + 5, writer) + struct.pack("<iIiIi", 0, 1, 0, last, count)
    return submessage(0x07, flags, body)


def fast_dds(*submessages: bytes, prefix: bytes = HERE) -> bytes:
    """A message that ends with statistics, like messages of Fast DDS."""
    return message(*submessages, submessage(0x80, 0, bytes(40)), prefix=prefix)


def test_a_later_heartbeat_is_of_the_same_stream():
    first = heartbeat_stream(fast_dds(info_dst(THERE), heartbeat(last=5, count=1)))
    later = heartbeat_stream(fast_dds(info_dst(THERE), heartbeat(last=9, count=70)))
    assert first is not None
    assert first == later


def test_the_last_destination_before_the_heartbeat_counts():
    stream = heartbeat_stream(fast_dds(info_dst(HERE), info_dst(THERE), heartbeat()))
    assert stream == heartbeat_stream(fast_dds(info_dst(THERE), heartbeat()))
    after = heartbeat_stream(fast_dds(info_dst(THERE), heartbeat(), info_dst(HERE)))
    assert after == stream


@pytest.mark.parametrize(
    "other",
    [
        fast_dds(info_dst(THERE), heartbeat(), prefix=THERE),
        fast_dds(info_dst(HERE), heartbeat()),
        fast_dds(heartbeat()),
        fast_dds(info_dst(THERE), heartbeat(writer=0x000004C2)),
        fast_dds(info_dst(THERE), heartbeat(flags=2)),
    ],
)
def test_another_writer_reader_or_flag_is_another_stream(other: bytes):
    stream = heartbeat_stream(other)
    assert stream is not None
    assert stream != heartbeat_stream(fast_dds(info_dst(THERE), heartbeat()))


@pytest.mark.parametrize(
    "datagram",
    [
        b"no RTPS",
        message(),
        fast_dds(info_dst(THERE)),
        fast_dds(info_dst(THERE), heartbeat(), heartbeat(0x000004C2)),
        fast_dds(info_dst(THERE), data(payload([])), heartbeat()),
        fast_dds(info_dst(THERE), submessage(0x06, 0, bytes(24))),
        message(submessage(0x0C, 0, bytes(20)), heartbeat()),
        message(submessage(0x07, 0, bytes(8))),
        fast_dds(info_dst(THERE), heartbeat(), submessage(0x01, 0, bytes(LONGEST_HEARTBEAT_BYTES))),
    ],
)
def test_what_says_more_than_a_heartbeat_is_of_no_stream(datagram: bytes):
    assert heartbeat_stream(datagram) is None
