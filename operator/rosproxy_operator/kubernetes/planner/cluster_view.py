"""What is seen in a cluster, put in order: which proxies are wanted where, and which exist.

Everything after this works by place, that is a RosProxy on a node, and not by pod.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeVar

import msgspec

from rosproxy.telemetry.text import listed
from rosproxy_operator.kubernetes.planner.pods.selection import on_node, select_rosproxy, selects
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    PodFailure,
    ProxyPod,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Name,
    Pod,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import is_own, proxy_id
from rosproxy_operator.kubernetes.status.findings import finding

K = TypeVar("K")
V = TypeVar("V")


class View(msgspec.Struct, frozen=True):
    """A `ClusterSnapshot` by RosProxy and by node.

    ``rosproxies`` are those that are not being deleted; ``proxies`` those that belong to one of
    them, ``orphans`` those of RosProxies that are gone. ``current`` is the proxy of a place, under
    the name that it is to have, unless it is being deleted. ``proxies_by_node`` are, by the node
    that they are meant for, all proxies that hold ports, of any RosProxy. ``wanted`` are the
    places where pods want a proxy, and those pods; ``places`` those where a proxy is wanted or
    exists, in order; ``selected_pods`` all pods that a RosProxy has taken, wherever they are.
    ``other_pods_by_node`` are, by node, the pods that hold ports and are neither proxies nor LAN
    relays, ``other_pod_names`` the names of all such pods, with ports or not, ``names`` those of
    all proxies. ``findings`` are those about pods.
    """

    observed: ClusterSnapshot
    rosproxies: Mapping[Name, RosProxy]
    proxies: Mapping[ProxyPlace, tuple[ProxyPod, ...]]
    current: Mapping[ProxyPlace, ProxyPod]
    orphans: tuple[ProxyPod, ...]
    proxies_by_node: Mapping[str, tuple[ProxyPod, ...]]
    wanted: Mapping[ProxyPlace, tuple[Pod, ...]]
    places: Mapping[Name, tuple[ProxyPlace, ...]]
    selected_pods: Mapping[Name, tuple[Pod, ...]]
    other_pods_by_node: Mapping[str, tuple[Pod, ...]]
    other_pod_names: frozenset[Name]
    names: frozenset[Name]
    findings: tuple[ClusterFinding, ...]


def place_of(proxy: ProxyPod) -> ProxyPlace:
    """The place that a proxy is meant for."""
    return ProxyPlace(proxy.of, proxy.node)


def serves(proxy: ProxyPod) -> bool:
    """Whether a proxy has its ports and is up, or has been and will be again."""
    running = proxy.ready or proxy.restarts > 0 or proxy.pod.phase == "Running"
    return running and not proxy.pod.ended


def has_ports(proxy: ProxyPod) -> bool:
    """Whether the scheduler has given a proxy its node, and with it its ports."""
    return bool(proxy.pod.node) and not proxy.pod.ended and proxy.stuck is not PodFailure.PORTS


def view(observed: ClusterSnapshot) -> View:
    """Put in order what is seen."""
    rosproxies = {r.id: r for r in observed.rosproxies if not r.deleting}
    proxies = group_by_key((place_of(p), p) for p in observed.proxies if _owned(p, rosproxies))
    unusable = {r.uid for r in observed.unusable.values()}
    orphans = (p for p in observed.proxies if not _owned(p, rosproxies))
    own_uids = {own_pod.pod.uid for own_pod in observed.own_pods}
    other_pods = {pod.uid: pod for pod in observed.pods if pod.uid not in own_uids}.values()
    taken, findings = _taken(observed, rosproxies)
    wanted, left_out = _wanted(observed, rosproxies, taken)
    return View(
        observed=observed,
        rosproxies=rosproxies,
        proxies=proxies,
        current={
            place: proxy
            for place, candidates in proxies.items()
            for proxy in candidates
            if proxy.pod.id == proxy_id(place.of, place.node) and not proxy.pod.deleting
        },
        orphans=tuple(p for p in orphans if p.owner not in unusable),
        proxies_by_node=group_by_key((p.node, p) for p in observed.proxies if not p.pod.ended),
        wanted=wanted,
        places=group_by_key((place.of, place) for place in sorted({*wanted, *proxies})),
        selected_pods=taken,
        other_pods_by_node=group_by_key(
            (pod.node, pod) for pod in other_pods if pod.node and pod.every_port and not pod.ended
        ),
        other_pod_names=frozenset(pod.id for pod in other_pods),
        names=frozenset(p.pod.id for p in observed.proxies),
        findings=(*findings, *left_out),
    )


def _owned(proxy: ProxyPod, rosproxies: Mapping[Name, RosProxy]) -> bool:
    return proxy.of in rosproxies and rosproxies[proxy.of].uid == proxy.owner


def _taken(
    observed: ClusterSnapshot, rosproxies: Mapping[Name, RosProxy]
) -> tuple[dict[Name, tuple[Pod, ...]], list[ClusterFinding]]:
    """Which RosProxy has taken which pods, and what is wrong with that."""
    pods = [pod for pod in observed.pods if not (pod.ended or pod.deleting or is_own(pod.labels))]
    choices = [(select_rosproxy(pod, rosproxies.values()), pod) for pod in pods]
    taken = group_by_key(
        (choice.id, pod) for choice, pod in choices if isinstance(choice, RosProxy)
    )
    refused = [(choice, pod) for choice, pod in choices if isinstance(choice, ClusterFinding)]
    # Each RosProxy that selects the pod reports that.
    findings = [
        replace(choice, of=r.id)
        for choice, pod in refused
        for r in rosproxies.values()
        if selects(r, pod)
    ]
    return taken, findings


def _wanted(
    observed: ClusterSnapshot,
    rosproxies: Mapping[Name, RosProxy],
    taken: Mapping[Name, Iterable[Pod]],
) -> tuple[dict[ProxyPlace, tuple[Pod, ...]], list[ClusterFinding]]:
    """The places where pods want a proxy, and findings about pods that get none."""
    places = group_by_key(
        (ProxyPlace(n, pod.node), pod) for n, pods in taken.items() for pod in pods
    )
    wanted: dict[ProxyPlace, tuple[Pod, ...]] = {}
    findings: list[ClusterFinding] = []
    for place, pods in sorted(places.items()):
        rosproxy = rosproxies[place.of]
        node = observed.nodes.get(place.node)
        if node is None or node.deleting:
            continue
        if on_node(rosproxy, node):
            wanted[place] = pods
            continue
        text = (
            f"node {place.node} does not match spec.nodeSelector, so selected pods there have no "
            f"proxy: {abbreviated(str(pod.id) for pod in pods)}. Widen spec.nodeSelector, or set "
            "the same nodeSelector in the pods"
        )
        findings.append(finding(rosproxy, "NodeLeftOut", text))
    return wanted, findings


def abbreviated(texts: Iterable[str]) -> str:
    """A few of the texts, and how many more there are."""
    return listed(sorted(set(texts)))


def group_by_key(pairs: Iterable[tuple[K, V]]) -> dict[K, tuple[V, ...]]:
    """The values of each key, in their order."""
    groups: dict[K, list[V]] = defaultdict(list)
    for key, value in pairs:
        groups[key].append(value)
    return {key: tuple(values) for key, values in groups.items()}
