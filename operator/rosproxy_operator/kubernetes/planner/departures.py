"""What a proxy is to be told of the pods on its node: which addresses are nobody's any more.

A proxy finds out by probing that a ROS node is gone, which takes long; the operator knows from the
API server that a pod is gone. It compares the addresses at which a proxy has ROS nodes with those
of the pods that are there, and is careful: what is unregistered by mistake is not found again.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from ipaddress import ip_address, ip_network

from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    ClusterSnapshot,
    Pod,
    ProxyPod,
    ProxyReport,
)

UNSEEN = 15.0
"""Seconds after which an address in a node's pod network is nobody's that no pod was seen with.

A pod's containers run before the API server knows its address.
"""
REMEMBERED = 15.0
"""Seconds for which the address of a pod that is gone is remembered, though no proxy names it.

A proxy's answer may be older than the look: what has just registered is named in the next one.
"""
LONGEST = 3600.0
"""The same where a proxy does not answer at all."""
AGAIN = 3.0
"""Seconds until proxies are looked at again whose pods have just gone."""


@dataclass(frozen=True, slots=True)
class Departures:
    """The addresses that are gone, by the uid of the proxy's pod, and what is remembered."""

    gone: Mapping[str, tuple[str, ...]]
    state: ClusterState


def gone(observed: ClusterSnapshot, state: ClusterState, now: float) -> Departures:
    """Compare where the proxies' ROS nodes are with the pods that there are.

    An address counts as gone if a pod was seen with it and none has it now; or if it belongs to
    the node's pod networks, all pods there have others, and that has been so for a while.
    """
    pods = _by_node(observed)
    known = {
        node: {**state.addresses.get(node, {}), **_own_addresses(pods.get(node, ()), now)}
        for node in {one.on for one in observed.proxies}
    }
    found: dict[str, tuple[str, ...]] = {}
    strange: dict[tuple[str, str], float] = {}
    for proxy in observed.proxies:
        answer, node = observed.reports.get(proxy.pod.uid), observed.nodes.get(proxy.on)
        if answer is None or not answer.answered or node is None or not node.ready:
            continue
        place = _Site(node, proxy, pods.get(proxy.on, ()), frozenset(known[proxy.on]))
        strange |= {
            (node.name, address): state.strange.get((node.name, address), now)
            for address in place.unknown(answer)
        }
        since = {address: at for (where, address), at in strange.items() if where == node.name}
        late = {address for address, at in since.items() if now - at >= UNSEEN}
        if addresses := place.gone(answer, late):
            found[proxy.pod.uid] = addresses
    kept = {node: _kept(observed, node, some, now) for node, some in known.items()}
    return Departures(found, replace(state, addresses=kept, strange=strange))


@dataclass(frozen=True, slots=True)
class _Site:
    """A proxy on its node, the pods there, and the addresses that pods there have or had."""

    node: ClusterNode
    proxy: ProxyPod
    pods: tuple[Pod, ...]
    known: frozenset[str]

    def gone(self, answer: ProxyReport, late: Collection[str]) -> tuple[str, ...]:
        """The addresses of ROS nodes whose pods are gone."""
        missing = set(answer.nodes) - _addresses(self.pods)
        unnamed = any(not pod.ip and not pod.host_network for pod in _living(self.pods))
        return tuple(sorted(missing & (self.known if unnamed else self.known | set(late))))

    def unknown(self, answer: ProxyReport) -> set[str]:
        """Addresses of ROS nodes that could only be a pod's, but no pod was seen with them."""
        missing = set(answer.nodes) - self.known - _addresses(self.pods)
        return {address for address in missing if self._is_pods(address)}

    def _is_pods(self, address: str) -> bool:
        """Whether an address is in the pod networks, and of the family that pods are listed with.

        Of a pod with addresses of both families only one is known here.
        """
        here = _version(self.proxy.pod.ip)
        return _version(address) == here != 0 and any(
            _inside(address, network) for network in self.node.pod_networks
        )


def _by_node(observed: ClusterSnapshot) -> dict[str, tuple[Pod, ...]]:
    every = {pod.uid: pod for pod in (*(one.pod for one in observed.proxies), *observed.pods)}
    found: dict[str, list[Pod]] = {}
    for pod in every.values():
        found.setdefault(pod.node, []).append(pod)
    return {node: tuple(pods) for node, pods in found.items()}


def _living(pods: Iterable[Pod]) -> Iterable[Pod]:
    return (pod for pod in pods if not pod.ended)


def _addresses(pods: Iterable[Pod]) -> set[str]:
    return {pod.ip for pod in _living(pods) if pod.ip}


def _own_addresses(pods: Iterable[Pod], now: float) -> dict[str, float]:
    return {pod.ip: now for pod in pods if pod.ip and not pod.host_network}


def _kept(
    observed: ClusterSnapshot, node: str, known: Mapping[str, float], now: float
) -> dict[str, float]:
    """Which addresses are worth remembering: those that a proxy names, or may name yet."""
    answers = [observed.reports.get(one.pod.uid) for one in observed.proxies if one.on == node]
    if not all(answer is not None and answer.answered for answer in answers):
        return {ip: at for ip, at in known.items() if now - at < LONGEST}
    named = {address for answer in answers if answer is not None for address in answer.nodes}
    return {ip: at for ip, at in known.items() if ip in named or now - at < REMEMBERED}


def waits(found: Departures, now: float) -> Iterator[float]:
    """In how many seconds there may be something to be told."""
    recent = (at for some in found.state.addresses.values() for at in some.values() if at != now)
    if found.gone or any(now - at < REMEMBERED for at in recent):
        yield AGAIN
    strange = (at + UNSEEN - now for at in found.state.strange.values())
    yield from (left for left in strange if left > 0)


def _version(address: str) -> int:
    try:
        return ip_address(address).version
    except ValueError:
        return 0


def _inside(address: str, network: str) -> bool:
    try:
        return ip_address(address) in ip_network(network, strict=False)
    except ValueError:
        return False
