"""What the operator sees in a Kubernetes cluster, in Kubernetes' words."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal

import msgspec

from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy.settings import DataPlane, Direction
from rosproxy_operator.common.problem import Problem

Json = Mapping[str, Any]
"""An object as the API server gives it, or a part of one."""


class Name(msgspec.Struct, frozen=True, order=True):
    """What tells namespaced objects of one kind apart."""

    namespace: str
    name: str

    def __str__(self) -> str:
        return f"{self.namespace}/{self.name}"


class ProxyPlace(msgspec.Struct, frozen=True, order=True):
    """A node, as one RosProxy (``of``) sees it."""

    of: Name
    node: str


class Selector(msgspec.Struct, frozen=True):
    """A label selector (``metav1.LabelSelector``): all parts must fit.

    ``expressions`` are (key, operator, values) with the operators In, NotIn, Exists, DoesNotExist.
    """

    labels: Mapping[str, str] = {}
    expressions: tuple[tuple[str, str, frozenset[str]], ...] = ()


PodEgress = Literal["any", "proxy"]
"""What selected pods may connect to: anything, or the proxies, one another and the DNS alone."""


class MasterSpec(msgspec.Struct, frozen=True):
    """Where the real ROS master is: outside at ``uri``, or a Service of the cluster.

    ``address`` is the IP address of the host in ``uri``, for names that the cluster's DNS does not
    know. ``publish`` is the hostPort under which outside finds a master that runs in the cluster,
    0 for none.
    """

    uri: str = ""
    address: str = ""
    service: Name | None = None
    service_port: int = 11311
    publish: int = 0


class Advertise(Enum):
    """Which of a node's addresses outside is told (``status.addresses[].type``)."""

    INTERNAL_IP = "InternalIP"
    EXTERNAL_IP = "ExternalIP"
    HOSTNAME = "Hostname"


class RosProxySpec(msgspec.Struct, frozen=True):
    """What a RosProxy asks for; the fields are those of the CRD.

    ``pod_selector`` None means: the pods whose label rosproxy.io/inject is "true" or the
    RosProxy's name. ``cleanup_after`` and ``grace`` are in seconds. ``image`` empty means the
    operator's default. ``policy`` is one layer or none. ``resources``, ``tolerations``,
    ``host_aliases`` and ``image_pull_secrets`` go into the pods as they are.
    """

    master: MasterSpec
    ports: int
    window: PortRange
    pod_selector: Selector | None = None
    node_selector: Mapping[str, str] = {}
    tolerations: tuple[Json, ...] = ()
    advertise: Advertise = Advertise.INTERNAL_IP
    cleanup_after: float = 30.0
    grace: float = 60.0
    slave_control: str = "any"
    policy: tuple[PolicyLayer, ...] = ()
    data_plane: DataPlane = "auto"
    direction: Direction = "out"
    pod_egress: PodEgress = "any"
    image: str = ""
    image_pull_policy: str = ""
    image_pull_secrets: tuple[Json, ...] = ()
    resources: Json = {}
    host_aliases: tuple[Json, ...] = ()


class RosProxy(msgspec.Struct, frozen=True):
    """A RosProxy, the custom resource.

    ``former`` are the ranges by node name that its status holds; ``cluster_ip`` is the address
    that its Service has, or had; ``status`` is its status as it is now.
    """

    id: Name
    uid: str
    generation: int
    spec: RosProxySpec
    former: Mapping[str, PortRange] = {}
    cluster_ip: str = ""
    status: Json = {}
    deleting: bool = False


class ClusterNode(msgspec.Struct, frozen=True):
    """A node of the cluster. ``addresses`` are by their type, the first of each.

    ``advertise_host`` is its annotation rosproxy.io/advertise-host. ``pod_networks`` are its
    ``spec.podCIDRs``.
    """

    name: str
    labels: Mapping[str, str] = {}
    addresses: Mapping[str, str] = {}
    advertise_host: str = ""
    pod_networks: tuple[str, ...] = ()
    ready: bool = True
    deleting: bool = False


ELSEWHERE = "$()"
"""Stands for a value that is only known once the container runs."""


class Pod(msgspec.Struct, frozen=True):
    """A pod. ``node`` and ``ip`` are empty until it has them; ``ips`` are all of its addresses.

    ``host_ports`` are the TCP ports that its containers take on the node. ``own_masters`` are
    the ROS_MASTER_URIs that its template sets itself, so that the webhook left them alone; one that
    is not a plain text (from a ConfigMap, for one) is `ELSEWHERE`. ``wired`` is the one that the
    webhook has set, empty if it has not.
    """

    id: Name
    uid: str
    labels: Mapping[str, str] = {}
    node: str = ""
    phase: str = "Pending"
    ip: str = ""
    host_ports: frozenset[int] = frozenset()
    host_network: bool = False
    deleting: bool = False
    own_masters: tuple[str, ...] = ()
    wired: str = ""
    ips: tuple[str, ...] = ()

    @property
    def ended(self) -> bool:
        """Whether it has run to its end: it holds no ports any more."""
        return self.phase in ("Succeeded", "Failed")


class Stuck(Enum):
    """Why a proxy's pod does not run."""

    PORTS = "ports"  # one of its hostPorts is taken
    SCHEDULING = "scheduling"  # the scheduler or the kubelet does not admit it for another reason
    IMAGE = "image"
    CRASHING = "crashing"
    SANDBOX = "sandbox"  # the kubelet can't set it up


