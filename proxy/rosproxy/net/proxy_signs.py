"""Which other proxies there are on this machine: each puts up a sign.

A port that is bound and does not listen is in none of the kernel's lists, so that nobody can tell
who holds a range. A sign says it (`signs`), to people alone, and not too much of it.
"""

import socket
from collections.abc import Collection
from dataclasses import dataclass
from itertools import islice

from rosproxy.net import signs
from rosproxy.net.addresses import HostPort, is_address, parse_host_port

MOST = 8
"""Proxies that are told of."""
_SIGN = r"rosproxy/([12]{1,2})/(\d{1,5})-(\d{1,5})/([0-9A-Fa-z.:\[\]-]{1,60})"


@dataclass(frozen=True, slots=True)
class Sign:
    """What a proxy says of itself: versions of ROS, first and last port, and its admin endpoint."""

    ros: str
    first: int
    last: int
    admin: str

    def __str__(self) -> str:
        """Words for people, to be used after "held by"."""
        return (
            f"another rosproxy, with --port-range {self.first}-{self.last} "
            f"(rosproxy status --admin http://{self.admin})"
        )


def publish_sign(
    ros: Collection[str], first: int, last: int, admin: object
) -> socket.socket | None:
    """Put up the sign of this process; it stays until the socket is closed.

    None where that is not possible: a sign only helps people.
    """
    return signs.put_up(f"rosproxy/{''.join(sorted(ros))}/{first}-{last}/{admin}")


def overlapping_proxies(
    ros: str, first: int, last: int, admin: HostPort | None = None
) -> list[Sign]:
    """The other proxies on this machine, for a version of ROS, that have some of these ports.

    ``admin`` is the own admin endpoint, which no other can have; None before the own sign is up. A
    proxy that was started twice has the same one. MOST at most, and none whose admin endpoint is
    not at an address: people are told to ask there.
    """
    proxies = (Sign(m[1], int(m[2]), int(m[3]), m[4]) for m in signs.read_all(_SIGN))
    overlapping = (
        s
        for s in proxies
        if ros in s.ros and s.first <= last and first <= s.last and s.admin != str(admin)
    )
    return list(islice(dict.fromkeys(s for s in overlapping if _is_at_address(s.admin)), MOST))


def _is_at_address(admin: str) -> bool:
    host_port = parse_host_port(admin)
    return host_port is not None and is_address(host_port.host)
