"""What a ROS master knows: which node provides what, under which address. No I/O, no locks."""

from __future__ import annotations

from dataclasses import dataclass, field

KINDS = ("publishers", "subscribers", "services", "params")


@dataclass
class Table:
    """Providers by key (topic, service or parameter), each a (caller_id, api), oldest first."""

    rows: dict[str, list[tuple[str, str]]] = field(default_factory=dict)

    def apis(self, key: str) -> list[str]:
        """Return the addresses registered under `key`."""
        return [api for _, api in self.rows.get(key, [])]

    def add(self, key: str, entry: tuple[str, str]) -> None:
        """Add a provider; one that is there already stays where it is."""
        row = self.rows.setdefault(key, [])
        if entry not in row:
            row.append(entry)

    def discard(self, key: str, entry: tuple[str, str]) -> bool:
        """Remove exactly this provider; return whether it was there."""
        row = self.rows.get(key, [])
        if entry not in row:
            return False
        row.remove(entry)
        if not row:
            del self.rows[key]
        return True

    def discard_node(self, caller_id: str) -> None:
        """Remove everything that the node provides."""
        for key, row in list(self.rows.items()):
            for entry in [entry for entry in row if entry[0] == caller_id]:
                self.discard(key, entry)

    def has_node(self, caller_id: str) -> bool:
        """Tell whether the node provides anything here."""
        return any(name == caller_id for row in self.rows.values() for name, _ in row)

    def state(self) -> list[list[object]]:
        """Return `[[key, [caller_id, ...]], ...]`, as getSystemState does."""
        return [[key, [name for name, _ in row]] for key, row in self.rows.items()]


class Book:
    """All registrations, and the address of every node that has at least one.

    Services are kept under their service address (`rosrpc://`), everything else under the
    node's own (`http://`). One service has one provider: the last one registered.
    """

    def __init__(self) -> None:
        self.nodes: dict[str, str] = {}
        self.tables = {kind: Table() for kind in KINDS}
        self.types: dict[str, str] = {}

    def register(self, kind: str, key: str, caller_id: str, api: str) -> str | None:
        """Register a topic or parameter; see `admit` for what comes back."""
        replaced = self.admit(caller_id, api)
        self.tables[kind].add(key, (caller_id, api))
        return replaced

    def register_service(self, key: str, caller_id: str, service_api: str, api: str) -> str | None:
        """Register a service in the place of whoever had it; see `admit` for what comes back."""
        replaced = self.admit(caller_id, api)
        self.tables["services"].rows[key] = [(caller_id, service_api)]
        return replaced

    def admit(self, caller_id: str, api: str) -> str | None:
        """Take note of a node's address.

        Return the old address when a node of this name was known under another one: that node
        has lost all its registrations and has to be told to shut down.
        """
        old = self.nodes.get(caller_id)
        self.nodes[caller_id] = api
        if old is None or old == api:
            return None
        for table in self.tables.values():
            table.discard_node(caller_id)
        return old

    def unregister(self, kind: str, key: str, caller_id: str, api: str) -> tuple[int, str, int]:
        """Remove one registration; the answer is the ROS triple (1, message, how many)."""
        if caller_id not in self.nodes:
            return 1, f"[{caller_id}] is not a registered node", 0
        if not self.tables[kind].discard(key, (caller_id, api)):
            return 1, self._mismatch(kind, key, caller_id, api), 0
        if not any(table.has_node(caller_id) for table in self.tables.values()):
            del self.nodes[caller_id]
        return 1, f"Unregistered [{caller_id}] as provider of [{key}]", 1

    def _mismatch(self, kind: str, key: str, caller_id: str, api: str) -> str:
        if kind == "services":
            return f"[{api}] is no longer the current service api handle for [{key}]"
        return f"[{caller_id}] is not a known provider of [{key}]"

    def set_type(self, topic: str, type_name: str, *, by_publisher: bool) -> None:
        """Note a topic's type: publishers decide, subscribers only while nobody has."""
        if type_name == "*":
            if by_publisher:
                self.types.setdefault(topic, type_name)
        elif by_publisher or topic not in self.types:
            self.types[topic] = type_name

    def published(self, subgraph: str) -> list[list[str]]:
        """Return `[[topic, type], ...]` of all topics with a publisher, below a namespace."""
        prefix = subgraph if not subgraph or subgraph.endswith("/") else subgraph + "/"
        topics = self.tables["publishers"].rows
        return [[topic, self.types[topic]] for topic in topics if topic.startswith(prefix)]
