"""ROS 2: attacks from an outside address that is proven, or that is a peer's.

Meanwhile a participant outside sends 100 messages a second inside, through a port that the proxy
relays in user space. A crowd of participants inside gets each announcement.
"""

import struct
from collections.abc import AsyncIterator
from contextlib import ExitStack, closing
from functools import partial

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import FAST_DDS, HEADER_BYTES, VERSION, source_prefix
from rosproxy.shared.addresses import HostPort
from tests.abuse.apart import APART, APART_HOST, INSIDE, NODES
from tests.abuse.conftest import Abused
from tests.abuse.ros2_neighbours import WELL_KNOWN, Flood, Participant
from tests.abuse.test_ros2_shares import (  # noqa: F401 - fixtures
    ANNOUNCED,
    LONGEST_GAP,
    PEER,
    pair,
    robot,
)
from tests.integration.net import until
from tests.unit.ros2.discovery.domains import SEDP_WRITERS, spdp
from tests.unit.ros2.protocol.messages import data, message, payload, submessage

EVIL_PREFIX = bytes([1, 15, 7]) + bytes(9)
PORTS = 256
CROWD = 50
AT_ONE_ADDRESS = 16
"""Participants of the crowd at an address."""
AMONG = 30_000
"""Datagrams of a flood."""
PER_SECOND = 5000
NAMED_TO = 20
"""Participants inside to which names are made up."""
NAMED_PER_SECOND = 1500
NAMED_GROWTH = 32_000_000
"""Bytes by which the proxy may grow then. The names may take 13 MB, and datagrams that wait some
more."""


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
async def crowd(abused) -> AsyncIterator[list[Participant]]:
    """Participants inside; the address of each has proved to receive."""
    with ExitStack() as stack:
        made = [stack.enter_context(closing(crowd_member(number))) for number in range(CROWD)]
        for leader in made[::AT_ONE_ADDRESS]:
            leader.proves_to_receive(partial(leader.announce, ANNOUNCED))

        def is_known() -> bool:
            for participant in made:
                participant.announce(ANNOUNCED)
            (domain,) = abused.status()["domains"]
            return len(domain["inside"]) >= CROWD

        await until(is_known, "the crowd is known")
        yield made


def crowd_member(number: int) -> Participant:
    prefix = bytes([1, 15, 6, number]) + bytes(8)
    return Participant(prefix, NODES[2 + number // AT_ONE_ADDRESS], 20_000 + 2 * number)


def speaking(count: int) -> bytes:
    """A datagram in which so many participants at the peer announce themselves."""
    parts = list[bytes]()
    for number in range(count):
        prefix = bytes([1, 15, 8, number]) + bytes(8)
        parts.append(submessage(0x0C, 0, bytes(4) + VERSION + FAST_DDS + prefix))
        parts.append(spdp(prefix, PEER, 9000 + number)[HEADER_BYTES:])
    return message(*parts, prefix=EVIL_PREFIX)


def known_outside(abused: Abused) -> set[str]:
    """The prefixes of the participants outside."""
    (domain,) = abused.status()["domains"]
    return {outsider["guid_prefix"].replace(".", "") for outsider in domain["outside"]}


async def test_many_announce_themselves_at_once(abused, robot, crowd, pair, first):  # noqa: F811
    """Six datagrams of 17 kB took seconds: no message came for 1.4 s, and 219 of 330 were lost."""
    discovery = APART_HOST, first
    last = bytes([1, 15, 9]) + bytes(9)
    with abused.watched(), pair:
        for _ in range(6):
            robot.meta.sendto(speaking(120), discovery)

        def is_read() -> bool:
            robot.meta.sendto(spdp(last, PEER, 9900), discovery)
            return last.hex() in known_outside(abused)

        await until(is_read, "all that waited has been read")
    assert pair.figures.lost == 0
    assert pair.figures.longest_gap < LONGEST_GAP


def ports_for_discovery(abused: Abused) -> list[int]:
    """The ports of the range at which the participants inside get discovery."""
    (domain,) = abused.status()["domains"]
    leases = [lease for insider in domain["inside"] for lease in insider["leases"]]
    return [lease["port"] for lease in leases if lease["kind"] == "metatraffic"]


def named(number: int) -> bytes:
    """The announcement of a writer, with a topic name that takes four times its bytes."""
    name = b"rt/" + f"\U0001f600{number:05d}".encode() + b"x" * 240 + b"\0" * 4
    parameters = [
        (Pid.ENDPOINT_GUID, EVIL_PREFIX + number.to_bytes(3, "big") + b"\3"),
        (Pid.TOPIC_NAME, struct.pack("<I", len(name)) + name),
        (Pid.TYPE_NAME, struct.pack("<I", len(name)) + name),
    ]
    content = data(payload(parameters), writer=SEDP_WRITERS, sequence=number + 1)
    return message(content, prefix=EVIL_PREFIX)


async def test_a_peer_makes_up_names(abused, robot, crowd, pair, first):  # noqa: F811
    """With 1,024 names for each of 20 participants inside, the proxy once took 86 MB."""
    robot.meta.sendto(spdp(EVIL_PREFIX, PEER, 9000), (APART_HOST, first))
    await until(lambda: EVIL_PREFIX.hex() in known_outside(abused), "the attacker is known")
    ports = ports_for_discovery(abused)[:NAMED_TO]
    datagrams = [
        (PEER, (APART_HOST, port), named(number)) for number in range(1024) for port in ports
    ]
    flood = Flood(datagrams, False, per_second=NAMED_PER_SECOND)
    with abused.watched(NAMED_GROWTH), pair, flood:
        flood.wait(len(datagrams))
    assert pair.figures.lost == 0
    assert pair.figures.longest_gap < LONGEST_GAP


async def test_an_address_repeats_its_answer(abused, robot, crowd, pair, first):  # noqa: F811
    """An announcement behind an answer was read at any rate: no message came for 0.4 s."""
    discovery = APART_HOST, first
    question = robot.is_asked(lambda: robot.announce(discovery))
    locator = pack_locator(HostPort(PEER, 9000), "<")
    announcement = data(payload([(Pid.METATRAFFIC_UNICAST_LOCATOR, locator)]))
    info_dst = submessage(0x0E, 0, source_prefix(question))
    answer = message(info_dst, announcement, prefix=EVIL_PREFIX)
    flood = Flood([(PEER, discovery, answer)], False, per_second=PER_SECOND)
    with abused.watched(), pair, flood:
        flood.wait(AMONG)
    assert pair.figures.lost == 0
    assert pair.figures.longest_gap < LONGEST_GAP
    assert "rate" in abused.refused()
