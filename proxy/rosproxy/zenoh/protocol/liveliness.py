"""Liveliness tokens of rmw_zenoh: the keys by which nodes announce what they publish and serve.

A token of a node has nine parts, a token of a topic or service has thirteen
(rmw_zenoh_cpp/src/detail/liveliness_utils.cpp, Entity::Entity):

    @ros2_lv/DOMAIN/SESSION/NODE_ID/ENTITY_ID/KIND/ENCLAVE/NAMESPACE/NODE[/NAME/TYPE/HASH/QOS]

In names, ``%`` stands for ``/``.
"""

import re
from collections.abc import Iterable, Sequence
from enum import Enum
from typing import NamedTuple

ALL_TOKENS = "@ros2_lv/**"
"""The key expression of all tokens."""
LONGEST_TOKEN = 1024
"""Characters of a token. The proxy ignores longer tokens. A name of ROS 2 has at most 255
characters, a type some tens."""
MOST_TOKENS = 8192
"""The highest number of tokens that the router process reports. A host with fifty nodes has some
1,000."""
_NODE_PARTS = 9
_TOPIC_OR_SERVICE_PARTS = 13
_NUMBER = re.compile(r"[0-9]{1,9}")
_SESSION = re.compile(r"[0-9a-f]{1,32}")


class EntityKind(Enum):
    """The kind of entity that a token announces."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    SERVICE_CLIENT = "SC"


_KINDS = {kind.value: kind for kind in EntityKind}
_KINDS_OF_NAMES = (
    EntityKind.PUBLISHER,
    EntityKind.SUBSCRIPTION,
    EntityKind.SERVICE,
    EntityKind.SERVICE_CLIENT,
)


class Entity(NamedTuple):
    """A node, or a publisher, subscription, service or service client of a node.

    ``session`` is the zenoh ID of the session that has the node. ``node`` is the full name of the
    node. ``name`` is the full name of the topic or service, and empty for a node.
    """

    domain: int
    session: str
    node_id: int
    kind: EntityKind
    node: str
    name: str = ""


class ZenohNode(NamedTuple):
    """A ROS node with its publishers, subscriptions, services and service clients.

    The full names of topics and services are sorted.
    """

    domain: int
    session: str
    name: str
    publishes: tuple[str, ...]
    subscribes: tuple[str, ...]
    services: tuple[str, ...]
    calls: tuple[str, ...] = ()


def parse_token(key: str) -> Entity | None:
    """The entity of a token; None if the key is too long, or no token of rmw_zenoh."""
    parts = key.split("/") if len(key) <= LONGEST_TOKEN else []
    kind = _KINDS.get(parts[5]) if len(parts) in (_NODE_PARTS, _TOPIC_OR_SERVICE_PARTS) else None
    if kind is None or parts[0] != "@ros2_lv" or not all(parts):
        return None
    if (kind is EntityKind.NODE) != (len(parts) == _NODE_PARTS):
        return None
    domain, session, node_id = parts[1:4]
    if not (_NUMBER.fullmatch(domain) and _NUMBER.fullmatch(node_id)):
        return None
    if not _SESSION.fullmatch(session):
        return None
    namespace = _ros_name(parts[7])
    node = f"{namespace.rstrip('/')}/{_ros_name(parts[8])}"
    name = "" if kind is EntityKind.NODE else _ros_name(parts[9])
    return Entity(int(domain), session, int(node_id), kind, node, name)


class TokenGraph(NamedTuple):
    """The nodes that tokens announce. ``left_out``: tokens that are not of rmw_zenoh."""

    nodes: tuple[ZenohNode, ...]
    left_out: int


def graph_of(tokens: Sequence[str]) -> TokenGraph:
    """The nodes of tokens. For MOST_TOKENS this takes 0.2 s."""
    entities = list(filter(None, map(parse_token, tokens)))
    return TokenGraph(nodes_of(entities), len(tokens) - len(entities))


def nodes_of(entities: Iterable[Entity]) -> tuple[ZenohNode, ...]:
    """The nodes of entities, sorted by domain and name."""
    by_node: dict[tuple[int, str, str, int], dict[EntityKind, set[str]]] = {}
    for entity in entities:
        key = (entity.domain, entity.node, entity.session, entity.node_id)
        names = by_node.setdefault(key, {kind: set() for kind in EntityKind})
        names[entity.kind].add(entity.name)
    return tuple(
        ZenohNode(
            domain,
            session,
            node,
            *(tuple(sorted(names[kind])) for kind in _KINDS_OF_NAMES),
        )
        for (domain, node, session, _), names in sorted(by_node.items(), key=lambda item: item[0])
    )


def _ros_name(mangled: str) -> str:
    return mangled.replace("%", "/")
