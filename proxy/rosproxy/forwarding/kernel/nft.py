"""nftables: the proxy's tables and their changes as nft takes them, their state as nft prints it.

One table per proxy and transport, with a number in its name that no other proxy in the same network
namespace has: for TCP the master port, for UDP the first port of the range. It holds maps from port
to mark, address and port; sets that count bytes by mark; the marks of connections that are being
cut (``cut``); the ports of nodes outside (``inward``) and who may use those (``near``); and three
chains, which stay as they are however many forwards there are:

- prerouting: what comes in for an address of this machine gets its port's mark (on the
  connection) and is sent on to the node;
- postrouting: it leaves with this machine's address, so that the node's replies come back;
- forward: bytes of IP packets are counted, in each direction, before any filter: what one drops
  is counted as well, so that it is known to have come. Datagrams that came in fragments are whole
  there.

Documents are in nft's own language (nft(8)), output is JSON (libnftables-json(5)).
"""

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from enum import StrEnum
from string import Template
from typing import Any, NamedTuple

import msgspec

from rosproxy.forwarding.kernel.decisions import Changes, Forwards
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort, Network, is_address, parse_address

Json = Any
Near = Sequence[Network]
"""Who may use the fast ports of nodes outside, IPv4 and IPv6; none overlaps another."""


class Transport(StrEnum):
    """What a table forwards."""

    TCP = "tcp"
    UDP = "udp"


class Counts(NamedTuple):
    """Bytes of IP packets from the node to its peers, and back; the number of packets back.

    A packet of UDP is a datagram.
    """

    sent: int = 0
    received: int = 0
    packets: int = 0


Counters = Mapping[int, Counts]
"""What was counted, by port."""

_MAPS = ("marks", "hosts4", "hosts6", "ports")
_SETS = ("sent", "received")
_NOTHING = 0, 0
# The first line makes sure that there is a table to delete: nft fails otherwise. Chains of type nat
# see only the first packet of a connection (nft(8)), so its port is kept in the connection's mark.
_TABLE_DOCUMENT = Template("""\
add table inet $name
delete table inet $name
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
    $transport dport @inward ip saddr != @near4 return
    $transport dport @inward ip6 saddr != @near6 return
    fib daddr type local ct mark set $transport dport map @marks
    fib daddr type local dnat ip to $transport dport map @hosts4 : $transport dport map @ports
    fib daddr type local dnat ip6 to $transport dport map @hosts6 : $transport dport map @ports
  }
  chain postrouting {
    type nat hook postrouting priority 100; policy accept;
    meta l4proto $transport ct status dnat ct mark @sent masquerade
  }
  chain forward {
    type filter hook forward priority -300; policy accept;
$reset
    meta l4proto $transport ct status dnat ct direction reply ct mark @sent
    meta l4proto $transport ct status dnat ct direction original ct mark @received
  }
}
""")
_RESET = "    ct direction original ct mark @cut reject with tcp reset"
_END_DOCUMENT = Template("""\
flush map inet $name marks
flush map inet $name hosts4
flush map inet $name hosts6
flush map inet $name ports
add rule inet $name forward ct status dnat ct direction original ct mark @sent reject with tcp reset
""")


class NftError(ValueError):
    """What nft printed is not what was expected."""


class TableState(msgspec.Struct, frozen=True):
    """What the kernel has in a proxy's table."""

    forwards: Forwards = {}
    counters: Counters = {}


class Marks(msgspec.Struct, frozen=True):
    """The marks of a table's connections: its number above, the port below."""

    number: int

    def of(self, port: int) -> int:
        """The mark of a port."""
        return self.number << 16 | port

    def port(self, mark: int) -> int | None:
        """The port of a mark; None if it is none of this table's."""
        return mark & 0xFFFF if mark >> 16 == self.number else None

    @property
    def table_selector(self) -> str:
        """All marks of the table, as conntrack's ``--mark`` takes it."""
        return f"{self.of(0):#x}/0xffff0000"

    def port_selector(self, port: int) -> str:
        """The mark of one port, as conntrack's ``--mark`` takes it."""
        return f"{self.of(port):#x}/0xffffffff"


