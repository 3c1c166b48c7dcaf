"""Splits a cluster into independent parts, so that the operator plans only the parts that change.

RosProxies of a namespace choose among the same pods, and proxies on a node among the same ports. So
a part is a set of namespaces and the nodes that these namespaces use. Two namespaces that use the
same node are in the same part. `partition_snapshot` reduces the snapshot to a part. `plan` plans
the part like a whole cluster. `merge_state` puts the new state of the part into the whole state.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, HelperPod
from rosproxy_operator.kubernetes.resources.model import Name

T = TypeVar("T")


class Partition(msgspec.Struct, frozen=True):
    """Namespaces, and the nodes that these namespaces use."""

    namespaces: frozenset[str] = frozenset()
    nodes: frozenset[str] = frozenset()


def partition_of(
    observed: ClusterSnapshot, namespaces: Iterable[str], nodes: Iterable[str] = ()
) -> Partition:
    """Return the part to plan after a change in these namespaces or nodes.

    A node that no namespace uses adds nothing.
    """
    nodes_of: dict[str, set[str]] = defaultdict(set)
    users: dict[str, set[str]] = defaultdict(set)
    for namespace, node in _uses(observed):
        nodes_of[namespace].add(node)
        users[node].add(namespace)
    reached = set(namespaces)
    reached_nodes = set[str]()
    for node in nodes:
        reached |= users.get(node, set())
    pending = [*reached]
    while pending:
        new_nodes = nodes_of.get(pending.pop(), set()) - reached_nodes
        reached_nodes |= new_nodes
        new_users = {user for node in new_nodes for user in users[node]} - reached
        reached |= new_users
        pending += new_users
    return Partition(frozenset(reached), frozenset(reached_nodes))


def partitions(observed: ClusterSnapshot) -> Iterator[Partition]:
    """Yield all parts of the cluster."""
    pending = {r.id.namespace for r in observed.rosproxies}
    pending |= {name.namespace for name in observed.unusable}
    pending |= {namespace for namespace, _ in _uses(observed)}
    pending |= {name.namespace for name in _own_objects(observed)}
    pods = (*observed.unselected_pods, *observed.misspelt_pods)
    pending |= {pod.id.namespace for pod in pods}
    while pending:
        partition = partition_of(observed, [min(pending)])
        pending -= partition.namespaces
        yield partition


def _uses(observed: ClusterSnapshot) -> Iterator[tuple[str, str]]:
    """Yield pairs of a namespace and a node that the namespace uses.

    A namespace uses a node by selected pods, by pods of the operator, or by a range of ports in the
    status of a RosProxy.
    """
    for pod in observed.pods:
        if pod.uid in observed.selected:
            yield pod.id.namespace, pod.node
    for own_pod in observed.own_pods:
        yield own_pod.of.namespace, own_pod.node
        yield own_pod.of.namespace, own_pod.pod.node
    for rosproxy in observed.rosproxies:
        for node in rosproxy.former_ranges:
            yield rosproxy.id.namespace, node


def partition_snapshot(observed: ClusterSnapshot, partition: Partition) -> ClusterSnapshot:
    """Return the snapshot of a part. Fields that the plan only searches by name stay whole."""
    namespaces = partition.namespaces
    return replace(
        observed,
        rosproxies=tuple(r for r in observed.rosproxies if r.id.namespace in namespaces),
        unusable={id: r for id, r in observed.unusable.items() if id.namespace in namespaces},
        pods=tuple(
            p for p in observed.pods if p.id.namespace in namespaces or p.node in partition.nodes
        ),
        unselected_pods=tuple(p for p in observed.unselected_pods if p.id.namespace in namespaces),
        misspelt_pods=tuple(p for p in observed.misspelt_pods if p.id.namespace in namespaces),
        proxies=tuple(p for p in observed.proxies if p.of.namespace in namespaces),
        lan_relays=_within(observed.lan_relays, namespaces),
        image_checks=_within(observed.image_checks, namespaces),
        services=_named_within(observed.services, namespaces),
        hub_services=_named_within(observed.hub_services, namespaces),
        outside_services=_named_within(observed.outside_services, namespaces),
        policies=_named_within(observed.policies, namespaces),
    )


def _own_objects(observed: ClusterSnapshot) -> Iterator[Name]:
    """Yield the names of RosProxies that have Services, and of NetworkPolicies."""
    yield from (*(service.of for service in observed.all_services), *observed.policies)


def _named_within(objects: Mapping[Name, T], namespaces: frozenset[str]) -> dict[Name, T]:
    return {id: obj for id, obj in objects.items() if id.namespace in namespaces}


def _within(helpers: tuple[HelperPod, ...], namespaces: frozenset[str]) -> tuple[HelperPod, ...]:
    return tuple(helper for helper in helpers if helper.of.namespace in namespaces)


_BY_ROSPROXY = (
    *("absent", "served", "given", "refused", "moved", "tried", "former"),
    *("unregistered", "attempts", "reported"),
)
_NAMESPACES: Mapping[str, Callable[[Any], str]] = {
    **dict.fromkeys(_BY_ROSPROXY, lambda key: key.of.namespace),
    **dict.fromkeys(("unselected", "undiscovered"), lambda pod: pod.namespace),
    "apart": lambda pair: pair[0].of.namespace,
}
"""By field of `ClusterState`: a function that returns the namespace of a key."""
_NODES: Mapping[str, Callable[[Any], str]] = {
    **dict.fromkeys(("lost", "addresses"), str),
    **dict.fromkeys(("taken", "strange"), lambda key: key[0]),
}
"""By field of `ClusterState`: a function that returns the node of a key."""


def partition_state(state: ClusterState, partition: Partition) -> ClusterState:
    """Return the state of a part."""
    return _filtered(state, partition, True)


def merge_state(state: ClusterState, partition: Partition, new: ClusterState) -> ClusterState:
    """Return the state of the whole cluster, with the new state of a part."""
    outside = _filtered(state, partition, False)
    names = (*_NAMESPACES, *_NODES)
    merged = {name: {**getattr(outside, name), **getattr(new, name)} for name in names}
    return replace(new, **merged)


def _filtered(state: ClusterState, partition: Partition, inside: bool) -> ClusterState:
    """Return the state of a part, or with ``inside`` False the state without the part."""
    fields: dict[str, Mapping[Any, Any]] = {}
    for owners, part in ((_NAMESPACES, partition.namespaces), (_NODES, partition.nodes)):
        for name, owner in owners.items():
            entries = getattr(state, name).items()
            fields[name] = {key: v for key, v in entries if (owner(key) in part) == inside}
    return replace(state, **fields)
