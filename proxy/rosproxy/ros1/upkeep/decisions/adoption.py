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
from rosproxy.ros1.upkeep.decisions.registration import is_known_as

Container = tuple[str, Collection[str]]
"""A container on an inside network: its IP address there, and its host names in lower case."""

_NEW_URI = re.compile(r"\[(/[^\]\s]*)\] Reason: new node registered")
"""rosmaster/registrations.py, shutdown_node_task."""


class DirectNode(msgspec.Struct, frozen=True):
    """A node that is registered with its own URI, and the places where it may be."""

    caller_id: str
    uri: str
    slaves: tuple[HostPort, ...]
    registrations: tuple[Registration, ...]

    @property
    def topics(self) -> set[str]:
        """Its topics, without /rosout, which nearly every node has, if it has others."""
        names = {r.name for r in self.registrations if r.kind in TOPIC_KINDS}
        return names - {ROSOUT} or names


def find_direct(
    graph: Graph, arrived: Iterable[Container], addressing: Addressing
) -> list[DirectNode]:
    """The nodes of a master whose URI may mean one of the containers that have arrived."""
    direct_nodes = []
    containers = list(arrived)
    for name, uri in graph.uris.items():
        slave = parse_slave_uri(uri)
        if slave is None or addressing.advertises(slave):
            continue
        host = slave.host.lower()
        addresses = dict.fromkeys(a for a, names in containers if host in (a, *names))
        if addresses:
            slaves = tuple(HostPort(address, slave.port) for address in addresses)
            direct_nodes.append(
                DirectNode(name, uri, slaves, tuple(graph.registrations.get(name, ())))
            )
    return direct_nodes


def locate(
    nodes: Iterable[DirectNode],
    infos: Mapping[HostPort, NodeInfo],
    verified: Collection[tuple[str, HostPort]] = (),
) -> tuple[dict[HostPort, list[DirectNode]], dict[str, str]]:
    """Where each node is, and why some are left alone, by name.

    ``infos`` is what the node at a slave address says of itself; addresses without a node are
    missing. Nodes that are ``verified``, by name and address, bear out what is registered for them.
    """
    located: dict[HostPort, list[DirectNode]] = {}
    doubts: dict[str, str] = {}
    for node in nodes:
        slaves = [s for s in node.slaves if s in infos and (node.caller_id, s) in verified]
        scores = {slave: _score(node, infos[slave]) for slave in slaves}
        best = [slave for slave, score in scores.items() if score == max(scores.values())]
        if len(best) == 1:
            located.setdefault(best[0], []).append(node)
        else:
            doubts[node.caller_id] = _doubt(node, best, infos)
    return located, doubts


def renamed_node(caller_id: str, reason: str) -> str | None:
    """The name whose URI has changed, if that is why ``shutdown`` is called."""
    match = _NEW_URI.match(reason)
    return match[1] if match and caller_id == "/master" else None


def has_name_still(endpoint: Endpoint, uri: str | None, advertised: str) -> bool:
    """Whether no other node has taken a name of an endpoint, which the master has by a URI now.

    The master calls ``shutdown`` at the URI that the name had before. The new URI may be a former
    one of the same node, which registered around the proxy, or the advertised one again by now.
    """
    if uri is None:  # between being taken back and registered anew, the master does not know it
        return endpoint.has_registered_directly
    return uri == advertised or is_known_as(endpoint, uri)


def _score(node: DirectNode, info: NodeInfo) -> int:
    """How well the topics of the node that answers at an address fit a direct node."""
    counts = Counter(info.has(topic) for topic in node.topics)
    return counts[True] - counts[False]


def _doubt(node: DirectNode, best: list[HostPort], infos: Mapping[HostPort, NodeInfo]) -> str:
    slaves = ", ".join(map(str, node.slaves))
    if best:
        candidates = " or ".join(map(str, best))
        reason = f"the node may be at {candidates}. Restart the container of the node"
    elif any(slave in infos for slave in node.slaves):
        reason = f"the node at {slaves} does not show that it made the registrations"
    else:
        reason = f"no node answers at {slaves}"
    return f"registered directly at the master as {node.uri}, and not adopted: {reason}"
