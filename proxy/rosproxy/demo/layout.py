"""Who lives where: the addresses of the demo's two sides and of the proxy between them."""

from __future__ import annotations

import random
import socket
from dataclasses import dataclass

from rosproxy.demo.boundary import Boundary

OUTSIDE_NETWORK = "127.0.1.0/24"
INSIDE_NETWORK = "127.0.2.0/24"
LOOPBACK = "127.0.0.1"
HOST = "127.0.1.1"
ROBOT = "127.0.1.10"
PROXY_INSIDE = "127.0.2.1"
INSIDE = {"talker": "127.0.2.11", "listener": "127.0.2.12", "adder": "127.0.2.13"}
# The proxy may leave from here: it is the source address that Linux takes for all of 127/8.
PROXY_SOURCE = f"{LOOPBACK}/32"

FIRST_PORT, LAST_PORT = 20000, 29000
"""Where ports for the proxy are looked for: below what systems hand out by themselves."""


@dataclass(frozen=True)
class Place:
    """Where a process lives: what it binds, what it calls itself, what the boundary lets it do."""

    address: str
    host: str
    boundary: Boundary


@dataclass(frozen=True)
class Layout:
    """All places; `note` says what is missing when the sides can't be fully separated."""

    host: str
    proxy_inside: str
    inside_network: str
    outside: Place
    inside: dict[str, Place]
    note: str = ""


def separate() -> Layout:
    """Lay the sides out on networks of their own."""
    wall, accept = (OUTSIDE_NETWORK,), (OUTSIDE_NETWORK, PROXY_SOURCE)
    outside = Boundary(wall, accept, ((OUTSIDE_NETWORK, ROBOT),))
    inside = {
        name: Place(address, f"{name}.inside", _inside_boundary(address))
        for name, address in INSIDE.items()
    }
    return Layout(HOST, PROXY_INSIDE, INSIDE_NETWORK, Place(ROBOT, ROBOT, outside), inside)


def _inside_boundary(address: str) -> Boundary:
    leave = ((INSIDE_NETWORK, address), (OUTSIDE_NETWORK, HOST))
    return Boundary(accept_from=(INSIDE_NETWORK, PROXY_SOURCE), leave_from=leave)


def names_only() -> Layout:
    """Lay both sides out on the one address that every system has: only names separate them."""
    outside = Place(LOOPBACK, LOOPBACK, Boundary(wall=(PROXY_SOURCE,)))
    inside = {name: Place(LOOPBACK, f"{name}.inside", Boundary()) for name in INSIDE}
    note = "This system has no 127.0.2.x addresses: the sides are separated by host names alone."
    return Layout(LOOPBACK, LOOPBACK, PROXY_SOURCE, outside, inside, note)


def detect() -> Layout:
    """Choose the best layout that this system can do."""
    wanted = [HOST, ROBOT, PROXY_INSIDE, *INSIDE.values()]
    return separate() if all(_bindable(address, 0) for address in wanted) else names_only()


def _bindable(address: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True


def free_ports(count: int) -> int:
    """Return the first of `count` ports in a row that nothing on this machine has bound.

    Raises RuntimeError when there is no such row.
    """
    for _ in range(200):
        first = random.randrange(FIRST_PORT, LAST_PORT - count)  # noqa: S311
        if all(_bindable("0.0.0.0", port) for port in range(first, first + count)):
            return first
    raise RuntimeError(f"no {count} free ports in a row between {FIRST_PORT} and {LAST_PORT}")
