"""What a proxy is to be told of the pods on its node: which addresses are nobody's any more.

A proxy finds out by probing that a ROS node is gone, which takes long; the operator knows from the
API server that a pod is gone. It compares the addresses at which a proxy has ROS nodes with those
of the pods that are there, and is careful: what is unregistered by mistake is not found again.
"""

from collections.abc import Collection, Iterator, Mapping
from ipaddress import ip_address, ip_network

import msgspec
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.planner.view import grouped
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPod, ProxyReport
from rosproxy_operator.kubernetes.resources.model import ClusterNode

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


class Departures(msgspec.Struct, frozen=True):
    """The addresses that are gone, by the uid of the proxy's pod, and what is remembered."""

    gone: Mapping[str, tuple[str, ...]]
    state: ClusterState


def gone(observed: ClusterSnapshot, state: ClusterState, now: float) -> Departures:
    """Compare where the proxies' ROS nodes are with the pods that there are.

    An address counts as gone if a pod was seen with it and none has it now; or if it belongs to
    the node's pod networks, all pods there have others, and that has been so for a while.
    """
    every = {pod.uid: pod for pod in (*(one.pod for one in observed.proxies), *observed.pods)}
    pods = grouped((pod.node, pod) for pod in every.values())
    known: dict[str, dict[str, float]] = {}
    for on in {one.on for one in observed.proxies}:
        own = {pod.ip: now for pod in pods.get(on, ()) if pod.ip and not pod.host_network}
        known[on] = {**state.addresses.get(on, {}), **own}
    found: dict[str, tuple[str, ...]] = {}
    strange: dict[tuple[str, str], float] = {}
    for proxy in observed.proxies:
        answer, node = observed.reports.get(proxy.pod.uid), observed.nodes.get(proxy.on)
        if answer is None or not answer.answered or node is None or not node.ready:
            continue
        living = [pod for pod in pods.get(node.name, ()) if not pod.ended]
        missing = answer.addresses - {pod.ip for pod in living}
        unseen = {ip for ip in missing - known[node.name].keys() if _is_pods(ip, proxy, node)}
        since = {ip: state.strange.get((node.name, ip), now) for ip in unseen}
        strange |= {(node.name, ip): at for ip, at in since.items()}
        unnamed = any(not pod.ip and not pod.host_network for pod in living)
        late = {ip for ip, at in since.items() if now - at >= UNSEEN and not unnamed}
        if addresses := (missing & known[node.name].keys()) | late:
            found[proxy.pod.uid] = tuple(sorted(addresses))
    proxies = grouped((one.on, observed.reports.get(one.pod.uid)) for one in observed.proxies)
    kept = {on: _kept(proxies[on], some, now) for on, some in known.items()}
    return Departures(found, replace(state, addresses=kept, strange=strange))


def _is_pods(address: str, proxy: ProxyPod, node: ClusterNode) -> bool:
    """Whether an address is in the pod networks, and of the family that pods are listed with.

    Of a pod with addresses of both families only one is known here.
    """
    try:
        ip, own = ip_address(address), ip_address(proxy.pod.ip)
        networks = [ip_network(network, strict=False) for network in node.pod_networks]
    except ValueError:
        return False
    return ip.version == own.version and any(ip in network for network in networks)


def _kept(
    asked: Collection[ProxyReport | None], known: Mapping[str, float], now: float
) -> dict[str, float]:
    """Which addresses are worth remembering: those that a proxy names, or may name yet."""
    answers = [answer for answer in asked if answer is not None and answer.answered]
    named = {address for answer in answers for address in answer.addresses}
    longest = REMEMBERED if len(answers) == len(asked) else LONGEST
    return {ip: at for ip, at in known.items() if ip in named or now - at < longest}


def waits(found: Departures, now: float) -> Iterator[float]:
    """In how many seconds there may be something to be told."""
    recent = (at for some in found.state.addresses.values() for at in some.values() if at != now)
    if found.gone or any(now - at < REMEMBERED for at in recent):
        yield AGAIN
    strange = (at + UNSEEN - now for at in found.state.strange.values())
    yield from (left for left in strange if left > 0)
