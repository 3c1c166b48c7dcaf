"""The snapshot of a cluster, sorted: the proxies that pods want, and the proxies that exist.

The later steps of a plan work by place. A place is a pair of a RosProxy and a node.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeVar

import msgspec

from rosproxy.shared.output.text import listed
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner.pods.selection import (
    ambiguity_warning,
    on_node,
    select_rosproxy,
    selects,
)
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    HelperPod,
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
from rosproxy_operator.kubernetes.status.findings import finding, pod_finding

K = TypeVar("K")
V = TypeVar("V")


class View(msgspec.Struct, frozen=True):
    """A `ClusterSnapshot`, sorted by RosProxy and by node.

    - ``rosproxies``: the RosProxies that are not being deleted.
    - ``proxies``: the proxies of these RosProxies, by place.
    - ``current``: by place, the proxy with the right name that is not being deleted.
    - ``orphans``: the proxies of RosProxies that are gone or being deleted. The proxies of an
      unusable RosProxy are no orphans.
    - ``proxies_by_node``: by intended node, all proxies whose pods have not ended.
    - ``lan_relays_by_node`` and ``image_checks_by_node``: by intended node, these pods.
    - ``wanted``: the places where pods want a proxy, with these pods.
    - ``places``: by RosProxy, the places where a proxy is wanted or exists, sorted.
    - ``selected_pods``: by RosProxy, the pods that the RosProxy takes, on any node.
    - ``other_pods_by_node``: the pods that hold ports and do not belong to the operator.
    - ``other_pod_names``: the names of all pods that do not belong to the operator.
    - ``names``: the names of all proxies' pods.
    - ``findings``: the findings about pods.
    """

    observed: ClusterSnapshot
    rosproxies: Mapping[Name, RosProxy]
    proxies: Mapping[ProxyPlace, tuple[ProxyPod, ...]]
    current: Mapping[ProxyPlace, ProxyPod]
    orphans: tuple[ProxyPod, ...]
    proxies_by_node: Mapping[str, tuple[ProxyPod, ...]]
    lan_relays_by_node: Mapping[str, tuple[HelperPod, ...]]
    image_checks_by_node: Mapping[str, tuple[HelperPod, ...]]
    wanted: Mapping[ProxyPlace, tuple[Pod, ...]]
    places: Mapping[Name, tuple[ProxyPlace, ...]]
    selected_pods: Mapping[Name, tuple[Pod, ...]]
    other_pods_by_node: Mapping[str, tuple[Pod, ...]]
    other_pod_names: frozenset[Name]
    names: frozenset[Name]
    findings: tuple[ClusterFinding, ...]


def place_of(proxy: ProxyPod) -> ProxyPlace:
    """Return the place that a proxy is meant for."""
    return ProxyPlace(proxy.of, proxy.node)


def serves(proxy: ProxyPod) -> bool:
    """Whether a proxy runs, or has run and the kubelet will start the container again.

    Such a pod has all hostPorts, because the kubelet starts no container without them.
    """
    running = proxy.ready or proxy.restarts > 0 or proxy.pod.phase == "Running"
    return running and not proxy.pod.ended


def has_ports(proxy: ProxyPod) -> bool:
    """Whether a proxy's pod holds its hostPorts.

    The scheduler reserves the ports when it binds the pod to a node. The kubelet may still refuse.
    """
    return bool(proxy.pod.node) and not proxy.pod.ended and proxy.stuck is not PodFailure.PORTS


def view(observed: ClusterSnapshot) -> View:
    """Return the sorted view of a snapshot."""
    rosproxies = {r.id: r for r in observed.rosproxies if not r.deleting}
    proxies = group_by_key((place_of(p), p) for p in observed.proxies if _owned(p, rosproxies))
    unusable = {r.uid for r in observed.unusable.values()}
    orphans = (p for p in observed.proxies if not _owned(p, rosproxies))
    own_uids = {own_pod.pod.uid for own_pod in observed.own_pods}
    other_pods = {pod.uid: pod for pod in observed.pods if pod.uid not in own_uids}.values()
    selected_pods, findings = _selected_pods(observed, rosproxies)
    wanted, left_out = _wanted(observed, rosproxies, selected_pods)
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
        lan_relays_by_node=group_by_key((relay.node, relay) for relay in observed.lan_relays),
        image_checks_by_node=group_by_key((check.node, check) for check in observed.image_checks),
        wanted=wanted,
        places=group_by_key((place.of, place) for place in sorted({*wanted, *proxies})),
        selected_pods=selected_pods,
        other_pods_by_node=group_by_key(
            (pod.node, pod) for pod in other_pods if pod.node and pod.every_port and not pod.ended
        ),
        other_pod_names=frozenset(pod.id for pod in other_pods),
        names=frozenset(p.pod.id for p in observed.proxies),
        findings=(*findings, *left_out),
    )


def _owned(proxy: ProxyPod, rosproxies: Mapping[Name, RosProxy]) -> bool:
    return proxy.of in rosproxies and rosproxies[proxy.of].uid == proxy.owner


def _selected_pods(
    observed: ClusterSnapshot, rosproxies: Mapping[Name, RosProxy]
) -> tuple[dict[Name, tuple[Pod, ...]], list[ClusterFinding]]:
    """Return the pods that each RosProxy takes, and findings about selected pods left out."""
    pods = [pod for pod in observed.pods if not (pod.ended or pod.deleting or is_own(pod.labels))]
    choices = [(select_rosproxy(pod, rosproxies.values()), pod) for pod in pods]
    selected_pods = group_by_key(
        (choice.id, pod) for choice, pod in choices if isinstance(choice, RosProxy)
    )
    refused = [(choice, pod) for choice, pod in choices if isinstance(choice, ClusterFinding)]
    # `select_rosproxy` names a single RosProxy in a finding, but the status of each RosProxy that
    # selects the pod has to show the finding.
    findings = [
        replace(choice, of=r.id)
        for choice, pod in refused
        for r in rosproxies.values()
        if selects(r, pod)
    ]
    findings += [
        pod_finding(pod, r, "Ambiguous", fault, fatal=False)
        for choice, pod in choices
        if isinstance(choice, RosProxy) and (fault := ambiguity_warning(pod, rosproxies.values()))
        for r in rosproxies.values()
        if selects(r, pod)
    ]
    return selected_pods, findings


def _wanted(
    observed: ClusterSnapshot,
    rosproxies: Mapping[Name, RosProxy],
    selected_pods: Mapping[Name, Iterable[Pod]],
) -> tuple[dict[ProxyPlace, tuple[Pod, ...]], list[ClusterFinding]]:
    """Return the places where pods want a proxy, and findings about pods that get no proxy.

    Places on an unknown node, or on a node that is being deleted, are left out without a finding.
    """
    places = group_by_key(
        (ProxyPlace(n, pod.node), pod) for n, pods in selected_pods.items() for pod in pods
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
            f"proxy: {abbreviated(str(pod.id) for pod in pods)}"
        )
        fix = (
            "Widen spec.nodeSelector (default: the chart's value proxy.pod.nodeSelector), or set "
            "the same nodeSelector in the pods"
        )
        findings.append(finding(rosproxy, "NodeLeftOut", Fault(text, fix)))
    return wanted, findings


def abbreviated(texts: Iterable[str]) -> str:
    """Return the first five texts, sorted and without duplicates, and the number of the rest."""
    return listed(sorted(set(texts)))


def group_by_key(pairs: Iterable[tuple[K, V]]) -> dict[K, tuple[V, ...]]:
    """Return the values of each key, in the order of the pairs."""
    groups: dict[K, list[V]] = defaultdict(list)
    for key, value in pairs:
        groups[key].append(value)
    return {key: tuple(values) for key, values in groups.items()}
