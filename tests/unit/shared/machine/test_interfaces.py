"""This machine's source address for a target, and the longest packet."""

from ipaddress import ip_network

import pytest

from rosproxy.shared.machine import interfaces
from rosproxy.shared.machine.interfaces import (
    address_into,
    default_gateways,
    interface_networks,
    is_own,
    route_towards,
)

ROUTES = """\
Iface Destination Gateway  Flags RefCnt Use Metric Mask     MTU Window IRTT
eth0  00000000    010013AC 0003  0      0   0      00000000 0   0      0
eth0  000013AC    00000000 0001  0      0   0      0000FFFF 0   0      0
eth1  000012AC    00000000 0001  0      0   0      0000FFFF 0   0      0
"""
BACKUP = "eth1 00000000 010012AC 0003 0 0 600 00000000 0 0 0"
"""A second default route, which the kernel uses only without the first."""


@pytest.mark.parametrize("network", ["127.0.0.0/8", "127.0.0.1/32", "127.0.0.0/31"])
def test_a_network_may_be_a_single_address(network: str) -> None:
    assert address_into(ip_network(network)).startswith("127.0.0.")


def test_the_route_to_an_own_address_begins_there_and_takes_packets_of_loopback() -> None:
    route = route_towards("127.0.0.1")
    assert route.source == "127.0.0.1"
    # Linux reports at most the longest IP packet, a byte less than the MTU of loopback.
    assert route.mtu >= 65_535


def test_there_is_no_route_to_what_is_no_address() -> None:
    assert route_towards("?").source == "127.0.0.1"


def test_an_anycast_address_of_this_machine_is_an_own_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A port of the proxy that led there led to the proxy: one datagram circulated without end."""
    line = "3 eth0 20010db8000000010000000000000000 1"
    monkeypatch.setattr(interfaces, "_lines", lambda path: [line] if "anycast6" in path else [])
    assert is_own("2001:db8:0:1::")
    assert not is_own("2001:db8:0:2::")


def test_the_gateway_of_the_default_route(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interfaces, "_lines", lambda _: ROUTES.splitlines())
    assert default_gateways() == {"172.19.0.1"}


def set_routes(monkeypatch: pytest.MonkeyPatch, routes: list[str]) -> None:
    monkeypatch.setattr(interfaces, "_lines", lambda path: routes if "route" in path else [])


def test_the_network_of_the_default_route_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    set_routes(monkeypatch, ROUTES.splitlines())
    networks = (ip_network("172.19.0.0/16"), ip_network("172.18.0.0/16"))
    assert interface_networks() == networks
    assert interface_networks(without_uplink=True) == networks[1:]


@pytest.mark.parametrize("place", [1, 4])
def test_of_two_default_routes_the_one_with_the_lower_metric_is_the_uplink(
    monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    routes = ROUTES.splitlines()
    routes.insert(place, BACKUP)
    set_routes(monkeypatch, routes)
    assert interface_networks(without_uplink=True) == (ip_network("172.18.0.0/16"),)
