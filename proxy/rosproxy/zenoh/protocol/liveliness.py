"""Liveliness tokens of rmw_zenoh: the keys by which nodes announce what they publish and serve.

A token of a node has nine parts, a token of a topic or service has thirteen
(rmw_zenoh_cpp/src/detail/liveliness_utils.cpp, Entity::Entity):

    @ros2_lv/DOMAIN/SESSION/NODE_ID/ENTITY_ID/KIND/ENCLAVE/NAMESPACE/NODE[/NAME/TYPE/HASH/QOS]

In names, ``%`` stands for ``/``.
"""

import re
from collections.abc import Iterable, Sequence
from enum import Enum
from functools import lru_cache
from typing import NamedTuple

ALL_TOKENS = "@ros2_lv/**"
"""The key expression of all tokens."""
LONGEST_TOKEN = 1024
"""Characters of a token. The proxy ignores longer tokens. A name of ROS 2 has at most 255
characters, a type some tens."""
_KEPT = re.compile(rf"[!#-\[\]-~]{{1,{LONGEST_TOKEN}}}")
MOST_TOKENS = 8192
"""The highest number of tokens that the router process reports. A host with fifty nodes has some
1,000."""
_NODE_PARTS = 9
_TOPIC_OR_SERVICE_PARTS = 13
_TYPE_PART = 10
_HASH_PART = 11
_QOS_PART = 12
_COMMON = {"0": "SYSTEM_DEFAULT", "4": "BEST_AVAILABLE"}
_RELIABILITY = {**_COMMON, "": "RELIABLE", "1": "RELIABLE", "2": "BEST_EFFORT"}
_DURABILITY = {**_COMMON, "": "VOLATILE", "1": "TRANSIENT_LOCAL", "2": "VOLATILE"}
_HISTORY = {"0": "SYSTEM_DEFAULT", "": "KEEP_LAST", "1": "KEEP_LAST", "2": "KEEP_ALL"}
"""Names of values by number (rmw/types.h). A default value is an empty text in a token
(liveliness_utils.cpp, qos_to_keyexpr; qos.cpp). Before March 2025, the default of the durability
was TRANSIENT_LOCAL (rmw_zenoh #521)."""
_UNKNOWN = "UNKNOWN"
_DEFAULT_DEPTH = 42
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
_KINDS_OF_TOPICS = (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION)


class Qos(NamedTuple):
    """The QoS in a token, ``reliability:durability:history,depth:...``. Values are names of ROS."""

    reliability: str = _RELIABILITY[""]
    durability: str = _DURABILITY[""]
    history: str = _HISTORY[""]
    depth: int = _DEFAULT_DEPTH


class TopicQos(NamedTuple):
    """The QoS of a publisher or a subscription of a node. ``name``: the topic."""

    name: str
    is_publisher: bool
    qos: Qos


class Entity(NamedTuple):
    """A node, or a publisher, subscription, service or service client of a node.

    ``session`` is the zenoh ID of the session that has the node. ``node`` is the full name of the
    node. ``name`` is the full name of the topic or service, and empty for a node. ``type`` and
    ``type_hash`` are as in the keys of the data: nodes exchange data only if both are the same.
    """

    domain: int
    session: str
    node_id: int
    kind: EntityKind
    node: str
    name: str = ""
    type: str = ""
    type_hash: str = ""
    qos: Qos = Qos()

    @property
    def is_transient_local(self) -> bool:
        """Whether a publisher keeps messages for later subscriptions, or one asks for them."""
        return self.qos.durability == "TRANSIENT_LOCAL"

    @property
    def node_key(self) -> str:
        """The key of the node (`ZenohNode.key`)."""
        return _node_key(self.domain, self.session, self.node_id, self.node)


class ZenohNode(NamedTuple):
    """A ROS node with its publishers, subscriptions, services and service clients.

    The full names of topics and services are sorted. ``types`` has each name with its ROS type.
    ``qos`` has the QoS of publishers and subscriptions, each once.
    """

    domain: int
    session: str
    name: str
    publishes: tuple[str, ...]
    subscribes: tuple[str, ...]
    services: tuple[str, ...]
    calls: tuple[str, ...] = ()
    types: tuple[tuple[str, str], ...] = ()
    node_id: int = 0
    qos: tuple[TopicQos, ...] = ()

    @property
    def key(self) -> str:
        """The key of the node, which is the same at all proxies: ``DOMAIN SESSION.NODE_ID/NAME``.

        Several nodes may have the same name.
        """
        return _node_key(self.domain, self.session, self.node_id, self.name)


