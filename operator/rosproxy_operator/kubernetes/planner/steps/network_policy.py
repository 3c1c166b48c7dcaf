"""The NetworkPolicies of a RosProxy: a policy for the proxies, and a policy for the selected pods.

`policy` says which sources may reach which ports of the proxies:

- Any source: ``spec.portWindow`` and a published master. ROS 1 uses TCP, ROS 2 and UDPROS use UDP.
  With ``spec.listen``, the port of rmw_zenoh for outside.
- The selected pods: the master port and the discovery port of ROS 2. With ``direction: Both`` or
  for ROS 2 also the ports of stand-ins. UDPROS from pods to outside goes through these ports, too.
  For rmw_zenoh, the port of the router, and nothing else.
- The proxies of the same RosProxy, for rmw_zenoh: the port of the hub. At this port no rules apply,
  so no other pod may reach the hub.
- The sources in ``settings.admin_from``, such as the operator's pod: the admin port. Without this
  setting any source may reach the admin port.

The policy does not limit the addresses to which a proxy connects. The kubelet's probes need no
rule, because Kubernetes always lets a node reach its own pods (``NetworkPolicySpec`` in k8s.io/api,
networking/v1).

The policy opens all of ``spec.portWindow``, not only the present ranges, so the ports of a new
proxy are open at once. The proxy's own ports are left out. If the proxies have stand-ins, the ports
of stand-ins (20000 to 32767) are left out as well, except for the present ranges.

`pods_policy` says what the selected pods may reach, and exists only with ``podEgress: Proxy``. The
pods reach only the proxies, each other and DNS servers. So all traffic between these pods and
outside goes through the proxy, which enforces the rules.
"""

from collections.abc import Collection, Iterator
from typing import Any

from rosproxy.shared.domain_ports import first_unicast_port
from rosproxy.shared.ports import STAND_IN_PORTS, PortRange
from rosproxy_operator.common.port_ranges import gaps
from rosproxy_operator.kubernetes.planner import proxy_ports
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreatePolicy,
    DeletePolicy,
    SetPolicy,
)
from rosproxy_operator.kubernetes.planner.manifests import metadata
from rosproxy_operator.kubernetes.planner.pods.selection import LABEL_OFF_VALUES, own_values
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.context import ClusterContext
from rosproxy_operator.kubernetes.resources.cluster import ProxyPolicy
from rosproxy_operator.kubernetes.resources.model import Json, Name, RosProxy
from rosproxy_operator.kubernetes.resources.names import (
    ADMIN_PORT,
    HUB_PORT,
    INJECT,
    MASTER_PORT,
    OUTSIDE_PORT,
    ROUTERS,
    own_labels,
    pods_policy_id,
    policy_id,
)
from rosproxy_operator.kubernetes.resources.objects import name_of
from rosproxy_operator.kubernetes.settings import ClusterSettings

_OFF_REASON = "the operator has --no-network-policy"


def policy(
    rosproxy: RosProxy, settings: ClusterSettings, ranges: Collection[PortRange] = ()
) -> Json:
    """The NetworkPolicy of a RosProxy's proxies, which have these ranges."""
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": metadata(rosproxy, policy_id(rosproxy.id), {}),
        "spec": _spec(rosproxy, settings, ranges),
    }


def pods_policy(rosproxy: RosProxy) -> Json:
    """The NetworkPolicy of the pods that a RosProxy selects."""
    pods = _pod_selector(rosproxy)
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


def wanted_policies(
    rosproxy: RosProxy, settings: ClusterSettings, ranges: Collection[PortRange] = ()
) -> dict[Name, Json]:
    """The NetworkPolicies that a RosProxy needs, by name; empty with --no-network-policy.

    ``ranges`` are the ranges of its proxies.
    """
    if not settings.network_policy:
        return {}
    wanted = {policy_id(rosproxy.id): policy(rosproxy, settings, ranges)}
    if rosproxy.spec.pod_egress == "proxy":
        wanted[pods_policy_id(rosproxy.id)] = pods_policy(rosproxy)
    return wanted


