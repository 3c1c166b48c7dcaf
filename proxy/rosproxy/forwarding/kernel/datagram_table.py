"""The table for UDP: the kernel rewrites each datagram by itself, and keeps no record of senders.

User data of RTPS goes one way. A reader answers to the locators that discovery has told, and never
to the source of a datagram. So a datagram needs no way back, and no entry among the connections
that the kernel tracks. Forged sources could fill such a table: masquerade gives each source one of
some 64,500 ports for half a minute.

- prerouting: the kernel does not track packets to a port of the range. The chain rewrites target
  address and port where the maps have them, and counts. Connection tracking joins fragments before
  that (priority -400, ``NF_IP_PRI_CONNTRACK_DEFRAG``), as long as any rule of this network
  namespace uses ``ct``. The kernel divides the datagram again on its way out.
- forward: the datagram gets an address of this machine as its source, which a node accepts without
  a route to outside. Prerouting is too early: Linux drops packets that arrive with one of its own
  addresses as the source (``net/ipv4/fib_frontend.c``, ``__fib_validate_source``).
"""

from string import Template

from rosproxy.forwarding.kernel.decisions import Forwards
from rosproxy.forwarding.kernel.nft import Surroundings, Table, checked
from rosproxy.leases.ports import PortRange

# Packets of this machine to itself arrive by loopback with their route, which a rule here can't
# change. The proxy's socket at the same port takes them.
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
# The port is written last, since every lookup is by the port. A rule ends at a map that lacks it.
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
        """Datagrams are counted by port."""
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
            # After a restart two ports may lead to one locator, which is one key here.
            by_map[name][f"{checked(target.host)} . {target.port}"] = checked(source)
        flushed = "".join(f"flush map inet {self.name} {name}\n" for name in by_map)
        elements = {
            name: [f"{target} : {source}" for target, source in sources.items()]
            for name, sources in by_map.items()
        }
        return flushed + self.element_document("add", elements)
