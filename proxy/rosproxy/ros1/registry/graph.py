"""The ROS graph: which node publishes, subscribes to and serves what, and where.

The master tells the graph of all nodes (`Graph`). A node tells its own part through its slave API
(`NodeInfo`). The two may differ: any program can write to the master, and the master keeps the
registrations of dead nodes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration

_Table = list[tuple[str, list[str]]]
ROSOUT = "/rosout"
"""The topic that nearly every node publishes, so that it identifies no node."""
TOPIC_KINDS = (Kind.PUBLISHER, Kind.SUBSCRIBER)
"""The registrations that a node itself tells (getPublications, getSubscriptions)."""
_STATE_KINDS = (Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE)


class Graph(msgspec.Struct, frozen=True):
    """The registrations of each node by name, and the known slave URIs of nodes by name."""

    registrations: Mapping[str, Sequence[Registration]]
    uris: Mapping[str, str]

    def by_topic(self, kind: Kind) -> dict[str, list[str]]:
        """The slave URIs of the publishers or subscribers, by topic."""
        topics: dict[str, list[str]] = {}
        for node, registrations in self.registrations.items():
            for registration in registrations:
                if registration.kind is kind and node in self.uris:
                    topics.setdefault(registration.name, []).append(self.uris[node])
        return topics


class NodeInfo(msgspec.Struct, frozen=True):
    """What a node says about itself: pid, topics with types, and TCPROS ports of some topics.

    None means that the node does not tell the value. This is no fault: no client library has to
    implement the whole slave API, and several implement only a part.
    """

    pid: int | None
    published: Mapping[str, str] | None
    subscribed: Mapping[str, str] | None
    topic_ports: Mapping[str, int] = {}

    @property
    def by_kind(self) -> dict[Kind, Mapping[str, str]]:
        """The known topics of the node, by kind of registration."""
        topics_by_kind = {Kind.PUBLISHER: self.published, Kind.SUBSCRIBER: self.subscribed}
        return {kind: topics for kind, topics in topics_by_kind.items() if topics is not None}

    def has(self, topic: str) -> bool | None:
        """Whether the node publishes or subscribes to a topic; None if the node does not tell."""
        tables = self.by_kind.values()
        if any(topic in topics for topics in tables):
            return True
        return False if len(tables) == len(TOPIC_KINDS) else None

    def holds(self, registration: Registration) -> bool | None:
        """Whether the node has what is registered; None if the node does not tell.

        No node tells its services and parameters.
        """
        topics = self.by_kind.get(registration.kind)
        return None if topics is None else registration.name in topics


def read_state(state: Any, types: Any) -> dict[str, list[Registration]]:
    """Read the registrations of each node from the values of getSystemState and getTopicTypes.

    ``state`` is ``[publishers, subscribers, services]``, each ``[[name, [node, …]], …]``, and
    ``types`` is ``[[topic, type], …]``. Raises msgspec.ValidationError if ``state`` has another
    form.
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
    """Read topics with their types from ``[[topic, type], …]``; other rows are left out."""
    types: dict[str, str] = {}
    for row in rows if isinstance(rows, list) else ():
        match row:
            case [str(name), str(type_)]:
                types[name] = type_
    return types
