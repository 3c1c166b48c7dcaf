"""The part for ROS 2 as a whole: a change of policy, and of where host and peers are."""

from collections.abc import Iterable
from ipaddress import ip_network
from typing import Any, cast

import pytest

from rosproxy.ros2 import stack
from rosproxy.ros2.protocol.rtps import RtpsError
from rosproxy.ros2.servers.domain_server import DomainServer
from rosproxy.ros2.stack import Ros2, advertised_hosts, networks_inside
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort, Network
from tests.run_options import parse_settings


class FailingOnce:
    """A domain's server that fails to apply a policy the first time."""

    calls = 0

    def apply_policy(self) -> None:
        self.calls += 1
        if self.calls == 1:
            raise RtpsError("made to fail")

    async def finish(self) -> None:
        """All have been told."""


async def test_a_policy_that_could_not_be_applied_is_tried_again() -> None:
    told = {"ros": ("2",), "advertise_host": "192.0.2.1", "port_range": "45000-45015"}
    runtime = Runtime(parse_settings(told))
    ros2 = Ros2(runtime)
    server = FailingOnce()
    ros2.servers.append(cast(DomainServer, server))
    runtime.policy.version += 1
    with pytest.raises(RtpsError):
        await ros2._look_at_policy()
    await ros2._look_at_policy()
    await ros2._look_at_policy()
    assert server.calls == 2


@pytest.mark.parametrize(
    ("resolved", "bind", "present", "announced"),
    [
        (["192.0.2.1"], "0.0.0.0", (), ("192.0.2.1",)),
        (["192.0.2.1", "192.0.2.2", "2001:db8::1"], "::", (), ("192.0.2.1", "2001:db8::1")),
        (["192.0.2.1", "2001:db8::1"], "0.0.0.0", (), ("192.0.2.1",)),
        (["2001:db8::1"], "0.0.0.0", (), ("2001:db8::1",)),
        # A name server gives the addresses in any order.
        (["192.0.2.2", "192.0.2.1"], "0.0.0.0", ("192.0.2.1",), ("192.0.2.1",)),
        (["192.0.2.2"], "0.0.0.0", ("192.0.2.1",), ("192.0.2.2",)),
        # The name server is away.
        ([], "0.0.0.0", ("192.0.2.1",), ("192.0.2.1",)),
    ],
)
def test_the_addresses_of_the_advertised_host(
    resolved: list[str], bind: str, present: tuple[str, ...], announced: tuple[str, ...]
) -> None:
    assert advertised_hosts(resolved, bind, present) == announced


class Listening:
    """A domain's server that notes the addresses of the host and of the peers."""

    hosts: tuple[str, ...] = ()
    peers: tuple[HostPort, ...] = ()

    def move_to(self, hosts: tuple[str, ...]) -> None:
        self.hosts = hosts

    def set_peers(self, peers: tuple[HostPort, ...]) -> None:
        self.peers = peers

    def join(self, addresses: Iterable[str]) -> None:
        """The networks do not matter here."""

    def note_gateways(self, gateways: frozenset[str]) -> None:
        """Not used here."""


async def test_names_are_looked_up_again_and_hold_while_no_name_server_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = {"base.example": ["192.0.2.1"], "robot.example": ["192.0.2.9"]}

    async def resolve(host: str) -> list[str]:
        return names.get(host, [])

    monkeypatch.setattr(stack, "resolve", resolve)
    told: dict[str, Any] = {"ros": ("2",), "advertise_host": "base.example"}
    told |= {"port_range": "45000-45015"}
    told |= {"ros2_peer": ("robot.example:7410",), "inside_network": ("192.0.2.0/24",)}
    ros2 = Ros2(Runtime(parse_settings(told)))
    server = Listening()
    ros2.servers.append(cast(DomainServer, server))
    await ros2._refresh()
    assert server.hosts == ("192.0.2.1",)
    assert server.peers == (HostPort("192.0.2.9", 7410),)
    assert not ros2._is_inside("192.0.2.9")
    names.update({"base.example": ["192.0.2.2"], "robot.example": ["192.0.2.10"]})
    await ros2._refresh()
    assert server.hosts == ("192.0.2.2",)
    assert server.peers == (HostPort("192.0.2.10", 7410),)
    names.clear()
    await ros2._refresh()
    assert server.hosts == ("192.0.2.2",)
    assert server.peers == (HostPort("192.0.2.10", 7410),)
    assert ros2._is_inside("192.0.2.9")


async def test_the_way_to_an_address_is_looked_up_once_between_two_looks_at_the_networks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An announcement goes to 512 participants inside, and took 10 ms for the lookups alone."""
    looked_up = list[str]()

    def address_towards(address: str) -> str:
        looked_up.append(address)
        return "172.30.0.2"

    monkeypatch.setattr(stack, "address_towards", address_towards)
    told: dict[str, Any] = {"ros": ("2",), "advertise_host": "127.0.0.1"}
    told |= {"port_range": "45000-45015", "inside_network": ("172.30.0.0/24",)}
    ros2 = Ros2(Runtime(parse_settings(told)))
    for _ in range(2):
        ros2._look_at_networks()
        for _ in range(3):
            assert ros2._address_towards("172.30.0.5") == "172.30.0.2"
    assert looked_up.count("172.30.0.5") == 2


async def test_an_address_without_a_way_is_looked_up_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The proxy announced loopback to participants of a network that it had just joined again."""
    found = iter(["127.0.0.1", "172.30.0.2"])
    told: dict[str, Any] = {"ros": ("2",), "advertise_host": "127.0.0.1"}
    told |= {"port_range": "45000-45015", "inside_network": ("172.30.0.0/24",)}
    monkeypatch.setattr(stack, "address_towards", lambda _: next(found))
    ros2 = Ros2(Runtime(parse_settings(told)))
    assert ros2._address_towards("172.30.0.5") == "127.0.0.1"
    assert [ros2._address_towards("172.30.0.5") for _ in range(2)] == ["172.30.0.2"] * 2


async def test_a_peer_on_loopback_may_be_inside_as_well() -> None:
    """In a trial on a single machine both sides may have the same address."""
    told: dict[str, Any] = {"ros": ("2",), "advertise_host": "127.0.0.1"}
    told |= {"ros2_peer": ("127.0.0.1:7410",), "inside_network": ("127.0.0.1/32",)}
    ros2 = Ros2(Runtime(parse_settings(told)))
    ros2.servers.append(cast(DomainServer, Listening()))
    await ros2._refresh()
    assert ros2._is_inside("127.0.0.1")


LAN = ip_network("192.0.2.0/24")
BRIDGE = ip_network("172.30.0.0/24")


@pytest.mark.parametrize(
    ("host", "inside"),
    [
        ("192.0.2.1", (BRIDGE,)),
        ("172.30.0.1", (LAN,)),
        # The address of another machine, as in a container.
        ("198.51.100.1", (LAN, BRIDGE)),
        ("192.0.2.7", (LAN, BRIDGE)),
    ],
)
def test_the_network_of_the_advertised_host_is_outside(
    host: str, inside: tuple[Network, ...]
) -> None:
    assert networks_inside({LAN: "192.0.2.1", BRIDGE: "172.30.0.1"}, (host,)) == inside


def test_the_only_network_is_inside() -> None:
    assert networks_inside({LAN: "192.0.2.1"}, ("192.0.2.1",)) == (LAN,)
