"""ROS 2: floods of datagrams from any source. Others are served, and no victim is flooded."""

import itertools
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from ipaddress import ip_network
from subprocess import PIPE, Popen

import pytest

from examples.demo.fake_http import free_ports
from examples.demo.proxy_process import clean_environment
from rosproxy.ros2.domain_settings import MOST_OUTSIDE_UNPROVEN, MOST_PER_UNPROVEN
from rosproxy.ros2.lan_relay.sources import UNPROVEN_BURST, UNPROVEN_PER_SECOND
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.relay_envelope import wrapped
from rosproxy.ros2.protocol.relay_proof import Direction, RelayProof
from rosproxy.ros2.servers.groups import group_socket, join
from rosproxy.ros2.sources.rates import cost
from rosproxy.shared.addresses import HostPort
from tests.abuse.apart import APART, APART_HOST, INSIDE, NODES, STRANGERS
from tests.abuse.conftest import Abused
from tests.abuse.ros2_neighbours import (
    PADDING,
    WELL_KNOWN,
    Address,
    Counted,
    Flood,
    Participant,
    forge,
)
from tests.integration.net import until
from tests.unit.ros2.discovery.domains import SEDP_WRITERS, dispose_message, sedp, spdp
from tests.unit.ros2.protocol.messages import (
    data,
    fragment,
    message,
    parameter_list,
    payload,
    submessage,
)

GOOD = bytes([1, 15, 1]) + bytes(9)
ROBOT = bytes([1, 15, 2]) + bytes(9)
LAPTOP = bytes([1, 15, 4]) + bytes(9)
NEWCOMER = bytes([1, 15, 5]) + bytes(9)
EVIL = NODES[1]
LAN_RELAY = NODES[19]
VICTIM = STRANGERS[9]
SECRET = "0123456789abcdef"
"""The shared secret of the proxy and its LAN relay."""
PORTS = 64
MORE = 20_000_000
"""Bytes that a second flood may take more than the first."""
PER_SECOND = 5000
"""Announcements that a forger sends to a LAN in a second."""
RELAYED_PER_SECOND = 10_000
"""Announcements that a forger sends in a second to a LAN with a relay."""
HEARD = 40
"""Announcements of an honest participant that the relay has to carry meanwhile."""
FORGED_NETWORK = ip_network("198.19.0.0/18")
"""Forged sources."""
AMONG = 20_000
"""Datagrams of a flood in which all others are served."""
ANNOUNCED = APART, WELL_KNOWN
"""The target of announcements from inside."""
GROUP = "239.255.0.1", 7400
"""The target of announcements on the LAN."""


@pytest.fixture
def first() -> int:
    """The first port of the proxy's range."""
    return free_ports(PORTS)


@pytest.fixture
def abused(start_abused, _apart, first) -> Abused:
    """A proxy for ROS 2 on a separate machine."""
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
    )


@pytest.fixture
def good(abused) -> Iterator[Participant]:
    """A participant inside."""
    with closing(Participant(GOOD, NODES[0], WELL_KNOWN)) as made:
        yield made


@pytest.fixture
def robot(abused) -> Iterator[Participant]:
    """A participant at the proxy's peer."""
    with closing(Participant(ROBOT, STRANGERS[0], WELL_KNOWN)) as made:
        yield made


def served(good: Participant, robot: Participant, marker: bytes) -> list[Address]:
    """Check that both discover each other, and that data arrives. Return the inside's locators."""
    locators = robot.hears(GOOD, lambda: good.announce(ANNOUNCED))
    assert [locator.host for locator in locators] == [APART_HOST] * 2
    meta, user = ((locator.host, locator.port) for locator in locators)
    (stand_in, _) = good.hears(ROBOT, lambda: robot.announce(meta))
    assert stand_in.host == APART
    content = message(submessage(0x07, 0, bytes(24) + marker), prefix=ROBOT)
    good.gets(content, lambda: robot.data.sendto(content, user))
    return [meta, user]


def carried(source: str, datagram: bytes, secret: str = SECRET) -> bytes:
    """The LAN relay's message for a datagram from an address."""
    proof = RelayProof(secret, time.time)
    return proof.sealed(Direction.TO_PROXY, wrapped(source, datagram))


def prefix(number: int) -> bytes:
    return bytes([1, 15, 9, 9]) + number.to_bytes(8, "big")


def described(number: int, count: int) -> bytes:
    """A topic's description with many locators and parameters."""
    name = b"rt/%06d\0" % number * 20
    locators = [pack_locator(HostPort(EVIL, 1024 + offset), "<") for offset in range(count)]
    parameters = [(Pid.UNICAST_LOCATOR, locator) for locator in locators] + [(0x1234, b"")] * count
    return payload([(Pid.TOPIC_NAME, struct.pack("<I", len(name)) + name), *parameters])