def reconcile_policies(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the actions that create, correct or delete the NetworkPolicies of a RosProxy.

    If the operator can't list NetworkPolicies, the function yields no action.
    """
    if context.observed.policies_error:
        return
    wanted = wanted_policies(rosproxy, context.settings, _ranges(context, rosproxy))
    existing = {name: p for name, p in context.observed.policies.items() if p.of == rosproxy.id}
    for current in existing.values():
        if current.owner != rosproxy.uid:
            yield from _delete(context, current, "its former RosProxy is gone")
        elif current.id not in wanted:
            enabled = context.settings.network_policy
            yield from _delete(
                context, current, "spec.podEgress is not Proxy" if enabled else _OFF_REASON
            )
    for name, body in wanted.items():
        yield from _create_or_correct(context, rosproxy, body, existing.get(name))


def _ranges(context: ClusterContext, rosproxy: RosProxy) -> set[PortRange]:
    """The ranges that the proxies of a RosProxy have, or get by this plan."""
    places = context.view.places.get(rosproxy.id, ())
    present = (proxy.range for place in places for proxy in context.view.proxies.get(place, ()))
    given = context.ranges.given
    return {*present, *(given[place] for place in places if place in given)}


def _create_or_correct(
    context: ClusterContext, rosproxy: RosProxy, body: Json, current: ProxyPolicy | None
) -> Iterator[Action]:
    """Yield the action that creates a missing policy, or corrects the ``current`` policy."""
    name = name_of(body["metadata"])
    is_due = context.retries.is_due
    if current is None:
        if is_due(Task(rosproxy.id, "create policy", name)):
            yield CreatePolicy(rosproxy.id, body)
        return
    changed = current.owner == rosproxy.uid and current.spec != body["spec"]
    if changed and is_due(Task(rosproxy.id, "set policy", name, current.uid)):
        yield SetPolicy(rosproxy.id, name, current.uid, body["spec"])


def reconcile_orphaned_policies(context: ClusterContext) -> Iterator[Action]:
    """Yield the actions that delete the policies of RosProxies that are gone.

    The garbage collector of the cluster may delete such a policy first.
    """
    unusable = {r.uid for r in context.observed.unusable.values()}
    for current in context.observed.policies.values():
        if current.of not in context.view.rosproxies and current.owner not in unusable:
            yield from _delete(context, current, "its RosProxy is gone")


def _delete(context: ClusterContext, current: ProxyPolicy, why: str) -> Iterator[Action]:
    task = Task(current.of, "delete policy", current.id, current.uid)
    if not current.deleting and context.retries.is_due(task):
        yield DeletePolicy(current.of, current.id, current.uid, why)


def _spec(rosproxy: RosProxy, settings: ClusterSettings, ranges: Collection[PortRange]) -> Json:
    """The spec of a policy, in the form in which the API server returns the spec.

    `_create_or_correct` compares this spec with the existing spec. With another form, the operator
    would correct the policy at each look.
    """
    admin: dict[str, Any] = {"ports": [_port(ADMIN_PORT)]}
    if settings.admin_from is not None:
        admin["from"] = [dict(peer) for peer in settings.admin_from]
    public_ports = [*_public_ports(rosproxy, ranges)]
    return {
        "podSelector": {"matchLabels": own_labels(rosproxy.id.name)},
        "policyTypes": ["Ingress"],
        "ingress": [
            # A rule with an empty list of ports would open all ports.
            *([{"ports": public_ports}] if public_ports else []),
            {"ports": [*_pod_ports(rosproxy)], "from": [{"podSelector": _pod_selector(rosproxy)}]},
            *_hub_rules(rosproxy),
            admin,
        ],
    }


def _hub_rules(rosproxy: RosProxy) -> Iterator[Json]:
    if rosproxy.spec.zenoh:
        proxies = {"matchLabels": own_labels(rosproxy.id.name)}
        yield {"ports": [_port(HUB_PORT)], "from": [{"podSelector": proxies}]}


def _public_ports(rosproxy: RosProxy, ranges: Collection[PortRange]) -> Iterator[Json]:
    """The ports for any source, without the proxy's own ports. See the docstring of the module.

    The own ports are the master port, the admin port, the well-known ports of ROS 2, and the ports
    of stand-ins outside ``ranges``.
    """
    own_ports = proxy_ports.fixed_ports(rosproxy.spec)
    for protocol in _protocols(rosproxy):
        has_stand_ins = protocol in proxy_ports.stand_in_protocols(rosproxy.spec)
        stand_ins = [*gaps(STAND_IN_PORTS, (), ranges)] if has_stand_ins else []
        for ports in gaps(rosproxy.spec.window, own_ports, stand_ins):
            yield _port(ports.first, ports.last, protocol)
    if rosproxy.spec.zenoh and rosproxy.spec.zenoh.listen:
        yield _port(OUTSIDE_PORT)
    publish = rosproxy.spec.master.publish
    if publish and publish not in rosproxy.spec.window:
        yield _port(publish)


def _protocols(rosproxy: RosProxy) -> list[str]:
    return [*(["TCP"] if rosproxy.spec.ros1 else []), *(["UDP"] if rosproxy.spec.takes_udp else [])]


def _pod_ports(rosproxy: RosProxy) -> Iterator[Json]:
    if rosproxy.spec.ros1:
        yield _port(MASTER_PORT)
    if rosproxy.spec.ros2:
        yield _port(first_unicast_port(rosproxy.spec.ros2.number), protocol="UDP")
    if rosproxy.spec.zenoh:
        yield _port(ROUTERS.first)
    for protocol in proxy_ports.stand_in_protocols(rosproxy.spec):
        yield _port(STAND_IN_PORTS.first, STAND_IN_PORTS.last, protocol)


def _port(first: int, last: int = 0, protocol: str = "TCP") -> Json:
    end = {"endPort": last} if last > first else {}
    return {"protocol": protocol, "port": first, **end}


def _pod_selector(rosproxy: RosProxy) -> Json:
    """The selector of the pods that a RosProxy selects, by the rules of `selection.selects`."""
    selector = rosproxy.spec.pod_selector
    if selector is None:
        values = sorted(own_values(rosproxy.id.name))
        return {"matchExpressions": [{"key": INJECT, "operator": "In", "values": values}]}
    expressions: list[Json] = [
        {"key": key, "operator": operator, **({"values": sorted(values)} if values else {})}
        for key, operator, values in selector.expressions
    ]
    off = {"key": INJECT, "operator": "NotIn", "values": sorted(LABEL_OFF_VALUES)}
    labels = {"matchLabels": dict(selector.labels)} if selector.labels else {}
    return {**labels, "matchExpressions": [*expressions, off]}
