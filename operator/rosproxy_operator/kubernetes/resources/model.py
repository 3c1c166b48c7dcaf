"""RosProxies, nodes of the cluster and pods. `cluster` has the operator's own objects."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal

import msgspec

from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import Rule
from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import (
    INVALID,
    Problem,
)
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, ProxySpec

Json = Mapping[str, Any]
"""An object as the API server sends it, or a part of the object."""


class Name(msgspec.Struct, frozen=True, order=True):
    """Namespace and name of an object, unique within the object's kind."""

    namespace: str
    name: str

    def __str__(self) -> str:
        return f"{self.namespace}/{self.name}"


class ProxyPlace(msgspec.Struct, frozen=True, order=True):
    """A place for a proxy: a RosProxy (``of``) and a node of the cluster."""

    of: Name
    node: str


class Selector(msgspec.Struct, frozen=True):
    """A label selector (``metav1.LabelSelector``). A pod must match all parts.

    ``expressions`` are (key, operator, values) with the operators In, NotIn, Exists, DoesNotExist.
    """

    labels: Mapping[str, str] = {}
    expressions: tuple[tuple[str, str, frozenset[str]], ...] = ()


PodEgress = Literal["any", "proxy"]
"""Where selected pods may connect to. ``proxy``: only to proxies, to each other, and to DNS."""


class MasterSpec(msgspec.Struct, frozen=True):
    """The real ROS 1 master: outside at ``uri``, or a Service in the cluster.

    ``address`` is the IP address of the host in ``uri``, for a name that the cluster's DNS does not
    resolve. ``publish`` is the hostPort at which outside reaches a master in the cluster, 0 for
    none.
    """

    uri: str = ""
    address: str = ""
    service: Name | None = None
    service_port: int = 11311
    publish: int = 0


class Ros2Spec(msgspec.Struct, frozen=True):
    """The ROS 2 fields of a RosProxy. ``peers`` are hosts outside, or HOST:PORT of other proxies.

    With ``domain`` None, the domain is 0, and the webhook sets no ROS_DOMAIN_ID in pods.
    """

    domain: int | None = None
    peers: tuple[str, ...] = ()
    multicast: bool = False

    @property
    def number(self) -> int:
        """The number of the domain."""
        return self.domain or 0


ListenType = Literal["NodePort", "LoadBalancer"]
"""The type of a Service that outside reaches."""


class ListenSpec(msgspec.Struct, frozen=True):
    """The Service at which outside reaches the proxies of a RosProxy for rmw_zenoh.

    With ``node_port`` 0, the API server chooses the port.
    """

    type: ListenType
    node_port: int = 0
    load_balancer_class: str = ""
    annotations: Mapping[str, str] = {}


class LinkSpec(msgspec.Struct, frozen=True):
    """The links of a RosProxy for rmw_zenoh to other sites.

    ``to`` are proxies of other sites, as ``tls/host:port``. ``secret`` is the name of the Secret
    with the certificate of this site. ``limits`` are rates, as ``/camera/*=2Hz``.
    """

    to: tuple[str, ...]
    secret: str
    limits: tuple[str, ...] = ()
    rules: tuple[Rule, ...] = ()


class ZenohSpec(msgspec.Struct, frozen=True):
    """The fields of a RosProxy for rmw_zenoh. ``peers`` are routers outside, as ``host:port``.

    With ``listen`` None, no port leads from outside to the proxies. With ``link`` None, the proxies
    have no links to other sites.
    """

    peers: tuple[str, ...] = ()
    listen: ListenSpec | None = None
    link: LinkSpec | None = None


class Advertise(Enum):
    """Type of the node's address that is the advertised host (``status.addresses[].type``)."""

    INTERNAL_IP = "InternalIP"
    EXTERNAL_IP = "ExternalIP"
    HOSTNAME = "Hostname"


