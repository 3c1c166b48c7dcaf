"""The outside addresses that the proxy announces inside, if inside sends to outside directly."""

from collections.abc import Callable

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    LAN_RELAY,
    NEAR,
    NOW,
    ROBOT,
    SEDP_WRITERS,
    B,
    carried,
    make_domain,
    meet,
    reached_at,
    to,
)
from tests.unit.ros2.protocol.messages import data, message, payload

GATEWAY = "172.30.0.1"
"""A robot's own container network has the same addresses as inside's."""
TOPIC = (Pid.TOPIC_NAME, b"\x0b\0\0\0rt/chatter\0\0")


def located(pid: int, *hosts: str) -> list[tuple[int, bytes]]:
    return [(pid, pack_locator(HostPort(host, 7411), "<")) for host in hosts]


def participant(address: str, *hosts: str) -> bytes:
    discovery = (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(address, 7410), "<"))
    told = [discovery, *located(Pid.DEFAULT_UNICAST_LOCATOR, *hosts)]
    return message(data(payload(told)), prefix=B)


def writer(*hosts: str) -> bytes:
    told = [TOPIC, *located(Pid.UNICAST_LOCATOR, *hosts)]
    return message(data(payload(told), writer=SEDP_WRITERS), prefix=B)


def told_of_participant(domain: Domain, *hosts: str) -> list[str]:
    """The announced addresses of an outside participant that the LAN relay has heard."""
    told = carried(ROBOT, participant(ROBOT, *hosts))
    (datagram,) = to(domain.heard_outside(told, LAN_RELAY.host, NOW), INSIDE)
    metatraffic, *users = [locator.host for locator in reached_at(datagram)]
    assert metatraffic == NEAR
    return users


def told_of_writer(domain: Domain, *hosts: str) -> list[str]:
    domain.heard_outside(participant(ROBOT, ROBOT), ROBOT, NOW)
    (port,) = [port for port, (_, le) in domain.mappings.by_port.items() if le.target.port == 7410]
    (sent,) = domain.at_range_port(port, writer(*hosts), ROBOT, NOW)
    return [locator.host for locator in reached_at(sent.datagram)]


@pytest.mark.parametrize("told", [told_of_participant, told_of_writer])
@pytest.mark.parametrize(
    ("announced", "passed"),
    [
        # Fast DDS sends to all addresses, Cyclone DDS only to the address on its own network.
        ((GATEWAY, ROBOT, "172.17.0.1"), [ROBOT]),
        ((ROBOT,), [ROBOT]),
        # Behind NAT: no announced address is the source.
        (("192.168.7.7", GATEWAY), ["192.168.7.7", GATEWAY]),
        (("192.168.7.7", "127.0.0.1"), ["192.168.7.7"]),
        # Inside may have the other family alone.
        ((ROBOT, GATEWAY, "fd77::9", "fe80::1"), [ROBOT, "fd77::9"]),
    ],
)
def test_inside_is_told_of_the_address_that_was_heard(
    told: Callable[..., list[str]], announced: tuple[str, ...], passed: list[str]
) -> None:
    domain = make_domain()
    meet(domain)
    assert told(domain, *announced) == passed


def test_on_one_machine_it_is_the_one_that_was_heard_as_well() -> None:
    domain = make_domain(peers=["127.0.1.10"])
    domain.settings.proxy_address_for = lambda _: "127.0.0.1"
    meet(domain)
    said = participant("127.0.1.10", "127.0.1.10", "127.0.0.1")
    (datagram,) = to(domain.heard_outside(said, "127.0.1.10", NOW), INSIDE)
    assert reached_at(datagram)[1:] == [HostPort("127.0.1.10", 7411)]
