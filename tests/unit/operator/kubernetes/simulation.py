"""A cluster reduced to what matters: API server, scheduler, kubelets, garbage collector.

Objects have the form of the API server, and the operator's code parses them.
"""

import copy
import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from msgspec.structs import replace

from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateHelper,
    CreatePolicy,
    CreateProxy,
    CreateService,
    DeleteHelper,
    DeletePolicy,
    DeleteProxy,
    DeleteService,
    Emit,
    PatchStatus,
    SetImage,
    SetPolicy,
)
from rosproxy_operator.kubernetes.planner.manifests import without_cluster_ip
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources import objects as parse
from rosproxy_operator.kubernetes.resources import spec as parse_rosproxy
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    ProxyReport,
    ServiceRole,
)
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.settings import Bounds, ClusterSettings

NAMESPACE = "ros"
BAD_IMAGE = "no-such-image"
PORTS_TAKEN = "1 node(s) didn't have free ports for the requested pod ports."
STAMP = "2026-01-01T00:00:00Z"
Object = dict[str, Any]


class Refused(Exception):
    """The API server refuses a request."""


def meta(obj: Object) -> Object:
    return obj["metadata"]


def name_of(obj: Object) -> Name:
    return Name(meta(obj)["namespace"], meta(obj)["name"])


def deleting(obj: Object) -> bool:
    return "deletionTimestamp" in meta(obj)


def ended(pod: Object) -> bool:
    return pod["status"]["phase"] in ("Succeeded", "Failed")


def node_of(pod: Object) -> str:
    return pod["spec"].get("nodeName", "")


def host_ports(pod: Object) -> set[tuple[str, int]]:
    parsed = parse.pod(pod)
    return {("TCP", port) for port in parsed.host_ports} | {
        ("UDP", port) for port in parsed.udp_ports
    }


def is_own(obj: Object) -> bool:
    """Whether the operator has made an object."""
    owned = any(ref["kind"] == names.KIND for ref in meta(obj).get("ownerReferences", ()))
    return names.is_own(meta(obj).get("labels", {})) and owned


def component_of(obj: Object) -> str:
    """The component of an object of the operator; empty for other objects."""
    return names.component(meta(obj).get("labels", {})) if is_own(obj) else ""


def bound_to(pod: Object) -> str:
    """The only node on which a pod may run, empty if any will do."""
    affinity = pod["spec"].get("affinity")
    if not affinity:
        return ""
    required = affinity["nodeAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"]
    return required["nodeSelectorTerms"][0]["matchFields"][0]["values"][0]


@dataclass
class State:
    """The objects of the API server."""

    rosproxies: dict[Name, Object] = field(default_factory=dict)
    nodes: dict[str, Object] = field(default_factory=dict)
    pods: dict[Name, Object] = field(default_factory=dict)
    services: dict[Name, Object] = field(default_factory=dict)
    policies: dict[Name, Object] = field(default_factory=dict)


