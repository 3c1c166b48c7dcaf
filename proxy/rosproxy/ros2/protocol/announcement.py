"""Announcements of the proxy's own participants, and dispose messages.

A participant that discovers a new participant announces itself to the new one at once, and does not
wait for its next regular announcement. So the proxy's participants soon know all others.
"""

import struct
from collections.abc import Iterable
from functools import lru_cache

from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import NO_VENDOR, SENTINEL, VERSION, SubmessageId, message_header
from rosproxy.shared.addresses import HostPort

_SPDP_READER = 0x000100C7
_SPDP_WRITER = 0x000100C2
_PARTICIPANT = bytes([0, 0, 1, 0xC1])
SPDP_ENDPOINTS = 0x01 | 0x02
"""The builtin endpoints of SPDP, as bits of PID_BUILTIN_ENDPOINT_SET (DDSI-RTPS 2.5, 9.3.2.12)."""
READER_ENDPOINTS = SPDP_ENDPOINTS | 0x08 | 0x20
"""SPDP, and the readers of SEDP for publications and subscriptions."""
WRITER_ENDPOINTS = SPDP_ENDPOINTS | 0x04
"""SPDP, and the writer of SEDP for publications."""
PORT_STORE_ENDPOINTS = WRITER_ENDPOINTS | 0x10
"""SPDP, and the writers of SEDP for publications and subscriptions."""


def announcement(
    prefix: bytes, reached_at: Iterable[HostPort], lease_duration: float, endpoints: int
) -> bytes:
    """The datagram in which a participant of the proxy announces itself.

    ``reached_at`` are its locators. ``lease_duration`` is in seconds, and is cut to whole seconds.
    ``endpoints`` are bits of PID_BUILTIN_ENDPOINT_SET. Raises ValueError if the host of a locator
    is a name.
    """
    locators = [pack_locator(host_port, "<") for host_port in reached_at]
    return _message(
        prefix,
        0x05,  # little-endian, with a payload
        b"",
        [
            (Pid.PROTOCOL_VERSION, VERSION + bytes(2)),
            (Pid.VENDOR_ID, NO_VENDOR + bytes(2)),
            (Pid.PARTICIPANT_GUID, prefix + _PARTICIPANT),
            # Cyclone DDS refuses a participant without a default locator (ddsi_discovery_spdp.c,
            # get_locators).
            *((Pid.METATRAFFIC_UNICAST_LOCATOR, locator) for locator in locators),
            *((Pid.DEFAULT_UNICAST_LOCATOR, locator) for locator in locators),
            (Pid.PARTICIPANT_LEASE_DURATION, struct.pack("<iI", int(lease_duration), 0)),
            (Pid.BUILTIN_ENDPOINT_SET, struct.pack("<I", endpoints)),
        ],
    )


@lru_cache(1024)
def dispose_message(prefix: bytes, vendor: bytes = NO_VENDOR, sequence: int = 2) -> bytes:
    """The datagram with which a participant ends: the key of the participant, and the status.

    If the proxy ends another participant, ``vendor`` is the vendor of that participant, and
    ``sequence`` is greater than its last sequence number. Fast DDS ignores a sample that is older
    than the last sample of the same writer (StatelessReader.cpp).
    """
    guid = prefix + _PARTICIPANT
    # Disposed and unregistered (9.6.3.9).
    status = _parameters([(Pid.KEY_HASH, guid), (Pid.STATUS_INFO, bytes([0, 0, 0, 3]))])
    flags = 0x0B  # little-endian, inline QoS, a key
    return _message(prefix, flags, status, [(Pid.PARTICIPANT_GUID, guid)], vendor, sequence)


def _message(
    prefix: bytes,
    flags: int,
    inline_qos: bytes,
    parameters: list[tuple[int, bytes]],
    vendor: bytes = NO_VENDOR,
    sequence: int = 1,
) -> bytes:
    body = struct.pack("<HH", 0, 16) + struct.pack(">II", _SPDP_READER, _SPDP_WRITER)
    body += struct.pack("<iI", sequence >> 32, sequence & 0xFFFFFFFF) + inline_qos
    body += bytes([0, 3, 0, 0]) + _parameters(parameters)  # PL_CDR_LE
    data = struct.pack("<BBH", SubmessageId.DATA, flags, len(body)) + body
    return message_header(prefix, vendor) + data


def _parameters(parameters: list[tuple[int, bytes]]) -> bytes:
    packed = b"".join(struct.pack("<HH", pid, len(value)) + value for pid, value in parameters)
    return packed + struct.pack("<HH", SENTINEL, 0)
