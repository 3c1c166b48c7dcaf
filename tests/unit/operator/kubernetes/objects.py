"""RosProxies, nodes, pods, and the operator's objects, for tests."""

import copy
from collections.abc import Iterable, Mapping
from typing import Any

from msgspec.structs import replace

from rosproxy.shared.ports import PortRange
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import Action, CreateProxy, Emit, PatchStatus
from rosproxy_operator.kubernetes.planner.manifests import ProxySite
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    PodFailure,
    ProxyPod,
    ProxyService,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    MasterSpec,
    Name,
    Pod,
    RosProxy,
    RosProxySpec,
)
from rosproxy_operator.kubernetes.resources.pod_defaults import with_pod_defaults
from rosproxy_operator.kubernetes.settings import Bounds, ClusterSettings
from rosproxy_operator.proxy_spec.spec import WISHES, ProxySpec

BOUNDS = Bounds(
    data_planes=("auto", "kernel", "splice", "copy"),
    images=("*",),
    listen=("NodePort", "LoadBalancer"),
)
SETTINGS = ClusterSettings(image="rosproxy:1", bounds=BOUNDS, network_policy=False)
"""Everything is allowed, without NetworkPolicies. Bounds and NetworkPolicies have separate
tests.
"""
STAMP = "2026-01-01T00:00:00Z"
RANGE = PortRange(11400, 11403)
ROBOT = Name("ros", "robot")


def rosproxy(name: str = "robot", uid: str = "", **changes: Any) -> RosProxy:
    """A RosProxy in namespace ros with four ports per node.

    ``changes``: fields of the RosProxy, the spec or the `ProxySpec`.
    """
    defaults: dict[str, Any] = {
        "master": MasterSpec("http://robot:11311"), "ports": 4, "window": PortRange(11400, 11499),
    }  # fmt: skip
    own = {key: changes.pop(key) for key in ("former_ranges", "cluster_ip", "status", "deleting")
           if key in changes}  # fmt: skip
    asked = {key: changes.pop(key) for key in WISHES if key in changes}
    spec = RosProxySpec(**defaults | changes, proxy=ProxySpec(**asked))
    return RosProxy(Name("ros", name), uid or f"uid-{name}", 1, spec, **own)


def node(name: str = "one", **changes: Any) -> ClusterNode:
    defaults: dict[str, Any] = {
        "addresses": {"InternalIP": "192.0.2.1", "Hostname": name},
        "pod_networks": ("10.244.1.0/24",),
    }
    return ClusterNode(name, **defaults | changes)


def pod(name: str = "talker", on: str = "one", ports: Iterable[int] = (), **changes: Any) -> Pod:
    """A running pod that asks for a proxy; or, with ``ports``, another pod with these hostPorts."""
    taken = frozenset(ports)
    defaults: dict[str, Any] = {
        "labels": {} if taken else {names.INJECT: "true"},
        "node": on,
        "phase": "Running",
        "ip": f"10.244.1.{sum(name.encode()) % 250 + 2}",
        "host_ports": taken,
        "wired_master_uri": "" if taken else "http://10.96.1.1:11311",
    }
    return Pod(Name("ros", name), f"uid-{name}", **defaults | changes)


def site(of: RosProxy, on: ClusterNode, ports: PortRange = RANGE, publish: int = 0) -> ProxySite:
    """A site for a proxy of a RosProxy, with the planner's defaults."""
    host = on.advertise_host or on.addresses.get("InternalIP", "")
    (of,) = with_pod_defaults(ClusterSnapshot(rosproxies=(of,)), SETTINGS.pod).rosproxies
    host = "" if of.spec.zenoh else host
    return ProxySite(of, on, host, ports, replace(of.spec.master, publish=publish))