def heavy(number: int) -> list[bytes]:
    """Datagrams of a participant that are made to take time and memory."""
    own = prefix(number % 60)
    sequences = range(number * 256 + 1, number * 256 + 257)
    qos = parameter_list([(0x1234, b"")] * 40)
    named = (Pid.TOPIC_NAME, b"\4\0\0\0rt/\0")
    kinds = [
        [
            data(described(sequence, 200), writer=SEDP_WRITERS, sequence=sequence)
            for sequence in sequences[:8]
        ],
        [
            data(payload([named]), qos=qos, writer=SEDP_WRITERS, sequence=sequence)
            for sequence in sequences
        ],
        [
            fragment(b"four", 1, 128, 300, writer=SEDP_WRITERS, sequence=sequence)
            for sequence in sequences[:60]
        ],
        [
            data(described(sequence, 1), writer=SEDP_WRITERS, sequence=sequence)
            for sequence in sequences[:150]
        ],
        [submessage(0x07, 0, bytes(4) + SEDP_WRITERS.to_bytes(4, "big") + b"\1" * 20)] * 256,
    ]
    kinds[2] += kinds[0][:7]
    return [message(*submessages, prefix=own)[:65_000] for submessages in kinds]


def announced() -> list[tuple[str, Address, bytes]]:
    """Participants that come, speak at length, go, and are too many."""
    said = [[spdp(prefix(number), EVIL, 9000 + number), *heavy(number)] for number in range(100)]
    said += [
        [spdp(prefix(number), EVIL), dispose_message(prefix(number))] for number in range(40, 400)
    ]
    return [(EVIL, ANNOUNCED, datagram) for datagram in itertools.chain(*said)]


async def test_one_address_inside_floods(abused, good, robot):
    """Thirty long datagrams a second kept /healthz from answering; fragments took 600 MB."""
    served(good, robot, b"before")

    def evil_count() -> int:
        return sum(
            participant["address"] == EVIL
            for participant in abused.status()["domains"][0]["inside"]
        )

    with abused.watched():
        arrived = [
            (EVIL, ANNOUNCED, spdp(prefix(number), EVIL, 9000 + number)) for number in range(60)
        ]
        with Flood(arrived, is_forged=False):
            await until(lambda: evil_count() >= 20, "the participants are admitted")
        with Flood(announced(), is_forged=False) as flood:
            served(good, robot, b"amid")
            await until(lambda: "rate" in abused.refused(), "the address exceeds its rate")
            flood.wait(AMONG)
        served(good, robot, b"after")
        most = abused.most_memory()
        with Flood(announced(), is_forged=False) as flood:
            flood.wait(AMONG)
        served(good, robot, b"again")
        dispose_messages = [
            (EVIL, ANNOUNCED, dispose_message(prefix(number))) for number in range(400)
        ]
        with Flood(dispose_messages, is_forged=False):
            await until(lambda: evil_count() == 0, "the participants have gone")
    assert abused.most_memory() - most < MORE


