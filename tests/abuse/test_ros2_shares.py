"""ROS 2: no neighbour takes more than its share, and a healthy pair notices nothing.

Meanwhile a participant outside sends 100 messages a second inside, through a port that the proxy
relays in user space.
"""

import socket
from collections.abc import Iterator
from contextlib import closing

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import SubmessageId
from tests.abuse.apart import APART, APART_HOST, INSIDE, NODES, STRANGERS
from tests.abuse.conftest import Abused
from tests.abuse.pair import Pair
from tests.abuse.ros2_neighbours import WELL_KNOWN, Address, Counted, Flood, Participant, udp
from tests.integration.net import until
from tests.unit.ros2.discovery.domains import SEDP_WRITERS, spdp
from tests.unit.ros2.protocol.messages import data, message, payload, submessage

STEADY = bytes([1, 15, 3]) + bytes(9)
ROBOT = bytes([1, 15, 2]) + bytes(9)
EVIL = NODES[1]
PEER = STRANGERS[0]
PORTS = 64
ANNOUNCED = APART, WELL_KNOWN
"""The target of announcements from inside."""
LONGEST_GAP = 0.3
"""Seconds without a message, of a hundred in a second."""


@pytest.fixture
def first() -> int:
    """The first port of the proxy's range."""
    return free_ports(PORTS)


@pytest.fixture
def abused(start_abused, _apart, first) -> Abused:
    """A proxy for ROS 2 on a separate machine that relays user data in user space."""
    return start_abused(
        ros=2,
        prefix=_apart.prefix,
        advertise_host=APART_HOST,
        inside_network=INSIDE,
        admin_bind=f"{APART}:{free_ports(1)}",
        port_range=f"{first}-{first + PORTS - 1}",
        ros2_peer=f"{PEER}:{WELL_KNOWN}",
        data_plane="copy",
    )


@pytest.fixture
def robot(abused) -> Iterator[Participant]:
    """A participant at the proxy's peer."""
    with closing(Participant(ROBOT, PEER, WELL_KNOWN)) as made:
        yield made


@pytest.fixture
def pair(abused, robot) -> Iterator[Pair]:
    """A healthy pair. The test starts and stops the messages."""
    with closing(Participant(STEADY, NODES[0], WELL_KNOWN)) as inside:
        _, user = robot.hears(STEADY, lambda: inside.announce(ANNOUNCED))
        yield Pair(inside, PEER, (user.host, user.port), APART)


def evil(number: int) -> bytes:
    """The prefix of a hostile participant."""
    return bytes([1, 15, 7, number]) + bytes(8)


def stand_ins(abused: Abused, robot: Participant, first: int, count: int) -> list[Address]:
    """Announce this number of participants at the peer. Return their stand-ins inside."""
    for number in range(count):
        prefix = bytes([1, 15, 8, number]) + bytes(8)
        robot.meta.sendto(spdp(prefix, PEER, 9000 + number), (APART, first))
    (domain,) = abused.status()["domains"]
    leases = [lease for outsider in domain["outside"] for lease in outsider["leases"]]
    return [(APART, lease["port"]) for lease in leases]


def is_met(abused: Abused, sock: socket.socket, number: int) -> bool:
    """Announce a participant from a socket, and return whether the proxy admits the participant.

    The proxy reads the datagrams of a source in order, so all earlier datagrams have been read
    then.
    """
    address, _ = sock.getsockname()
    prefix = evil(number)
    sock.sendto(spdp(prefix, address, 9500 + number), ANNOUNCED)
    (domain,) = abused.status()["domains"]
    return prefix.hex() in {p["guid_prefix"].replace(".", "") for p in domain["inside"]}


def described(endpoint_count: int, parameter_count: int) -> bytes:
    """A datagram of 64 kB, in which readers and writers have many parameters."""
    content = payload([(Pid.TOPIC_NAME, b"\4\0\0\0rt/\0"), *[(0x1234, b"")] * parameter_count])
    samples = [
        data(content, writer=SEDP_WRITERS, sequence=number)
        for number in range(1, endpoint_count + 1)
    ]
    size = len(message(*samples))
    padding = [submessage(SubmessageId.PAD, 0, bytes(64_000 - size))] if size < 64_000 else []
    return message(*samples, *padding, prefix=evil(1))


async def test_one_address_sends_long_discovery_to_all_stand_ins(abused, robot, pair, first):
    """180 datagrams of 64 kB took three to five seconds, in which nothing else was served."""
    await until(lambda: len(stand_ins(abused, robot, first, 60)) >= 60, "60 are known")
    ports = stand_ins(abused, robot, first, 60)
    with abused.watched(), pair, closing(udp(EVIL)) as sock:
        await until(lambda: is_met(abused, sock, 1), "the hostile participant is met")
        for datagram in (described(31, 500), described(32, 120), described(31, 500)):
            for port in ports:
                sock.sendto(datagram, port)
        await until(lambda: is_met(abused, sock, 2), "all waiting datagrams are read")
    assert pair.figures.lost == 0
    assert pair.figures.longest_gap < LONGEST_GAP


async def test_a_message_in_which_many_speak_is_not_multiplied(abused, robot, pair, first):
    """A long INFO_DST went into each part: of 195 kB the peer got 209 MB."""
    await until(lambda: stand_ins(abused, robot, first, 1), "the robot is known")
    port, *_ = stand_ins(abused, robot, first, 1)
    heartbeat = submessage(0x07, 0, bytes(4) + SEDP_WRITERS.to_bytes(4, "big") + bytes(20))
    part = submessage(0x0C, 0, bytes(4) + b"\2\3\1\x0f" + evil(1)) + heartbeat
    info_dst = submessage(0x0E, 0, ROBOT + bytes(55_000))
    datagram = message(info_dst, *[part] * 120, prefix=evil(1))
    with closing(Counted(PEER)) as counted, closing(udp(EVIL)) as sock, abused.watched(), pair:
        await until(lambda: is_met(abused, sock, 1), "the hostile participant is met")
        counted.bytes_from([APART, APART_HOST])
        for _ in range(10):
            sock.sendto(datagram, port)
        arrived = 0

        def has_arrived() -> bool:
            nonlocal arrived
            arrived += counted.bytes_from([APART, APART_HOST])
            return arrived > len(datagram)

        await until(has_arrived, "the peer gets a part")
        await until(lambda: is_met(abused, sock, 2), "all waiting datagrams are read")
        has_arrived()
    assert arrived <= 3 * 10 * len(datagram)
    assert pair.figures.lost == 0
    assert pair.figures.longest_gap < LONGEST_GAP


def forged_crowd(address: str) -> list[tuple[str, Address, bytes]]:
    """Announcements in the name of participants at an address that is another container's."""
    return [
        (address, ANNOUNCED, spdp(evil(number), address, 9000 + 2 * number, lease=300))
        for number in range(100)
    ]


async def test_forged_participants_at_an_address_keep_no_new_one_out(abused, robot, pair):
    """A neighbour announces participants at a container's address."""
    flood = Flood(forged_crowd(NODES[0]), is_forged=True, per_second=500)
    with abused.watched(), pair, flood, closing(Participant(evil(200), NODES[0], 8000)) as new:
        flood.wait(200)
        new.proves_to_receive(lambda: new.announce(ANNOUNCED))
        robot.hears(evil(200), lambda: new.announce(ANNOUNCED))
    assert pair.figures.lost == 0
    assert pair.figures.longest_gap < LONGEST_GAP
