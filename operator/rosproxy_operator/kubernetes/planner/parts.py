"""A cluster in parts that have nothing to do with each other, so that each can be planned alone.

RosProxies of one namespace choose among the same pods, and proxies on one node among the same
ports: so a part is made of namespaces and of the nodes that they use, with all that is connected
by these. `plan` is asked for a part as it is for a whole cluster: `cut` gives it what there is of
that part alone, and `joined` puts what it remembers into the memory of the whole.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, own_pods


class Part(msgspec.Struct, frozen=True):
    """Namespaces with RosProxies, and the nodes that they use."""

    namespaces: frozenset[str] = frozenset()
    nodes: frozenset[str] = frozenset()


def part_of(
    observed: ClusterSnapshot, namespaces: Iterable[str], nodes: Iterable[str] = ()
) -> Part:
    """What may have to be planned anew if something of these namespaces or nodes has changed.

    A node that nobody uses concerns nobody.
    """
    nodes_of: dict[str, set[str]] = defaultdict(set)
    users: dict[str, set[str]] = defaultdict(set)
    for namespace, node in _uses(observed):
        nodes_of[namespace].add(node)
        users[node].add(namespace)
    found, found_nodes = set(namespaces), set[str]()
    for node in nodes:
        found |= users.get(node, set())
    left = [*found]
    while left:
        new = nodes_of.get(left.pop(), set()) - found_nodes
        found_nodes |= new
        more = {one for node in new for one in users[node]} - found
        found |= more
        left += more
    return Part(frozenset(found), frozenset(found_nodes))


def parts(observed: ClusterSnapshot) -> Iterator[Part]:
    """All parts."""
    left = {one.id.namespace for one in observed.rosproxies}
    left |= {one.namespace for one in observed.unusable}
    left |= {namespace for namespace, _ in _uses(observed)}
    left |= {one.namespace for one in (*observed.services, *observed.policies)}
    while left:
        part = part_of(observed, [min(left)])
        left -= part.namespaces
        yield part


def _uses(observed: ClusterSnapshot) -> Iterator[tuple[str, str]]:
    """Which namespace uses which node: by pods, by proxies, or by ports that it had there."""
    for pod in observed.pods:
        if pod.uid in observed.selected:
            yield pod.id.namespace, pod.node
    for one in own_pods(observed.proxies, observed.ears):
        yield one.of.namespace, one.on
        yield one.of.namespace, one.pod.node
    for rosproxy in observed.rosproxies:
        for node in rosproxy.former:
            yield rosproxy.id.namespace, node


def cut(observed: ClusterSnapshot, part: Part) -> ClusterSnapshot:
    """What there is of a part. What is only looked up by name is left as it is."""
    own = part.namespaces
    return replace(
        observed,
        rosproxies=tuple(one for one in observed.rosproxies if one.id.namespace in own),
        unusable={id: one for id, one in observed.unusable.items() if id.namespace in own},
        pods=tuple(
            pod for pod in observed.pods if pod.id.namespace in own or pod.node in part.nodes
        ),
        proxies=tuple(one for one in observed.proxies if one.of.namespace in own),
        ears=tuple(one for one in observed.ears if one.of.namespace in own),
        services={id: one for id, one in observed.services.items() if id.namespace in own},
        policies={id: one for id, one in observed.policies.items() if id.namespace in own},
    )


def cut_state(state: ClusterState, part: Part) -> ClusterState:
    """What is remembered of a part."""
    return _chosen(state, part, True)


def joined(state: ClusterState, part: Part, new: ClusterState) -> ClusterState:
    """What is remembered of all, with what is remembered of a part now."""
    others = _chosen(state, part, False)
    both = {
        name: {**getattr(others, name), **getattr(new, name)}
        for name in (*_BY_PLACE, *_BY_NODE, "attempts", "reported", "taken", "strange")
    }
    return replace(new, **both)


_BY_PLACE = ("absent", "served", "given", "refused", "moved", "tried", "former")
_BY_NODE = ("lost", "addresses")


def _chosen(state: ClusterState, part: Part, inside: bool) -> ClusterState:
    """What is remembered of a part, or of all others."""
    own, nodes = part.namespaces, part.nodes
    found: dict[str, Mapping[Any, Any]] = {
        "attempts": {
            task: one
            for task, one in state.attempts.items()
            if (task.of.namespace in own) == inside
        },
        "reported": {
            one: at for one, at in state.reported.items() if (one.of.namespace in own) == inside
        },
        "taken": {where: at for where, at in state.taken.items() if (where[0] in nodes) == inside},
        "strange": {
            where: at for where, at in state.strange.items() if (where[0] in nodes) == inside
        },
    }
    for name in _BY_PLACE:
        places = getattr(state, name)
        found[name] = {p: one for p, one in places.items() if (p.of.namespace in own) == inside}
    for name in _BY_NODE:
        table = getattr(state, name)
        found[name] = {node: one for node, one in table.items() if (node in nodes) == inside}
    return replace(state, **found)
