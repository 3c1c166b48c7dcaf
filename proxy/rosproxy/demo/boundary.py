"""The boundary between the two sides, and what exactly is enforced.

All of 127.0.0.0/8 is loopback on Linux, so each side gets a network of its own there without root.
Outside is 127.0.1.0/24, inside is 127.0.2.0/24. Enforced, in each process by itself:

- An outside process (node or master) can't connect to any address but those of outside, and can't
  resolve any host name. An interpreter audit hook refuses both; it sees every socket of the
  process and can't be removed once installed. Its sockets leave from an address of outside.
- An inside node listens on its own inside address alone, and turns away every connection that
  comes from an address of outside. It announces a host name that no resolver knows.
- An inside node leaves for outside from the host's address, as through NAT, so outside never
  even sees an inside address.

Not enforced: the kernel itself would route from one network to the other, and the proxy, which
lives on both sides, is a plain process without any restriction.

Where the system has no such addresses (macOS knows 127.0.0.1 alone), both sides share 127.0.0.1 and
only the names are left: outside can't resolve what inside nodes announce.
"""

from __future__ import annotations

import errno
import ipaddress
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

_DESTINATION_EVENTS = frozenset({"socket.connect", "socket.sendto", "socket.sendmsg"})
_LOOKUP_EVENTS = frozenset({"socket.getaddrinfo", "socket.gethostbyname"})


def is_literal(host: str) -> bool:
    """Tell whether `host` is an IP address rather than a name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def within(host: str, networks: Sequence[str]) -> bool:
    """Tell whether `host` is an address in one of `networks` (CIDR); a name never is."""
    if not is_literal(host):
        return False
    address = ipaddress.ip_address(host)
    return any(address in ipaddress.ip_network(network) for network in networks)


@dataclass(frozen=True)
class Boundary:
    """What one process may do across the boundary; every field is plain JSON.

    `wall`: the only networks this process may connect to; empty means no wall.
    `accept_from`: the only networks it takes connections from; empty means all.
    `leave_from`: pairs (network, source address); the first network that holds the destination
    gives the address that a connection leaves from.
    """

    wall: tuple[str, ...] = ()
    accept_from: tuple[str, ...] = ()
    leave_from: tuple[tuple[str, str], ...] = ()

    @classmethod
    def from_json(cls, fields: dict[str, Any]) -> Boundary:
        """Rebuild a boundary from its JSON form (`dataclasses.asdict`)."""
        pairs = tuple((str(network), str(source)) for network, source in fields["leave_from"])
        return cls(tuple(fields["wall"]), tuple(fields["accept_from"]), pairs)

    def admits(self, address: str) -> bool:
        """Tell whether a connection from `address` is taken."""
        return not self.accept_from or within(address, self.accept_from)

    def source_for(self, host: str) -> tuple[str, int] | None:
        """Return the local address to connect to `host` from, or None to let the system choose."""
        for network, source in self.leave_from:
            if within(host, (network,)):
                return (source, 0)
        return None

    def connect(self, host: str, port: int, timeout: float) -> socket.socket:
        """Open a TCP connection; raises OSError like `socket.create_connection`."""
        return socket.create_connection((host, port), timeout, self.source_for(host))

    def raise_wall(self) -> None:
        """Enforce `wall` on the whole process, from now until it ends."""
        if self.wall:
            sys.addaudithook(_Wall(self.wall))


class _Wall:
    """An audit hook that refuses connections and name look-ups which would leave the side."""

    def __init__(self, networks: tuple[str, ...]) -> None:
        self._networks = networks

    def __call__(self, event: str, args: tuple[Any, ...]) -> None:
        if event in _DESTINATION_EVENTS:
            self._check_destination(args[1])
        elif event in _LOOKUP_EVENTS:
            self._check_name(args[0])

    def _check_destination(self, address: object) -> None:
        if isinstance(address, tuple) and not within(str(address[0]), self._networks):
            raise OSError(errno.EHOSTUNREACH, "No route to host")

    def _check_name(self, host: object) -> None:
        if isinstance(host, str) and not is_literal(host):
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
