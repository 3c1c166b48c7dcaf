"""The ROS graph as nodes inside are to see it: what the master says, and what is hidden from it.

Replies: ros_comm/tools/rosmaster/src/rosmaster/master_api.py, getPublishedTopics, getTopicTypes and
getSystemState. All are lists of strings.
"""

from typing import Any

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry.graph import read_types
from rosproxy.ros1.registry.registry import Registry

METHODS = frozenset({"getPublishedTopics", "getTopicTypes", "getSystemState"})
"""The calls whose replies tell the graph."""
_TABLES = (Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE)


def with_hidden(call: Call, listing: Any, registry: Registry) -> Any:
    """What the master has said of the graph, with what is hidden; as it is if it is malformed."""
    if not isinstance(listing, list):
        return listing
    if call.method == "getSystemState":
        if len(listing) != len(_TABLES):
            return listing
        pairs = zip(_TABLES, listing, strict=True)
        return [_with_nodes(table, kind, registry) for kind, table in pairs]
    kinds = [Kind.PUBLISHER, Kind.SUBSCRIBER]
    prefix = ""
    if call.method == "getPublishedTopics":  # of a namespace, if it names one
        kinds = kinds[:1]
        namespace = call.string(1) or ""
        prefix = f"{namespace.rstrip('/')}/" if namespace else ""
    listed = read_types(listing)
    types = _types(kinds, registry)
    return listing + [
        [topic, type_]
        for topic, type_ in sorted(types.items())
        if topic not in listed and topic.startswith(prefix)
    ]


def _with_nodes(table: Any, kind: Kind, registry: Registry) -> Any:
    """A table of names with their nodes, and the hidden ones among them."""
    if not isinstance(table, list):
        return table
    rows = {row[0]: [*row[1]] for row in table if _is_row(row)}
    for (hidden_kind, name), holders in registry.hidden.items():
        if hidden_kind is kind:
            nodes = rows.setdefault(name, [])
            nodes += [node for node in holders if node not in nodes]
    return [[name, nodes] for name, nodes in rows.items()]


def _is_row(row: Any) -> bool:
    match row:
        case [str(_), [*_]]:
            return True
    return False


def _types(kinds: list[Kind], registry: Registry) -> dict[str, str]:
    """The types of hidden topics, as far as a node has given one."""
    types: dict[str, str] = {}
    for (kind, name), holders in registry.hidden.items():
        for node, endpoint in holders.items() if kind in kinds else ():
            type_ = endpoint.registrations[kind, name, node].type
            if types.get(name, "*") == "*":
                types[name] = type_
    return types
