"""What users and the cluster have: RosProxies, nodes and pods, in Kubernetes' words.

What the operator has made of it is in `cluster`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal

import msgspec

from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, ProxySpec

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


class Ros2Spec(msgspec.Struct, frozen=True):
    """What it asks for of ROS 2. ``domain`` None is 0, pods are not told it; ``peers``: hosts."""

    domain: int | None = None
    peers: tuple[str, ...] = ()
    multicast: bool = False

    @property
    def number(self) -> int:
        """The domain."""
        return self.domain or 0


class Advertise(Enum):
    """Which of a node's addresses outside is told (``status.addresses[].type``)."""

    INTERNAL_IP = "InternalIP"
    EXTERNAL_IP = "ExternalIP"
    HOSTNAME = "Hostname"


class MaxUnavailable(msgspec.Struct, frozen=True):
    """How many proxies of a RosProxy a rollout may have away: a count, or a percentage."""

    number: int = 1
    is_percent: bool = False

    def of(self, count: int) -> int:
        """How many of ``count`` proxies these are: at least one; a percentage is rounded up."""
        return max(1, -(-count * self.number // 100) if self.is_percent else self.number)


class RosProxySpec(msgspec.Struct, frozen=True):
    """What a RosProxy asks for; the fields are those of the CRD.

    ``pod_selector`` None means: the pods whose label rosproxy.io/inject is "true" or the
    RosProxy's name. ``cleanup_after`` and ``grace`` are in seconds. ``image`` empty means the
    operator's default. ``policy`` is one layer or none. ``resources``, ``tolerations``,
    ``host_aliases`` and ``image_pull_secrets`` go into the pods as they are. ``node_selector``,
    ``tolerations``, ``image_pull_secrets`` and ``resources`` None mean the administrator's
    defaults (`pod_defaults`). It is for ROS 1 if ``ros1`` is set (``master`` says nothing
    otherwise), for ROS 2 if ``ros2`` is there.
    """

    master: MasterSpec
    ports: int
    window: PortRange
    pod_selector: Selector | None = None
    node_selector: Mapping[str, str] | None = None
    tolerations: tuple[Json, ...] | None = None
    advertise: Advertise = Advertise.INTERNAL_IP
    cleanup_after: float = 30.0
    grace: float = 60.0
    max_unavailable: MaxUnavailable = MaxUnavailable()
    proxy: ProxySpec = OWN_SPEC
    policy: tuple[PolicyLayer, ...] = ()
    pod_egress: PodEgress = "any"
    image: str = ""
    image_pull_policy: str = ""
    image_pull_secrets: tuple[Json, ...] | None = None
    resources: Json | None = None
    host_aliases: tuple[Json, ...] = ()
    ros1: bool = True
    ros2: Ros2Spec | None = None

    @property
    def multicast(self) -> bool:
        """Whether each proxy has a LAN relay, at the last port of its range."""
        return self.ros2 is not None and self.ros2.multicast

    @property
    def takes_udp(self) -> bool:
        """Whether its proxies take UDP ports of their nodes: for DDS, or for UDPROS."""
        return self.ros2 is not None or self.proxy.udp


class RosProxy(msgspec.Struct, frozen=True):
    """A RosProxy, the custom resource.

    ``former_ranges`` are the ranges by node name that its status holds; ``cluster_ip`` is the
    address that its Service has, or had; ``status`` is its status as it is now. ``remakes``:
    whether pods that came by unwired are to be made anew. ``misspelt``: what is wrong with the
    names of its annotations and labels, as for nodes and pods (`misspelt_names`). ``created`` is
    the time of the creation, as the API server writes it.
    """

    id: Name
    uid: str
    generation: int
    spec: RosProxySpec
    former_ranges: Mapping[str, PortRange] = {}
    cluster_ip: str = ""
    status: Json = {}
    deleting: bool = False
    remakes: bool = False
    created: str = ""
    misspelt: tuple[str, ...] = ()


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
    misspelt: tuple[str, ...] = ()


VALUE_AT_RUNTIME = "$()"
"""Stands for a value that is only known once the container runs."""


class PodContainer(msgspec.Struct, frozen=True):
    """A container of a pod: its image, and those of its variables that matter to ROS 2."""

    image: str = ""
    variables: Mapping[str, str] = {}


class Pod(msgspec.Struct, frozen=True):
    """A pod. ``node`` and ``ip`` are empty until it has them; ``ips`` are all of its addresses.

    ``host_ports`` are the TCP ports that its containers take on the node. ``own_masters`` are the
    ROS_MASTER_URIs that its template sets itself, so that the webhook left them alone; one that is
    not a plain text (from a ConfigMap, for one) is `VALUE_AT_RUNTIME`. ``wired_master_uri`` is the
    one that the webhook has set, empty if it has not; ``static_peers`` the same of
    ROS_STATIC_PEERS. ``udp_ports`` are the UDP ports that it takes, ``controller`` is the kind of
    the object that creates the pod again, ``workload`` names the object whose pods `kubectl rollout
    restart` creates anew, as "deployment/talker". ``created`` is the time of the creation, as the
    API server writes it.
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
    wired_master_uri: str = ""
    ips: tuple[str, ...] = ()
    udp_ports: frozenset[int] = frozenset()
    static_peers: str = ""
    containers: tuple[PodContainer, ...] = ()
    controller: str = ""
    workload: str = ""
    created: str = ""
    misspelt: tuple[str, ...] = ()

    @property
    def every_port(self) -> frozenset[int]:
        """The ports that it takes, by either protocol."""
        return self.host_ports | self.udp_ports

    def ports_of(self, spec: RosProxySpec) -> frozenset[int]:
        """Its ports that a RosProxy can't have, by the protocols that its proxies use."""
        tcp = self.host_ports if spec.ros1 else frozenset[int]()
        return tcp | self.udp_ports if spec.takes_udp else tcp

    @property
    def ended(self) -> bool:
        """Whether it has run to its end: it holds no ports any more."""
        return self.phase in ("Succeeded", "Failed")


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