def proxy(
    of: RosProxy | None = None,
    on: ClusterNode | None = None,
    ports: PortRange = RANGE,
    stuck: PodFailure | None = None,
    phase: str = "Running",
    publish: int = 0,
    settings: ClusterSettings = SETTINGS,
    **changes: Any,
) -> ProxyPod:
    """The pod of a proxy, by default running. ``changes``: fields of the `Pod`."""
    of = of or rosproxy()
    on = on or node()
    body: dict[str, Any] = copy.deepcopy(
        dict(manifests.proxy_pod(site(of, on, ports, publish), settings))
    )
    body["metadata"]["uid"] = f"uid-proxy-{of.id.name}-{on.name}"
    running = phase == "Running" and stuck is None
    parsed = objects.proxy_pod({**body, "status": {"phase": "Pending" if stuck else phase}})
    assert parsed is not None
    placement = {"node": "" if stuck else on.name, "ip": "10.244.1.200" if running else ""}
    own = replace(parsed.pod, **placement | changes)
    return replace(parsed, pod=own, ready=running, stuck=stuck, message="so it is" if stuck else "")


def service(of: RosProxy | None = None, ip: str = "10.96.1.1", **changes: Any) -> ProxyService:
    of = of or rosproxy()
    print_ = manifests.fingerprint_of(manifests.service(of))
    proxy_service = ProxyService(of.id, of.uid, f"uid-service-{of.id.name}", ip, print_)
    return replace(proxy_service, **changes)


def observed(
    *resources: RosProxy | ClusterNode | Pod | ProxyPod | ProxyService, **more: Any
) -> ClusterSnapshot:
    """A cluster with these objects. Without a ClusterNode, the cluster has the node ``one``."""
    nodes = [r for r in resources if isinstance(r, ClusterNode)] or [node()]
    services = [r for r in resources if isinstance(r, ProxyService)]
    return ClusterSnapshot(
        rosproxies=tuple(r for r in resources if isinstance(r, RosProxy)),
        nodes={n.name: n for n in nodes},
        pods=tuple(r for r in resources if isinstance(r, Pod)),
        proxies=tuple(r for r in resources if isinstance(r, ProxyPod)),
        services={s.of: s for s in services},
        **more,
    )


def scene(*more: Any, of: Any = None) -> ClusterSnapshot:
    """A pod that wants a proxy, and other things."""
    of = of or rosproxy()
    return observed(of, service(of), pod(), *more)


def complete(**changes: Any) -> ClusterSnapshot:
    """A pod, a proxy, and the Service."""
    return replace(observed(rosproxy(), pod(), proxy(), service()), **changes)


def look(
    seen: ClusterSnapshot,
    memory: ClusterState | None = None,
    now: float = 100.0,
    settings: ClusterSettings = SETTINGS,
) -> ClusterPlan:
    return plan(seen, settings, memory or ClusterState(), now, STAMP)


def written(seen: ClusterSnapshot, plan: ClusterPlan | None = None) -> ClusterSnapshot:
    """The cluster with the status that a plan writes, by default the first plan."""
    plan = plan or look(seen)
    new = {action.of: action.status for action in plan.actions if isinstance(action, PatchStatus)}
    rosproxies = (replace(of, status=new.get(of.id, of.status)) for of in seen.rosproxies)
    return replace(seen, rosproxies=tuple(rosproxies))


def done(plan: ClusterPlan) -> list[Action]:
    """The actions of a plan, without Events and statuses."""
    return [action for action in plan.actions if not isinstance(action, Emit | PatchStatus)]


def kinds(plan: ClusterPlan) -> list[type]:
    return [type(action) for action in done(plan)]


def creation(plan: ClusterPlan) -> CreateProxy:
    (action,) = done(plan)
    assert isinstance(action, CreateProxy), action
    return action


def status(plan: ClusterPlan, of: Name = ROBOT) -> Mapping[str, Any]:
    """The status that a plan writes."""
    written = [action for action in plan.actions if isinstance(action, PatchStatus)]
    return next(action.status for action in written if action.of == of)


def told(plan: ClusterPlan, reason: str) -> list[str]:
    """The texts of findings with a reason."""
    return [
        f"{finding.subject}: {finding.message}"
        for finding in plan.problems
        if finding.reason == reason
    ]


def node_of(action: Any) -> str:
    """The node on which a proxy is created; empty for anything else."""
    return str(action.body["metadata"]["annotations"].get(names.NODE, ""))


def ports_of(action: Any) -> str:
    """The range with which a proxy is created."""
    return str(action.body["metadata"]["annotations"][names.PORT_RANGE])
