"""What the operating system knows of this host's ports and addresses."""

from collections.abc import Collection, Sequence
from pathlib import Path

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import is_loopback
from rosproxy.net.interfaces import address_towards

_USUAL_EPHEMERAL = "32768 60999"
# TCP_LISTEN of the kernel's include/net/tcp_states.h, as hexadecimal digits.
_LISTEN = "0A"
_ELSEWHERE = "192.0.2.1"
"""An address of no network (RFC 5737), to find out where connections to far hosts leave."""


def ephemeral_ports() -> PortRange:
    """The range from which the kernel takes ports for connections, in this network namespace.

    The kernel's default if it can't be read.
    """
    text = _read_text("/proc/sys/net/ipv4/ip_local_port_range") or _USUAL_EPHEMERAL
    return PortRange(*map(int, text.split()))


def listening_ports() -> frozenset[int]:
    """The TCP ports on which anything listens, in this network namespace."""
    return parse_listening(_read_text("/proc/net/tcp")) | parse_listening(
        _read_text("/proc/net/tcp6")
    )


def bound_udp_ports() -> frozenset[int]:
    """The UDP ports that anything has, in this network namespace."""
    return parse_bound(_read_text("/proc/net/udp")) | parse_bound(_read_text("/proc/net/udp6"))


def parse_bound(text: str) -> frozenset[int]:
    """The ports of all sockets in ``/proc/net/udp`` or ``/proc/net/udp6``."""
    return frozenset(_port(line.split()) for line in text.splitlines()[1:])


def parse_listening(text: str) -> frozenset[int]:
    """The ports of listening sockets in ``/proc/net/tcp`` or ``/proc/net/tcp6``."""
    rows = (line.split()[:4] for line in text.splitlines()[1:])
    return frozenset(_port(row) for row in rows if row[3] == _LISTEN)


def _port(row: Sequence[str]) -> int:
    """The local port of a row in one of these files."""
    return int(row[1].rpartition(":")[2], 16)


def has(address: str) -> bool:
    """Whether an IPv4 address is one of this machine's, as seen in this network namespace.

    Connections to an own address, and to no other, come from that address.
    """
    return address_towards(address) == address


def own_address_towards(master: str, gateways: Collection[str]) -> str:
    """This host's address for a master at an address; empty if there is none to be told.

    Where the way leads to a container or to this host itself over one of the engine's
    ``gateways``, it is the address from which far hosts are reached: the gateway means something
    to this host alone.
    """
    own = address_towards(master)
    if own in gateways or is_loopback(own):
        own = far_address() or own
    return "" if is_loopback(own) else own


def far_address() -> str:
    """This host's address for hosts far away; empty if it has no way there."""
    far = address_towards(_ELSEWHERE)
    return "" if is_loopback(far) else far


def _read_text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii")
    except OSError:
        return ""
