"""Signs of proxies: which other proxies are on this machine, and which ranges they hold.

A socket that is bound but does not listen is in no list of the kernel, so no tool shows which
program holds the ports of a range. The sign of a proxy (`signs`) shows users the range and the
admin endpoint. The proxy does not trust signs.
"""

import socket
from collections.abc import Collection
from dataclasses import dataclass
from itertools import islice

from rosproxy.shared.addresses import HostPort, is_address, parse_host_port
from rosproxy.shared.machine import signs

MOST_SIGNS = 8
"""Most proxies that a message names."""
_SIGN = r"rosproxy/([12]{1,2})/(\d{1,5})-(\d{1,5})/([0-9A-Fa-z.:\[\]-]{1,60})"


@dataclass(frozen=True, slots=True)
class Sign:
    """The sign of a proxy: versions of ROS, first and last port, and the admin endpoint."""

    ros: str
    first: int
    last: int
    admin: str

    def __str__(self) -> str:
        """Text for users, after the words "held by"."""
        return (
            f"another rosproxy, with --port-range {self.first}-{self.last} "
            f"(rosproxy status --admin http://{self.admin})"
        )


def publish_sign(
    ros: Collection[str], first: int, last: int, admin: object
) -> socket.socket | None:
    """Publish the sign of this process until the returned socket is closed.

    None if that fails: the proxy works without a sign.
    """
    return signs.publish(f"rosproxy/{''.join(sorted(ros))}/{first}-{last}/{admin}")


def overlapping_proxies(
    ros: str, first: int, last: int, admin: HostPort | None = None
) -> list[Sign]:
    """The signs of other proxies for a ROS version on this machine, if the ranges overlap.

    ``admin``: the own admin endpoint, to leave the own sign out. None before the own sign exists: a
    sign with that endpoint then belongs to an earlier start of the same proxy, and counts.
    At most MOST_SIGNS signs, and only signs with an IP address, where users can ask.
    """
    proxies = (Sign(m[1], int(m[2]), int(m[3]), m[4]) for m in signs.read_all(_SIGN))
    overlapping = (
        s
        for s in proxies
        if ros in s.ros and s.first <= last and first <= s.last and s.admin != str(admin)
    )
    return list(
        islice(dict.fromkeys(s for s in overlapping if _is_at_address(s.admin)), MOST_SIGNS)
    )


def _is_at_address(admin: str) -> bool:
    host_port = parse_host_port(admin)
    return host_port is not None and is_address(host_port.host)
