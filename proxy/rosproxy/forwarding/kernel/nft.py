"""nftables: the common parts of the proxy's tables, and the state of a table as nft prints it.

A proxy has a table for each transport: `ConnectionTable` for TCP (ROS 1), `DatagramTable` for UDP
(ROS 2). A table has maps from port to address and port, and sets that count bytes. The chains never
change, so a packet costs the same for any number of forwards.

Documents are in the language of nft (nft(8)), output is JSON (libnftables-json(5)).
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import msgspec

from rosproxy.forwarding.kernel.decisions import Changes, Forwards
from rosproxy.shared.addresses import HostPort, Network, is_address, parse_address

Json = Any
Near = Sequence[Network]
"""Networks that may use the fast ports of nodes outside, IPv4 and IPv6, without overlaps."""
Elements = dict[str, list[str]]
"""Elements in the language of nft, by the name of the map or set."""


class Counts(NamedTuple):
    """Bytes of IP packets from a node to its peers (``sent``), and from the peers (``received``).

    ``packets``: the number of packets from the peers. A packet of UDP is a datagram.
    """

    sent: int = 0
    received: int = 0
    packets: int = 0


Counters = Mapping[int, Counts]
"""Counts by port."""


class NftError(ValueError):
    """nft printed other output than expected."""


class TableState(msgspec.Struct, frozen=True):
    """The forwards and counters of a proxy's table in the kernel."""

    forwards: Forwards = {}
    counters: Counters = {}


class Surroundings(msgspec.Struct, frozen=True):
    """Facts that a table needs besides the forwards.

    ``near`` are the networks that may use the forwards to nodes outside. ``sources``, by the
    address of a host: the address of this machine from which packets go to this host.
    """

    near: Near = ()
    sources: Mapping[str, str] = {}


class Table(ABC):
    """A table of a proxy. The name is unique in the network namespace."""

    maps: ClassVar[tuple[str, ...]]
    """The names of the maps with the targets of ports."""
    counted_sets: ClassVar[tuple[str, ...]]
    """The names of the sets that count."""

    def __init__(self, name: str) -> None:
        self.name = name

    @property
    @abstractmethod
    def chains(self) -> str:
        """The document that makes the table without elements."""

    @abstractmethod
    def counter_key(self, port: int) -> int:
        """The element of a counting set for a port."""

    @abstractmethod
    def counted_port(self, key: int) -> int | None:
        """The port of an element of a counting set; None for an element of another table."""

    @abstractmethod
    def adapted(self, forwards: Forwards, surroundings: Surroundings) -> str:
        """Return the document that replaces the elements that depend on the surroundings."""

    def made(
        self, forwards: Forwards, surroundings: Surroundings, counted: Collection[int] = ()
    ) -> str:
        """The document that makes the whole table, and replaces an earlier table of this name.

        ``counted`` are further ports that the table counts, because open connections remain.
        """
        # The first line ensures that a table exists: otherwise nft fails to delete the table.
        document = f"add table inet {self.name}\ndelete table inet {self.name}\n{self.chains}"
        document += self._counting({*counted, *forwards})
        document += self._forwarding("add", forwards)
        return document + self.adapted(forwards, surroundings)

    def changed(self, change: Changes) -> str:
        """The document that removes forwards and adds forwards."""
        removed = self._forwarding("delete", change.removed)
        return removed + self._counting(change.added) + self._forwarding("add", change.added)

    def removed(self) -> str:
        """The document that deletes the table."""
        return f"delete table inet {self.name}\n"

    def read(self, text: str) -> TableState:
        """Read the table from the output of ``nft -j list table``. Raises NftError."""
        elements = {
            str(body.get("name")): body.get("elem")
            for kind in ("map", "set")
            for body in _objects(text, kind)
            if body.get("table") == self.name
        }
        if not {*self.maps, *self.counted_sets} <= set(elements):
            raise NftError(f"table {self.name} lacks sets or maps")
        hosts = {**pairs(elements["hosts4"]), **pairs(elements["hosts6"])}
        ports = pairs(elements["ports"])
        forwards = {
            port: HostPort(host, ports[port])
            for port, host in hosts.items()
            if isinstance(ports.get(port), int)
            and parse_address(str(host))
            and self.is_whole(port, elements)
        }
        return TableState(forwards, self._counters(elements))

    def is_whole(self, port: int, elements: Mapping[str, Json]) -> bool:
        """Whether a port has all further elements that the proxy makes for a forward."""
        return True

    def elements(self, forwards: Forwards) -> Elements:
        """The elements of forwards, by map or set."""
        targets = {port: (checked(target.host), target.port) for port, target in forwards.items()}
        hosts = {port: host for port, (host, _) in targets.items()}
        return {
            "hosts4": [f"{port} : {host}" for port, host in hosts.items() if ":" not in host],
            "hosts6": [f"{port} : {host}" for port, host in hosts.items() if ":" in host],
            "ports": [f"{port} : {number}" for port, (_, number) in targets.items()],
        }

    def element_document(self, verb: str, elements: Elements) -> str:
        """The document that adds or deletes elements; ``verb`` is ``add`` or ``delete``."""
        return "".join(
            f"{verb} element inet {self.name} {name} {{ {', '.join(listed)} }}\n"
            for name, listed in elements.items()
            if listed
        )

    def _forwarding(self, verb: str, forwards: Forwards) -> str:
        return self.element_document(verb, self.elements(forwards))

    def _counting(self, ports: Iterable[int]) -> str:
        keys = [str(self.counter_key(port)) for port in sorted(ports)]
        return self.element_document("add", dict.fromkeys(self.counted_sets, keys))

    def _counters(self, elements: Mapping[str, Json]) -> Counters:
        sent = _counted(elements.get("sent"))
        received = _counted(elements["received"])
        ports = {key: self.counted_port(key) for key in sent | received}
        return {
            port: Counts(sent.get(key, _NOTHING)[0], *received.get(key, _NOTHING))
            for key, port in ports.items()
            if port is not None
        }


_NOTHING = 0, 0


def checked(host: str) -> str:
    """The host if it is an address without a zone, else "?": nft then refuses the document."""
    return host if is_address(host) and "%" not in host else "?"


def dropping_chains(text: str) -> list[str]:
    """The chains at hook forward with policy drop, in the output of ``nft -j list chains``.

    The proxy can't tell which packets the rules of such a chain accept. Raises NftError.
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


def pairs(elements: Json) -> dict[int, Json]:
    """The elements of a map in nft's JSON, values by key, without malformed elements."""
    items = elements if isinstance(elements, list) else []
    couples = (item for item in items if isinstance(item, list) and len(item) == 2)
    return {key: value for key, value in couples if isinstance(key, int)}


def _counted(elements: Json) -> dict[int, tuple[int, int]]:
    """Bytes and packets of a counting set, by element: a mark or a port."""
    counted = {}
    for item in elements if isinstance(elements, list) else []:
        body = _dict(_dict(item).get("elem"))
        counter = _dict(body.get("counter"))
        key = body.get("val")
        size = counter.get("bytes", 0)
        count = counter.get("packets", 0)
        if isinstance(key, int) and isinstance(size, int) and isinstance(count, int):
            counted[key] = size, count
    return counted


def _dict(value: Json) -> dict[str, Json]:
    return value if isinstance(value, dict) else {}
