"""Which nodes of rmw_zenoh do not match, although both have the same topic or service.

rmw_zenoh puts domain, name, type and type hash into the key of the data (rmw_zenoh_cpp,
liveliness_utils.cpp, TopicInfo). So nodes exchange data only if all four are the same. No QoS keeps
nodes apart (rmw_qos.cpp, rmw_qos_profile_check_compatible). But a publisher with the durability
VOLATILE keeps no messages for later subscriptions.

Each session declares its own tokens. Without a mismatch, two nodes still may not reach each other.
"""

from collections.abc import Collection, Iterable, Iterator
from itertools import chain, islice, product
from math import prod
from typing import NamedTuple

from rosproxy.shared.documents.status_document import MismatchStatus
from rosproxy.zenoh.protocol.liveliness import Entity, EntityKind, ros_type

TYPE = "type"
TYPE_HASH = "type hash"
DURABILITY = "durability"
"""Values of `MismatchStatus.policy`. With DURABILITY, later messages pass nevertheless."""
MOST_COMPARISONS = 10_000
"""Pairs of different entities in one comparison, which takes at most 0.1 s. Nodes with the same
entities count once. A node may have several entities of a name (`_size`)."""
MOST_MISMATCHES_OF_NAME = 100
"""Pairs of nodes of a topic or service that a comparison returns. All others are counted."""
MOST_LISTED_VALUES = 3
"""Types or type hashes of one node that a mismatch lists."""
_SIDES = {
    EntityKind.PUBLISHER: ("topic", 0),
    EntityKind.SUBSCRIPTION: ("topic", 1),
    EntityKind.SERVICE: ("service", 0),
    EntityKind.SERVICE_CLIENT: ("service", 1),
}


class _Variant(NamedTuple):
    """What two entities of the same name can differ in."""

    type: str
    type_hash: str
    is_transient_local: bool


class _Node(NamedTuple):
    """The session and the key of a node."""

    session: str
    key: str


_Side = dict[_Node, set[_Variant]]
"""The nodes that publish or serve a name, or those that subscribe or call."""
_Groups = dict[frozenset[_Variant], list[_Node]]
"""The nodes of a side. Nodes with the same variants are together."""


class Comparison(NamedTuple):
    """The pairs of nodes that do not match.

    ``late`` are pairs that differ in durability alone: only messages from before the subscription
    are missing. ``left_out``: further mismatches. ``not_compared``: pairs of nodes.
    """

    mismatches: tuple[MismatchStatus, ...] = ()
    late: tuple[MismatchStatus, ...] = ()
    left_out: int = 0
    not_compared: int = 0


class _OfName(NamedTuple):
    """The mismatches of a topic or service, as in `Comparison`."""

    mismatches: list[MismatchStatus]
    late: list[MismatchStatus]
    left_out: int


def compare(entities: Iterable[Entity], inside: Collection[str]) -> Comparison:
    """Compare the nodes of each topic and service. ``inside`` has the sessions of nodes inside.

    Pairs without a node inside are left out. If there are too many different entities, the names
    with the most are not compared.
    """
    by_name = {
        names: (_grouped(writers), _grouped(readers))
        for names, (writers, readers) in _by_name(entities).items()
    }
    found: list[_OfName] = []
    compared = 0
    not_compared = 0
    for names in sorted(by_name, key=lambda names: (_size(by_name[names]), names)):
        sides = by_name[names]
        if compared + _size(sides) > MOST_COMPARISONS:
            not_compared += prod(sum(map(len, side.values())) for side in sides)
            continue
        compared += _size(sides)
        found.append(_of_name(names[0], names[2], sides, inside))
    return Comparison(
        tuple(pair for of_name in found for pair in of_name.mismatches),
        tuple(pair for of_name in found for pair in of_name.late),
        sum(of_name.left_out for of_name in found),
        not_compared,
    )


def _by_name(entities: Iterable[Entity]) -> dict[tuple[str, int, str], tuple[_Side, _Side]]:
    """Both sides of each topic and service, by kind, domain and name."""
    by_name: dict[tuple[str, int, str], tuple[_Side, _Side]] = {}
    for entity in entities:
        if entity.kind in _SIDES:
            kind, side = _SIDES[entity.kind]
            sides = by_name.setdefault((kind, entity.domain, entity.name), ({}, {}))
            variant = _Variant(entity.type, entity.type_hash, entity.is_transient_local)
            node = _Node(entity.session, entity.node_key)
            sides[side].setdefault(node, set()).add(variant)
    return by_name


def _grouped(side: _Side) -> _Groups:
    groups: _Groups = {}
    for node, variants in side.items():
        groups.setdefault(frozenset(variants), []).append(node)
    return groups


def _size(sides: tuple[_Groups, _Groups]) -> int:
    """The cost to compare both sides: the pairs, each with the mean of its entities per node."""
    writers, readers = sides
    entities = sum(map(len, writers)) * len(readers) + sum(map(len, readers)) * len(writers)
    return (entities + 1) // 2


def _of_name(
    kind: str, name: str, sides: tuple[_Groups, _Groups], inside: Collection[str]
) -> _OfName:
    mismatches: list[MismatchStatus] = []
    late: list[MismatchStatus] = []
    left_out = 0
    for offered, requested in product(*sides):
        differs = _mismatch(offered, requested, is_topic=kind == "topic")
        if differs is None:
            continue
        rows = late if differs[0] == DURABILITY else mismatches
        count, pairs = _with_inside(sides[0][offered], sides[1][requested], inside)
        room = MOST_MISMATCHES_OF_NAME - len(rows)
        rows += (
            MismatchStatus(kind, name, *differs, writer.key, reader.key)
            for writer, reader in islice(pairs, room)
        )
        left_out += max(count - room, 0) if rows is mismatches else 0
    return _OfName(mismatches, late, left_out)


def _with_inside(
    writers: Collection[_Node], readers: Collection[_Node], inside: Collection[str]
) -> tuple[int, Iterator[tuple[_Node, _Node]]]:
    """The number of pairs with a node inside, and these pairs."""
    writers_inside = [node for node in writers if node.session in inside]
    readers_inside = [node for node in readers if node.session in inside]
    others = [node for node in writers if node.session not in inside]
    count = len(writers_inside) * len(readers) + len(others) * len(readers_inside)
    return count, chain(product(writers_inside, readers), product(others, readers_inside))


def _mismatch(
    offered: Collection[_Variant], requested: Collection[_Variant], *, is_topic: bool
) -> tuple[str, str, str] | None:
    """The policy that differs, the offer and the request; None if two nodes match.

    A node may have several publishers of a topic. If one of them matches, the nodes match.
    """
    types = {o.type for o in offered} & {r.type for r in requested}
    if not types:
        return (
            TYPE,
            _listed(ros_type(o.type) for o in offered),
            _listed(ros_type(r.type) for r in requested),
        )
    hashes = {o[:2] for o in offered} & {r[:2] for r in requested}
    if not hashes:
        own = (o.type_hash for o in offered if o.type in types)
        return TYPE_HASH, _listed(own), _listed(r.type_hash for r in requested if r.type in types)
    keeps = any(o.is_transient_local for o in offered if o[:2] in hashes)
    wants = all(r.is_transient_local for r in requested if r[:2] in hashes)
    return (DURABILITY, "VOLATILE", "TRANSIENT_LOCAL") if is_topic and wants and not keeps else None


def _listed(values: Iterable[str]) -> str:
    """The different values, sorted: usually one."""
    return ", ".join(sorted({*values})[:MOST_LISTED_VALUES])
