"""Ports and addresses of this host, from the kernel."""

from collections.abc import Collection, Sequence
from pathlib import Path

from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.machine.interfaces import address_towards
from rosproxy.shared.ports import PortRange

_DEFAULT_EPHEMERAL_PORTS = "32768 60999"
# TCP_LISTEN of the kernel's include/net/tcp_states.h, as hexadecimal digits.
_LISTEN = "0A"
_FAR_ADDRESS = "192.0.2.1"
"""An address of no network (RFC 5737). The route to this address is the route to far hosts."""


def ephemeral_ports() -> PortRange:
    """Return the range of ephemeral ports in this network namespace.

    If the setting of the kernel can't be read, return the kernel's default.
    """
    text = _read_text("/proc/sys/net/ipv4/ip_local_port_range") or _DEFAULT_EPHEMERAL_PORTS
    return PortRange(*map(int, text.split()))


def listening_ports() -> frozenset[int]:
    """Return the TCP ports on which a program listens, in this network namespace."""
    return parse_listening(_read_text("/proc/net/tcp")) | parse_listening(
        _read_text("/proc/net/tcp6")
    )


def bound_udp_ports() -> frozenset[int]:
    """Return the UDP ports to which a socket is bound, in this network namespace."""
    return parse_bound(_read_text("/proc/net/udp")) | parse_bound(_read_text("/proc/net/udp6"))


def parse_bound(text: str) -> frozenset[int]:
    """Return the ports of all sockets in ``/proc/net/udp`` or ``/proc/net/udp6``."""
    return frozenset(_port(line.split()) for line in text.splitlines()[1:])


def parse_listening(text: str) -> frozenset[int]:
    """Return the ports of the listening sockets in ``/proc/net/tcp`` or ``/proc/net/tcp6``."""
    rows = (line.split()[:4] for line in text.splitlines()[1:])
    return frozenset(_port(row) for row in rows if row[3] == _LISTEN)


def _port(row: Sequence[str]) -> int:
    """Return the local port in a row of ``/proc/net``, where the port has hexadecimal digits."""
    return int(row[1].rpartition(":")[2], 16)


def is_own_address(address: str) -> bool:
    """Return whether an IPv4 address belongs to this network namespace."""
    # Only a connection to an own address has the same address as source and as target.
    return address_towards(address) == address


def own_address_towards(master: str, gateways: Collection[str]) -> str:
    """Return the address at which a master reaches this host; empty without a route.

    ``master`` is an address. The result is the source address of the route to the master. If this
    source is on loopback or one of the engine's ``gateways``, no other host can reach the source.
    Then the result is `default_route_address`; without a default route, the gateway, or empty for
    loopback.
    """
    own = address_towards(master)
    if own in gateways or is_loopback(own):
        own = default_route_address() or own
    return "" if is_loopback(own) else own


def default_route_address() -> str:
    """Return the address at which far hosts reach this host; empty without a default route."""
    far = address_towards(_FAR_ADDRESS)
    return "" if is_loopback(far) else far


def _read_text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii")
    except OSError:
        return ""