def is_kept(key: str) -> bool:
    """Whether the router process reports a token: short, and of characters of names in ROS.

    The characters take a byte each in JSON. Others take up to twelve bytes, so a report of
    MOST_TOKENS could exceed its bound.
    """
    return _KEPT.fullmatch(key) is not None


def parse_token(key: str) -> Entity | None:
    """The entity of a token; None if `is_kept` is false, or the key is no token of rmw_zenoh."""
    parts = key.split("/") if is_kept(key) else []
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
    if kind is EntityKind.NODE:
        return Entity(int(domain), session, int(node_id), kind, node)
    return Entity(
        int(domain),
        session,
        int(node_id),
        kind,
        node,
        _ros_name(parts[9]),
        parts[_TYPE_PART],
        parts[_HASH_PART],
        _qos(parts[_QOS_PART]),
    )


@lru_cache(maxsize=1024)
def _qos(text: str) -> Qos:
    """The QoS in a token; UNKNOWN for other numbers than those of ROS."""
    reliability, durability, history, *_ = [*text.split(":"), "", "", ""]
    kind, _, depth = history.partition(",")
    return Qos(
        _RELIABILITY.get(reliability, _UNKNOWN),
        _DURABILITY.get(durability, _UNKNOWN),
        _HISTORY.get(kind, _UNKNOWN),
        int(depth) if _NUMBER.fullmatch(depth) else _DEFAULT_DEPTH,
    )


class TokenGraph(NamedTuple):
    """What tokens announce. ``left_out``: tokens that are not of rmw_zenoh."""

    entities: tuple[Entity, ...] = ()
    nodes: tuple[ZenohNode, ...] = ()
    left_out: int = 0


def graph_of(tokens: Sequence[str]) -> TokenGraph:
    """What tokens announce. For MOST_TOKENS this takes 0.2 s."""
    entities = tuple(filter(None, map(parse_token, tokens)))
    return TokenGraph(entities, nodes_of(entities), len(tokens) - len(entities))


def nodes_of(entities: Iterable[Entity]) -> tuple[ZenohNode, ...]:
    """The nodes of entities, sorted by domain and name."""
    by_node: dict[tuple[int, str, str, int], list[Entity]] = {}
    for entity in entities:
        key = (entity.domain, entity.node, entity.session, entity.node_id)
        by_node.setdefault(key, []).append(entity)
    return tuple(_node_of(by_node[key]) for key in sorted(by_node))


def _node_of(entities: Sequence[Entity]) -> ZenohNode:
    """The node to which all the entities belong."""
    first = entities[0]
    names: dict[EntityKind, set[str]] = {kind: set() for kind in EntityKind}
    for entity in entities:
        names[entity.kind].add(entity.name)
    publishes, subscribes, services, calls = (
        tuple(sorted(names[kind])) for kind in _KINDS_OF_NAMES
    )
    types = {(entity.name, ros_type(entity.type)) for entity in entities if entity.name}
    qos = {
        TopicQos(entity.name, entity.kind is EntityKind.PUBLISHER, entity.qos)
        for entity in entities
        if entity.kind in _KINDS_OF_TOPICS
    }
    return ZenohNode(
        first.domain,
        first.session,
        first.node,
        publishes,
        subscribes,
        services,
        calls,
        tuple(sorted(types)),
        first.node_id,
        tuple(sorted(qos)),
    )


def ros_type(key_type: str) -> str:
    """The ROS type for the type in a key: std_msgs/msg/String for std_msgs::msg::dds_::String_."""
    package, separator, name = key_type.partition("::dds_::")
    return f"{package.replace('::', '/')}/{name.removesuffix('_')}" if separator else key_type


def _node_key(domain: int, session: str, node_id: int, node: str) -> str:
    return f"{domain} {session}.{node_id}{node}"


def _ros_name(mangled: str) -> str:
    return mangled.replace("%", "/")
