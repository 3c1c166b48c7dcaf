"""Locators for both discovery and user data, as in Cyclone DDS."""

import struct

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.protocol.addressing import MOST_UNREAD_SUBMESSAGES, may_be_discovery
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.registry.participants import TrafficKind
from rosproxy.ros2.sources.rates import BURST, BYTES_PER_UNIT
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    NOW,
    OTHER,
    ROBOT,
    SEDP_WRITERS,
    STRANGER,
    A,
    B,
    allowance_left,
    make_domain,
    of_vendor,
    sedp,
    spdp,
)
from tests.unit.ros2.protocol.messages import data, fragment, message, payload, submessage

USER = 0x00001203
BUILT_IN = 0x000003C7
UNKNOWN = 0
TIME = submessage(0x09, 0, bytes(8))
TO_A = submessage(0x0E, 0, A)
SAID = data(bytes(1200), writer=USER)


def with_reader(submessage_of_data: bytes, reader: int) -> bytes:
    return submessage_of_data[:8] + struct.pack(">I", reader) + submessage_of_data[12:]


def between(kind: int, reader: int, writer: int) -> bytes:
    """A heartbeat, an acknowledgement, and so on."""
    return submessage(kind, 0, struct.pack(">II", reader, writer) + bytes(20))


def announcement(prefix: bytes, address: str) -> bytes:
    locator = pack_locator(HostPort(address, 7410), "<")
    told = payload(
        [(Pid.METATRAFFIC_UNICAST_LOCATOR, locator), (Pid.DEFAULT_UNICAST_LOCATOR, locator)]
    )
    return data(told)


def shared() -> tuple[Domain, int, int]:
    """A domain, the port that leads to A inside, and the stand-in for B outside."""
    domain = make_domain(both_ways=True)
    domain.heard_inside(message(announcement(A, INSIDE), prefix=A), INSIDE, NOW)
    domain.heard_outside(message(announcement(B, ROBOT), prefix=B), ROBOT, NOW)
    (port,) = domain.mappings.by_port
    (stand_in,) = domain.stand_ins.by_port
    assert domain.mappings.by_port[port][1].kind is TrafficKind.METATRAFFIC
    return domain, port, stand_in


def test_user_data_takes_nothing_of_the_allowance_of_discovery() -> None:
    """Otherwise 1.2 MB of user data a second stops user data and discovery."""
    domain, port, stand_in = shared()
    before = allowance_left(domain, INSIDE), allowance_left(domain, ROBOT)
    inwards = message(TIME, TO_A, SAID, prefix=B)
    outwards = message(TIME, SAID, prefix=A)
    for _ in range(40_000):
        assert domain.at_range_port(port, inwards, ROBOT, NOW) == [
            Outgoing(HostPort(INSIDE, 7410), inwards)
        ]
        assert domain.at_stand_in(stand_in, outwards, INSIDE, NOW) == [
            Outgoing(HostPort(ROBOT, 7410), outwards)
        ]
    assert (allowance_left(domain, INSIDE), allowance_left(domain, ROBOT)) == before
    assert domain.refused.count == 0


@pytest.mark.parametrize(
    "in_front", [SAID, TIME + data(bytes(8), writer=USER) * (MOST_UNREAD_SUBMESSAGES + 4)]
)
def test_discovery_behind_user_data_is_read_and_charged(in_front: bytes) -> None:
    domain, port, stand_in = shared()
    for kind in (spdp, sedp):
        before = allowance_left(domain, INSIDE), allowance_left(domain, ROBOT)
        outwards = message(in_front, kind(A, INSIDE, 7000)[20:], prefix=A)
        inwards = message(in_front, kind(B, ROBOT, 7000)[20:], prefix=B)
        for sent in (
            domain.at_stand_in(stand_in, outwards, INSIDE, NOW),
            domain.at_range_port(port, inwards, ROBOT, NOW),
        ):
            assert len(sent[-1].datagram) in (len(outwards), len(inwards))
            assert sent[-1].datagram not in (outwards, inwards)  # the locators are rewritten
        assert allowance_left(domain, INSIDE) == before[0] - 1 - len(outwards) // BYTES_PER_UNIT
        assert allowance_left(domain, ROBOT) == before[1] - 1 - len(inwards) // BYTES_PER_UNIT


def test_what_users_send_passes_where_discovery_is_used_up() -> None:
    domain, port, stand_in = shared()
    domain.rates.charge(INSIDE, int(BURST))
    domain.rates.charge(ROBOT, int(BURST))
    hidden = message(SAID, spdp(B, ROBOT)[20:], prefix=B)
    assert domain.at_range_port(port, message(SAID, prefix=B), ROBOT, NOW)
    assert domain.at_stand_in(stand_in, message(SAID, prefix=A), INSIDE, NOW)
    assert domain.at_range_port(port, hidden, ROBOT, NOW) == []


def test_strangers_are_not_passed_on_there() -> None:
    domain, port, stand_in = shared()
    assert domain.at_range_port(port, message(SAID, prefix=B), STRANGER, NOW) == []
    assert domain.at_stand_in(stand_in, message(SAID, prefix=A), OTHER, NOW) == []


STATISTICS = submessage(0x80, 0, bytes(56))


@pytest.mark.parametrize(
    "unread",
    [
        message(),
        message(SAID),
        message(TIME, TO_A, with_reader(SAID, USER), between(0x07, USER, USER)),
        message(fragment(bytes(1200), 1, 1200, 5000, writer=USER)),
        message(*[SAID] * MOST_UNREAD_SUBMESSAGES),
        *[message(between(kind, UNKNOWN, USER)) for kind in (0x06, 0x07, 0x08, 0x12, 0x13)],
        message(submessage(0x0C, 0, bytes(20)), submessage(0x01, 0, bytes(8)), SAID),
        message(SAID, STATISTICS),  # at the end of all that Fast DDS sends
    ],
)
def test_what_users_send_is_known(unread: bytes) -> None:
    assert not may_be_discovery(unread)


@pytest.mark.parametrize(
    "read",
    [
        b"",
        b"RTPX" + message(SAID)[4:],
        message(SAID)[:-1],
        message(SAID, b"\x15"),
        message(submessage(0x15, 0, bytes(8))),
        message(submessage(0x80, 0, b"abc"), SAID),
        message(*[SAID] * (MOST_UNREAD_SUBMESSAGES + 1)),
        message(SAID, data(bytes(40), writer=SEDP_WRITERS)),
        message(SAID, data(bytes(40), writer=0xFF0003C2)),
        message(with_reader(SAID, BUILT_IN)),
        message(fragment(bytes(1200), 1, 1200, 5000, writer=SEDP_WRITERS)),
        *[message(between(kind, BUILT_IN, USER)) for kind in (0x06, 0x07, 0x08, 0x12, 0x13)],
        *[message(between(kind, UNKNOWN, SEDP_WRITERS)) for kind in (0x06, 0x07, 0x08, 0x12, 0x13)],
        *[message(submessage(kind, 0, bytes(40)), SAID) for kind in range(0x30, 0x35)],
        *[message(submessage(kind, 0, bytes(40)), SAID) for kind in (0x00, 0x0F, 0x81, 0xFF)],
        of_vendor(message(SAID, STATISTICS)),
    ],
)
def test_what_can_not_be_told_from_discovery_is_read(read: bytes) -> None:
    assert may_be_discovery(read)
