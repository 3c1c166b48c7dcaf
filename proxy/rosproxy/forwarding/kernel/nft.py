"""nftables in libnftables' JSON (libnftables-json(5)): the proxy's table, its changes, its state.

One table per proxy, named after its master port, so that two of them in one network namespace
leave each other alone. It holds maps from fast port to mark, address and port; sets that count
bytes by mark; and three chains, which stay as they are however many forwards there are:

- prerouting: what comes in for an address of this machine gets its port's mark (on the
  connection) and is sent on to the node;
- postrouting: it leaves with this machine's address, so that the node's replies come back;
- forward: bytes of IP packets are counted, in each direction.
"""

import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosproxy.forwarding.kernel.policy import Changes, Forwards
from rosproxy.net.addresses import HostPort, parse_address

Json = Any
Counters = Mapping[int, tuple[int, int]]
"""Bytes of IP packets by port: sent outside, received from there."""

_DPORT = {"payload": {"protocol": "tcp", "field": "dport"}}
_MAPS = {"marks": "mark", "hosts4": "ipv4_addr", "hosts6": "ipv6_addr", "ports": "inet_service"}
_SETS = ("sent", "received")
_BEFORE_FILTERS = -300
"""A priority: what a filter drops is counted as well, so that it is known to have come."""


class NftError(ValueError):
    """What nft printed is not what was expected."""


@dataclass(frozen=True, slots=True)
class TableState:
    """What the kernel has in a proxy's table; bytes by port as sent outside and received."""

    forwards: Forwards = field(default_factory=dict)
    counters: Counters = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Marks:
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


