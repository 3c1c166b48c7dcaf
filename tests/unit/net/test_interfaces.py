"""Which of its own addresses this machine uses, and how long packets may be."""

from ipaddress import ip_network

import pytest

from rosproxy.net.interfaces import address_into, route_towards


@pytest.mark.parametrize("network", ["127.0.0.0/8", "127.0.0.1/32", "127.0.0.0/31"])
def test_a_network_may_be_a_single_address(network: str) -> None:
    assert address_into(ip_network(network)).startswith("127.0.0.")


def test_the_route_to_an_own_address_begins_there_and_takes_packets_of_loopback() -> None:
    route = route_towards("127.0.0.1")
    assert route.source == "127.0.0.1"
    # Linux tells at most the longest packet of IP, and loopback's MTU is one byte more.
    assert route.mtu >= 65_535


def test_there_is_no_route_to_what_is_no_address() -> None:
    assert route_towards("?").source == "127.0.0.1"
