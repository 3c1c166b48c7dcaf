"""ROS 2: the proxy is killed and restarts, and attackers claim other participants' ports.

Participants answer the proxy like DDS readers, and remember the proxy's numbers. The proxy relays
user data in user space, and outside is silent until the attacker has had a turn.
"""

import time
from collections.abc import Iterator
from contextlib import closing, suppress
from typing import Any

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.ros2.ports.store import PortStore, port_store_key
from rosproxy.ros2.protocol.relay_envelope import wrapped
from rosproxy.ros2.protocol.relay_proof import Direction, RelayProof
from rosproxy.ros2.protocol.reliable import heartbeats
from rosproxy.ros2.protocol.rtps import NO_VENDOR, source_prefix, source_vendor
from rosproxy.shared.ports import PortRange
from tests.abuse.apart import APART, APART_HOST, INSIDE, NODES, STRANGERS
from tests.abuse.conftest import Abused
from tests.abuse.ros2_neighbours import PADDING, WELL_KNOWN, Participant, udp
from tests.abuse.test_ros2 import served
from tests.integration.net import until
from tests.unit.ros2.discovery.domains import kept_number, spdp
from tests.unit.ros2.protocol.messages import message, submessage

GOOD = bytes([1, 15, 1]) + bytes(9)
ROBOT = bytes([1, 15, 2]) + bytes(9)
THIEF = bytes([1, 15, 7]) + bytes(9)
EVIL = NODES[1]
LAN_RELAY = NODES[19]
SECRET = "0123456789abcdef"
PORTS = 64
ANNOUNCED = APART, WELL_KNOWN
MESSAGES = 20


class Reader(Participant):
    """A participant that answers the proxy, and remembers the expected number of each writer.

    A number in ``claimed`` replaces the true number.
    """

    def __init__(self, prefix: bytes, address: str, port: int) -> None:
        super().__init__(prefix, address, port)
        self.meta.setblocking(False)
        self.numbers: dict[tuple[bytes, int], int] = {}
        self.claimed: dict[tuple[bytes, int], int] = {}

    def live(self) -> None:
        """Announce the participant, and answer all received datagrams."""
        self.announce(ANNOUNCED)
        with suppress(BlockingIOError):
            while True:
                self._answer(self.meta.recv(65536))

    def _answer(self, datagram: bytes) -> None:
        if source_vendor(datagram) != NO_VENDOR:
            return
        own = source_prefix(datagram)
        for heartbeat in heartbeats(datagram):
            writer = own, heartbeat.writer
            number = max(self.numbers.get(writer, 1), heartbeat.first)
            self.numbers[writer] = number
            told = self.claimed.get(writer, number)
            answer = kept_number(own, self.prefix, told, heartbeat.writer)
            self.meta.sendto(answer, ANNOUNCED)


@pytest.fixture
def first() -> int:
    """The first port of the proxy's range."""
    return free_ports(PORTS)


@pytest.fixture
def abused(start_abused, _apart, first) -> Abused:
    """A proxy for ROS 2 on a separate machine, with a secret, that relays user data in user
    space.
    """
    return start_abused(
        ros=2,
        prefix=_apart.prefix,
        advertise_host=APART_HOST,
        inside_network=INSIDE,
        admin_bind=f"{APART}:{free_ports(1)}",
        port_range=f"{first}-{first + PORTS - 1}",
        ros2_peer=f"{STRANGERS[0]}:{WELL_KNOWN}",
        ros2_lan_relay=f"{LAN_RELAY}:{WELL_KNOWN}",
        ros2_lan_relay_secret=SECRET,
        data_plane="copy",
    )


@pytest.fixture
def good(abused) -> Iterator[Reader]:
    """A participant inside."""
    with closing(Reader(GOOD, NODES[0], WELL_KNOWN)) as made:
        yield made


@pytest.fixture
def thief(abused) -> Iterator[Reader]:
    """A participant inside that claims another participant's ports."""
    with closing(Reader(THIEF, EVIL, WELL_KNOWN)) as made:
        yield made


@pytest.fixture
def robot(abused) -> Iterator[Participant]:
    """A participant at the proxy's peer."""
    with closing(Participant(ROBOT, STRANGERS[0], WELL_KNOWN)) as made:
        yield made


def participants(abused: Abused, side: str) -> dict[str, dict[str, Any]]:
    """The participants of a side, by prefix and address."""
    (domain,) = abused.status()["domains"]
    return {f"{p['guid_prefix'].replace('.', '')} {p['address']}": p for p in domain[side]}


def ports(abused: Abused, participant: Participant) -> list[int]:
    """The ports of a participant inside; empty if the proxy does not serve the participant."""
    found = participants(abused, "inside").get(f"{participant.prefix.hex()} {participant.address}")
    return [lease["port"] for lease in found["leases"]] if found else []