class Table:
    """A table of a proxy with a number that no other table for that transport has.

    ``leases`` are the ports whose forwards lead to nodes inside; all others lead outside.
    """

    def __init__(
        self, number: int, leases: PortRange, transport: Transport = Transport.TCP
    ) -> None:
        self.transport, self.marks, self._leases = transport, Marks(number), leases
        self.name = f"rosproxy-{number}" if self.has_connections else f"rosproxy-udp-{number}"

    @property
    def has_connections(self) -> bool:
        """Whether what it forwards are connections: answered, and ended by a reset."""
        return self.transport is Transport.TCP

    def made(self, forwards: Forwards, counted: Collection[int] = (), near: Near = ()) -> str:
        """The document that makes the whole table, in place of one that may be there.

        ``counted`` are further ports whose connections are counted, though no new ones come.
        """
        reset = _RESET if self.has_connections else ""
        document = _TABLE_DOCUMENT.substitute(name=self.name, transport=self.transport, reset=reset)
        document += self._near("add", near)
        return document + self._counting({*counted, *forwards}) + self._forwarding("add", forwards)

    def opened(self, near: Near) -> str:
        """The document that replaces those who may use the fast ports of nodes outside."""
        flushed = (f"flush set inet {self.name} {name}\n" for name in ("near4", "near6"))
        return "".join(flushed) + self._near("add", near)

    def changed(self, change: Changes) -> str:
        """The document that takes forwards out and puts others in."""
        removed = self._forwarding("delete", change.removed)
        return removed + self._counting(change.added) + self._forwarding("add", change.added)

    def cut(self, ports: Collection[int], verb: str = "add") -> str:
        """Whoever sends to a node through these ports gets a reset; with verb "delete" no more."""
        return self._elements(verb, "cut", [str(self.marks.of(port)) for port in sorted(ports)])

    def ended(self) -> str:
        """No forwards any more, and whoever sends something from outside gets a reset.

        Some clients (rospy) try again only when they see their connection end.
        """
        return _END_DOCUMENT.substitute(name=self.name)

    def removed(self) -> str:
        """The document that deletes the table."""
        return f"delete table inet {self.name}\n"

    def read(self, text: str) -> TableState:
        """The table as ``nft -j list table`` prints it. Raises NftError."""
        elements = {
            str(body.get("name")): body.get("elem")
            for kind in ("map", "set")
            for body in _objects(text, kind)
            if body.get("table") == self.name
        }
        if not {*_MAPS, *_SETS} <= set(elements):
            raise NftError(f"table {self.name} lacks sets or maps")
        hosts = {**_pairs(elements["hosts4"]), **_pairs(elements["hosts6"])}
        ports, marks = _pairs(elements["ports"]), _pairs(elements["marks"])
        forwards = {
            port: HostPort(host, ports[port])
            for port, host in hosts.items()
            if isinstance(ports.get(port), int)
            and parse_address(str(host))
            and marks.get(port) == self.marks.of(port)
        }
        sent, received = _counted(elements["sent"]), _counted(elements["received"])
        port_by_mark = {mark: self.marks.port(mark) for mark in sent | received}
        counters = {
            port: Counts(sent.get(mark, _NOTHING)[0], *received.get(mark, _NOTHING))
            for mark, port in port_by_mark.items()
            if port is not None
        }
        return TableState(forwards, counters)

    def _forwarding(self, verb: str, forwards: Forwards) -> str:
        by_name: dict[str, list[str]] = {name: [] for name in _MAPS}
        for port, target in forwards.items():
            # No host should be other than an address: for "?" nft refuses the whole document.
            host = target.host if is_address(target.host) and "%" not in target.host else "?"
            by_name["marks"].append(f"{port} : {self.marks.of(port)}")
            by_name["hosts6" if ":" in host else "hosts4"].append(f"{port} : {host}")
            by_name["ports"].append(f"{port} : {target.port}")
        by_name["inward"] = [str(port) for port in forwards if port not in self._leases]
        return "".join(self._elements(verb, name, e) for name, e in by_name.items() if e)

    def _near(self, verb: str, near: Near) -> str:
        by_set = {f"near{v}": [str(n) for n in near if n.version == v] for v in (4, 6)}
        return "".join(self._elements(verb, name, e) for name, e in by_set.items() if e)

    def _counting(self, ports: Iterable[int]) -> str:
        marks = [str(self.marks.of(port)) for port in sorted(ports)]
        return "".join(self._elements("add", name, marks) for name in _SETS if marks)

    def _elements(self, verb: str, name: str, elements: list[str]) -> str:
        return f"{verb} element inet {self.name} {name} {{ {', '.join(elements)} }}\n"


def dropping_chains(text: str) -> list[str]:
    """The chains at hook forward that drop by policy, in what ``nft -j list chains`` prints.

    What such a chain lets through can't be told from outside. Raises NftError.
    """
    return [
        f"{body.get('family')} {body.get('table')} {body.get('name')}"
        for body in _objects(text, "chain")
        if body.get("hook") == "forward" and body.get("policy") == "drop"
    ]


def _objects(text: str, kind: str) -> list[dict[str, Json]]:
    try:
        listed = json.loads(text)["nftables"]
        bodies = [item[kind] for item in listed if kind in item]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise NftError(f"nft printed {text[:200]!r}: {error}") from None
    return [body for body in bodies if isinstance(body, dict)]


def _pairs(elements: Json) -> dict[int, Json]:
    items = elements if isinstance(elements, list) else []
    pairs = (item for item in items if isinstance(item, list) and len(item) == 2)
    return {key: value for key, value in pairs if isinstance(key, int)}


def _counted(elements: Json) -> dict[int, tuple[int, int]]:
    """Bytes and packets by mark."""
    counted = {}
    for item in elements if isinstance(elements, list) else []:
        body = _dict(_dict(item).get("elem"))
        counter = _dict(body.get("counter"))
        mark, size, count = body.get("val"), counter.get("bytes", 0), counter.get("packets", 0)
        if isinstance(mark, int) and isinstance(size, int) and isinstance(count, int):
            counted[mark] = size, count
    return counted


def _dict(value: Json) -> dict[str, Json]:
    return value if isinstance(value, dict) else {}
