"""Nodes that registered around the proxy: which they are, where, and which calls are due to it.

A container may start while its master's name still leads to the real master. Its nodes then
register with their own URIs, which outside can't reach: they are *direct*. Such a node is adopted:
everything that it holds is taken back and registered anew in the form that outside can use.

Its connection to the real master stays open (both client libraries keep it), so that later calls
of such a node may go around the proxy as well. Then the master drops what the name had before and
calls ``shutdown`` at the node, through the proxy, as it does if another node has taken the name.
`has_name_still` tells the two apart.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping

import msgspec

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.graph import ROSOUT, TOPIC_KINDS, Graph, NodeInfo
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.ros1.upkeep.decisions.registration import known_as

Container = tuple[str, Collection[str]]
"""A container on an inside network: its IP address there, and its host names in lower case."""

_NEW_URI = re.compile(r"\[(/[^\]\s]*)\] Reason: new node registered")
"""rosmaster/registrations.py, shutdown_node_task."""


class DirectNode(msgspec.Struct, frozen=True):
    """A node that is registered with its own URI, and the places where it may be."""

    caller_id: str
    uri: str
    places: tuple[HostPort, ...]
    registrations: tuple[Registration, ...]

    @property
    def topics(self) -> set[str]:
        """Its topics, without everybody's /rosout as far as it has others."""
        names = {held.name for held in self.registrations if held.kind in TOPIC_KINDS}
        return names - {ROSOUT} or names


def find_direct(
    graph: Graph, arrived: Iterable[Container], addressing: Addressing
) -> list[DirectNode]:
    """The nodes of a master whose URI may mean one of the containers that have arrived."""
    found, containers = [], list(arrived)
    for name, uri in graph.uris.items():
        where = parse_slave_uri(uri)
        if where is None or addressing.advertises(where):
            continue
        host = where.host.lower()
        called = dict.fromkeys(a for a, names in containers if host in (a, *names))
        if called:
            places = tuple(HostPort(address, where.port) for address in called)
            found.append(DirectNode(name, uri, places, tuple(graph.held.get(name, ()))))
    return found


def locate(
    nodes: Iterable[DirectNode],
    infos: Mapping[HostPort, NodeInfo],
    sure: Collection[tuple[str, HostPort]] = (),
) -> tuple[dict[HostPort, list[DirectNode]], dict[str, str]]:
    """Where each node is, and why some are left alone, by name.

    ``infos`` is what the node at a place says of itself; places without a node are missing. Those
    that are ``sure``, by name and place, have borne out what is registered for them.
    """
    found: dict[HostPort, list[DirectNode]] = {}
    doubts: dict[str, str] = {}
    for node in nodes:
        places = [p for p in node.places if p in infos and (node.caller_id, p) in sure]
        likely = {place: _score(node, infos[place]) for place in places}
        best = [place for place, score in likely.items() if score == max(likely.values())]
        if len(best) == 1:
            found.setdefault(best[0], []).append(node)
        else:
            doubts[node.caller_id] = _doubt(node, best, infos)
    return found, doubts


def renamed_node(caller_id: str, reason: str) -> str | None:
    """The name whose URI has changed, if that is why somebody calls ``shutdown``."""
    found = _NEW_URI.match(reason)
    return found[1] if found and caller_id == "/master" else None


def has_name_still(endpoint: Endpoint, uri: str | None, advertised: str) -> bool:
    """Whether no other node has taken a name of an endpoint, which the master has by a URI now.

    The master calls ``shutdown`` at the URI that the name had before. The new one may be a former
    one of the same node, which has registered around the proxy, or is advertised again by now.
    """
    if uri is None:
        return endpoint.direct
    return uri == advertised or known_as(endpoint, uri)


def _score(node: DirectNode, info: NodeInfo) -> int:
    """How well the topics of whoever answers at a place fit a node."""
    told = Counter(info.has(topic) for topic in node.topics)
    return told[True] - told[False]


def _doubt(node: DirectNode, best: list[HostPort], infos: Mapping[HostPort, NodeInfo]) -> str:
    places = ", ".join(map(str, node.places))
    if best:
        why = f"could be at {' and '.join(map(str, best))}; left alone"
    elif any(place in infos for place in node.places):
        why = f"the node at {places} is another"
    else:
        why = f"no node answers at {places}"
    return f"registered as {node.uri} around the proxy: {why}"
