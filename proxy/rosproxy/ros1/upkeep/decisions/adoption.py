"""Adoption of nodes that registered at the real master directly: which nodes, where, which calls.

A container may start while the name of the master still leads to the real master. Nodes of this
container then register with URIs that outside cannot reach. Such nodes are *direct*. To adopt a
direct node, the proxy takes back all registrations of the node. Then the proxy registers the same
names with URIs that outside can reach.

Both client libraries keep the connection to the real master open. So later calls of such a node may
bypass the proxy as well. The master then drops the registrations that the name had before, and
calls ``shutdown`` at the node, through the proxy. The master does the same if another node has
taken the name. `has_name_still` tells the two cases apart.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping

import msgspec

from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.graph import ROSOUT, TOPIC_KINDS, Graph, NodeInfo
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.ros1.upkeep.decisions.registration import is_known_as
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_slave_uri

Container = tuple[str, Collection[str]]
"""The IP address of a container on an inside network, and the host names in lower case."""

_NEW_URI = re.compile(r"\[(/[^\]\s]*)\] Reason: new node registered")
"""The reason in a ``shutdown`` for a name with a new URI (rosmaster/registrations.py,
shutdown_node_task)."""


class DirectNode(msgspec.Struct, frozen=True):
    """A node that is registered with the node's own URI, and the slave addresses to try."""

    caller_id: str
    uri: str
    slaves: tuple[HostPort, ...]
    registrations: tuple[Registration, ...]

    @property
    def topics(self) -> set[str]:
        """The topics of the node, without /rosout unless /rosout is the only topic."""
        names = {r.name for r in self.registrations if r.kind in TOPIC_KINDS}
        return names - {ROSOUT} or names


def find_direct(
    graph: Graph, arrived: Iterable[Container], addressing: Addressing
) -> list[DirectNode]:
    """The nodes of a master whose URI may mean a container that has arrived."""
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
    """Decide which nodes are at which slave address.

    ``infos`` has what the node at each slave address says about itself; addresses without a node
    are missing. ``verified`` has the name and address of each node that has confirmed its
    registrations.

    Returns:
        The nodes at each address, and by name the reason why a node is not adopted.
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


def name_registered_again(caller_id: str, reason: str) -> str | None:
    """The name with a changed URI, if that is the reason of a ``shutdown`` call; else None."""
    match = _NEW_URI.match(reason)
    return match[1] if match and caller_id == "/master" else None


def has_name_still(endpoint: Endpoint, uri: str | None, advertised: str) -> bool:
    """Whether a name of an endpoint still belongs to the endpoint's node.

    ``uri`` is the URI that the master has for the name now. The master calls ``shutdown`` at the
    URI that the name had before. The new URI may be a former URI of the same node, which registered
    at the real master directly, or the advertised URI again. None: the master has no URI.
    """
    if uri is None:  # the proxy is registering the node anew: the master has no URI meanwhile
        return endpoint.has_registered_directly
    return uri == advertised or is_known_as(endpoint, uri)


def _score(node: DirectNode, info: NodeInfo) -> int:
    """The number of topics that the answering node has, minus the number of missing topics."""
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
