"""The table for UDP: the kernel rewrites each datagram separately, without connection tracking.

User data of RTPS goes one way. A reader answers to the locators that discovery has announced, never
to the source of a datagram. So a datagram needs no way back, and no entry in the kernel's table of
connections. Forged sources could fill that table: masquerade gives each source one of some 64,500
ports for half a minute.

- prerouting: the kernel does not track packets to a port of the range. If the maps have the port,
  the chain rewrites target address and port, and counts the datagram. Connection tracking joins
  fragments earlier (priority -400, ``NF_IP_PRI_CONNTRACK_DEFRAG``), as long as any rule of this
  network namespace uses ``ct``. The kernel divides the datagram again on the way out.
- forward: the datagram gets an address of this machine as its source, which a node accepts without
  a route to outside. Prerouting is too early: Linux drops packets that arrive with an own address
  as the source (``net/ipv4/fib_frontend.c``, ``__fib_validate_source``).
"""

from string import Template

from rosproxy.forwarding.kernel.decisions import Forwards
from rosproxy.forwarding.kernel.nft import Surroundings, Table, checked
from rosproxy.shared.ports import PortRange

# Packets from this machine to itself arrive by loopback and already have a route, which a rule here
# can't change. The proxy's socket at the same port receives these packets.
# A checksum of 0 stands for no checksum (RFC 768). nft changes the field whenever nft writes the
# port, and the node's kernel would drop the datagram. IPv6 has no datagrams without a checksum.
_CHAINS = Template("""\
table inet $name {
  map hosts4 { type inet_service : ipv4_addr; }
  map hosts6 { type inet_service : ipv6_addr; }
  map ports { type inet_service : inet_service; }
  map sources4 { type ipv4_addr . inet_service : ipv4_addr; }
  map sources6 { type ipv6_addr . inet_service : ipv6_addr; }
  set received { type inet_service; counter; }
  chain prerouting {
    type filter hook prerouting priority -300; policy accept;
    iif "lo" return
    meta l4proto != udp return
    udp dport != $range return
    fib daddr type != local return
    notrack
    udp checksum 0 $to4 udp checksum set 0 return
    $to4
    $to6
  }
  chain forward {
    type filter hook forward priority -300; policy accept;
    ct state untracked ip saddr set ip daddr . udp dport map @sources4
    ct state untracked ip6 saddr set ip6 daddr . udp dport map @sources6
  }
}
""")
# Every lookup is by the port, so the port is written last. A rule ends at a map without the port.
_LEAD = Template(
    "$family daddr set udp dport map @$hosts udp dport @received udp dport set udp dport map @ports"
)


class DatagramTable(Table):
    """The table ``rosproxy-udp-FIRST`` of a range of ports that begins at FIRST."""

    maps = ("hosts4", "hosts6", "ports", "sources4", "sources6")
    counted_sets = ("received",)

    def __init__(self, ports: PortRange) -> None:
        super().__init__(f"rosproxy-udp-{ports.first}")
        self._ports = ports

    @property
    def chains(self) -> str:
        """Return the document that makes the table without elements."""
        return _CHAINS.substitute(
            name=self.name,
            range=self._ports,
            to4=_LEAD.substitute(family="ip", hosts="hosts4"),
            to6=_LEAD.substitute(family="ip6", hosts="hosts6"),
        )

    def counter_key(self, port: int) -> int:
        """The port itself, by which the table counts."""
        return port

    def counted_port(self, key: int) -> int | None:
        """The port itself."""
        return key

    def adapted(self, forwards: Forwards, surroundings: Surroundings) -> str:
        """Return the document that replaces the sources of all forwards."""
        by_map: dict[str, dict[str, str]] = {"sources4": {}, "sources6": {}}
        for target in forwards.values():
            source = surroundings.sources[target.host]
            name = "sources6" if ":" in target.host else "sources4"
            # After a restart two ports may lead to the same locator, which is a single key here.
            by_map[name][f"{checked(target.host)} . {target.port}"] = checked(source)
        flushed = "".join(f"flush map inet {self.name} {name}\n" for name in by_map)
        elements = {
            name: [f"{target} : {source}" for target, source in sources.items()]
            for name, sources in by_map.items()
        }
        return flushed + self.element_document("add", elements)
