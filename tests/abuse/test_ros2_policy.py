"""ROS 2: a change of the policy for many participants at an inside address."""

from collections.abc import Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import pytest

from examples.demo.fake_http import free_ports
from rosproxy.ros2.domain_settings import MOST_PER_ADDRESS
from rosproxy.ros2.protocol.rtps import source_prefix
from rosproxy.ros2.rewriting.discovery import read_discovery
from tests.abuse.apart import APART, APART_HOST, INSIDE
from tests.abuse.conftest import Abused
from tests.abuse.ros2_neighbours import PADDING, WELL_KNOWN, Participant
from tests.abuse.test_ros2_shares import (  # noqa: F401 - fixtures
    ANNOUNCED,
    EVIL,
    LONGEST_GAP,
    PEER,
    evil,
    pair,
    robot,
)
from tests.integration.net import until
from tests.unit.ros2.discovery.domains import sedp, spdp

PORTS = 256
LEASE = 600
"""Seconds for which the participants count as present."""
AT_PEER = [bytes([1, 15, 8]) + number.to_bytes(9, "big") for number in range(128)]
"""The prefixes of participants at the peer."""


@pytest.fixture
def first() -> int:
    """The first port of the proxy's range."""
    return free_ports(PORTS)


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """The proxy's policy file."""
    file = tmp_path / "policy"
    file.write_text("allow publish *")
    return file


@pytest.fixture
def abused(start_abused, _apart, first, policy) -> Abused:
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
        policy_file=str(policy),
    )


@pytest.fixture
def last(abused) -> Iterator[Participant]:
    """The last participant of the hostile address, which has a proxy's answer."""
    with closing(Participant(evil(MOST_PER_ADDRESS - 1), EVIL, 9400)) as made:
        announcement = spdp(made.prefix, EVIL, made.port, lease=LEASE, padding=PADDING)
        made.proves_to_receive(partial(made.meta.sendto, announcement, ANNOUNCED))
        yield made


def known(abused: Abused) -> set[bytes]:
    """The prefixes of all participants."""
    (domain,) = abused.status()["domains"]
    every = [*domain["inside"], *domain["outside"]]
    return {bytes.fromhex(participant["guid_prefix"].replace(".", "")) for participant in every}


def met_anew(participant: Participant) -> set[bytes]:
    """The peer's participants that the proxy now announces to a participant inside."""
    prefixes = set()
    with suppress(BlockingIOError):
        while True:
            datagram = participant.meta.recv(65536)
            told = read_discovery(datagram).of_participant
            if told is not None and not told.ended:
                prefixes.add(source_prefix(datagram))
    return prefixes


async def crowd(
    abused: Abused,
    robot: Participant,  # noqa: F811 - not the fixture
    last: Participant,
    first: int,
) -> None:
    """Have as many participants at the hostile address as there may be, and many at the peer."""
    hostile = [evil(number) for number in range(MOST_PER_ADDRESS)]
    expected = {*hostile, *AT_PEER}

    def are_present() -> bool:
        present = known(abused)
        for number, prefix in enumerate(AT_PEER):
            if prefix not in present:
                announcement = spdp(prefix, PEER, 20_000 + number, lease=LEASE)
                robot.meta.sendto(announcement, (APART, first))
        for number, prefix in enumerate(hostile):
            if prefix not in present:
                port = last.port if prefix == last.prefix else 9500 + 2 * number
                announcement = spdp(prefix, EVIL, port, lease=LEASE)
                last.meta.sendto(announcement, ANNOUNCED)
        return present >= expected

    await until(are_present, "all are known")

    def are_publishers() -> bool:
        (domain,) = abused.status()["domains"]
        stand_in = domain["outside"][0]["leases"][0]["port"]
        for prefix in hostile:
            last.meta.sendto(sedp(prefix, EVIL, 9401), (APART, stand_in))
        publishers = [p for p in domain["inside"] if p["address"] == EVIL and p["publishes"]]
        return len(publishers) == MOST_PER_ADDRESS

    await until(are_publishers, "each participant has a publisher")


async def test_a_change_of_the_policy_for_many_participants(
    abused,
    robot,  # noqa: F811 - the fixture
    pair,  # noqa: F811 - the fixture
    last,
    policy,
    first,
):
    """Rediscovery of 64 participants with 256 must not block others, once for three seconds."""
    met = set[bytes]()

    def is_complete() -> bool:
        met.update(met_anew(last))
        return met >= {*AT_PEER}

    def told() -> str:
        (domain,) = abused.status()["domains"]
        numbers = f"lost {domain.get('lost')}, dropped {domain.get('dropped')}, {abused.refused()}"
        return f"{len(met & {*AT_PEER})} of {len(AT_PEER)} have met again: {numbers}"

    with pair:
        await crowd(abused, robot, last, first)
        last.meta.setblocking(False)
        met_anew(last)
        with abused.watched():
            policy.write_text("deny publish /chatter")
            await until(is_complete, told)
    assert pair.figures.lost == 0
    assert pair.figures.longest_gap < LONGEST_GAP
