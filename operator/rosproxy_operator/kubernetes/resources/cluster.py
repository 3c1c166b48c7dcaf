"""The operator's own objects, the proxies' reports, and a snapshot of the cluster."""

from collections.abc import Mapping
from enum import Enum

import msgspec

from rosproxy.shared.documents.status_document import RangeProbeStatus
from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    InvalidRosProxy,
    Json,
    Name,
    Pod,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    hubs_service_id,
    outside_service_id,
    service_id,
)


class PodFailure(Enum):
    """Why a proxy's pod does not run."""

    PORTS = "ports"  # a hostPort is taken
    SCHEDULING = "scheduling"  # the scheduler or the kubelet refuses the pod for another reason
    IMAGE = "image"
    CRASHING = "crashing"
    SANDBOX = "sandbox"  # the kubelet can't set up the pod or its container


class OwnPod(msgspec.Struct, frozen=True):
    """A pod that the operator has created.

    ``of`` and ``owner`` are the name and the uid of the pod's RosProxy. ``node`` is the node that
    the operator has chosen; ``pod.node`` is empty until the scheduler has bound the pod. ``image``
    is the image in the pod's spec. ``ready`` is the pod's condition Ready. ``stuck`` is the reason
    why the pod does not run; ``message`` has the words of the scheduler or the kubelet.
    """

    pod: Pod
    of: Name
    owner: str
    node: str
    fingerprint: str
    image: str
    ready: bool = False
    stuck: PodFailure | None = None
    message: str = ""


class ProxyPod(OwnPod, frozen=True, kw_only=True):
    """The pod of a proxy.

    ``restarts`` is the restart count of the container. ``runs``: the container's last known state
    is running. ``token`` is the token of the admin endpoint if a former operator wrote the token
    into the pod, otherwise empty. ``of_zenoh``: the proxy is for rmw_zenoh, and ``range`` has no
    ports of the node.
    """

    range: PortRange
    token: str = ""
    restarts: int = 0
    runs: bool = False
    of_zenoh: bool = False

    @property
    def has_registrations(self) -> bool:
        """Whether nodes of the proxy are known outside by ports. With rmw_zenoh they are not."""
        return not self.of_zenoh


class HelperPod(OwnPod, frozen=True, kw_only=True):
    """A LAN relay or an image check: ``component`` is LAN_RELAY or IMAGE_CHECK (`names`)."""

    component: str


class ServiceRole(Enum):
    """What a Service of a RosProxy is for."""

    PODS = "pods"  # each pod reaches the proxy on its own node
    HUBS = "hubs"  # headless: gives the proxies for rmw_zenoh their names
    OUTSIDE = "outside"  # outside reaches the proxies for rmw_zenoh


SERVICE_IDS = {
    ServiceRole.PODS: service_id,
    ServiceRole.HUBS: hubs_service_id,
    ServiceRole.OUTSIDE: outside_service_id,
}
"""The functions that return the name of a RosProxy's Service."""


class ProxyService(msgspec.Struct, frozen=True):
    """A Service of a RosProxy. ``created`` is the time of the creation, in RFC 3339.

    A Service for outside has ``node_port``, the port of each node of the cluster, and of type
    LoadBalancer ``balancer``, the name or address of the load balancer; empty before there is one.
    """

    of: Name
    owner: str
    uid: str
    cluster_ip: str
    fingerprint: str
    deleting: bool = False
    role: ServiceRole = ServiceRole.PODS
    node_port: int = 0
    balancer: str = ""
    created: str = ""

    @property
    def id(self) -> Name:
        """The namespace and name of the Service."""
        return SERVICE_IDS[self.role](self.of)


class MasterService(msgspec.Struct, frozen=True):
    """A Service that the operator has not created. A RosProxy may name the Service as its master.

    ``address`` is ``spec.clusterIP`` as written (also ``None``), ``type`` is ``spec.type``.
    ``allowed`` are other namespaces whose RosProxies may name the Service. ``misspelt`` has the
    texts of `misspelt_names`.
    """

    id: Name
    address: str = ""
    type: str = ""
    ports: frozenset[int] = frozenset()
    allowed: frozenset[str] = frozenset()
    misspelt: tuple[str, ...] = ()


