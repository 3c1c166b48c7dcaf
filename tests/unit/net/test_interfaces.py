"""Which of its own addresses this machine uses for a network."""

from ipaddress import ip_network

import pytest

from rosproxy.net.interfaces import address_into


@pytest.mark.parametrize("network", ["127.0.0.0/8", "127.0.0.1/32", "127.0.0.0/31"])
def test_a_network_may_be_a_single_address(network: str) -> None:
    assert address_into(ip_network(network)).startswith("127.0.0.")