def test_strangers_flood(abused, good, robot, first):
    """At all ports, from own and from forged addresses."""
    leases = served(good, robot, b"before")
    ports = [(APART, port) for port in range(first, first + PORTS)]
    said = [spdp(prefix(1), STRANGERS[3]), *heavy(1), dispose_message(GOOD), b"\0" * 999]
    said += [sedp(ROBOT, STRANGERS[0], 4000, to=GOOD)]
    own = [
        (STRANGERS[3], to, datagram) for to in ports for datagram in said if to not in leases[1:]
    ]
    forged = [
        (f"198.18.{3 + number % 200}.{number % 250 + 1}", to, datagram[:1400])
        for number, (_, to, datagram) in enumerate(own * 4)
    ]
    with closing(Counted(STRANGERS[3])) as counted, abused.watched():
        for kind in (own, forged):
            with Flood(kind, is_forged=kind is forged) as flood:
                flood.wait(AMONG // 2)
                assert served(good, robot, b"amid") == leases
                flood.wait(AMONG)
        assert served(good, robot, b"after") == leases
        assert counted.bytes_from([APART, APART_HOST]) == 0
    (domain,) = abused.status()["domains"]
    assert [participant["address"] for participant in domain["outside"]] == [robot.address]


def test_no_attacker_takes_or_ends_another_participant(abused, good, robot, first):
    """By its prefix, from inside and outside. Nor does an attacker get a port to another host."""
    leases = served(good, robot, b"before")
    for number, source in enumerate((EVIL, STRANGERS[3])):
        said = [
            dispose_message(GOOD),
            dispose_message(ROBOT),
            spdp(GOOD, source, 9000),
            spdp(ROBOT, source, 9000),
            spdp(GOOD, good.address, 9000),
            spdp(prefix(number), good.address, WELL_KNOWN),
            message(
                submessage(0x0C, 0, bytes(8) + GOOD), dispose_message(GOOD)[20:], prefix=prefix(8)
            ),
        ]
        to = [ANNOUNCED, (APART, first), (APART, leases[0][1])]
        with Flood(
            [(source, at, datagram) for at in to for datagram in said], is_forged=False
        ) as flood:
            flood.wait(2000)
            assert served(good, robot, b"amid") == leases
    (domain,) = abused.status()["domains"]
    led = {lease["where"] for participant in domain["inside"] for lease in participant["leases"]}
    assert led == {f"{good.address}:{WELL_KNOWN}", f"{good.address}:{WELL_KNOWN + 1}"}
    assert {participant["address"] for participant in domain["outside"]} == {robot.address}


def test_no_victim_gets_more_than_came_in_its_name(abused, good, robot, first):
    """A forger names a victim, and participants inside send much to each new participant."""
    served(good, robot, b"before")
    heard = [spdp(prefix(number), VICTIM, 4000 + number) for number in range(MOST_PER_UNPROVEN)]
    with closing(Counted(VICTIM)) as counted, abused.watched():
        came = got = 0
        for datagram in heard:
            forge(LAN_RELAY, (APART, first), carried(VICTIM, datagram))
            came += len(datagram)
            (stand_in, _) = good.hears(datagram[8:20], lambda: None)
            for _ in range(100):
                good.meta.sendto(sedp(GOOD, good.address, 4000), (stand_in.host, stand_in.port))
            forge(VICTIM, (APART, first), dispose_message(prefix(999)))
            served(good, robot, b"amid")
            got += counted.bytes_from([APART, APART_HOST])
            assert got <= came
    assert got > 0
    assert "unproven" in abused.refused()


def test_a_process_at_the_relays_address_is_not_the_relay(abused, good, robot, first):
    """Behind Docker's port proxy each client has the relay's address. Forged claims must not make
    inside hosts participants outside.
    """
    served(good, robot, b"before")
    host = NODES[5]
    claims = [(host, 9999), (APART, first), (APART_HOST, first + 3), ("127.0.0.1", 9999)]
    said = [spdp(prefix(number), *claim) for number, claim in enumerate(claims)]
    said.append(spdp(prefix(9), LAN_RELAY, 9999))
    unproven = [wrapped(claim[0], told) for claim, told in zip(claims, said, strict=False)]
    forged = [
        carried(claim[0], told, "another secret") for claim, told in zip(claims, said, strict=False)
    ]
    with closing(Counted(host)) as counted, abused.watched():
        datagrams = [*said, *unproven, *forged, carried(VICTIM, said[0])[:27]]
        with Flood([(LAN_RELAY, (APART, first), d) for d in datagrams], is_forged=False) as flood:
            flood.wait(AMONG // 2)
            served(good, robot, b"amid")
        assert {"not_a_peer", "relay_proof"} <= abused.refused()
        assert not {"claimed_address", "own_port"} & abused.refused()
        # Nor may the relay lead there if a machine on the LAN forges its source.
        for number, claim in enumerate(claims):
            forge(LAN_RELAY, (APART, first), carried(claim[0], spdp(prefix(20 + number), *claim)))
        served(good, robot, b"after")
        assert {"claimed_address", "own_port"} <= abused.refused()
        assert counted.bytes_from([APART, APART_HOST]) == 0
    (domain,) = abused.status()["domains"]
    assert {participant["address"] for participant in domain["outside"]} == {robot.address}


@pytest.fixture
def lan_relay(abused, first) -> Iterator[Popen[str]]:
    """The LAN relay, on the LAN of the strangers."""
    command = [sys.executable, "-m", "rosproxy", "lan-relay", "--lan", STRANGERS[1]]
    command += ["--bind", f"{LAN_RELAY}:{WELL_KNOWN}", "--proxy", f"{APART}:{first}"]
    command += ["--secret", SECRET]
    with Popen(command, stderr=PIPE, text=True, env=clean_environment()) as made:
        assert made.stderr
        assert "ready: " in made.stderr.readline()
        yield made
        made.terminate()
        assert "Traceback" not in made.stderr.read()


async def test_a_flood_on_the_lan(abused, good, lan_relay):
    """Discovery goes on in both directions."""
    said = [message(prefix=prefix(1)), *heavy(1), *(spdp(prefix(n), EVIL) for n in range(30))]
    laptop = Participant(ROBOT, STRANGERS[2], WELL_KNOWN)
    listening = group_socket(HostPort(*GROUP))
    join(listening, STRANGERS[2])

    def is_known() -> bool:
        laptop.announce(GROUP)
        return STRANGERS[2] in {
            participant["address"] for participant in abused.status()["domains"][0]["outside"]
        }

    def is_announced() -> bool:
        good.announce(ANNOUNCED)
        with suppress(BlockingIOError):
            while True:
                datagram = listening.recv(65536)
                if datagram[8:20] == GOOD:
                    return True
        return False

    flood = Flood([(STRANGERS[4], GROUP, datagram) for datagram in said], is_forged=False)
    with closing(laptop), closing(listening), abused.watched(), flood:
        flood.wait(AMONG // 10)
        await until(is_known, "a participant on the LAN is met")
        await until(is_announced, "the LAN gets the inside announcement")
        flood.wait(AMONG)
    assert lan_relay.poll() is None


async def test_forged_sources_on_the_lan_take_nobodys_place(abused, good, robot, lan_relay):
    """1,200 announcements with leases of 300 s took all places for these 300 s."""
    served(good, robot, b"before")
    sources = [f"198.18.{3 + number // 250}.{number % 250 + 1}" for number in range(1200)]
    said = [
        (source, GROUP, spdp(prefix(number), source, lease=300))
        for number, source in enumerate(sources)
    ]
    laptop = Participant(LAPTOP, STRANGERS[2], WELL_KNOWN)
    newcomer = Participant(NEWCOMER, STRANGERS[0], 7440)

    def unproven() -> float:
        return abused.metric('rosproxy_ros2_unproven_participants{domain="0",side="outside"}')

    with closing(laptop), closing(newcomer), abused.watched():
        flood = Flood(said, is_forged=True, via=STRANGERS[4], per_second=PER_SECOND)
        with flood:
            flood.wait(len(said))
            await until(lambda: unproven() > 200, "most of the unproven places are taken")
            assert unproven() <= MOST_OUTSIDE_UNPROVEN + 1

            def all_announce() -> None:
                good.announce(ANNOUNCED)
                laptop.announce(GROUP)
                newcomer.announce(GROUP)

            def answer_and_announce() -> None:
                laptop.answers_all()
                all_announce()

            laptop.proves_to_receive(all_announce)
            good.hears(LAPTOP, answer_and_announce)
            good.hears(NEWCOMER, answer_and_announce)
            served(good, robot, b"amid")
            flood.wait(flood.sent + len(said))
        served(good, robot, b"after")
        known = {p["guid_prefix"] for p in abused.status()["domains"][0]["outside"]}
        assert {LAPTOP.hex("."), ROBOT.hex(".")} <= known


async def test_forged_sources_on_the_lan_take_no_more_than_their_share(
    abused, good, robot, lan_relay
):
    """Without shares, the relay would lose honest announcements in a flood."""
    served(good, robot, b"before")
    said = [
        (str(source), GROUP, spdp(prefix(number), str(source), padding=PADDING))
        for number, source in enumerate(FORGED_NETWORK)
    ]
    laptop = Participant(LAPTOP, STRANGERS[2], WELL_KNOWN)
    newcomer = Participant(NEWCOMER, STRANGERS[3], WELL_KNOWN)
    honest_count = 0

    def all_announce() -> None:
        nonlocal honest_count
        honest_count += 2
        good.announce(ANNOUNCED)
        laptop.announce(GROUP)
        newcomer.announce(GROUP)

    def refused_count() -> float:
        return abused.metric('rosproxy_ros2_dropped_datagrams_total{domain="0"}')

    with closing(laptop), closing(newcomer), abused.watched():
        laptop.proves_to_receive(all_announce)
        before = refused_count()
        began = time.monotonic()
        with Flood(said, is_forged=True, via=STRANGERS[4], per_second=RELAYED_PER_SECOND) as flood:
            flood.wait(AMONG)
            for _ in range(HEARD):
                good.hears(LAPTOP, all_announce)
            newcomer.proves_to_receive(all_announce)
            good.hears(NEWCOMER, all_announce)
            served(good, robot, b"amid")
            flood.wait(5 * AMONG)
        served(good, robot, b"after")
        units = UNPROVEN_BURST + UNPROVEN_PER_SECOND * (time.monotonic() - began)
        most = units / cost(len(said[0][2]))
        assert refused_count() - before <= most + 2 * honest_count
    assert lan_relay.poll() is None