class ProxyPolicy(msgspec.Struct, frozen=True):
    """A NetworkPolicy of the operator, for the proxies or the selected pods of a RosProxy."""

    id: Name
    of: Name
    owner: str
    uid: str
    spec: Json
    deleting: bool = False


class ZenohReport(msgspec.Struct, frozen=True):
    """The part of a `ProxyReport` about rmw_zenoh.

    ``nodes`` are the names of ROS nodes in pods, ``sessions`` counts their sessions. ``peers`` and
    ``hubs`` have the routers outside and the hubs of other nodes as ``host:port``, with the error
    of the link; an empty error for a link that is up. ``sites`` has the links to other sites in the
    same way, as ``tls/host:port``.
    """

    nodes: tuple[str, ...] = ()
    sessions: int = 0
    peers: Mapping[str, str] = {}
    hubs: Mapping[str, str] = {}
    sites: Mapping[str, str] = {}


class ProxyReport(msgspec.Struct, frozen=True):
    """The part of a proxy's ``/status`` that the operator uses.

    - ``answered``: whether the proxy answers.
    - ``master_up``: whether the proxy reaches its master; for an answer without ROS 1, always true.
    - ``error``: why the proxy does not answer, or does not reach its master.
    - ``nodes``: names of ROS 1 nodes, by the IP address of their pod.
    - ``topics``: names of all topics inside.
    - ``problems``: texts of the proxy's present and recent problems, without denials.
    - ``refusal``: why the proxy refuses its policy.
    - ``participants``: GUID prefixes of ROS 2 participants, by the IP address of their pod.
    - ``leases``: ports of participants, by GUID prefix.
    - ``range_probe``: whether outside reaches the range. None: not tried yet. ``age`` is always 0,
      so that an unchanged result gives an equal report.
    - ``unregistered_addresses``: addresses of nodes that the proxy has given up after a long
      silence. Such a node may come back.
    - ``zenoh``: the routers for rmw_zenoh; None without routers.
    - ``retired``: the proxy has unregistered its ROS 1 nodes, and accepts no others.
    """

    answered: bool
    master_up: bool = False
    error: str = ""
    nodes: Mapping[str, tuple[str, ...]] = {}
    topics: frozenset[str] = frozenset()
    problems: tuple[str, ...] = ()
    refusal: str = ""
    participants: Mapping[str, tuple[str, ...]] = {}
    leases: Mapping[str, tuple[int, ...]] = {}
    range_probe: RangeProbeStatus | None = None
    unregistered_addresses: frozenset[str] = frozenset()
    zenoh: ZenohReport | None = None
    retired: bool = False

    @property
    def addresses(self) -> frozenset[str]:
        """The addresses of all nodes and participants, also of nodes that may come back."""
        return self.unregistered_addresses | {*self.nodes, *self.participants}


class Obstacle(msgspec.Struct, frozen=True):
    """Why the operator can't create or change a proxy on a node.

    The status shows ``text`` after the node's name. ``reason`` is a CamelCase word.
    """

    reason: str
    text: str
    fix: str = ""


class RosProxyOnNode(msgspec.Struct, frozen=True):
    """The state of a RosProxy on a node: an entry of ``status.perNode``.

    ``pods`` are the selected pods that are neither ended nor being deleted. The status also lists a
    node without pods, so that the node gets the same ``range`` again. ``range`` is None if no range
    is free. ``proxy`` is the pod that serves the node, None if there is no such pod. ``lan_relay``
    is the proxy's LAN relay, ``image_check`` the check of the proxy's next image. ``answer`` is the
    proxy's report, None before the first report. ``unregistered_at`` is empty, or the time at which
    a proxy last unregistered the ROS 1 nodes of running pods.
    """

    name: str
    advertise_host: str
    range: PortRange | None
    proxy: ProxyPod | None = None
    pods: tuple[Pod, ...] = ()
    answer: ProxyReport | None = None
    obstacle: Obstacle | None = None
    lan_relay: HelperPod | None = None
    image_check: HelperPod | None = None
    unregistered_at: str = ""