class Cluster:
    """The cluster. ``forbidden``: no pod with hostPorts is admitted.

    ``addresses`` are the real addresses of pods by uid, before the status has them. ``ros`` are the
    addresses of the ROS nodes that a proxy knows, by the uid of the proxy's pod.
    """

    def __init__(self, namespace: str = NAMESPACE) -> None:
        self.namespace = namespace
        self.state = State()
        self.forbidden = False
        self.numbers = itertools.count(1)
        self.addresses: dict[str, str] = {}
        self.ros: dict[str, set[str]] = {}
        self.master_ip = "10.96.0.7"
        self.made = 0
        self.key = b"k" * 32

    # what users do

    def add_node(self, name: str, ip: str) -> None:
        number = ip.rpartition(".")[2]
        self.state.nodes[name] = {
            "metadata": {"name": name, "uid": self.uid("node"), "labels": {"zone": name[-1]}},
            "spec": {"podCIDRs": [f"10.244.{number}.0/24"]},
            "status": {
                "addresses": [{"type": "InternalIP", "address": ip}],
                "conditions": [{"type": "Ready", "status": "True"}],
            },
        }

    def add_rosproxy(self, name: str, spec: Object) -> None:
        self.state.rosproxies[Name(self.namespace, name)] = {
            "metadata": {
                "name": name, "namespace": self.namespace, "uid": self.uid("rosproxy"),
                "generation": 1,
            },
            "spec": spec,
        }  # fmt: skip

    def add_pod(
        self,
        name: str,
        node: str,
        labels: dict[str, str],
        ports: Iterable[int] = (),
        protocol: str = "TCP",
    ) -> None:
        """A user's pod: bound to a node at once, or left to the scheduler if the pod has ports."""
        taken = [{"containerPort": port, "hostPort": port, "protocol": protocol} for port in ports]
        pod: Object = {
            "metadata": {"name": name, "namespace": self.namespace, "labels": labels},
            "spec": {"containers": [{"name": "main", "image": "user", "ports": taken}]},
        }
        if taken:
            terms = {"nodeSelectorTerms": [{"matchFields": [{"values": [node]}]}]}
            key = "requiredDuringSchedulingIgnoredDuringExecution"
            pod["spec"]["affinity"] = {"nodeAffinity": {key: terms}}
        else:
            pod["spec"]["nodeName"] = node
        self.create_pod(pod)

    def uid(self, kind: str) -> str:
        return f"{self.namespace}-{kind}-{next(self.numbers)}"

    # what the API server does

    def create_pod(self, body: Object) -> None:
        if name_of(body) in self.state.pods:
            raise Refused("AlreadyExists")
        if self.forbidden and host_ports({**body, "status": {}}):
            raise Refused('pods "p" is forbidden: violates PodSecurity "baseline:latest"')
        pod = copy.deepcopy(body)
        pod["metadata"]["uid"] = self.uid("pod")
        pod["status"] = {"phase": "Pending"}
        self.state.pods[name_of(pod)] = pod

    def delete_pod(self, pod: Object) -> None:
        """Delete a pod; at once without a kubelet."""
        if not node_of(pod) or node_of(pod) not in self.state.nodes:
            self.state.pods.pop(name_of(pod), None)
        meta(pod)["deletionTimestamp"] = STAMP

    def create_service(self, body: Object) -> None:
        if name_of(body) in self.state.services:
            raise Refused("AlreadyExists")
        allocated = {existing["spec"]["clusterIP"] for existing in self.state.services.values()}
        allocated.discard("None")  # of headless Services
        service = copy.deepcopy(body)
        wanted = service["spec"].setdefault("clusterIP", f"10.96.1.{next(self.numbers) % 250}")
        if wanted in allocated:
            raise Refused("provided IP is already allocated")
        service["metadata"]["uid"] = self.uid("service")
        self.state.services[name_of(service)] = service

    def create_policy(self, body: Object) -> None:
        if name_of(body) in self.state.policies:
            raise Refused("AlreadyExists")
        policy = copy.deepcopy(body)
        policy["metadata"]["uid"] = self.uid("policy")
        self.state.policies[name_of(policy)] = policy

    # what goes on by itself

    def step(self) -> None:
        """Run the garbage collector, the scheduler and all kubelets once."""
        self.collect()
        self.schedule()
        for name in list(self.state.nodes):
            self.kubelet(name)
        self.collect()

    def collect(self) -> None:
        """The garbage collectors: owners and nodes that are gone."""
        uids = {meta(owner)["uid"] for owner in self.state.rosproxies.values()}
        for pod in list(self.state.pods.values()):
            owners = meta(pod).get("ownerReferences", ())
            orphaned = any(ref["uid"] not in uids for ref in owners)
            if (orphaned and not deleting(pod)) or (
                node_of(pod) and node_of(pod) not in self.state.nodes
            ):
                self.delete_pod(pod)
        for kind in (self.state.services, self.state.policies):
            for name, dependent in list(kind.items()):
                if any(
                    ref["uid"] not in uids for ref in meta(dependent).get("ownerReferences", ())
                ):
                    del kind[name]

    def schedule(self) -> None:
        for pod in self.state.pods.values():
            if not node_of(pod) and not ended(pod) and not deleting(pod):
                why = self._bind(pod, bound_to(pod))
                unbound = {"type": "PodScheduled", "status": "False", "reason": "Unschedulable"}
                pod["status"]["conditions"] = [{**unbound, "message": why}] if why else []

    def _bind(self, pod: Object, node: str) -> str:
        if node not in self.state.nodes or not self.is_ready(node):
            return "node(s) didn't match Pod's node affinity/selector"
        if host_ports(pod) & self.taken_host_ports(node):
            return PORTS_TAKEN
        pod["spec"]["nodeName"] = node
        return ""

    def taken_host_ports(self, node: str) -> set[tuple[str, int]]:
        """The hostPorts that the scheduler counts on a node."""
        pods = [pod for pod in self.state.pods.values() if node_of(pod) == node]
        return {port for pod in pods if not ended(pod) for port in host_ports(pod)}

    def running(self) -> set[str]:
        pods = self.state.pods.values()
        return {meta(pod)["uid"] for pod in pods if pod["status"]["phase"] == "Running"}

    def is_ready(self, node: str) -> bool:
        return self.state.nodes[node]["status"]["conditions"][0]["status"] == "True"

    def kubelet(self, node: str) -> None:
        if not self.is_ready(node):
            return
        for name, pod in list(self.state.pods.items()):
            if node_of(pod) == node and deleting(pod):
                del self.state.pods[name]
            elif node_of(pod) == node and not ended(pod):
                self._run(pod)

    def _run(self, pod: Object) -> None:
        uid = meta(pod)["uid"]
        container = pod["spec"]["containers"][0]
        if uid not in self.addresses:
            network = self.state.nodes[node_of(pod)]["spec"]["podCIDRs"][0]
            self.addresses[uid] = network.replace(".0/24", f".{next(self.numbers)}")
            return  # the containers run, but the status does not say so yet
        state: Object = {"running": {}}
        if container["image"] == BAD_IMAGE:
            state = {"waiting": {"reason": "ImagePullBackOff", "message": "not found"}}
        ready = "running" in state
        pod["status"] = {
            "phase": "Running" if ready else "Pending",
            "podIP": self.addresses[uid],
            "conditions": [{"type": "Ready", "status": str(ready)}],
            "containerStatuses": [{"name": container["name"], "state": state, "restartCount": 0}],
        }
        if component_of(pod) == names.PROXY and ready:
            self.ros.setdefault(uid, set())
        elif component_of(pod) == names.IMAGE_CHECK and ready:
            pod["status"]["phase"] = "Succeeded"

    # what the operator sees

    def observe(self, old: State | None, failures: dict[Name, dict[Name, str]]) -> ClusterSnapshot:
        """The state of the cluster, with pods, nodes and Services of ``old`` if given."""
        seen = old or self.state
        pods = [parse.pod(pod) for pod in seen.pods.values()]
        own = [proxy for pod in seen.pods.values() if (proxy := parse.proxy_pod(pod))]
        helpers = [*filter(None, map(parse.helper_pod, seen.pods.values()))]
        services = [*filter(None, map(parse.service, seen.services.values()))]
        policies = seen.policies.values()
        of = tuple(parse_rosproxy.rosproxy(rosproxy) for rosproxy in self.state.rosproxies.values())
        masters = {rosproxy.spec.master.service for rosproxy in of if rosproxy.spec.master.service}
        resolved = (self.master_ip, None) if self.master_ip else ("", Fault("does not exist"))
        return ClusterSnapshot(
            rosproxies=of,
            nodes={name: parse.node(node) for name, node in seen.nodes.items()},
            pods=tuple(pods),
            proxies=tuple(own),
            lan_relays=tuple(h for h in helpers if h.component == names.LAN_RELAY),
            image_checks=tuple(h for h in helpers if h.component == names.IMAGE_CHECK),
            services={s.of: s for s in services if s.role is ServiceRole.PODS},
            hub_services={s.of: s for s in services if s.role is ServiceRole.HUBS},
            outside_services={s.of: s for s in services if s.role is ServiceRole.OUTSIDE},
            policies={policy.id: policy for policy in filter(None, map(parse.policy, policies))},
            key=self.key,
            masters=dict.fromkeys(masters, resolved),
            reports={
                uid: ProxyReport(
                    True, True, nodes={ip: (f"/node_{ip}",) for ip in sorted(addresses)}
                )
                for uid, addresses in self.ros.items()
                if uid in self.running()
            },
            failures=failures,
        )

    # what the operator does

    def apply(self, action: Action) -> None:  # noqa: C901, PLR0912 - one case per action
        """Raises Refused. An AssertionError means that the plan is wrong in itself."""
        match action:
            case CreateService(body=body):
                self.made += 1
                try:
                    self.create_service(dict(body))
                except Refused as error:
                    if "allocated" not in str(error):
                        raise
                    self.create_service(dict(without_cluster_ip(body)))
            case CreateProxy(body=body) | CreateHelper(body=body):
                self.made += 1
                self.create_pod(dict(body))
            case CreatePolicy(body=body):
                self.made += 1
                self.create_policy(dict(body))
            case DeletePolicy(id=id, uid=uid):
                if self._own(self.state.policies, id, uid):
                    del self.state.policies[id]
            case SetPolicy(id=id, uid=uid, spec=spec):
                if policy := self._own(self.state.policies, id, uid):
                    policy["spec"] = copy.deepcopy(dict(spec))
            case DeleteProxy(id=id, uid=uid) | DeleteHelper(id=id, uid=uid):
                if pod := self._own(self.state.pods, id, uid):
                    self.delete_pod(pod)
            case DeleteService(id=id, uid=uid):
                if self._own(self.state.services, id, uid):
                    del self.state.services[id]
            case SetImage(id=id, uid=uid, image=image):
                if pod := self._own(self.state.pods, id, uid):
                    works = pod["status"]["phase"] == "Running"
                    assert image != BAD_IMAGE or not works, f"{id} loses an image that works"
                    pod["spec"]["containers"][0]["image"] = image
            case PatchStatus(of=of, status=status):
                if of in self.state.rosproxies:
                    self.state.rosproxies[of]["status"] = copy.deepcopy(dict(status))
            case Emit():
                pass

    def _own(self, objects: dict[Name, Object], id: Name, uid: str) -> Object | None:
        """The object for an action, if the uid is still the same."""
        target = objects.get(id)
        if target is None or meta(target)["uid"] != uid:
            return None
        assert is_own(target), f"{id} is not the operator's"
        self.made += 1
        return target


