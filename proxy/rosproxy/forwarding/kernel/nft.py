"""nftables: the proxy's table and its changes as nft takes them, its state as nft prints it.

One table per proxy, named after its master port, so that two of them in one network namespace
leave each other alone. It holds maps from fast port to mark, address and port; sets that count
bytes by mark; and three chains, which stay as they are however many forwards there are:

- prerouting: what comes in for an address of this machine gets its port's mark (on the
  connection) and is sent on to the node;
- postrouting: it leaves with this machine's address, so that the node's replies come back;
- forward: bytes of IP packets are counted, in each direction, before any filter: what one drops
  is counted as well, so that it is known to have come.

Documents are in nft's own language (nft(8)), output is JSON (libnftables-json(5)).
"""

import json
from collections.abc import Collection, Iterable, Mapping
from string import Template
from typing import Any

import msgspec

from rosproxy.forwarding.kernel.policy import Changes, Forwards
from rosproxy.net.addresses import HostPort, is_address, parse_address

Json = Any
Counters = Mapping[int, tuple[int, int]]
"""Bytes of IP packets by port: sent outside, received from there."""

_MAPS = ("marks", "hosts4", "hosts6", "ports")
_SETS = ("sent", "received")
_MADE = Template("""\
add table inet $name
delete table inet $name
table inet $name {
  map marks { type inet_service : mark; }
  map hosts4 { type inet_service : ipv4_addr; }
  map hosts6 { type inet_service : ipv6_addr; }
  map ports { type inet_service : inet_service; }
  set sent { type mark; counter; }
  set received { type mark; counter; }
  chain prerouting {
    type nat hook prerouting priority -100; policy accept;
    fib daddr type local ct mark set tcp dport map @marks
    fib daddr type local dnat ip to tcp dport map @hosts4 : tcp dport map @ports
    fib daddr type local dnat ip6 to tcp dport map @hosts6 : tcp dport map @ports
  }
  chain postrouting {
    type nat hook postrouting priority 100; policy accept;
    ct status dnat ct mark @sent masquerade
  }
  chain forward {
    type filter hook forward priority -300; policy accept;
    ct status dnat ct direction reply ct mark @sent
    ct status dnat ct direction original ct mark @received
  }
}
""")
_ENDED = Template("""\
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
    """The connection marks of a proxy: its master port above, the fast port below."""

    master_port: int

    def of(self, port: int) -> int:
        """The mark of a fast port."""
        return self.master_port << 16 | port

    def port(self, mark: int) -> int | None:
        """The fast port of a mark; None if it is none of this proxy's."""
        return mark & 0xFFFF if mark >> 16 == self.master_port else None

    @property
    def all(self) -> str:
        """All of them, as conntrack's ``--mark`` takes it."""
        return f"{self.of(0):#x}/0xffff0000"

    def one(self, port: int) -> str:
        """One of them, as conntrack's ``--mark`` takes it."""
        return f"{self.of(port):#x}/0xffffffff"


class Table:
    """The table of the proxy with a master port."""

    def __init__(self, master_port: int) -> None:
        self.name, self.marks = f"rosproxy-{master_port}", Marks(master_port)

    def made(self, forwards: Forwards, counted: Collection[int] = ()) -> str:
        """The whole table, in place of one that may be there.

        ``counted`` are further ports whose connections are counted, though no new ones come.
        """
        made = _MADE.substitute(name=self.name)
        return made + self._counting({*counted, *forwards}) + self._forwarding("add", forwards)

    def changed(self, change: Changes) -> str:
        """Forwards taken out and put in."""
        removed = self._forwarding("delete", change.removed)
        return removed + self._counting(change.added) + self._forwarding("add", change.added)

    def ended(self) -> str:
        """No forwards any more, and whoever sends something from outside gets a reset.

        Some clients (rospy) try again only when they see their connection end.
        """
        return _ENDED.substitute(name=self.name)

    def removed(self) -> str:
        """No table."""
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
        out, into = _counted(elements["sent"]), _counted(elements["received"])
        counted = {mark: self.marks.port(mark) for mark in out | into}
        counters = {p: (out.get(m, 0), into.get(m, 0)) for m, p in counted.items() if p is not None}
        return TableState(forwards, counters)

    def _forwarding(self, verb: str, forwards: Forwards) -> str:
        pairs: dict[str, list[str]] = {name: [] for name in _MAPS}
        for port, where in forwards.items():
            # A host that is no address, which can't be, makes no sense to nft: it refuses all.
            host = where.host if is_address(where.host) and "%" not in where.host else "?"
            pairs["marks"].append(f"{port} : {self.marks.of(port)}")
            pairs["hosts6" if ":" in host else "hosts4"].append(f"{port} : {host}")
            pairs["ports"].append(f"{port} : {where.port}")
        return "".join(self._elements(verb, name, held) for name, held in pairs.items() if held)

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
        found = [item[kind] for item in listed if kind in item]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise NftError(f"nft printed {text[:200]!r}: {error}") from None
    return [body for body in found if isinstance(body, dict)]


def _pairs(elements: Json) -> dict[int, Json]:
    items = elements if isinstance(elements, list) else []
    pairs = (item for item in items if isinstance(item, list) and len(item) == 2)
    return {key: value for key, value in pairs if isinstance(key, int)}


def _counted(elements: Json) -> dict[int, int]:
    counted = {}
    for item in elements if isinstance(elements, list) else []:
        body = _dict(_dict(item).get("elem"))
        mark, size = body.get("val"), _dict(body.get("counter")).get("bytes", 0)
        if isinstance(mark, int) and isinstance(size, int):
            counted[mark] = size
    return counted


def _dict(value: Json) -> dict[str, Json]:
    return value if isinstance(value, dict) else {}