class WebhookState(msgspec.Struct, frozen=True):
    """Whether the operator has a webhook, and since when the webhook can wire the pods.

    ``since``: since when the operator serves the webhook, empty while the operator does not.
    ``service_since``: since when the RosProxy of the pods has its Service, empty if unknown. The
    webhook wires no pod before. Both are in RFC 3339.
    """

    served: bool = True
    since: str = ""
    service_since: str = ""


class ClusterSnapshot(msgspec.Struct, frozen=True):
    """The part of a cluster's state that the operator uses, at a single moment.

    From the API server:

    - ``pods``: all pods that a RosProxy selects, and all pods of the operator. On the nodes of
      these pods, also all pods with hostPorts, and all pods of some namespaces: the namespaces with
      a RosProxy or with a pod of the operator.
    - ``services``: the Services of RosProxies, by RosProxy. ``hub_services``: the Services that
      name the proxies for rmw_zenoh. ``outside_services``: the Services at which outside reaches
      these proxies.
    - ``masters``: for each Service that a RosProxy names as its master, the address and the
      problem. Either the address or the problem is empty.
    - ``consents``: for each such Service, other namespaces whose RosProxies may name the Service.
    - ``misspelt_services``: for each such Service, the texts of `misspelt_names`.
    - ``selected``: uids of the pods that a RosProxy selects and that have not ended.
    - ``unselected_pods``: pods that ask for a proxy by their label, but that no RosProxy selects.
    - ``misspelt_pods``: pods with a misspelt label or annotation.
    - ``policies``: the operator's NetworkPolicies by name. ``policies_error`` is why the operator
      can't list or watch NetworkPolicies.
    - ``unusable``: RosProxies that the operator can't read. `planner.bounds` adds RosProxies that
      ask for more than allowed. The operator leaves the objects of these RosProxies unchanged.
    - ``vanished``: the places whose proxy's pod is gone although the operator did not see the
      container end. The value is the time, in seconds of the operator's monotonic clock.

    From the operator itself:

    - ``key``: the key of the proxies' tokens.
    - ``hub_certificates``: key, certificate and CA of the hubs of each RosProxy for rmw_zenoh.
    - ``reports``: the proxies' reports, by the uid of the pod.
    - ``failures``: the API server's errors about actions that failed at the last try, by RosProxy
      and object.
    - ``webhook``: the state of the operator's webhook.
    """

    rosproxies: tuple[RosProxy, ...] = ()
    nodes: Mapping[str, ClusterNode] = {}
    pods: tuple[Pod, ...] = ()
    proxies: tuple[ProxyPod, ...] = ()
    lan_relays: tuple[HelperPod, ...] = ()
    image_checks: tuple[HelperPod, ...] = ()
    services: Mapping[Name, ProxyService] = {}
    hub_services: Mapping[Name, ProxyService] = {}
    outside_services: Mapping[Name, ProxyService] = {}
    masters: Mapping[Name, tuple[str, Fault | None]] = {}
    consents: Mapping[Name, frozenset[str]] = {}
    selected: frozenset[str] = frozenset()
    unselected_pods: tuple[Pod, ...] = ()
    misspelt_pods: tuple[Pod, ...] = ()
    misspelt_services: Mapping[Name, tuple[str, ...]] = {}
    policies: Mapping[Name, ProxyPolicy] = {}
    policies_error: str = ""
    vanished: Mapping[ProxyPlace, float] = {}
    key: bytes = b""
    hub_certificates: Mapping[Name, str] = {}
    reports: Mapping[str, ProxyReport] = {}
    unusable: Mapping[Name, InvalidRosProxy] = {}
    failures: Mapping[Name, Mapping[Name, str]] = {}
    webhook: WebhookState = WebhookState()

    @property
    def all_services(self) -> tuple[ProxyService, ...]:
        """All Services of RosProxies."""
        groups = (self.services, self.hub_services, self.outside_services)
        return tuple(service for group in groups for service in group.values())

    @property
    def own_pods(self) -> tuple[OwnPod, ...]:
        """All pods that the operator has created."""
        return (*self.proxies, *self.lan_relays, *self.image_checks)
