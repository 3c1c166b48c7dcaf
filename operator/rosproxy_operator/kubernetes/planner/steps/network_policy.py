"""The NetworkPolicies of a RosProxy, for its proxies and for its pods.

That of the proxies says who may connect to which of their ports (`policy`).

The port range, and a published master, are for everybody: that is what they are for; for ROS 2, and
for UDPROS, it is UDP. The master port is for the pods that the RosProxy selects, as are, with
``direction: Both`` or for ROS 2, the ports that stand in for nodes outside, and those where UDPROS
of pods goes out; the admin port for the operator and for whom the administrator names. What a proxy
connects to is not limited. The kubelet's probes need no rule: a pod is always reached from its own
node (``NetworkPolicySpec`` in k8s.io/api, networking/v1).

The policy allows the whole window instead of the ranges of the moment: nothing else listens there,
and a proxy that gets a range finds it open.

That of the pods says to what they may connect (`pods_policy`); there is one with ``podEgress:
Proxy`` alone. The selected pods reach the proxies, one another and any DNS server, and
nothing else. All that they have of outside then comes through their proxy, where rules hold.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from rosproxy.leases.ports import PortRange
from rosproxy.ros1.registry.stand_ins import PORTS as STAND_IN_PORTS
from rosproxy_operator.common.ros2 import discovery_port, well_known_ports
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreatePolicy,
    DeletePolicy,
    SetPolicy,
)
from rosproxy_operator.kubernetes.planner.manifests import metadata
from rosproxy_operator.kubernetes.planner.pods.selection import OFF, own_values
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.reconcile import ClusterContext
from rosproxy_operator.kubernetes.resources.cluster import ProxyPolicy
from rosproxy_operator.kubernetes.resources.model import Json, Name, RosProxy
from rosproxy_operator.kubernetes.resources.names import (
    ADMIN_PORT,
    INJECT,
    MASTER_PORT,
    own_labels,
    pods_policy_id,
    policy_id,
)
from rosproxy_operator.kubernetes.resources.objects import name_of
from rosproxy_operator.kubernetes.settings import ClusterSettings


def policy(rosproxy: RosProxy, settings: ClusterSettings) -> Json:
    """A RosProxy's NetworkPolicy."""
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": metadata(rosproxy, policy_id(rosproxy.id), {}),
        "spec": _spec(rosproxy, settings),
    }


def pods_policy(rosproxy: RosProxy) -> Json:
    """The NetworkPolicy of the pods that a RosProxy selects."""
    pods = _selected(rosproxy)
    dns = [{"protocol": protocol, "port": 53} for protocol in ("UDP", "TCP")]
    spec = {
        "podSelector": pods,
        "policyTypes": ["Egress"],
        "egress": [
            {"to": [{"podSelector": {"matchLabels": own_labels(rosproxy.id.name)}}]},
            {"to": [{"podSelector": pods}]},
            {"ports": dns},
        ],
    }
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": metadata(rosproxy, pods_policy_id(rosproxy.id), {}),
        "spec": spec,
    }


def wanted_policies(of: RosProxy, settings: ClusterSettings) -> dict[Name, Json]:
    """The NetworkPolicies that a RosProxy is to have, by their names."""
    if not settings.network_policy:
        return {}
    wanted = {policy_id(of.id): policy(of, settings)}
    if of.spec.pod_egress == "proxy":
        wanted[pods_policy_id(of.id)] = pods_policy(of)
    return wanted


def reconcile_policies(context: ClusterContext, of: RosProxy) -> Iterator[Action]:
    """Make, mend or remove the NetworkPolicies of a RosProxy."""
    if context.observed.no_policies:
        return
    wanted = wanted_policies(of, context.settings)
    there = {name: one for name, one in context.observed.policies.items() if one.of == of.id}
    for found in there.values():
        if found.owner != of.uid:
            yield from _delete(context, found, "it is that of a RosProxy that is gone")
        elif found.id not in wanted:
            on = context.settings.network_policy
            yield from _delete(context, found, "not asked for" if on else "--no-network-policy")
    for name, body in wanted.items():
        yield from _keep(context, of, body, there.get(name))


