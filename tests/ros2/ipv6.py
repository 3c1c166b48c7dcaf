"""The machines with IPv6, alone or beside IPv4: what `tests.ros.topology` has, NAT and all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from tests.ros.topology import ADVERTISED_NAME, Place, Plan, Topology, give, ip, run_command, sysctl
from tests.ros2.machines import PLAN, PORTS

HOST6 = "fd77::1"
ROBOT6 = "fd77::2"
GATEWAY6 = "fd30::1"
PLAN6 = replace(PLAN, name="v", host=HOST6, robot=ROBOT6)
DUAL = replace(PLAN, name="w", host=ADVERTISED_NAME, robot="robot")

_ADDRESSES = {
    "host": (HOST6, "10.77.0.1"),
    "out": (ROBOT6, "10.77.0.2"),
    "px": ("fd30::2", "172.30.1.2"),
    "c1": ("fd30::11", "172.30.1.11"),
    "c2": ("fd30::12", "172.30.1.12"),
}
_GATEWAYS = GATEWAY6, "172.30.1.1"
_LENGTHS = 64, 24
_RULES = f"""
table inet boundary {{
  chain published {{
    type nat hook prerouting priority dstnat;
    ip6 daddr {HOST6} udp dport {PORTS.bound} dnat ip6 to fd30::2
    ip daddr 10.77.0.1 udp dport {PORTS.bound} dnat ip to 172.30.1.2
  }}
  chain leaving {{
    type nat hook postrouting priority srcnat;
    iifname "br1" oifname "out0" masquerade
  }}
  chain forward {{
    type filter hook forward priority filter; policy drop;
    ct state established,related accept
    ct status dnat accept
    iifname "br1" accept
  }}
}}
"""


class Topology6(Topology):
    """The machines with IPv6; of the plan DUAL with IPv4 as well."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self._families = 2 if plan is DUAL else 1

    def _connect(self) -> None:
        host = self.places["host"]
        for bridge in ("out0", "br1"):
            ip("-n", host.namespace, "link", "add", bridge, "type", "bridge")
        self._give("host", "out0", _ADDRESSES["host"])
        self._give("host", "br1", _GATEWAYS)
        self._wire("out", "out0", _ADDRESSES["host"])
        for role in ("px", "c1", "c2"):
            self._wire(role, "br1", _GATEWAYS)
        sysctl(host, "net.ipv6.conf.all.forwarding=1")
        sysctl(host, "net.ipv4.ip_forward=1")
        run_command("ip", "netns", "exec", host.namespace, "nft", "-f", "-", text=_RULES)

    def _wire(self, role: str, bridge: str, gateways: Sequence[str]) -> None:
        """Connect a machine; outside has a route to inside on purpose, as in IPv4."""
        host = self.places["host"].namespace
        place = self.places[role]
        peer = ("peer", "name", "eth0", "netns", place.namespace)
        ip("-n", host, "link", "add", f"{role}-1", "type", "veth", *peer)
        ip("-n", host, "link", "set", f"{role}-1", "master", bridge, "up")
        self._give(role, "eth0", _ADDRESSES[role])
        for gateway in gateways[: self._families]:
            family = "-6" if ":" in gateway else "-4"
            ip("-n", place.namespace, family, "route", "add", "default", "via", gateway)

    def _give(self, role: str, device: str, addresses: Sequence[str]) -> None:
        for address, length in zip(addresses[: self._families], _LENGTHS, strict=False):
            # Without duplicate address detection the address is usable at once.
            flags = ("nodad",) if ":" in address else ()
            give(self.places[role], device, f"{address}/{length}", *flags)

    def _known_names(self, place: Place) -> Iterator[tuple[str, str]]:
        yield place.address, place.hostname
        if place.role == "px":
            yield from (
                (address, ADVERTISED_NAME) for address in _ADDRESSES["host"][: self._families]
            )
            yield from ((address, "robot") for address in _ADDRESSES["out"][: self._families])
