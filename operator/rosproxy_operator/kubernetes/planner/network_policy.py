"""The NetworkPolicy of a RosProxy's proxies: who may connect to which of their ports.

The port range, and a published master, are for everybody: that is what they are for. The master
port is for the pods that the RosProxy selects, the admin port for the operator and for whom the
administrator names. What a proxy connects to is not limited. The kubelet's probes need no rule:
a pod is always reached from its own node (``NetworkPolicySpec`` in k8s.io/api, networking/v1).

The policy allows the whole window instead of the ranges of the moment: nothing else listens there,
and a proxy that gets a range finds it open.
"""

from collections.abc import Iterator
from typing import Any

from rosproxy.leases.ports import PortRange
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreatePolicy,
    DeletePolicy,
    SetPolicy,
)
from rosproxy_operator.kubernetes.planner.manifests import metadata
from rosproxy_operator.kubernetes.planner.reconcile import ClusterContext
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.selection import OFF, own_values
from rosproxy_operator.kubernetes.resources.model import Json, ProxyPolicy, RosProxy
from rosproxy_operator.kubernetes.resources.names import (
    ADMIN_PORT,
    INJECT,
    MASTER_PORT,
    own_labels,
    policy_id,
)
from rosproxy_operator.kubernetes.settings import ClusterSettings


def policy(rosproxy: RosProxy, settings: ClusterSettings) -> Json:
    """A RosProxy's NetworkPolicy."""
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": metadata(rosproxy, policy_id(rosproxy.id), {}),
        "spec": _spec(rosproxy, settings),
    }


def reconcile_policy(context: ClusterContext, of: RosProxy) -> Iterator[Action]:
    """Make, mend or remove the NetworkPolicy of a RosProxy."""
    there, settings = context.observed.policies.get(of.id), context.settings
    name = policy_id(of.id)
    if context.observed.no_policies:
        return
    if there is None:
        if settings.network_policy and context.retries.ask(Task(of.id, "create policy", name)):
            yield CreatePolicy(of.id, policy(of, settings))
    elif there.owner != of.uid or not settings.network_policy:
        gone = there.owner != of.uid
        why = "it is that of a RosProxy that is gone" if gone else "--no-network-policy"
        yield from _delete(context, there, why)
    elif (spec := _spec(of, settings)) != there.spec and context.retries.ask(
        Task(of.id, "set policy", name, there.uid)
    ):
        yield SetPolicy(of.id, name, there.uid, spec)


def reconcile_orphaned_policies(context: ClusterContext) -> Iterator[Action]:
    """Delete the policies of RosProxies that are gone; the garbage collector may come first."""
    unusable = {one.uid for one in context.observed.unusable.values()}
    for there in context.observed.policies.values():
        if there.of not in context.view.rosproxies and there.owner not in unusable:
            yield from _delete(context, there, "its RosProxy is gone")


def _delete(context: ClusterContext, there: ProxyPolicy, why: str) -> Iterator[Action]:
    name = policy_id(there.of)
    task = Task(there.of, "delete policy", name, there.uid)
    if not there.deleting and context.retries.ask(task):
        yield DeletePolicy(there.of, name, there.uid, why)


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
            {"ports": [_port(MASTER_PORT)], "from": [{"podSelector": _selected(of)}]},
            admin,
        ],
    }


def _open(of: RosProxy) -> Iterator[Json]:
    """The ports that are for everybody: never the proxy's own, even if the window has them."""
    first, last = of.spec.window.first, of.spec.window.last
    for own in sorted((MASTER_PORT, ADMIN_PORT)):
        if first <= own <= last:
            if first < own:
                yield _port(first, own - 1)
            first = own + 1
    if first <= last:
        yield _port(first, last)
    publish = of.spec.master.publish
    if publish and publish not in PortRange(of.spec.window.first, of.spec.window.last):
        yield _port(publish)


def _port(first: int, last: int = 0) -> Json:
    more = {"endPort": last} if last > first else {}
    return {"protocol": "TCP", "port": first, **more}


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
