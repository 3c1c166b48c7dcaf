"""What is seen in a cluster, put in order: who is wanted where, and what is there.

Everything after this works by place, that is a RosProxy on a node, and not by pod.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from rosproxy_operator.kubernetes.planner.selection import chosen, on_node
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    ClusterSnapshot,
    Name,
    Pod,
    ProxyPlace,
    ProxyPod,
    Reference,
    RosProxy,
    Stuck,
)
from rosproxy_operator.kubernetes.resources.names import KIND, is_own, proxy_id

K = TypeVar("K")
V = TypeVar("V")
_SHOWN = 5
"""How many objects of a kind a text names at most."""


@dataclass(frozen=True, slots=True)
class View:
    """An `ClusterSnapshot` by RosProxy and by node.

    ``rosproxies`` are those that are not being deleted; ``proxies`` those that belong to one of
    them, ``orphans`` those of RosProxies that are gone. ``wanted`` are the places where pods want a
    proxy, and those pods; ``taken`` all pods that a RosProxy has taken, wherever they are.
    ``strangers`` are, by node, the other pods on it that hold ports. ``findings`` are those about
    pods.
    """

    observed: ClusterSnapshot
    rosproxies: Mapping[Name, RosProxy]
    proxies: Mapping[ProxyPlace, tuple[ProxyPod, ...]]
    orphans: tuple[ProxyPod, ...]
    wanted: Mapping[ProxyPlace, tuple[Pod, ...]]
    taken: Mapping[Name, tuple[Pod, ...]]
    strangers: Mapping[str, tuple[Pod, ...]]
    findings: tuple[ClusterFinding, ...]
    _by_node: Mapping[str, tuple[ProxyPod, ...]] = field(default_factory=dict)

    def current(self, place: ProxyPlace) -> ProxyPod | None:
        """The proxy of a place, as long as it is not being deleted."""
        named = (one for one in self.proxies.get(place, ()) if is_current(one))
        return next(named, None)

    def misplaced(self, place: ProxyPlace) -> tuple[ProxyPod, ...]:
        """Other pods of a place, under names that a proxy does not have (any more)."""
        own = self.proxies.get(place, ())
        return tuple(one for one in own if one.pod.id != proxy_id(place.of, place.node))

    def on(self, node: str) -> tuple[ProxyPod, ...]:
        """All proxies that are meant for a node, whosever they are, as long as they hold ports."""
        return self._by_node.get(node, ())

    def places(self) -> set[ProxyPlace]:
        """All places where a proxy is wanted or there."""
        return set(self.wanted) | set(self.proxies)


def is_current(proxy: ProxyPod) -> bool:
    """Whether a proxy's pod is the one of its place and is not being deleted."""
    return not proxy.pod.deleting and proxy.pod.id == proxy_id(proxy.of, proxy.on)


def place_of(proxy: ProxyPod) -> ProxyPlace:
    """The place that a proxy is meant for."""
    return ProxyPlace(proxy.of, proxy.on)


def serves(proxy: ProxyPod) -> bool:
    """Whether a proxy has its ports and is up, or has been and will be again."""
    running = proxy.ready or proxy.restarts > 0 or proxy.pod.phase == "Running"
    return running and not proxy.pod.ended


def has_ports(proxy: ProxyPod) -> bool:
    """Whether the scheduler has given a proxy its node, and with it its ports."""
    return bool(proxy.pod.node) and not proxy.pod.ended and proxy.stuck is not Stuck.PORTS


def view(observed: ClusterSnapshot) -> View:
    """Put in order what is seen."""
    rosproxies = {one.id: one for one in observed.rosproxies if not one.deleting}
    uids = {one.uid: one.id for one in rosproxies.values()}
    unusable = {one.uid for one in observed.unusable.values()}
    own = [one for one in observed.proxies if uids.get(one.owner) == one.of]
    orphans = [one for one in observed.proxies if uids.get(one.owner) != one.of]
    holding = (one for one in observed.proxies if not one.pod.ended)
    wanted, taken, findings = _choose(observed, rosproxies)
    return View(
        observed=observed,
        rosproxies=rosproxies,
        proxies=_grouped((place_of(one), one) for one in own),
        orphans=tuple(one for one in orphans if one.owner not in unusable),
        wanted=wanted,
        taken=taken,
        strangers=_strangers(observed),
        findings=tuple(findings),
        _by_node=_grouped((one.on, one) for one in holding),
    )


def short(texts: Iterable[str]) -> str:
    """A few of them, and how many more there are."""
    every = sorted(set(texts))
    more = len(every) - _SHOWN
    return ", ".join(every[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _choose(
    observed: ClusterSnapshot, rosproxies: Mapping[Name, RosProxy]
) -> tuple[dict[ProxyPlace, tuple[Pod, ...]], dict[Name, tuple[Pod, ...]], list[ClusterFinding]]:
    """Who is wanted where, who has taken which pods, and what is wrong with that."""
    taken: list[tuple[Name, Pod]] = []
    findings: list[ClusterFinding] = []
    for pod in observed.pods:
        if not (pod.ended or pod.deleting or is_own(pod.labels)):
            choice = chosen(pod, rosproxies.values())
            taken += [(choice.rosproxy.id, pod)] if choice.rosproxy else []
            findings += [choice.finding] if choice.finding else []
    wanted: list[tuple[ProxyPlace, Pod]] = []
    left_out: list[tuple[ProxyPlace, Pod]] = []
    for of, pod in taken:
        node = observed.nodes.get(pod.node)
        if node is not None and not node.deleting:
            fits = on_node(rosproxies[of], node)
            (wanted if fits else left_out).append((ProxyPlace(of, pod.node), pod))
    findings += _left_out(rosproxies, _grouped(left_out))
    return _grouped(wanted), _grouped(taken), findings


def _left_out(
    rosproxies: Mapping[Name, RosProxy], pods: Mapping[ProxyPlace, tuple[Pod, ...]]
) -> Iterator[ClusterFinding]:
    for place, some in sorted(pods.items()):
        of = rosproxies[place.of]
        yield finding(
            of,
            "NodeLeftOut",
            f"selected pods run on node {place.node}, which spec.nodeSelector leaves out, so they "
            f"have no proxy: {short(str(pod.id) for pod in some)}: widen spec.nodeSelector, or "
            "give the pods the same one",
        )


def finding(of: RosProxy, reason: str, text: str) -> ClusterFinding:
    """Something about a RosProxy that keeps nothing else from being done."""
    return ClusterFinding(
        subject=f"rosproxy {of.id}",
        text=text,
        fatal=False,
        reason=reason,
        of=of.id,
        about=Reference(KIND, of.id, of.uid),
    )


def _strangers(observed: ClusterSnapshot) -> dict[str, tuple[Pod, ...]]:
    own = {one.pod.uid for one in observed.proxies}
    others = {pod.uid: pod for pod in observed.pods if pod.uid not in own}
    holding = (pod for pod in others.values() if pod.node and pod.host_ports and not pod.ended)
    return _grouped((pod.node, pod) for pod in holding)


def _grouped(pairs: Iterable[tuple[K, V]]) -> dict[K, tuple[V, ...]]:
    found: dict[K, list[V]] = defaultdict(list)
    for key, value in pairs:
        found[key].append(value)
    return {key: tuple(values) for key, values in found.items()}
