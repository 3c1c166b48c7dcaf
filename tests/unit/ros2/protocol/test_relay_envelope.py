"""The envelope around an announcement, and the lists of addresses that go the other way."""

import pytest

from rosproxy.ros2.protocol.relay_envelope import (
    LIST_MAGIC,
    MOST_LISTED,
    address_lists,
    listed_addresses,
    unwrapped,
    wrapped,
)
from rosproxy.ros2.protocol.relay_proof import LONGEST_CONTENT_BYTES
from rosproxy.ros2.protocol.rtps import RtpsError

ADDRESSES = ["192.0.2.7", "2001:db8::9", "169.254.7.7"]


@pytest.mark.parametrize("address", ADDRESSES)
def test_an_envelope_keeps_address_and_datagram(address: str) -> None:
    assert unwrapped(wrapped(address, b"RTPS")) == (address, b"RTPS")


def test_an_envelope_has_an_address() -> None:
    with pytest.raises(RtpsError):
        unwrapped(bytes(15))


def test_a_list_keeps_its_addresses() -> None:
    (listed,) = address_lists(ADDRESSES)
    assert listed_addresses(listed) == ADDRESSES
    assert listed_addresses(listed[:-1]) == ADDRESSES[:-1]
    assert listed_addresses(LIST_MAGIC) == []
    assert list(address_lists([])) == []


def test_many_addresses_take_several_lists() -> None:
    addresses = [f"10.0.{number // 256}.{number % 256}" for number in range(MOST_LISTED + 1)]
    lists = list(address_lists(addresses))
    assert [len(listed_addresses(listed) or ()) for listed in lists] == [MOST_LISTED, 1]
    assert max(map(len, lists)) <= LONGEST_CONTENT_BYTES


def test_an_announcement_is_no_list() -> None:
    assert listed_addresses(b"RTPS" + bytes(16)) is None
    assert listed_addresses(b"") is None
