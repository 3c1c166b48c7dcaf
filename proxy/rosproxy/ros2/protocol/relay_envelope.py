"""The envelope that the LAN relay puts around an announcement: the source address.

The envelope is 16 bytes before the datagram: an IPv6 address, or an IPv4-mapped IPv6 address. The
proxy sends to a participant outside only at the source address of an announcement. This address is
lost when the LAN relay passes the datagram on.

In the other direction, the proxy tells the relay which addresses are proven: `LIST_MAGIC`, and 16
bytes for each address. A list and an announcement differ in the first bytes: an announcement begins
with the letters RTPS.
"""

from collections.abc import Iterable, Iterator
from ipaddress import IPv6Address, ip_address
from itertools import islice

from rosproxy.ros2.protocol.rtps import RtpsError
from rosproxy.shared.addresses import plain_address

LIST_MAGIC = b"ADDR"
MOST_LISTED = 256
"""The highest number of addresses in a list; the datagram then has 4 KiB."""
_ADDRESS_BYTES = 16


def wrapped(source: str, datagram: bytes) -> bytes:
    """The source address, then a datagram. Raises ValueError if ``source`` is not an address."""
    return _packed(source) + datagram


def unwrapped(data: bytes) -> tuple[str, bytes]:
    """The source address and the datagram. Raises RtpsError if ``data`` is too short."""
    if len(data) < _ADDRESS_BYTES:
        raise RtpsError("the datagram is too short for the address of its source")
    return _unpacked(data[:_ADDRESS_BYTES]), data[_ADDRESS_BYTES:]


def address_lists(addresses: Iterable[str]) -> Iterator[bytes]:
    """Yield lists of addresses, a list for each datagram, and make each list when it is taken.

    Raises ValueError if an item is not an address.
    """
    remaining = iter(addresses)
    while listed := list(islice(remaining, MOST_LISTED)):
        yield LIST_MAGIC + b"".join(map(_packed, listed))


def listed_addresses(content: bytes) -> list[str] | None:
    """Return the addresses in a list; None if the content is not a list."""
    if not content.startswith(LIST_MAGIC):
        return None
    starts = range(len(LIST_MAGIC), len(content) - _ADDRESS_BYTES + 1, _ADDRESS_BYTES)
    return [_unpacked(content[start : start + _ADDRESS_BYTES]) for start in starts]


def _packed(text: str) -> bytes:
    address = ip_address(text)
    return IPv6Address(f"::ffff:{address}").packed if address.version == 4 else address.packed


def _unpacked(packed: bytes) -> str:
    return plain_address(str(IPv6Address(packed)))
