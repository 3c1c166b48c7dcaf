"""Nodes, pods and Services as the API server gives them, as far as they matter here.

Names and meaning are those of k8s.io/api, core/v1/types.go; what is absent there is empty here.
Read them with `fields.lenient`.
"""

from typing import Any

from msgspec import field

from rosproxy_operator.kubernetes.resources.fields import ApiFields


class OwnerReference(ApiFields, frozen=True):
    """One of ``metadata.ownerReferences``."""

    api_version: str = ""
    kind: str = ""
    uid: str = ""
    controller: bool = False


class Metadata(ApiFields, frozen=True):
    """``metav1.ObjectMeta``."""

    name: str = ""
    namespace: str = ""
    uid: str = ""
    generation: int = 0
    labels: dict[str, str] = field(default_factory=dict)
    annotations: dict[str, str] = field(default_factory=dict)
    owner_references: tuple[OwnerReference, ...] = ()
    deletion_timestamp: Any = None

    @property
    def deleting(self) -> bool:
        """Whether it is about to go."""
        return self.deletion_timestamp is not None


class ObjectCondition(ApiFields, frozen=True):
    """One of ``status.conditions``."""

    type: str = ""
    status: str = ""
    reason: str = ""
    message: str = ""


class NodeAddress(ApiFields, frozen=True):
    """One of a node's ``status.addresses``."""

    type: str = ""
    address: str = ""


class NodeSpec(ApiFields, frozen=True):
    """A node's ``spec``."""

    pod_cidr: str = field(default="", name="podCIDR")
    pod_cidrs: tuple[str, ...] = field(default=(), name="podCIDRs")
    unschedulable: bool = False


class NodeObjectStatus(ApiFields, frozen=True):
    """A node's ``status``."""

    addresses: tuple[NodeAddress, ...] = ()
    conditions: tuple[ObjectCondition, ...] = ()


class ContainerPort(ApiFields, frozen=True):
    """One of a container's ``ports``."""

    host_port: int = 0
    protocol: str = "TCP"


class Variable(ApiFields, frozen=True):
    """One of a container's ``env``."""

    name: str = ""
    value: str = ""
    value_from: Any = None


class PodContainer(ApiFields, frozen=True):
    """A container or init container of a pod."""

    name: str = ""
    image: str = ""
    restart_policy: str = ""
    env: tuple[Variable, ...] = ()
    ports: tuple[ContainerPort, ...] = ()


class PodSpec(ApiFields, frozen=True):
    """A pod's ``spec``."""

    node_name: str = ""
    host_network: bool = False
    init_containers: tuple[PodContainer, ...] = ()
    containers: tuple[PodContainer, ...] = ()


class Terminated(ApiFields, frozen=True):
    """How a container ended."""

    exit_code: int = 0
    reason: str = ""
    message: str = ""


class Waiting(ApiFields, frozen=True):
    """What a container waits for."""

    reason: str = ""
    message: str = ""


class ContainerState(ApiFields, frozen=True):
    """A container's ``state`` or ``lastState``."""

    waiting: Waiting = Waiting()
    terminated: Terminated = Terminated()


class ContainerStatus(ApiFields, frozen=True):
    """One of a pod's ``status.containerStatuses``."""

    name: str = ""
    restart_count: int = 0
    state: ContainerState = ContainerState()
    last_state: ContainerState = ContainerState()


class PodStatus(ApiFields, frozen=True):
    """A pod's ``status``."""

    phase: str = ""
    reason: str = ""
    message: str = ""
    pod_ip: str = field(default="", name="podIP")
    conditions: tuple[ObjectCondition, ...] = ()
    container_statuses: tuple[ContainerStatus, ...] = ()


class ServiceSpec(ApiFields, frozen=True):
    """A Service's ``spec``."""

    cluster_ip: str = field(default="", name="clusterIP")


class ObjectFields(ApiFields, frozen=True):
    """Any object."""

    metadata: Metadata = Metadata()


class NodeObject(ObjectFields, frozen=True):
    """A node."""

    spec: NodeSpec = NodeSpec()
    status: NodeObjectStatus = NodeObjectStatus()


class PodObject(ObjectFields, frozen=True):
    """A pod. At admission it may have no name, uid, node and address."""

    spec: PodSpec = PodSpec()
    status: PodStatus = PodStatus()


class ServiceObject(ObjectFields, frozen=True):
    """A Service."""

    spec: ServiceSpec = ServiceSpec()
