"""The envelope that the ear puts around an announcement: the address that it came from.

16 bytes before the datagram: the address, IPv4 as IPv4-in-IPv6. The proxy uses a participant
outside only at the address that it sends from, which is lost when the ear passes a datagram on.
"""

from ipaddress import IPv6Address, ip_address

from rosproxy.net.addresses import plain_address
from rosproxy.ros2.protocol.rtps import RtpsError

_SIZE = 16


def wrapped(source: str, datagram: bytes) -> bytes:
    """A datagram with the address that it came from. Raises ValueError if ``source`` is none."""
    address = ip_address(source)
    packed = IPv6Address(f"::ffff:{address}").packed if address.version == 4 else address.packed
    return packed + datagram


def unwrapped(data: bytes) -> tuple[str, bytes]:
    """The address and the datagram. Raises RtpsError if it is too short."""
    if len(data) < _SIZE:
        raise RtpsError("shorter than an address")
    return plain_address(str(IPv6Address(data[:_SIZE]))), data[_SIZE:]
