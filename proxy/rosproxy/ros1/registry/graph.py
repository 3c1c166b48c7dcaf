"""The ROS graph: who publishes, subscribes and serves what, and where.

The master tells it of all nodes (`Graph`), a node through its slave API of itself (`NodeInfo`).
The two may differ: anybody can write to the master, and it keeps what a dead node had.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration

_Table = list[tuple[str, list[str]]]
ROSOUT = "/rosout"
"""The topic that nearly every node publishes, so that it tells nothing of who a node is."""
TOPIC_KINDS = (Kind.PUBLISHER, Kind.SUBSCRIBER)
"""What a node can be asked for (getPublications, getSubscriptions)."""
_STATE_KINDS = (Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE)


class Graph(msgspec.Struct, frozen=True):
    """What each node has registered, and each node's slave URI as far as known."""

    registrations: Mapping[str, Sequence[Registration]]
    uris: Mapping[str, str]

    def by_topic(self, kind: Kind) -> dict[str, list[str]]:
        """The slave URIs of each topic's publishers or subscribers."""
        topics: dict[str, list[str]] = {}
        for node, registrations in self.registrations.items():
            for registration in registrations:
                if registration.kind is kind and node in self.uris:
                    topics.setdefault(registration.name, []).append(self.uris[node])
        return topics


class NodeInfo(msgspec.Struct, frozen=True):
    """What a node says of itself: its pid, its topics with their types, the TCPROS ports of some.

    None is what it does not tell. That means nothing: no client library has to implement all of
    the slave API, and several don't.
    """

    pid: int | None
    published: Mapping[str, str] | None
    subscribed: Mapping[str, str] | None
    topic_ports: Mapping[str, int] = {}

    @property
    def by_kind(self) -> dict[Kind, Mapping[str, str]]:
        """Its topics by the kind of registration that they need, as far as it tells them."""
        topics_by_kind = {Kind.PUBLISHER: self.published, Kind.SUBSCRIBER: self.subscribed}
        return {kind: topics for kind, topics in topics_by_kind.items() if topics is not None}

    def has(self, topic: str) -> bool | None:
        """Whether it publishes a topic or subscribes to it; None if it does not tell."""
        tables = self.by_kind.values()
        if any(topic in topics for topics in tables):
            return True
        return False if len(tables) == len(TOPIC_KINDS) else None

    def holds(self, registration: Registration) -> bool | None:
        """Whether it has what is registered; None if it does not tell, as of services."""
        topics = self.by_kind.get(registration.kind)
        return None if topics is None else registration.name in topics


def read_state(state: Any, types: Any) -> dict[str, list[Registration]]:
    """What each node has registered, from the values of getSystemState and getTopicTypes.

    ``state`` is ``[publishers, subscribers, services]``, each ``[[name, [node, …]], …]``, and
    ``types`` is ``[[topic, type], …]``. Raises msgspec.ValidationError if ``state`` is not.
    """
    tables = msgspec.convert(state, tuple[_Table, _Table, _Table])
    type_by_topic = read_types(types)
    by_node: dict[str, list[Registration]] = {}
    for kind, rows in zip(_STATE_KINDS, tables, strict=True):
        for name, nodes in rows:
            for node in nodes:
                registration = Registration(kind, name, node, type_by_topic.get(name, "*"))
                by_node.setdefault(node, []).append(registration)
    return by_node


def read_types(rows: Any) -> dict[str, str]:
    """Topics with their types, from ``[[topic, type], …]``; other rows are left out."""
    types: dict[str, str] = {}
    for row in rows if isinstance(rows, list) else ():
        match row:
            case [str(name), str(type_)]:
                types[name] = type_
    return types