class ProxyPod(msgspec.Struct, frozen=True):
    """A pod of the operator in which a proxy runs, or is to run.

    ``of`` and ``owner`` are the name and uid of its RosProxy, ``on`` the node that it is meant for
    (``pod.node`` may still be empty). ``image`` is what its spec names. ``stuck`` and ``message``
    say why it does not run, in the words of the scheduler or the kubelet; ``ready`` is its
    condition Ready. ``restarts`` counts those of its container. ``token`` is that of its admin
    endpoint where it stands in the pod, as former operators wrote it.
    """

    pod: Pod
    of: Name
    owner: str
    on: str
    range: PortRange
    fingerprint: str
    image: str
    token: str = ""
    ready: bool = False
    stuck: Stuck | None = None
    message: str = ""
    restarts: int = 0


class ProxyService(msgspec.Struct, frozen=True):
    """A Service of the operator: under its address pods find the proxy on their node."""

    of: Name
    owner: str
    uid: str
    cluster_ip: str
    fingerprint: str
    deleting: bool = False


class ProxyPolicy(msgspec.Struct, frozen=True):
    """A NetworkPolicy of the operator, for the proxies of a RosProxy or for its pods."""

    id: Name
    of: Name
    owner: str
    uid: str
    spec: Json
    deleting: bool = False


class ProxyReport(msgspec.Struct, frozen=True):
    """What a proxy says of itself (``/status``), as far as it matters here.

    ``nodes`` are the names of the ROS nodes behind it, by their pod's IP; ``problems`` what it
    warns of; ``error`` is why its master is not reached, or why the proxy itself does not answer;
    ``refusal`` why it does not take its policy.
    """

    answered: bool
    master_up: bool = False
    error: str = ""
    nodes: Mapping[str, tuple[str, ...]] = {}
    topics: frozenset[str] = frozenset()
    problems: tuple[str, ...] = ()
    refusal: str = ""


class Obstacle(msgspec.Struct, frozen=True):
    """What keeps a proxy from being made or changed, told with the node's name before it.

    ``reason`` is the same in one CamelCase word.
    """

    reason: str
    text: str


class NodeState(msgspec.Struct, frozen=True):
    """What one RosProxy has on one node, and what it gets there: a line of its status.

    ``pods`` are the selected ones that are neither ended nor being deleted; a node without any is
    told for its ``range``, so that it gets the same again. ``range`` is None if there is none to be
    had. ``proxy`` is the pod that serves the node, None where there is none yet or any more.
    """

    name: str
    advertise_host: str
    range: PortRange | None
    proxy: ProxyPod | None = None
    pods: tuple[Pod, ...] = ()
    answer: ProxyReport | None = None
    obstacle: Obstacle | None = None


class Reference(msgspec.Struct, frozen=True):
    """What a Kubernetes Event is about (``involvedObject``)."""

    kind: str
    id: Name
    uid: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterFinding(Problem):
    """A problem as conditions and Kubernetes Events tell it.

    ``reason`` is one word in CamelCase; ``of`` the RosProxy that it belongs to. ``about`` is the
    object that the Event is about; None means that the problem gets no Event.
    """

    reason: str
    of: Name
    about: Reference | None = None


class InvalidRosProxy(msgspec.Struct, frozen=True):
    """A RosProxy that can't be read, or asks for more than it may.

    ``text`` says why, ``reason`` the same in one CamelCase word; the rest is as it is there.
    """

    id: Name
    uid: str
    generation: int
    text: str
    status: Json = {}
    reason: str = "Invalid"


class ClusterSnapshot(msgspec.Struct, frozen=True):
    """A cluster at one moment, as far as it matters.

    ``pods`` are those that a RosProxy selects, and all others on the nodes where those run.
    ``masters`` gives, for each Service that a RosProxy names as its master, its address and what is
    wrong; one of them is empty. ``consents`` gives, for the same, the namespaces whose RosProxies
    may name it, besides its own. ``selected`` are the uids of the pods that a RosProxy selects.
    ``policies`` are the operator's own NetworkPolicies by their names; ``no_policies`` is why they
    can't be listed. ``key`` is that from which the proxies' tokens are made.
    ``unusable`` are the RosProxies that can't be read at all: what they have is left as it is.
    ``reports`` are what the proxies say of themselves, by the uid of the pod; ``failures`` are, by
    RosProxy and object, what the API server said of the actions that failed at the last try:
    neither is listed, the operator puts them here.
    """

    rosproxies: tuple[RosProxy, ...] = ()
    nodes: Mapping[str, ClusterNode] = {}
    pods: tuple[Pod, ...] = ()
    proxies: tuple[ProxyPod, ...] = ()
    services: Mapping[Name, ProxyService] = {}
    masters: Mapping[Name, tuple[str, str]] = {}
    consents: Mapping[Name, frozenset[str]] = {}
    selected: frozenset[str] = frozenset()
    policies: Mapping[Name, ProxyPolicy] = {}
    no_policies: str = ""
    key: bytes = b""
    reports: Mapping[str, ProxyReport] = {}
    unusable: Mapping[Name, InvalidRosProxy] = {}
    failures: Mapping[Name, Mapping[Name, str]] = {}