class Controller:
    """A controller that looks, plans, carries out, and may be killed anywhere."""

    def __init__(self, cluster: Cluster, settings: ClusterSettings) -> None:
        self.cluster = cluster
        self.settings = settings
        self.state = ClusterState()
        self.failures: dict[Name, dict[Name, str]] = {}
        self.now = 1000.0
        self.old: State | None = None

    def remember(self) -> None:
        """Let the next looks see the current state, as long as ``old`` stays."""
        self.old = self.old or copy.deepcopy(self.cluster.state)

    def look(self) -> ClusterPlan:
        observed = self.cluster.observe(self.old, self.failures)
        stamp = f"2026-01-01T{int(self.now) // 3600 % 24:02}:00:00Z"
        cluster_plan = plan(observed, self.settings, self.state, self.now, stamp)
        self.state = cluster_plan.state
        for uid, briefing in cluster_plan.briefings.items():
            if briefing.gone:
                self.cluster.ros[uid] -= set(briefing.gone)
        return cluster_plan

    def carry_out(self, cluster_plan: ClusterPlan, most: int | None = None) -> None:
        """Carry out a plan's actions, or the first few."""
        actions = cluster_plan.actions[:most]
        failed: dict[Name, dict[Name, str]] = {action.of: {} for action in actions}
        for action in actions:
            failed[action.of] |= self._try(action)
        self.failures |= failed

    def _try(self, action: Action) -> dict[Name, str]:
        try:
            self.cluster.apply(action)
        except Refused as error:
            assert isinstance(action, CreateProxy | CreateHelper | CreateService | CreatePolicy)
            name = name_of(dict(action.body))
            state = self.cluster.state
            kinds = {
                CreateProxy: state.pods, CreateHelper: state.pods, CreateService: state.services,
            }  # fmt: skip
            existing = kinds.get(type(action), state.policies).get(name)
            if str(error) == "AlreadyExists" and existing is not None:
                text = "a Pod of this name exists already that the operator did not create"
                return {} if is_own(existing) else {name: text}
            return {name: str(error)}
        return {}

    def lose_memory(self) -> None:
        self.state = ClusterState()
        self.failures = {}
        self.old = None


SETTINGS = replace(
    ClusterSettings(), image="rosproxy:1", bounds=Bounds(images=("*",), listen=("NodePort",))
)