def _keep(
    context: ClusterContext, of: RosProxy, body: Json, there: ProxyPolicy | None
) -> Iterator[Action]:
    """Make a policy that is not there, or mend the one that is."""
    name, ask = name_of(body["metadata"]), context.retries.ask
    if there is None:
        if ask(Task(of.id, "create policy", name)):
            yield CreatePolicy(of.id, body)
        return
    changed = there.owner == of.uid and there.spec != body["spec"]
    if changed and ask(Task(of.id, "set policy", name, there.uid)):
        yield SetPolicy(of.id, name, there.uid, body["spec"])


def reconcile_orphaned_policies(context: ClusterContext) -> Iterator[Action]:
    """Delete the policies of RosProxies that are gone; the garbage collector may come first."""
    unusable = {one.uid for one in context.observed.unusable.values()}
    for there in context.observed.policies.values():
        if there.of not in context.view.rosproxies and there.owner not in unusable:
            yield from _delete(context, there, "its RosProxy is gone")


def _delete(context: ClusterContext, there: ProxyPolicy, why: str) -> Iterator[Action]:
    task = Task(there.of, "delete policy", there.id, there.uid)
    if not there.deleting and context.retries.ask(task):
        yield DeletePolicy(there.of, there.id, there.uid, why)


def _spec(of: RosProxy, settings: ClusterSettings) -> Json:
    """As the API server gives it back: whether it is there as it ought to be is told by that."""
    admin: dict[str, Any] = {"ports": [_port(ADMIN_PORT)]}
    if settings.admin_from is not None:
        admin["from"] = [dict(one) for one in settings.admin_from]
    return {
        "podSelector": {"matchLabels": own_labels(of.id.name)},
        "policyTypes": ["Ingress"],
        "ingress": [
            {"ports": [*_open(of)]},
            {"ports": [*_for_pods(of)], "from": [{"podSelector": _selected(of)}]},
            admin,
        ],
    }


def _open(of: RosProxy) -> Iterator[Json]:
    """The ports that are for everybody: never the proxy's own, even if the window has them."""
    known = well_known_ports(of.spec.ros2.number) if of.spec.ros2 else ()
    own = (MASTER_PORT, ADMIN_PORT, *known)
    for protocol in _protocols(of):
        for first, last in _but_for(of.spec.window, own):
            yield _port(first, last, protocol)
    publish = of.spec.master.publish
    if publish and publish not in of.spec.window:
        yield _port(publish)


def _but_for(window: PortRange, own: Iterable[int]) -> Iterator[tuple[int, int]]:
    """The ports of a window but for some, as ranges of first and last."""
    first = window.first
    for port in sorted(own):
        if first <= port <= window.last:
            if first < port:
                yield first, port - 1
            first = port + 1
    if first <= window.last:
        yield first, window.last


def _protocols(of: RosProxy) -> list[str]:
    return [*(["TCP"] if of.spec.ros1 else []), *(["UDP"] if of.spec.takes_udp else [])]


def _for_pods(of: RosProxy) -> Iterator[Json]:
    if of.spec.ros1:
        yield _port(MASTER_PORT)
        if of.spec.direction == "both":
            yield _port(STAND_IN_PORTS[0], STAND_IN_PORTS[-1])
    if of.spec.ros2:
        yield _port(discovery_port(of.spec.ros2.number), protocol="UDP")
    if of.spec.ros2 or of.spec.direction == "both":
        yield _port(STAND_IN_PORTS[0], STAND_IN_PORTS[-1], "UDP")


def _port(first: int, last: int = 0, protocol: str = "TCP") -> Json:
    more = {"endPort": last} if last > first else {}
    return {"protocol": protocol, "port": first, **more}


def _selected(of: RosProxy) -> Json:
    """The selector of the pods that a RosProxy takes, as in `selection`."""
    selector = of.spec.pod_selector
    if selector is None:
        values = sorted(own_values(of.id.name))
        return {"matchExpressions": [{"key": INJECT, "operator": "In", "values": values}]}
    expressions: list[Json] = [
        {"key": key, "operator": operator, **({"values": sorted(values)} if values else {})}
        for key, operator, values in selector.expressions
    ]
    off = {"key": INJECT, "operator": "NotIn", "values": sorted(OFF)}
    labels = {"matchLabels": dict(selector.labels)} if selector.labels else {}
    return {**labels, "matchExpressions": [*expressions, off]}
