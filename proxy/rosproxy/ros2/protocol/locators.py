"""Locators: the addresses at which participants, readers and writers receive datagrams.

A locator has 24 bytes: kind 4, port 4, address 16. An IPv4 address is in the last four bytes
(DDSI-RTPS 2.5, 9.3.2.4). Vendors define further kinds (16 is shared memory of Fast DDS).
"""

import struct
from enum import IntEnum
from functools import lru_cache
from ipaddress import IPv4Address, IPv6Address

import msgspec

from rosproxy.ros2.protocol.parameters import Parameter, ParameterList
from rosproxy.ros2.protocol.rtps import Overwrite
from rosproxy.shared.addresses import HostPort

LOCATOR_BYTES = 24
"""Bytes of a locator."""


class LocatorKind(IntEnum):
    """Transports. Only locators of UDP can lead to the proxy."""

    UDP_V4 = 1
    UDP_V6 = 2
    TCP_V4 = 4
    TCP_V6 = 8


class Locator(msgspec.Struct, frozen=True):
    """A locator in a parameter. ``address`` has 16 bytes for each kind."""

    kind: int
    port: int
    address: bytes

    @property
    def host_port(self) -> HostPort | None:
        """The address and port of a UDP locator; None for other kinds, or without a valid port."""
        if not 0 < self.port < 65536:
            return None
        if self.kind == LocatorKind.UDP_V4:
            return HostPort("{}.{}.{}.{}".format(*self.address[12:]), self.port)
        if self.kind == LocatorKind.UDP_V6:
            return HostPort(str(IPv6Address(self.address)), self.port)
        return None


def read_locator(
    datagram: bytes, parameters: ParameterList, parameter: Parameter
) -> Locator | None:
    """The locator in a parameter; None if the parameter is too short."""
    start = parameter.value.start
    if parameter.value.end - start < LOCATOR_BYTES:
        return None
    kind, port = struct.unpack_from(parameters.order + "iI", datagram, start)
    return Locator(kind, port, datagram[start + 8 : start + LOCATOR_BYTES])


def replaced(parameters: ParameterList, parameter: Parameter, target: HostPort) -> Overwrite:
    """The edit that replaces a locator by ``target``. Raises ValueError if the host is a name."""
    return Overwrite(parameter.value.start, pack_locator(target, parameters.order))


def pack_locator(host_port: HostPort, order: str) -> bytes:
    """A locator of UDP in the byte order ``order``, in the notation of `struct`.

    Raises ValueError if the host is a name.
    """
    kind, address = _packed(host_port.host)
    return struct.pack(order + "iI", kind, host_port.port) + address


@lru_cache(256)
def _packed(host: str) -> tuple[LocatorKind, bytes]:
    if ":" in host:
        return LocatorKind.UDP_V6, IPv6Address(host).packed
    # Cyclone DDS rejects a locator whose first 12 bytes are not zero (ddsi_plist.c, do_locator).
    return LocatorKind.UDP_V4, bytes(12) + IPv4Address(host).packed
