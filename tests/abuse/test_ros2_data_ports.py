"""ROS 2: discovery at a port for user data, where Cyclone DDS reads discovery.

A reader of a denied topic that a stranger announced there matched, and got that topic's data.
"""

import struct
from collections.abc import Iterator
from contextlib import closing

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import SubmessageId, submessages
from tests.abuse.apart import APART, APART_HOST, INSIDE, NODES, STRANGERS
from tests.abuse.conftest import Abused
from tests.abuse.ros2_neighbours import WELL_KNOWN, Address, Flood, Participant, udp
from tests.abuse.test_ros2_shares import (  # noqa: F401 - fixtures
    ANNOUNCED,
    LONGEST_GAP,
    PEER,
    PORTS,
    ROBOT,
    first,
    pair,
    robot,
)
from tests.unit.ros2.discovery.domains import CYCLONE_DDS, SEDP_WRITERS, of_vendor, sedp
from tests.unit.ros2.protocol.messages import data, fragment, message, payload, submessage

READER = bytes([1, 16, 1]) + bytes(9)
"""The prefix of a participant inside of Cyclone DDS."""
EVIL = STRANGERS[3]
COUNT = 6000
PER_SECOND = 3000
"""Datagrams of a flood."""
USER_WRITER = 0x00001203


@pytest.fixture
def abused(start_abused, _apart, first) -> Abused:  # noqa: F811 - the fixture
    """A proxy for ROS 2 that relays user data itself, and denies a topic."""
    return start_abused(
        ros=2,
        prefix=_apart.prefix,
        advertise_host=APART_HOST,
        inside_network=INSIDE,
        admin_bind=f"{APART}:{free_ports(1)}",
        port_range=f"{first}-{first + PORTS - 1}",
        ros2_peer=f"{PEER}:{WELL_KNOWN}",
        policy="deny subscribe /chatter",
        data_plane="copy",
    )


@pytest.fixture
def reader(abused) -> Iterator[Participant]:
    """A participant inside that reads discovery at the port for user data."""
    with closing(Participant(READER, NODES[2], WELL_KNOWN, CYCLONE_DDS)) as made:
        made.data.settimeout(30)
        yield made


def user_data(marker: bytes) -> bytes:
    return message(data(marker, writer=USER_WRITER), prefix=ROBOT)


def fragments() -> list[bytes]:
    """A reader or writer that is announced in two datagrams."""
    named = (Pid.TOPIC_NAME, struct.pack("<I", 11) + b"rt/chatter\0\0")
    whole = payload([named, (Pid.ENTITY_NAME, bytes(200))])
    return [
        message(fragment(chunk, number, 128, len(whole), writer=SEDP_WRITERS), prefix=ROBOT)
        for number, chunk in enumerate((whole[:128], whole[128:]), 1)
    ]


def announced() -> list[bytes]:
    """Discovery in many forms."""
    whole = sedp(ROBOT, PEER, 7000)
    info_src = submessage(0x0C, 0, bytes(4) + b"\2\3\1\x10" + ROBOT)
    of_writer = bytes(4) + SEDP_WRITERS.to_bytes(4, "big") + bytes(20)
    return [
        whole,
        of_vendor(whole, b"\xab\xcd"),
        *fragments(),
        message(user_data(b"")[20:], whole[20:], prefix=ROBOT),
        message(info_src, whole[20:], prefix=bytes([1, 15, 9]) + bytes(9)),
        message(whole[20:], b"\x15\1\xff\xff", prefix=ROBOT),
        *[message(submessage(kind, 0, of_writer), prefix=ROBOT) for kind in (6, 7, 8, 0x12, 0x13)],
    ]


def arrived(reader: Participant, last: bytes) -> list[bytes]:
    """The datagrams at the port for user data before the last datagram."""
    datagrams = list[bytes]()
    while (datagram := reader.data.recv(65536)) != last:
        datagrams.append(datagram)
    return datagrams


def flood_of_discovery(user: Address, is_forged: bool) -> None:
    """Send discovery from the stranger's address, or from many forged addresses."""
    sources = [f"198.18.{3 + n // 250}.{n % 250 + 1}" for n in range(500)] if is_forged else [EVIL]
    datagrams = [(source, user, datagram) for source in sources for datagram in announced()]
    with Flood(datagrams, is_forged, per_second=PER_SECOND) as flood:
        flood.wait(COUNT)


async def test_strangers_announce_at_a_port_for_user_data(
    abused,
    robot,  # noqa: F811 - the fixture
    pair,  # noqa: F811 - the fixture
    reader,
):
    locators = robot.hears(READER, lambda: reader.announce(ANNOUNCED))
    meta, user = ((locator.host, locator.port) for locator in locators)
    reader.hears(ROBOT, lambda: robot.announce(meta))
    with abused.watched(), pair, closing(udp(EVIL)) as stranger:
        for is_forged in (False, True):
            flood_of_discovery(user, is_forged)
            last = user_data(b"of a stranger, %d" % is_forged)
            stranger.sendto(last, user)
            assert arrived(reader, last) == []
    assert "not_a_peer" in abused.refused()
    assert pair.figures.lost == 0
    assert pair.figures.longest_gap < LONGEST_GAP


async def test_a_peer_announces_at_a_port_for_user_data(abused, robot, reader):  # noqa: F811
    locators = robot.hears(READER, lambda: reader.announce(ANNOUNCED))
    meta, user = ((locator.host, locator.port) for locator in locators)
    reader.hears(ROBOT, lambda: robot.announce(meta))
    with abused.watched():
        for datagram in (sedp(ROBOT, PEER, 7000), *fragments()):
            robot.meta.sendto(datagram, user)
        hidden = [reader.data.recv(65536) for _ in range(2)]
        robot.meta.sendto(user_data(b"last"), user)
        assert arrived(reader, user_data(b"last")) == []
    for datagram in hidden:
        assert [kind for kind, _, _ in submessages(datagram)] == [
            SubmessageId.GAP,
            SubmessageId.PAD,
        ]
        assert b"chatter" not in datagram