@dataclass(frozen=True, slots=True)
class Table:
    """The table of the proxy with a master port."""

    master_port: int

    @property
    def name(self) -> str:
        """What it is called."""
        return f"rosproxy-{self.master_port}"

    @property
    def marks(self) -> Marks:
        """The connection marks in it."""
        return Marks(self.master_port)

    def made(self, forwards: Forwards, counted: Collection[int] = ()) -> str:
        """The whole table, in place of one that may be there.

        ``counted`` are further ports whose connections are counted, though no new ones come.
        """
        table = {"family": "inet", "name": self.name}
        commands = [_add("table", table), _delete("table", table), _add("table", table)]
        commands += [self._map(name, data) for name, data in _MAPS.items()]
        commands += [self._set(name) for name in _SETS]
        commands += self._chains()
        commands += self._counting({*counted, *forwards})
        return _document(commands + self._elements("add", forwards))

    def changed(self, change: Changes) -> str:
        """Forwards taken out and put in."""
        return _document(
            [
                *self._elements("delete", change.removed),
                *self._counting(change.added),
                *self._elements("add", change.added),
            ]
        )

    def ended(self) -> str:
        """No forwards any more, and whoever sends something from outside gets a reset.

        Some clients (rospy) try again only when they see their connection end.
        """
        flushed = [{"flush": {"map": self._named(name)}} for name in _MAPS]
        reset = {"reject": {"type": "tcp reset"}}
        return _document([*flushed, self._rule("forward", *_INWARD, _ct("mark", "@sent"), reset)])

    def removed(self) -> str:
        """No table."""
        return _document([_delete("table", {"family": "inet", "name": self.name})])

    def read(self, text: str) -> TableState:
        """The table as ``nft -j list table`` prints it. Raises NftError."""
        elements = {
            str(body.get("name")): _list(body.get("elem"))
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
        return TableState(forwards, self._counters(*(elements[name] for name in _SETS)))

    def _counters(self, sent: Json, received: Json) -> dict[int, tuple[int, int]]:
        out, into = _counted(sent), _counted(received)
        ports = {mark: self.marks.port(mark) for mark in out | into}
        return {p: (out.get(m, 0), into.get(m, 0)) for m, p in ports.items() if p is not None}

    def _elements(self, verb: str, forwards: Forwards) -> list[Json]:
        wanted = {name: {} for name in _MAPS}  # type: dict[str, dict[int, Json]]
        for port, where in forwards.items():
            wanted["marks"][port] = self.marks.of(port)
            wanted["hosts6" if ":" in where.host else "hosts4"][port] = where.host
            wanted["ports"][port] = where.port
        return [
            {verb: {"element": self._named(name, elem=[[k, v] for k, v in pairs.items()])}}
            for name, pairs in wanted.items()
            if pairs
        ]

    def _counting(self, ports: Iterable[int]) -> list[Json]:
        marks = sorted(self.marks.of(port) for port in ports)
        if not marks:
            return []
        return [_add("element", self._named(name, elem=marks)) for name in _SETS]

    def _named(self, name: str, **more: Json) -> Json:
        return {"family": "inet", "table": self.name, "name": name, **more}

    def _map(self, name: str, data: str) -> Json:
        return _add("map", self._named(name, type="inet_service", map=data))

    def _set(self, name: str) -> Json:
        return _add("set", self._named(name, type="mark", stmt=[{"counter": None}]))

    def _chains(self) -> list[Json]:
        return [
            self._chain("prerouting", "nat", -100),
            self._chain("postrouting", "nat", 100),
            self._chain("forward", "filter", _BEFORE_FILTERS),
            self._rule("prerouting", _LOCAL, _mangle("marks")),
            self._rule("prerouting", _LOCAL, _dnat("ip", "hosts4")),
            self._rule("prerouting", _LOCAL, _dnat("ip6", "hosts6")),
            self._rule("postrouting", _TRANSLATED, _ct("mark", "@sent"), {"masquerade": None}),
            self._rule("forward", *_OUTWARD, _ct("mark", "@sent")),
            self._rule("forward", *_INWARD, _ct("mark", "@received")),
        ]

    def _chain(self, hook: str, kind: str, priority: int) -> Json:
        body = self._named(hook, type=kind, hook=hook, prio=priority, policy="accept")
        return _add("chain", body)

    def _rule(self, chain: str, *expressions: Json) -> Json:
        body = {"family": "inet", "table": self.name, "chain": chain, "expr": list(expressions)}
        return _add("rule", body)


def dropping_chains(text: str) -> list[str]:
    """The chains at hook forward that drop by policy, in what ``nft -j list chains`` prints.

    What such a chain lets through can't be told from outside. Raises NftError.
    """
    return [
        f"{body.get('family')} {body.get('table')} {body.get('name')}"
        for body in _objects(text, "chain")
        if body.get("hook") == "forward" and body.get("policy") == "drop"
    ]


def _objects(text: str, kind: str) -> list[Json]:
    try:
        listed = json.loads(text)["nftables"]
        found = [item[kind] for item in listed if kind in item]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise NftError(f"nft printed {text[:200]!r}: {error}") from None
    return [body for body in found if isinstance(body, dict)]


def _list(value: Json) -> list[Json]:
    return value if isinstance(value, list) else []


def _dict(value: Json) -> dict[str, Json]:
    return value if isinstance(value, dict) else {}


def _pairs(elements: list[Json]) -> dict[int, Json]:
    pairs = (item for item in elements if isinstance(item, list) and len(item) == 2)
    return {key: value for key, value in pairs if isinstance(key, int)}


def _counted(elements: list[Json]) -> dict[int, int]:
    counted = {}
    for item in elements:
        body = _dict(_dict(item).get("elem"))
        mark, size = body.get("val"), _dict(body.get("counter")).get("bytes", 0)
        if isinstance(mark, int) and isinstance(size, int):
            counted[mark] = size
    return counted


def _document(commands: list[Json]) -> str:
    return json.dumps({"nftables": commands})


def _add(kind: str, body: Json) -> Json:
    return {"add": {kind: body}}


def _delete(kind: str, body: Json) -> Json:
    return {"delete": {kind: body}}


def _match(left: Json, right: Json, operator: str = "==") -> Json:
    return {"match": {"op": operator, "left": left, "right": right}}


def _ct(key: str, right: Json) -> Json:
    return _match({"ct": {"key": key}}, right)


def _mangle(name: str) -> Json:
    return {"mangle": {"key": {"ct": {"key": "mark"}}, "value": _looked_up(name)}}


def _dnat(family: str, hosts: str) -> Json:
    return {"dnat": {"family": family, "addr": _looked_up(hosts), "port": _looked_up("ports")}}


def _looked_up(name: str) -> Json:
    return {"map": {"key": _DPORT, "data": f"@{name}"}}


_LOCAL = _match({"fib": {"result": "type", "flags": ["daddr"]}}, "local")
_TRANSLATED = _match({"ct": {"key": "status"}}, "dnat", "in")
_OUTWARD = _TRANSLATED, _ct("direction", "reply")
_INWARD = _TRANSLATED, _ct("direction", "original")