class MaxUnavailable(msgspec.Struct, frozen=True):
    """Number of proxies that a rollout may replace at the same time: a count, or a percentage."""

    number: int = 1
    is_percent: bool = False

    def of(self, count: int) -> int:
        """Return the number for ``count`` proxies, at least 1. A percentage is rounded up."""
        return max(1, -(-count * self.number // 100) if self.is_percent else self.number)


class RosProxySpec(msgspec.Struct, frozen=True):
    """The spec of a RosProxy, with the fields of the custom resource definition.

    ``ports`` is the number of ports in the range of each proxy. The ranges lie in ``window``. With
    ``pod_selector`` None, the RosProxy selects pods whose label rosproxy.io/inject is "true"
    or the RosProxy's name. ``cleanup_after`` and ``grace`` are in seconds. An empty ``image`` means
    the operator's default. ``policy`` has at most a single layer.

    ``resources``, ``tolerations``, ``host_aliases`` and ``image_pull_secrets`` go into the pods
    unchanged. None in ``node_selector``, ``tolerations``, ``image_pull_secrets`` or ``resources``
    means the administrator's default (`pod_defaults`).

    ``ros1``: the proxies are for ROS 1. Without ``ros1``, ``master`` has no meaning. ``ros2`` None:
    the proxies are not for DDS. ``zenoh``: the proxies are for rmw_zenoh, and for nothing else.
    Such proxies have no ports of the node, so ``ports``, ``window`` and ``advertise`` have no
    meaning.
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
    zenoh: ZenohSpec | None = None

    @property
    def multicast(self) -> bool:
        """Whether each proxy has a LAN relay. The relay uses the last port of the proxy's range."""
        return self.ros2 is not None and self.ros2.multicast

    @property
    def takes_udp(self) -> bool:
        """Whether the proxies use UDP ports of the nodes: for DDS, or for UDPROS."""
        return self.ros2 is not None or self.proxy.udp


class RosProxy(msgspec.Struct, frozen=True):
    """A RosProxy, the custom resource.

    ``former_ranges`` are the ranges in the status, by node name. ``cluster_ip`` is the address of
    the RosProxy's Service in the status, also of a deleted Service. ``remakes``: the operator
    evicts unwired pods. ``created`` is the creation time, as the API server writes the time.
    ``unregistered_at`` is, by node name, the time at which a proxy last unregistered the ROS 1
    nodes of running pods, in the same form. ``registered`` are the addresses at which its proxies
    have ROS 1 nodes, ``discovered`` those at which they have ROS 2 participants. On the nodes
    ``silent``, a proxy has not answered. ``misspelt`` has the texts of `misspelt_names`.
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
    unregistered_at: Mapping[str, str] = {}
    silent: frozenset[str] = frozenset()
    registered: frozenset[str] = frozenset()
    discovered: frozenset[str] = frozenset()
    misspelt: tuple[str, ...] = ()


class ClusterNode(msgspec.Struct, frozen=True):
    """A node of the cluster. ``addresses`` has the first address of each type.

    ``advertise_host`` is the annotation rosproxy.io/advertise-host. ``pod_networks`` are
    ``spec.podCIDRs``. ``misspelt`` has the texts of `misspelt_names`.
    """

    name: str
    labels: Mapping[str, str] = {}
    addresses: Mapping[str, str] = {}
    advertise_host: str = ""
    pod_networks: tuple[str, ...] = ()
    ready: bool = True
    deleting: bool = False
    misspelt: tuple[str, ...] = ()


REFERENCE = "$("
"""The beginning of a reference to another variable, in the value of a variable."""
VALUE_AT_RUNTIME = "$()"
"""Stands for a value that is unknown until the container runs."""


class PodContainer(msgspec.Struct, frozen=True):
    """A container of a pod: the image, and the variables that ROS 2 reads."""

    image: str = ""
    variables: Mapping[str, str] = {}


class Pod(msgspec.Struct, frozen=True):
    """A pod.

    ``node`` and ``ip`` are empty until the pod has a node and an address. ``ips`` are all addresses
    of the pod. ``host_ports`` are the TCP hostPorts of the containers, ``udp_ports`` the UDP
    hostPorts.

    ``wired_master_uri`` is the ROS_MASTER_URI that the webhook has set, empty for none.
    ``own_masters`` are the other values of ROS_MASTER_URI, which the pod's template sets. A value
    that is no plain text, for example from a ConfigMap, is `VALUE_AT_RUNTIME`. ``static_peers`` is
    the ROS_STATIC_PEERS that the webhook has set, ``wired_domain`` the ROS_DOMAIN_ID, and
    ``router_endpoint`` the endpoint in the ZENOH_CONFIG_OVERRIDE, each empty for none.

    ``replaced_master_uri`` is the ROS_MASTER_URI of the template that the webhook has replaced.
    ``not_wired_because`` is why the webhook has set no variable. ``labelled_later``: the pod got
    the label of the webhook after the creation.

    ``controller`` is the kind of the pod's controller, for example ReplicaSet. ``workload`` is the
    object with the template, for example "deployment/talker" or "job/survey". ``created`` is the
    creation time, as the API server writes the time. ``running_since`` is the earliest start of a
    running container with a ROS_MASTER_URI, in the same form, empty if no such container runs.
    ``misspelt`` has the texts of `misspelt_names`.
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
    wired_domain: str = ""
    router_endpoint: str = ""
    replaced_master_uri: str = ""
    not_wired_because: str = ""
    labelled_later: bool = False
    containers: tuple[PodContainer, ...] = ()
    controller: str = ""
    workload: str = ""
    created: str = ""
    running_since: str = ""
    misspelt: tuple[str, ...] = ()

    @property
    def every_port(self) -> frozenset[int]:
        """All hostPorts of the pod, for TCP and UDP."""
        return self.host_ports | self.udp_ports

    def ports_of(self, spec: RosProxySpec) -> frozenset[int]:
        """Return the pod's hostPorts for protocols that the RosProxy's proxies use."""
        tcp = self.host_ports if spec.ros1 else frozenset[int]()
        return tcp | self.udp_ports if spec.takes_udp else tcp

    @property
    def ended(self) -> bool:
        """Whether the pod has ended. An ended pod holds no ports."""
        return self.phase in ("Succeeded", "Failed")


class Reference(msgspec.Struct, frozen=True):
    """The object of a Kubernetes Event (``involvedObject``)."""

    kind: str
    id: Name
    uid: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterFinding(Problem):
    """A problem that conditions and Kubernetes Events report.

    ``of`` is the RosProxy. ``about`` is the object of the Event; None: no Event.
    """

    of: Name
    about: Reference | None = None


class InvalidRosProxy(msgspec.Struct, frozen=True):
    """A RosProxy that the operator can't read, or that asks for more than allowed.

    ``text`` says what is wrong. ``reason`` is a CamelCase word.
    """

    id: Name
    uid: str
    generation: int
    text: str
    fix: str = ""
    status: Json = {}
    reason: str = INVALID
