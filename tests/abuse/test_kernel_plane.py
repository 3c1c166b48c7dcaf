"""ROS 2 on the kernel plane: forged sources at a data port keep no sender from getting through."""

import subprocess
from collections.abc import Iterator
from contextlib import closing
from ipaddress import IPv4Address
from typing import Any

import pytest

from examples.demo.fake_http import free_ports
from tests.abuse.apart import APART, APART_HOST, INSIDE, STRANGERS, Apart
from tests.abuse.conftest import Abused
from tests.abuse.ros2_neighbours import WELL_KNOWN, Participant, forge, udp
from tests.abuse.test_ros2 import PORTS, first, good, robot, served  # noqa: F401 - fixtures
from tests.integration.net import until

FORGED = IPv4Address("198.19.0.0")
"""The first of the forged sources. Each source sends a single datagram."""
ROUNDS = 720
FORGED_A_ROUND = 100
"""With masquerade, a port of the proxy's address for each source: there are some 64,500."""


@pytest.fixture
def forwarding(_apart: Apart) -> Iterator[Apart]:
    """The proxy's machine, which forwards as containers of Docker do."""

    def forward(value: int) -> None:
        setting = f"echo {value} > /proc/sys/net/ipv4/ip_forward"
        subprocess.run([*_apart.prefix, "sh", "-c", setting], check=True)

    forward(1)
    yield _apart
    forward(0)


@pytest.fixture
def abused(start_abused, forwarding, first) -> Abused:  # noqa: F811 - the fixture
    """A proxy for ROS 2 with the kernel plane."""
    return start_abused(
        ros=2,
        prefix=forwarding.prefix,
        advertise_host=APART_HOST,
        inside_network=INSIDE,
        admin_bind=f"{APART}:{free_ports(1)}",
        port_range=f"{first}-{first + PORTS - 1}",
        ros2_peer=f"{STRANGERS[0]}:{WELL_KNOWN}",
        data_plane="kernel",
    )


def data_lease(abused: Abused) -> dict[str, Any]:
    """The port for user data in the status."""
    (domain,) = abused.status()["domains"]
    leases = [lease for participant in domain["inside"] for lease in participant["leases"]]
    (lease,) = [lease for lease in leases if lease["kind"] == "data"]
    return lease


def take(good: Participant, wanted: set[bytes]) -> None:  # noqa: F811 - the fixture
    """Read user data until all that is wanted has come."""
    missing = set(wanted)
    while missing:
        try:
            missing.discard(good.data.recv(65536))
        except TimeoutError:
            raise AssertionError(f"lost: {sorted(missing)}") from None


async def test_forged_sources_at_a_data_port(abused, good, robot):  # noqa: F811 - the fixtures
    """Sources that took all ports of the masquerade kept every new sender out for 30 s."""
    _, user = served(good, robot, b"before")
    await until(lambda: data_lease(abused)["plane"] == "kernel", "the kernel forwards")
    passed_on = data_lease(abused)["datagrams"]
    good.data.settimeout(5)
    with abused.watched():
        for number in range(ROUNDS):
            for offset in range(FORGED_A_ROUND):
                forge(str(FORGED + number * FORGED_A_ROUND + offset), user, b"forged")
            healthy = b"healthy %d" % number
            new = b"new %d" % number
            robot.data.sendto(healthy, user)
            with closing(udp(STRANGERS[number % len(STRANGERS)])) as sender:
                sender.sendto(new, user)
            take(good, {healthy, new})
    await until(
        lambda: data_lease(abused)["kernel_datagrams"] >= ROUNDS * (FORGED_A_ROUND + 2),
        "all are counted",
    )
    assert data_lease(abused)["datagrams"] == passed_on


async def test_the_kernel_tracks_connections_as_before(abused, forwarding):
    """The table for datagrams ended the tracking of TCP, so topics of ROS 1 were not forwarded."""
    abused.status()  # by a connection from another machine
    host, port = abused.admin
    words = ("conntrack", "-L", "-p", "tcp", "--orig-port-dst", str(port))
    listed = subprocess.run(
        [*forwarding.prefix, *words], capture_output=True, text=True, check=True
    )
    assert f"dst={host}" in listed.stdout
