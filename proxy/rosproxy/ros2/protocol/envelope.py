"""What the ear puts around an announcement that it has heard: where that came from.

16 bytes before the datagram: the address, IPv4 as IPv4-in-IPv6. A participant outside is used only
at the address that it has sent from, and that ends where the ear hears it.
"""

from ipaddress import IPv6Address, ip_address

from rosproxy.net.addresses import plain_address
from rosproxy.ros2.protocol.rtps import RtpsError

_SIZE = 16


def wrapped(source: str, datagram: bytes) -> bytes:
    """A datagram with the address that it came from. Raises ValueError if that is none."""
    address = ip_address(source)
    packed = IPv6Address(f"::ffff:{address}").packed if address.version == 4 else address.packed
    return packed + datagram


def unwrapped(data: bytes) -> tuple[str, bytes]:
    """The address and the datagram. Raises RtpsError if it is too short."""
    if len(data) < _SIZE:
        raise RtpsError("shorter than an address")
    return plain_address(str(IPv6Address(data[:_SIZE]))), data[_SIZE:]
