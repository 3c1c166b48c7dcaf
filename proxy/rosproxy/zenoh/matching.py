"""Which nodes of rmw_zenoh do not match, although both have the same topic or service.

rmw_zenoh puts domain, name, type and type hash into the key of the data (rmw_zenoh_cpp,
liveliness_utils.cpp, TopicInfo). So nodes exchange data only if all four are the same. No QoS keeps
nodes apart (rmw_qos.cpp, rmw_qos_profile_check_compatible). But a publisher with the durability
VOLATILE keeps no messages for later subscriptions.

Each session declares its own tokens. Without a mismatch, two nodes still may not reach each other.
"""

from collections.abc import Collection, Iterable, Iterator
from itertools import product
from typing import NamedTuple

from rosproxy.admin.status_document import MismatchStatus
from rosproxy.zenoh.protocol.liveliness import Entity, EntityKind, ros_type

TYPE = "type"
TYPE_HASH = "type hash"
DURABILITY = "durability"
"""Values of `MismatchStatus.policy`. With DURABILITY, later messages pass nevertheless."""
MOST_COMPARED_PAIRS = 10_000
"""Pairs of nodes in one comparison, which takes at most 0.1 s."""
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


_Node = tuple[str, str]
"""The session and the key of a node."""
_Side = dict[_Node, set[_Variant]]
"""The nodes that publish or serve a name, or those that subscribe or call."""


class Comparison(NamedTuple):
    """The pairs of nodes that do not match, and how many pairs are not compared."""

    mismatches: tuple[MismatchStatus, ...] = ()
    not_compared: int = 0


def compare(entities: Iterable[Entity], inside: Collection[str]) -> Comparison:
    """Compare the nodes of each topic and service. ``inside`` has the sessions of nodes inside.

    Pairs without a node inside are left out. If the pairs are too many, the names with the most
    pairs are not compared.
    """
    by_name = {name: sides for name, sides in _by_name(entities).items() if _may_differ(sides)}
    mismatches: list[MismatchStatus] = []
    compared = 0
    not_compared = 0
    for kind, domain, name in sorted(by_name, key=lambda key: (_size(by_name[key]), key)):
        sides = by_name[kind, domain, name]
        if compared + _size(sides) > MOST_COMPARED_PAIRS:
            not_compared += _size(sides)
            continue
        compared += _size(sides)
        mismatches += _mismatches(kind, name, sides, inside)
    return Comparison(tuple(mismatches), not_compared)


def _by_name(entities: Iterable[Entity]) -> dict[tuple[str, int, str], tuple[_Side, _Side]]:
    """Both sides of each topic and service, by kind, domain and name."""
    by_name: dict[tuple[str, int, str], tuple[_Side, _Side]] = {}
    for entity in entities:
        if entity.kind in _SIDES:
            kind, side = _SIDES[entity.kind]
            sides = by_name.setdefault((kind, entity.domain, entity.name), ({}, {}))
            variant = _Variant(entity.type, entity.type_hash, entity.is_transient_local)
            sides[side].setdefault((entity.session, entity.node_key), set()).add(variant)
    return by_name


def _may_differ(sides: tuple[_Side, _Side]) -> bool:
    """Whether there are both sides, and not all entities are the same."""
    return all(sides) and len(set().union(*sides[0].values(), *sides[1].values())) > 1


def _size(sides: tuple[_Side, _Side]) -> int:
    return len(sides[0]) * len(sides[1])


def _mismatches(
    kind: str, name: str, sides: tuple[_Side, _Side], inside: Collection[str]
) -> Iterator[MismatchStatus]:
    for writer, reader in product(*sides):
        if writer[0] in inside or reader[0] in inside:
            found = _mismatch(sides[0][writer], sides[1][reader], is_topic=kind == "topic")
            if found:
                yield MismatchStatus(kind, name, *found, writer[1], reader[1])


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
