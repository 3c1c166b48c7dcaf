"""Hidden registrations: how nodes inside find each other without the master.

The proxy answers calls of nodes inside instead of the master:

- A subscriber gets hidden publishers, besides the publishers that the master names.
- A hidden subscriber gets all publishers inside, and no publisher outside.
- lookupService finds a hidden service. lookupNode finds a node with only hidden registrations.
- The graph has the hidden names, too.

`Registry` has the table of hidden registrations. Texts and values of the answers:
ros_comm/tools/rosmaster/src/rosmaster/master_api.py and registrations.py.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from msgspec.structs import replace

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.graph import read_types
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.ros1.rewriting.master_calls import LocalAnswer, RegistryChange

_TABLES = (Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE)
"""The tables of getSystemState, in order."""


@dataclass(slots=True, eq=False)
class HiddenAnswers:
    """Answers nodes inside as a master with the hidden registrations would."""

    _registry: Registry
    _addressing: Addressing

    def answer_registration(
        self, registration: Registration, endpoint: Endpoint, caller: Caller
    ) -> LocalAnswer:
        """The answer to a new hidden registration."""
        name = registration.name
        change = RegistryChange(registration, endpoint)
        if registration.kind is Kind.SERVICE:
            text = f"Registered [{registration.caller_id}] as provider of [{name}]"
            return LocalAnswer(1, text, 1, change)
        if registration.kind is Kind.PUBLISHER:
            neighbours = [e for e, _ in self._registry.subscriptions(name)]
            text = f"Registered [{registration.caller_id}] as publisher of [{name}]"
        else:
            neighbours = self._publishers_inside(name)
            text = f"Subscribed to [{name}]"
        caller = replace(caller, endpoint=endpoint)
        uris = map(self._addressing.advertised_uri, dict.fromkeys(neighbours))
        imported = [self._addressing.import_slave(uri, caller) for uri in uris]
        return LocalAnswer(1, text, imported, change)

    def answer_unregistration(self, registration: Registration) -> LocalAnswer:
        """The answer to a call that ends a hidden registration."""
        # rosmaster says "provider" of topics as well (registrations.py, unregister).
        text = f"Unregistered [{registration.caller_id}] as provider of [{registration.name}]"
        return LocalAnswer(1, text, 1, RegistryChange(registration, None))

    def find_service(self, name: str, endpoint: Endpoint, caller: Caller) -> LocalAnswer:
        """The answer to lookupService for a hidden service of an endpoint."""
        uri = self._addressing.advertised_service(endpoint)
        imported = self._addressing.import_service(uri, name, caller)
        return LocalAnswer(1, f"rosrpc URI: [{imported}]", imported)

    def find_node(self, caller_id: str, caller: Caller) -> LocalAnswer | None:
        """The answer to lookupNode for a node without shown registrations; None for other nodes."""
        endpoint = self._registry.by_caller.get(caller_id)
        if endpoint is None or endpoint.health.cleaned:
            return None
        if not all(registration.hidden for registration in endpoint.registrations_of(caller_id)):
            return None
        uri = self._addressing.import_slave(self._addressing.advertised_uri(endpoint), caller)
        return LocalAnswer(1, "node api", uri)

    def publishers_for(self, endpoint: Endpoint, topic: str, at_master: Sequence[str]) -> list[str]:
        """The publishers of a topic for the node of an endpoint, by the URIs that the master has.

        ``at_master`` are the publishers that the master tells this node.
        """
        if endpoint in self._registry.hidden_holders(Kind.SUBSCRIBER, topic).values():
            at_master = []
            extra = self._publishers_inside(topic)
        else:
            extra = _living(self._registry.hidden_holders(Kind.PUBLISHER, topic).values())
        return [*dict.fromkeys([*at_master, *map(self._addressing.advertised_uri, extra)])]

    def complete_graph(self, call: Call, listing: Any) -> Any:
        """The master's graph with the hidden names; unchanged if malformed.

        Shapes, all lists of strings: master_api.py, getPublishedTopics, getTopicTypes and
        getSystemState.
        """
        if not isinstance(listing, list):
            return listing
        if call.method == "getSystemState":
            if len(listing) != len(_TABLES):
                return listing
            pairs = zip(_TABLES, listing, strict=True)
            return [self._with_nodes(table, kind) for kind, table in pairs]
        kinds = [Kind.PUBLISHER, Kind.SUBSCRIBER]
        prefix = ""
        if call.method == "getPublishedTopics":  # of a namespace, if the call names one
            kinds = kinds[:1]
            namespace = call.string(1) or ""
            prefix = f"{namespace.rstrip('/')}/" if namespace else ""
        listed = read_types(listing)
        return listing + [
            [topic, type_]
            for topic, type_ in sorted(self._types(kinds).items())
            if topic not in listed and topic.startswith(prefix)
        ]

    def _with_nodes(self, table: Any, kind: Kind) -> Any:
        """A table of names with their nodes, including hidden registrations."""
        if not isinstance(table, list):
            return table
        rows = {row[0]: dict.fromkeys(row[1]) for row in table if _is_row(row)}
        for _, registration in self._registry.hidden_registrations():
            if registration.kind is kind:
                rows.setdefault(registration.name, {})[registration.caller_id] = None
        return [[name, [*nodes]] for name, nodes in rows.items()]

    def _types(self, kinds: Sequence[Kind]) -> dict[str, str]:
        """The types of hidden topics; ``*`` if no node has given a type."""
        types: dict[str, str] = {}
        for _, registration in self._registry.hidden_registrations():
            if registration.kind in kinds and types.get(registration.name, "*") == "*":
                types[registration.name] = registration.type
        return types

    def _publishers_inside(self, topic: str) -> list[Endpoint]:
        """All nodes inside that publish a topic."""
        return _living(self._registry.holders(Kind.PUBLISHER, topic).values())


def _living(endpoints: Iterable[Endpoint]) -> list[Endpoint]:
    """The endpoints that are not `Health.cleaned`, without duplicates, in order of ports."""
    by_id = {id(endpoint): endpoint for endpoint in endpoints if not endpoint.health.cleaned}
    return sorted(by_id.values(), key=lambda endpoint: endpoint.port)


def _is_row(row: Any) -> bool:
    match row:
        case [str(_), [*nodes]]:
            return all(isinstance(node, str) for node in nodes)
    return False
