"""The bound of the document at ``/status``: MOST_BYTES of JSON, whatever names nodes choose.

Nodes choose names and the number of names, and any address outside can add connections. A document
within the bound stays the same. In a longer document each address gets a fair share of the bytes.
An address that needs less keeps all rows and lists. So no address can hide the rows of another.

An address that needs more than its share first keeps rows (nodes, participants and so on) without
lists, then as much of each list as fits. Counters named ``left_out`` count the missing entries.
"""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, takewhile
from typing import Any, TypeVar

import msgspec

from rosproxy.shared.addresses import parse_authority
from rosproxy.shared.documents.status_document import (
    DomainStatus,
    PolicyStatus,
    ProxyStatus,
    ZenohStatus,
)

MOST_BYTES = 1024 * 1024
"""Bytes of JSON. A hundred nodes with ten topics and as many connections each have 250,000."""
_ROW_COUNTER_BYTES = 10
"""Bytes by which the ``left_out`` of a row may grow."""
_MOST_LISTS = 8
"""Lists of a row at most; `_fit` reserves a byte for each, for a comma."""
_OTHER_COUNTERS_BYTES = 4096
"""Bytes by which all other counters together may grow: counters that belong to no row."""
_FIRST_TABLES = ("nodes", "inside", "outside", "sessions", "stand_ins", "udpros", "layers", "peers")
"""Tables, in the order in which an owner keeps the rows; rows of other tables come last."""
_UNCOUNTED_LISTS = ("types", "qos")
"""The lists whose entries ``left_out`` does not count: each entry belongs to a name."""
_DELETE = b"\x7f"
_ESCAPED = (
    (_DELETE, 5),
    (bytes(range(0xC2, 0xE0)), 4),
    (bytes(range(0xE0, 0xF0)), 3),
    (bytes(range(0xF0, 0xF5)), 8),
)
"""The first bytes of characters in UTF-8 that `encode` escapes, and by how many bytes each grows:
``\\u`` with four digits takes six bytes, and a pair of these twelve."""
Item = TypeVar("Item")
Parent = TypeVar("Parent", bound=msgspec.Struct)
Row = Any
"""A struct or a text."""
VisitTable = Callable[[str, Sequence[Row], Callable[[Row], str]], tuple[Row, ...]]
"""Takes a table: the name, the rows, and a function from row to owner. Returns the rows to show."""


def bounded(status: ProxyStatus, most: int = MOST_BYTES) -> ProxyStatus:
    """The status with tables short enough for ``most`` bytes of JSON."""
    excess = encoded_size(status) - most
    if excess <= 0:
        return status
    entries = _entries(status)
    wanted: defaultdict[str, int] = defaultdict(int)
    by_owner: defaultdict[str, list[_Entry]] = defaultdict(list)
    for entry in entries:
        wanted[entry.owner] += entry.size
        by_owner[entry.owner].append(entry)
    room = max(sum(wanted.values()) - excess - _OTHER_COUNTERS_BYTES, 0)
    shares = dict(zip(wanted, fair_shares(list(wanted.values()), room), strict=True))
    for owner, share in shares.items():
        if share < wanted[owner]:
            _fit(by_owner[owner], share)
    shown = iter(entries)

    def visit(_name: str, rows: Sequence[Row], _owner: Callable[[Row], str]) -> tuple[Row, ...]:
        visited = [next(shown) for _ in rows]
        return tuple(entry.row for entry in visited if not entry.is_left_out)

    return _visit_tables(status, visit)


def left_out(status: ProxyStatus) -> int:
    """The number of rows and names that were left out of the status."""
    policy = status.policy or PolicyStatus()
    counts = [status.left_out, policy.left_out, policy.layers_left_out]
    counts += [node.left_out for node in status.nodes]
    counts += [layer.left_out for layer in policy.layers]
    for domain in status.domains:
        counts += [domain.left_out, domain.mismatches_left_out]
        counts += [participant.left_out for participant in (*domain.inside, *domain.outside)]
    zenoh = status.zenoh or ZenohStatus()
    counts += [zenoh.left_out, zenoh.mismatches_left_out]
    counts += [node.left_out for node in zenoh.nodes]
    return sum(counts)


