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
_STATE_KINDS = (Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE)


class Graph(msgspec.Struct, frozen=True):
    """What each node has registered, and each node's slave URI as far as known."""

    held: Mapping[str, Sequence[Registration]]
    uris: Mapping[str, str]

    def by_topic(self, kind: Kind) -> dict[str, list[str]]:
        """The slave URIs of each topic's publishers or subscribers."""
        topics: dict[str, list[str]] = {}
        for node, registrations in self.held.items():
            for held in registrations:
                if held.kind is kind and node in self.uris:
                    topics.setdefault(held.name, []).append(self.uris[node])
        return topics


class NodeInfo(msgspec.Struct, frozen=True):
    """What a node says of itself: its pid, its topics with their types, its TCPROS port.

    ``pid`` and ``tcpros_port`` are None where it does not tell.
    """

    pid: int | None
    published: Mapping[str, str]
    subscribed: Mapping[str, str]
    tcpros_port: int | None

    @property
    def topics(self) -> set[str]:
        """All topics that it publishes or subscribes to."""
        return {*self.published, *self.subscribed}

    @property
    def by_kind(self) -> dict[Kind, Mapping[str, str]]:
        """Its topics by the kind of registration that they need; of other kinds it can't tell."""
        return {Kind.PUBLISHER: self.published, Kind.SUBSCRIBER: self.subscribed}


def read_state(state: Any, types: Any) -> dict[str, list[Registration]]:
    """What each node has registered, from the values of getSystemState and getTopicTypes.

    ``state`` is ``[publishers, subscribers, services]``, each ``[[name, [node, …]], …]``, and
    ``types`` is ``[[topic, type], …]``. Raises msgspec.ValidationError if ``state`` is not.
    """
    tables, known = msgspec.convert(state, tuple[_Table, _Table, _Table]), read_types(types)
    found: dict[str, list[Registration]] = {}
    for kind, entries in zip(_STATE_KINDS, tables, strict=True):
        for name, nodes in entries:
            for node in nodes:
                held = Registration(kind, name, node, known.get(name, "*"))
                found.setdefault(node, []).append(held)
    return found


def read_types(rows: Any) -> dict[str, str]:
    """Topics with their types, from ``[[topic, type], …]``; other rows are left out."""
    held: dict[str, str] = {}
    for row in rows if isinstance(rows, list) else ():
        match row:
            case [str(name), str(type_)]:
                held[name] = type_
    return held
