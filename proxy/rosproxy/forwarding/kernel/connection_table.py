"""The table for TCP: the kernel tracks each connection, and forwards it by DNAT and masquerade.

The table has the mark of each port, and sets that count bytes by mark. ``cut`` has the marks of
connections that are being ended. ``inward`` has the ports that lead to nodes outside. ``near4`` and
``near6`` have the networks that may use the ports in ``inward``. The table has three chains:

- prerouting: a connection to an address of this machine gets the mark of its port, and leads to the
  node. New connections have a limit, and those over the limit stay with the proxy's own socket;
- postrouting: the connection leaves with this machine's address, so that replies come back;
- forward: bytes of IP packets are counted, in each direction. The chain stands before any filter,
  so that the proxy also counts packets that a filter drops later.
"""

from collections.abc import Collection, Mapping
from string import Template

import msgspec

from rosproxy.forwarding.kernel.decisions import Forwards
from rosproxy.forwarding.kernel.nft import Elements, Json, Surroundings, Table, pairs
from rosproxy.shared.ports import PortRange

NEW_PER_SECOND = 200
NEW_BURST = 2000
"""New connections that the kernel forwards in a second, and at once, all ports together.

A forged SYN costs its sender nothing. The kernel tracks an unanswered connection for 120 s
(nf_conntrack_tcp_timeout_syn_sent), and a half-open connection for 60 s. Masquerade gives each
connection to a node another of 64,512 ports. With these limits forged SYNs take at most 26,000.
The proxy's own socket gets the connections over the limit, and there the kernel uses SYN cookies.
"""

# Chains of type nat see only the first packet of a connection (nft(8)), so the mark of the
# connection keeps the port.
_CHAINS = Template("""\
table inet $name {
  map marks { type inet_service : mark; }
  map hosts4 { type inet_service : ipv4_addr; }
  map hosts6 { type inet_service : ipv6_addr; }
  map ports { type inet_service : inet_service; }
  set sent { type mark; counter; }
  set received { type mark; counter; }
  set cut { type mark; }
  set inward { type inet_service; }
  set near4 { type ipv4_addr; flags interval; }
  set near6 { type ipv6_addr; flags interval; }
  chain prerouting {
    type nat hook prerouting priority -100; policy accept;
    tcp dport @inward ip saddr != @near4 return
    tcp dport @inward ip6 saddr != @near6 return
    fib daddr type local ct mark set tcp dport map @marks
$limit    fib daddr type local dnat ip to tcp dport map @hosts4 : tcp dport map @ports
    fib daddr type local dnat ip6 to tcp dport map @hosts6 : tcp dport map @ports
  }
  chain postrouting {
    type nat hook postrouting priority 100; policy accept;
    meta l4proto tcp ct status dnat ct mark @sent masquerade
  }
  chain forward {
    type filter hook forward priority -300; policy accept;
    ct direction original ct mark @cut reject with tcp reset
    meta l4proto tcp ct status dnat ct direction reply ct mark @sent
    meta l4proto tcp ct status dnat ct direction original ct mark @received
  }
}
""")
# A port without a forward has no mark, and uses nothing of the limit.
_LIMIT = Template(
    "    meta l4proto tcp ct mark & 0xffff0000 == $mark "
    "limit rate over $rate/second burst $burst packets ct mark set 0 return\n"
)
_END_DOCUMENT = Template("""\
flush map inet $name marks
flush map inet $name hosts4
flush map inet $name hosts6
flush map inet $name ports
add rule inet $name forward ct status dnat ct direction original ct mark @sent reject with tcp reset
""")


class Marks(msgspec.Struct, frozen=True):
    """The marks of a table's connections: the number of the table times 65,536, plus the port."""

    number: int

    def of(self, port: int) -> int:
        """The mark of a port."""
        return self.number << 16 | port

    def port(self, mark: int) -> int | None:
        """The port of a mark; None for a mark of another table."""
        return mark & 0xFFFF if mark >> 16 == self.number else None

    @property
    def table_selector(self) -> str:
        """The argument of conntrack's ``--mark`` for all marks of the table."""
        return f"{self.of(0):#x}/0xffff0000"

    def port_selector(self, port: int) -> str:
        """The argument of conntrack's ``--mark`` for a port."""
        return f"{self.of(port):#x}/0xffffffff"


class ConnectionTable(Table):
    """The table ``rosproxy-NUMBER``; the number is the master port.

    ``leases`` are the ports whose forwards lead to nodes inside; other ports lead outside.
    ``limits_new``: new connections have a limit, for which Linux needs the module nft_limit.
    """

    maps = ("marks", "hosts4", "hosts6", "ports")
    counted_sets = ("sent", "received")

    def __init__(self, number: int, leases: PortRange) -> None:
        super().__init__(f"rosproxy-{number}")
        self.marks = Marks(number)
        self._leases = leases
        self.limits_new = True

    @property
    def chains(self) -> str:
        """Return the document that makes the table without elements."""
        limit = _LIMIT.substitute(
            mark=f"{self.marks.of(0):#x}", rate=NEW_PER_SECOND, burst=NEW_BURST
        )
        return _CHAINS.substitute(name=self.name, limit=limit if self.limits_new else "")

    def counter_key(self, port: int) -> int:
        """The mark of a port, by which the table counts."""
        return self.marks.of(port)

    def counted_port(self, key: int) -> int | None:
        """The port of a mark."""
        return self.marks.port(key)

    def is_whole(self, port: int, elements: Mapping[str, Json]) -> bool:
        """Whether a port has its mark."""
        return pairs(elements["marks"]).get(port) == self.marks.of(port)

    def elements(self, forwards: Forwards) -> Elements:
        """Return the elements of forwards, with marks, and with the ports that lead outside."""
        return {
            "marks": [f"{port} : {self.marks.of(port)}" for port in forwards],
            **super().elements(forwards),
            "inward": [str(port) for port in forwards if port not in self._leases],
        }

    def adapted(self, forwards: Forwards, surroundings: Surroundings) -> str:
        """Return the document that replaces the networks that may use ports of nodes outside."""
        near = surroundings.near
        by_set = {f"near{v}": [str(n) for n in near if n.version == v] for v in (4, 6)}
        flushed = "".join(f"flush set inet {self.name} {name}\n" for name in by_set)
        return flushed + self.element_document("add", by_set)

    def cut(self, ports: Collection[int], verb: str = "add") -> str:
        """Return the document that resets connections to these ports; "delete" ends the resets."""
        marks = [str(self.marks.of(port)) for port in sorted(ports)]
        return self.element_document(verb, {"cut": marks})

    def ended(self) -> str:
        """Return the document that ends all forwards and resets all connections.

        Without the reset, rospy would not connect again.
        """
        return _END_DOCUMENT.substitute(name=self.name)
