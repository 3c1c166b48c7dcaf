"""Nodes that registered around the proxy: which they are, where, and which calls are due to it.

A container may start while its master's name still leads to the real master. Its nodes then
register with their own URIs, which outside can't reach: they are *direct*. Such a node is adopted:
everything that it holds is taken back and registered anew in the form that outside can use.

Its connection to the real master stays open (both client libraries keep it), so that later calls
of such a node may go around the proxy as well. Then the master drops what the name had before and
calls ``shutdown`` at the node, through the proxy, as it does if another node has taken the name.
`shutdown_cause` tells the two apart.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum

from rosproxy.admin.requests import Arrival
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.graph import Graph
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.ros1.upkeep.registration.policy import known_as

_NEW_URI = re.compile(r"\[(/[^\]\s]*)\] Reason: new node registered")
"""rosmaster/registrations.py, shutdown_node_task."""


@dataclass(frozen=True, slots=True)
class DirectNode:
    """A node that is registered with its own URI, and the places where it may be."""

    caller_id: str
    uri: str
    places: tuple[HostPort, ...]
    registrations: tuple[Registration, ...]

    @property
    def topics(self) -> set[str]:
        """Its topics, without everybody's /rosout as far as it has others."""
        names = {held.name for held in self.registrations if held.kind is not Kind.SERVICE}
        return names - {"/rosout"} or names


class ShutdownCause(Enum):
    """Why the master calls ``shutdown`` at a node."""

    NAME_TAKEN = "another node has its name"
    REGISTERED_DIRECTLY = "it registered around the proxy"
    ADOPTED_AGAIN = "it registered around the proxy, and is registered anew already"


def find_direct(
    graph: Graph, arrived: Iterable[Arrival], addressing: Addressing
) -> list[DirectNode]:
    """The nodes of a master whose URI may mean one of the containers that have arrived."""
    found, containers = [], list(arrived)
    for name, uri in graph.uris.items():
        where = parse_slave_uri(uri)
        if where is None or addressing.advertises(where):
            continue
        called = dict.fromkeys(c.address for c in containers if c.is_called(where.host))
        if called:
            places = tuple(HostPort(address, where.port) for address in called)
            found.append(DirectNode(name, uri, places, tuple(graph.held.get(name, ()))))
    return found


def locate(
    nodes: Iterable[DirectNode], topics: Mapping[HostPort, Iterable[str]]
) -> tuple[dict[HostPort, list[DirectNode]], dict[str, str]]:
    """Where each node is, and why some are left alone, by name.

    ``topics`` are those that the node at a place names itself; places without a node are missing.
    """
    found: dict[HostPort, list[DirectNode]] = {}
    doubts: dict[str, str] = {}
    for node in nodes:
        scores = {p: _score(node, set(topics[p])) for p in node.places if p in topics}
        likely = {place: score for place, score in scores.items() if score is not None}
        best = [place for place, score in likely.items() if score == max(likely.values())]
        if len(best) == 1:
            found.setdefault(best[0], []).append(node)
        else:
            doubts[node.caller_id] = _doubt(node, best, topics)
    return found, doubts


def renamed_node(caller_id: str, reason: str) -> str | None:
    """The name whose URI has changed, if that is why somebody calls ``shutdown``."""
    found = _NEW_URI.match(reason)
    return found[1] if found and caller_id == "/master" else None


def shutdown_cause(endpoint: Endpoint, uri: str | None, advertised: str) -> ShutdownCause:
    """Why a name of an endpoint, which the master has by a URI now, is to be shut down.

    The master calls at the URI that the name had before. If the new one is a former URI of the
    same node, or is the endpoint's own by now, no other node has taken the name.
    """
    if uri == advertised:
        return ShutdownCause.ADOPTED_AGAIN
    itself = endpoint.direct if uri is None else known_as(endpoint, uri)
    return ShutdownCause.REGISTERED_DIRECTLY if itself else ShutdownCause.NAME_TAKEN


def _score(node: DirectNode, topics: set[str]) -> int | None:
    """How well the topics of whoever answers at a place fit a node; None if not at all."""
    shared = node.topics & topics
    return len(shared) - len(node.topics - topics) if shared else None


def _doubt(node: DirectNode, best: list[HostPort], topics: Mapping[HostPort, Iterable[str]]) -> str:
    places = ", ".join(str(place) for place in node.places)
    if best:
        either = " and ".join(str(place) for place in best)
        return f"registered as {node.uri} around the proxy: could be at {either}; left alone"
    if any(place in topics for place in node.places):
        return f"registered as {node.uri} around the proxy: the node at {places} is another"
    return f"registered as {node.uri} around the proxy: no node answers at {places}"
