"""Machines that have IPv6 and nothing else: the proxy's machine itself is the boundary.

    out (roscore, outside nodes) -- px -- c1

Neither end has a route to the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from tests.ros.lab import Lab
from tests.ros.topology import (
    ADVERTISED_NAME,
    MASTER_PORT,
    SHARED,
    Place,
    Topology,
    give,
    ip,
    sysctl,
)

PLAN = replace(SHARED, name="v", networks=(("c1",),), forwarding=True)
ADDRESSES = {"out": "fd77::2", "c1": "fd30::11"}
PROXY_ADDRESSES = {"out": "fd77::1", "c1": "fd30::1"}


class Topology6(Topology):
    """The machines with IPv6."""

    def __init__(self) -> None:
        super().__init__(PLAN)
        del self.places["host"]

    def _connect(self) -> None:
        for role in ADDRESSES:
            self._join(role)
        sysctl(self.places["px"], "net.ipv6.conf.all.forwarding=1")

    def _join(self, role: str) -> None:
        place = self.places[role]
        proxy = self.places["px"]
        peer = ("peer", "name", "eth0", "netns", place.namespace)
        ip("-n", proxy.namespace, "link", "add", f"{role}0", "type", "veth", *peer)
        # Without duplicate address detection the addresses are usable at once.
        give(place, "eth0", f"{ADDRESSES[role]}/64", "nodad")
        give(proxy, f"{role}0", f"{PROXY_ADDRESSES[role]}/64", "nodad")

    def _known_names(self, place: Place) -> Iterator[tuple[str, str]]:
        yield place.address, place.hostname
        if place.role in ("out", "px"):
            yield ADDRESSES["out"], "robot"
            yield PROXY_ADDRESSES["out"], ADVERTISED_NAME
        if place.role == "c1":
            yield PROXY_ADDRESSES["c1"], "rosproxy"


class Lab6(Lab):
    """A lab with IPv6 for nodes and roscore."""

    def environment(self, role: str) -> dict[str, str]:
        """The environment of a ROS program on this machine."""
        return super().environment(role) | {"ROS_IPV6": "on"}

    def master_address(self, role: str) -> tuple[str, int]:
        """The address of the master for a machine."""
        return (PROXY_ADDRESSES if role == "c1" else ADDRESSES)[role], MASTER_PORT