def encode(value: object) -> bytes:
    """A document or a part as JSON in ASCII, which is harmless on a terminal."""
    encoded = msgspec.json.encode(value)
    if encoded.isascii() and _DELETE not in encoded:
        return encoded
    # In one call of C code: nodes may choose names in which every second character is not ASCII.
    return json.dumps(msgspec.json.decode(encoded), separators=(",", ":")).encode()


def encoded_size(value: object) -> int:
    """The number of bytes that `encode` returns, without the escaping."""
    encoded = msgspec.json.encode(value)
    if encoded.isascii() and _DELETE not in encoded:
        return len(encoded)
    every = len(encoded)
    return every + sum(more * (every - len(encoded.translate(None, f))) for f, more in _ESCAPED)


def fair_shares(wanted: Sequence[int], most: int) -> list[int]:
    """The fair shares of ``most``, in the order of ``wanted`` (max-min fairness).

    Each share is the wanted amount, or the limit that is the same for all larger wants.
    """
    shares = [0] * len(wanted)
    remaining = most
    by_size = sorted(range(len(wanted)), key=wanted.__getitem__)
    for served, index in enumerate(by_size):
        shares[index] = min(wanted[index], remaining // (len(wanted) - served))
        remaining -= shares[index]
    return shares


def fair_shares_by_owner(owners: Sequence[str], wanted: Sequence[int], most: int) -> list[int]:
    """Divide ``most`` fairly among the owners, then each owner's share among the owner's items.

    The item ``i`` belongs to ``owners[i]`` and wants ``wanted[i]``. Returns the share of each item.
    """
    by_owner: defaultdict[str, list[int]] = defaultdict(list)
    for index, owner in enumerate(owners):
        by_owner[owner].append(index)
    totals = [sum(wanted[index] for index in own) for own in by_owner.values()]
    shares = [0] * len(wanted)
    for own, room in zip(by_owner.values(), fair_shares(totals, most), strict=True):
        for index, share in zip(own, fair_shares([wanted[i] for i in own], room), strict=True):
            shares[index] = share
    return shares


def fair_choice(items: Iterable[Item], owner: Callable[[Item], str], most: int) -> list[Item]:
    """The first items of each owner, ``most`` in all, with fair shares; the order stays."""
    every = list(items)
    if len(every) <= most:
        return every
    by_owner: defaultdict[str, list[int]] = defaultdict(list)
    for index, item in enumerate(every):
        by_owner[owner(item)].append(index)
    shares = fair_shares([len(own) for own in by_owner.values()], most)
    chosen = [own[:share] for own, share in zip(by_owner.values(), shares, strict=True)]
    return [every[index] for index in sorted(index for own in chosen for index in own)]


@dataclass(slots=True)
class _Entry:
    """A row of a table with the owner. ``size``: bytes as JSON, with a comma."""

    table: str
    owner: str
    row: Row
    size: int
    is_left_out: bool = False


def _entries(status: ProxyStatus) -> list[_Entry]:
    entries: list[_Entry] = []

    def visit(name: str, rows: Sequence[Row], owner: Callable[[Row], str]) -> tuple[Row, ...]:
        entries.extend(_Entry(name, owner(row), row, encoded_size(row) + 1) for row in rows)
        return tuple(rows)

    _visit_tables(status, visit)
    return entries


def _visit_tables(status: ProxyStatus, visit: VisitTable) -> ProxyStatus:
    """The status with the results of ``visit`` for each table that nodes or strangers lengthen."""
    policy = status.policy and _with_tables(
        status.policy,
        visit,
        layers=lambda _: "layers",
        hidden=lambda hidden: hidden.address,
    )
    domains = tuple(
        _with_tables(
            domain,
            visit,
            peers=lambda _: "peers",
            inside=lambda participant: participant.address,
            outside=lambda participant: participant.address,
            unselected=lambda address: address,
            mismatches=_owners_of_mismatches(domain),
        )
        for domain in status.domains
    )
    zenoh = status.zenoh and _with_tables(
        status.zenoh,
        visit,
        sessions=lambda session: _host(f"//{session.remote}"),
        nodes=lambda node: node.address,
        mismatches=_owners_of_zenoh_mismatches(status.zenoh),
    )
    return _with_tables(
        msgspec.structs.replace(status, policy=policy, domains=domains, zenoh=zenoh),
        visit,
        nodes=lambda node: _host(f"//{node.address}"),
        stand_ins=lambda stand_in: _host(stand_in.uri),
        udpros=lambda subscription: subscription.peer,
    )


def _with_tables(parent: Parent, visit: VisitTable, **owners: Callable[[Row], str]) -> Parent:
    """The parent with the visited tables, and with counters of the rows that were left out."""
    changes: dict[str, Any] = {}
    for name, owner in owners.items():
        rows = getattr(parent, name)
        changes[name] = visit(name, rows, owner)
        counter = f"{name}_left_out"
        counter = counter if hasattr(parent, counter) else "left_out"
        before = changes.get(counter, getattr(parent, counter))
        changes[counter] = before + len(rows) - len(changes[name])
    return msgspec.structs.replace(parent, **changes)


def _owners_of_mismatches(domain: DomainStatus) -> Callable[[Row], str]:
    """A function from a mismatch to the address of the participant inside; empty if unknown."""
    addresses = {participant.guid_prefix: participant.address for participant in domain.inside}
    return lambda mismatch: addresses.get(mismatch.writer, addresses.get(mismatch.reader, ""))


def _owners_of_zenoh_mismatches(zenoh: ZenohStatus) -> Callable[[Row], str]:
    """A function from a mismatch to the address of the node inside; empty if unknown."""
    addresses = {node.key: node.address for node in zenoh.nodes if node.port is not None}
    return lambda mismatch: addresses.get(mismatch.writer, addresses.get(mismatch.reader, ""))


def _host(uri: str) -> str:
    address = parse_authority(uri)
    return address.host if address else uri


def _fit(entries: Sequence[_Entry], room: int) -> None:
    """Shorten the rows of one owner, or leave rows out, until ``room`` bytes are enough."""
    ranks = {table: rank for rank, table in enumerate(_FIRST_TABLES)}
    ordered = sorted(entries, key=lambda entry: ranks.get(entry.table, len(ranks)))
    bare_sizes = [
        encoded_size(_shortened(entry.row, 0)) + 1 + _ROW_COUNTER_BYTES for entry in ordered
    ]
    kept = sum(1 for used in accumulate(bare_sizes) if used <= room)
    for entry in ordered[kept:]:
        entry.is_left_out = True
    room -= sum(bare_sizes[:kept])
    # `_shortened` counts a comma for the last entry of each list, too.
    in_lists = [
        max(entry.size - bare, 0) + _ROW_COUNTER_BYTES + _MOST_LISTS
        for entry, bare in zip(ordered[:kept], bare_sizes, strict=False)
    ]
    for entry, share in zip(ordered[:kept], fair_shares(in_lists, room), strict=True):
        entry.row = _shortened(entry.row, share)


def _shortened(row: Row, room: int) -> Row:
    """A row with as many first entries of the lists as fit into ``room`` bytes in all."""
    lists: dict[str, Any] = {}
    left_out = 0
    for name in getattr(row, "__struct_fields__", ()):
        entries = getattr(row, name)
        if isinstance(entries, tuple):
            sizes = accumulate(encoded_size(entry) + 1 for entry in entries)
            used = list(takewhile(room.__ge__, sizes))
            lists[name] = entries[: len(used)]
            room -= used[-1] if used else 0
            left_out += 0 if name in _UNCOUNTED_LISTS else len(entries) - len(used)
    if not lists:
        return row
    return msgspec.structs.replace(row, **lists, left_out=row.left_out + left_out)
