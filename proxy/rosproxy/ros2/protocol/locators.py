"""Locators: where a participant, a reader or a writer is reached. The addresses of DDS.

24 bytes: kind 4, port 4, address 16; of IPv4 the address is in the last four (DDSI-RTPS 2.5,
9.3.2.4). Kinds of its own (Fast DDS: 16 is shared memory) a vendor may have as it likes.
"""

import struct
from enum import IntEnum
from functools import lru_cache
from ipaddress import IPv4Address, IPv6Address

import msgspec

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.parameters import Parameter, ParameterList
from rosproxy.ros2.protocol.rtps import Overwrite

SIZE = 24


class LocatorKind(IntEnum):
    """Transports. Only locators of UDP can lead to the proxy."""

    UDP_V4 = 1
    UDP_V6 = 2
    TCP_V4 = 4
    TCP_V6 = 8


class Locator(msgspec.Struct, frozen=True):
    """A locator as it stands in a parameter; ``address`` has 16 bytes, of any kind."""

    kind: int
    port: int
    address: bytes

    @property
    def where(self) -> HostPort | None:
        """The address and port of one of UDP; None for other kinds, and where no port is given."""
        if not 0 < self.port < 65536:
            return None
        if self.kind == LocatorKind.UDP_V4:
            return HostPort("{}.{}.{}.{}".format(*self.address[12:]), self.port)
        if self.kind == LocatorKind.UDP_V6:
            return HostPort(str(IPv6Address(self.address)), self.port)
        return None


def read_locator(datagram: bytes, held: ParameterList, parameter: Parameter) -> Locator | None:
    """The locator in a parameter; None if that is too short to be one."""
    start = parameter.value.start
    if parameter.value.end - start < SIZE:
        return None
    kind, port = struct.unpack_from(held.order + "iI", datagram, start)
    return Locator(kind, port, datagram[start + 8 : start + SIZE])


def replaced(held: ParameterList, parameter: Parameter, where: HostPort) -> Overwrite:
    """The edit by which a locator leads elsewhere. Raises ValueError if that is no address."""
    return Overwrite(parameter.value.start, pack_locator(where, held.order))


def pack_locator(where: HostPort, order: str) -> bytes:
    """A locator of UDP, in a byte order as `struct` has it. Raises ValueError for a name."""
    kind, address = _packed(where.host)
    return struct.pack(order + "iI", kind, where.port) + address


@lru_cache(256)
def _packed(host: str) -> tuple[LocatorKind, bytes]:
    if ":" in host:
        return LocatorKind.UDP_V6, IPv6Address(host).packed
    return LocatorKind.UDP_V4, bytes(12) + IPv4Address(host).packed