async def serve_and_restart(abused: Abused, good: Reader, robot: Participant) -> list[int]:
    """Serve a pair until the ports are kept, then restart the proxy. Return the ports."""
    good.meta.settimeout(0.1)
    meta, user = served(good, robot, b"before")
    good.meta.setblocking(False)
    key = f"{GOOD.hex()} {good.address}"

    def is_kept() -> bool:
        good.live()
        return bool(participants(abused, "inside")[key]["kept"])

    await until(is_kept, "the ports are kept")
    abused.kill()
    abused.start()
    return [meta[1], user[1]]


async def has_its_ports(abused: Abused, good: Reader, before: list[int]) -> None:
    """Wait until a participant has its former ports."""

    def is_served() -> bool:
        good.live()
        return ports(abused, good) == before

    await until(is_served, "the participant is served at its ports")


def gets_all(good: Participant, robot: Participant, port: int, others: Participant) -> None:
    """Check that datagrams from outside to a port arrive at a single participant."""
    good.data.settimeout(5)
    others.data.setblocking(False)
    for number in range(MESSAGES):
        content = message(submessage(0x07, 0, bytes(24) + b"%d" % number), prefix=ROBOT)
        robot.data.sendto(content, (APART_HOST, port))
        while good.data.recv(65536) != content:
            pass
    with pytest.raises(BlockingIOError):
        others.data.recv(65536)


@pytest.mark.parametrize("has_proof", [True, False])
@pytest.mark.parametrize("is_alone", [True, False])
async def test_a_claimed_port_goes_to_its_former_participant(
    abused, good, robot, thief, first, has_proof, is_alone
):
    """The attacker got the ports, and the messages, in 20 of 20 restarts."""
    before = await serve_and_restart(abused, good, robot)
    listened = PortRange(first, first + PORTS - 1)
    port_store = PortStore.of(APART_HOST, listened, 0, 0.0, port_store_key(SECRET))
    seen = port_store.numbers(GOOD, before)
    thief.claimed = {
        writer: number if has_proof or writer[0] == port_store.prefix else 1
        for writer, number in seen.items()
    }
    with abused.watched():

        def has_had_its_turn() -> bool:
            thief.live()
            if not is_alone:
                good.live()
            return bool(ports(abused, thief)) or ports(abused, good) == before

        await until(has_had_its_turn, "the attacker has had its turn")
        await has_its_ports(abused, good, before)
        gets_all(good, robot, before[1], thief)
        for _ in range(MESSAGES):
            thief.live()
        assert not {*ports(abused, thief)} & {*before}
        assert ports(abused, good) == before


async def test_a_prefix_of_inside_goes_to_its_former_participant(abused, good, robot, first):
    """A host on the LAN that used the prefix kept the participant from being served."""
    before = await serve_and_restart(abused, good, robot)
    proof = RelayProof(SECRET, time.time)
    with closing(udp(LAN_RELAY)) as relay, closing(Participant(GOOD, STRANGERS[3], 9000)) as liar:

        def forge() -> None:
            heard = wrapped(liar.address, spdp(GOOD, liar.address, 9000, padding=PADDING))
            relay.sendto(proof.sealed(Direction.TO_PROXY, heard), (APART, first))

        key = f"{GOOD.hex()} {liar.address}"

        def is_known() -> bool:
            forge()
            return key in participants(abused, "outside")

        await until(is_known, "the attacker is known outside")
        with abused.watched():

            def is_served() -> bool:
                forge()
                good.live()
                return ports(abused, good) == before

            await until(is_served, "the participant is served at its ports")
            for _ in range(MESSAGES):
                forge()
            assert key not in participants(abused, "outside")
            assert "prefix" in abused.refused()
            gets_all(good, robot, before[1], liar)


async def test_a_prefix_of_a_peer_goes_to_the_participant_that_had_it(abused, good, robot):
    """A container that used the prefix kept the robot from being heard."""
    before = await serve_and_restart(abused, good, robot)
    with closing(Reader(ROBOT, EVIL, WELL_KNOWN)) as liar, abused.watched():

        def is_in() -> bool:
            liar.live()
            return bool(ports(abused, liar))

        await until(is_in, "the attacker is served")
        await has_its_ports(abused, good, before)

        def is_heard() -> bool:
            liar.live()
            robot.announce((APART_HOST, before[0]), (APART, discovery_port(abused)))
            return f"{ROBOT.hex()} {robot.address}" in participants(abused, "outside")

        await until(is_heard, "the robot is heard")
        for _ in range(MESSAGES):
            liar.live()
        assert not ports(abused, liar)
        gets_all(good, robot, before[1], liar)


def discovery_port(abused: Abused) -> int:
    """The port of the range at which outside announces itself."""
    return int(str(abused.options["port_range"]).split("-")[0])
