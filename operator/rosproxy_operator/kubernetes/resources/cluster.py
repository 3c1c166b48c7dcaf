"""The operator's own objects, what proxies say, and the cluster as a whole at one moment."""

from collections.abc import Mapping
from enum import Enum

import msgspec

from rosproxy.admin.status_document import RangeProbeStatus
from rosproxy.leases.ports import PortRange
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    InvalidRosProxy,
    Json,
    Name,
    Pod,
    ProxyPlace,
    RosProxy,
)


class PodFailure(Enum):
    """Why a proxy's pod does not run."""

    PORTS = "ports"  # one of its hostPorts is taken
    SCHEDULING = "scheduling"  # the scheduler or the kubelet does not admit it for another reason
    IMAGE = "image"
    CRASHING = "crashing"
    SANDBOX = "sandbox"  # the kubelet can't set it up


class OwnPod(msgspec.Struct, frozen=True):
    """A pod of the operator.

    ``of`` and ``owner`` are the name and uid of its RosProxy, ``node`` where it is meant to run
    (``pod.node`` may still be empty). ``image`` is what its spec names. ``stuck`` and ``message``
    say why it does not run, in the words of the scheduler or the kubelet; ``ready`` is its
    condition Ready.
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
    """A pod in which a proxy runs, or is to run.

    ``restarts`` counts those of its container. ``token`` is that of its admin endpoint where it
    stands in the pod, as former operators wrote it. ``runs``: its container was started, and was
    not seen to end.
    """

    range: PortRange
    token: str = ""
    restarts: int = 0
    runs: bool = False


class HelperPod(OwnPod, frozen=True, kw_only=True):
    """A pod beside a proxy: LAN_RELAY or IMAGE_CHECK, by its ``component`` (`names`)."""

    component: str


class ProxyService(msgspec.Struct, frozen=True):
    """A Service of the operator: under its address pods find the proxy on their node."""

    of: Name
    owner: str
    uid: str
    cluster_ip: str
    fingerprint: str
    deleting: bool = False


class MasterService(msgspec.Struct, frozen=True):
    """Any other Service, which may be that of a master.

    ``address`` is its cluster IP as it stands there, ``type`` its type; ``allowed`` are the
    namespaces whose RosProxies may name it, besides its own; ``misspelt`` is as that of a pod.
    """

    id: Name
    address: str = ""
    type: str = ""
    ports: frozenset[int] = frozenset()
    allowed: frozenset[str] = frozenset()
    misspelt: tuple[str, ...] = ()


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
    ``refusal`` why it does not take its policy. ``participants`` are the GUID prefixes of those of
    ROS 2, ``leases`` their ports. One without ROS 1 has no master, which counts as reached.
    ``range_probe`` is, without its age, whether outside reaches its ports; None: not tried yet.
    ``unregistered_addresses`` are those of nodes that were silent for long, and may come back.
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

    @property
    def addresses(self) -> frozenset[str]:
        """Where it has ROS nodes or participants."""
        return self.unregistered_addresses | {*self.nodes, *self.participants}


class Obstacle(msgspec.Struct, frozen=True):
    """What keeps a proxy from being made or changed, told with the node's name before it.

    ``reason`` is the same in one CamelCase word.
    """

    reason: str
    text: str


class RosProxyOnNode(msgspec.Struct, frozen=True):
    """What one RosProxy has on one node, and what it gets there: a line of its status.

    ``pods`` are the selected ones that are neither ended nor being deleted; a node without any is
    told for its ``range``, so that it gets the same again. ``range`` is None if there is none to be
    had. ``proxy`` is the pod that serves the node, None where there is none yet or any more;
    ``lan_relay`` its LAN relay, ``image_check`` the check of its next image.
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


class WebhookState(msgspec.Struct, frozen=True):
    """Whether the operator serves the webhook, and since when, in RFC 3339; empty: not known."""

    served: bool = True
    since: str = ""


class ClusterSnapshot(msgspec.Struct, frozen=True):
    """A cluster at one moment, as far as it matters.

    ``pods`` are those that a RosProxy selects; and on the nodes where those, proxies or LAN relays
    run all others of the namespaces that have such, and any that take ports there. ``masters``
    gives, for each Service that a RosProxy names as its master, its address and what is wrong; one
    of them is empty. ``consents`` gives, for the same, the namespaces whose RosProxies may name it,
    besides its own. ``selected`` are the uids of the pods that a RosProxy selects,
    ``unselected_pods`` those that ask for a proxy by their label and that no RosProxy selects;
    ``misspelt_pods`` are those with a misspelt label or annotation, ``misspelt_services`` says what
    is wrong with those of ``masters``. ``policies`` are the operator's own NetworkPolicies by their
    names; ``policies_error`` is why they can't be listed. ``key`` is that from which the proxies'
    tokens are made. ``unusable`` are the RosProxies that can't be read at all: what they have is
    left as it is. ``reports`` are what the proxies say of themselves, by the uid of the pod;
    ``failures`` are, by RosProxy and object, what the API server said of the actions that failed at
    the last try; ``vanished`` are the places whose proxy's pod is gone though its container was not
    seen to end, and when, by the operator's monotonic clock; ``webhook`` is that of this operator:
    the reports, the failures and the webhook are not listed, the operator puts them here.
    """

    rosproxies: tuple[RosProxy, ...] = ()
    nodes: Mapping[str, ClusterNode] = {}
    pods: tuple[Pod, ...] = ()
    proxies: tuple[ProxyPod, ...] = ()
    lan_relays: tuple[HelperPod, ...] = ()
    image_checks: tuple[HelperPod, ...] = ()
    services: Mapping[Name, ProxyService] = {}
    masters: Mapping[Name, tuple[str, str]] = {}
    consents: Mapping[Name, frozenset[str]] = {}
    selected: frozenset[str] = frozenset()
    unselected_pods: tuple[Pod, ...] = ()
    misspelt_pods: tuple[Pod, ...] = ()
    misspelt_services: Mapping[Name, tuple[str, ...]] = {}
    policies: Mapping[Name, ProxyPolicy] = {}
    policies_error: str = ""
    vanished: Mapping[ProxyPlace, float] = {}
    key: bytes = b""
    reports: Mapping[str, ProxyReport] = {}
    unusable: Mapping[Name, InvalidRosProxy] = {}
    failures: Mapping[Name, Mapping[Name, str]] = {}
    webhook: WebhookState = WebhookState()

    @property
    def own_pods(self) -> tuple[OwnPod, ...]:
        """The operator's pods of all kinds."""
        return (*self.proxies, *self.lan_relays, *self.image_checks)
