"""Objects of the API server, read: what the planner wants to know of nodes, pods and Services.

Their fields are those of k8s.io/api, core/v1/types.go. The API server has checked their types; what
is missing is as if it were empty.
"""

from collections.abc import Iterator

from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.cluster import (
    EarPod,
    MasterService,
    ProxyPod,
    ProxyPolicy,
    ProxyService,
)
from rosproxy_operator.kubernetes.resources.model import (
    ELSEWHERE,
    ClusterNode,
    Json,
    Name,
    Pod,
    PodContainer,
)
from rosproxy_operator.kubernetes.resources.pod_failures import stuck
from rosproxy_operator.kubernetes.resources.values import (
    is_label,
    number,
    part,
    parts,
    port_range,
    word,
    words,
)

VARIABLE = "ROS_MASTER_URI"
ROS2_VARIABLES = frozenset(
    {
        "ROS_STATIC_PEERS",
        "ROS_DOMAIN_ID",
        "ROS_DISTRO",
        "ROS_LOCALHOST_ONLY",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "RMW_IMPLEMENTATION",
    }
)
"""Those by which it is told what a pod can't have of ROS 2."""


def node(obj: Json) -> ClusterNode:
    """A node."""
    meta, spec, status = part(obj, "metadata"), part(obj, "spec"), part(obj, "status")
    networks = spec.get("podCIDRs") or (word(spec, "podCIDR"),)
    addresses = reversed(parts(status, "addresses"))
    return ClusterNode(
        name=word(meta, "name"),
        labels=words(meta, "labels"),
        addresses={word(address, "type"): word(address, "address") for address in addresses},
        advertise_host=word(part(meta, "annotations"), names.ADVERTISE_HOST).strip(),
        pod_networks=tuple(network for network in networks if network and isinstance(network, str)),
        ready=_is_ready(status),
        deleting=is_deleted(meta),
    )


def pod(obj: Json) -> Pod:
    """A pod. At admission it may have no name, uid, node and address."""
    meta, spec, status = part(obj, "metadata"), part(obj, "spec"), part(obj, "status")
    wired = word(part(meta, "annotations"), names.MASTER_URI)
    return Pod(
        id=name_of(meta),
        uid=word(meta, "uid"),
        labels=words(meta, "labels"),
        node=word(spec, "nodeName"),
        phase=word(status, "phase") or "Pending",
        ip=word(status, "podIP"),
        host_ports=frozenset(_host_ports(spec, "TCP")),
        udp_ports=frozenset(_host_ports(spec, "UDP")),
        host_network=spec.get("hostNetwork") is True,
        deleting=is_deleted(meta),
        own_masters=tuple(uri for uri in _masters(spec) if not wired or uri != wired),
        wired=wired,
        static_peers=word(part(meta, "annotations"), names.STATIC_PEERS),
        containers=tuple(map(_container, parts(spec, "containers"))),
        ips=tuple(filter(None, (word(pod_ip, "ip") for pod_ip in parts(status, "podIPs")))),
        controller=_controller(meta),
    )


def proxy_pod(obj: Json) -> ProxyPod | None:
    """A proxy's pod; None if the object is not one that this operator made, or not whole."""
    meta, status = part(obj, "metadata"), part(obj, "status")
    labels, notes = words(meta, "labels"), words(meta, "annotations")
    containers = parts(part(obj, "spec"), "containers")
    container = next((c for c in containers if c.get("name") == names.CONTAINER), None)
    ports = port_range(notes, names.PORT_RANGE)
    on, owner = notes.get(names.NODE, ""), _owner(meta)
    if not names.is_own(labels) or names.is_ear(labels):
        return None
    if ports is None or not (on and owner and container):
        return None
    reason, message = stuck(status)
    variables = {word(v, "name"): word(v, "value") for v in parts(container, "env")}
    return ProxyPod(
        pod=pod(obj),
        of=Name(word(meta, "namespace"), labels[names.PROXY_OF]),
        owner=owner,
        on=on,
        range=ports,
        fingerprint=notes.get(names.FINGERPRINT, ""),
        image=word(container, "image"),
        token=variables.get(names.TOKEN_VARIABLE, ""),
        ready=_is_ready(status),
        stuck=reason,
        message=message,
        restarts=sum(number(c, "restartCount") for c in parts(status, "containerStatuses")),
    )


def ear_pod(obj: Json) -> EarPod | None:
    """An ear's pod; None if the object is not one that this operator made, or not whole."""
    meta, status = part(obj, "metadata"), part(obj, "status")
    labels, notes = words(meta, "labels"), words(meta, "annotations")
    container = next(iter(parts(part(obj, "spec"), "containers")), {})
    on, owner = notes.get(names.NODE, ""), _owner(meta)
    if not names.is_ear(labels) or not (on and owner):
        return None
    reason, message = stuck(status)
    return EarPod(
        pod=pod(obj),
        of=Name(word(meta, "namespace"), labels[names.PROXY_OF]),
        owner=owner,
        on=on,
        fingerprint=notes.get(names.FINGERPRINT, ""),
        image=word(container, "image"),
        ready=_is_ready(status),
        stuck=reason,
        message=message,
    )


def service(obj: Json) -> ProxyService | None:
    """A Service; None if the object is not one that this operator made."""
    meta, address = part(obj, "metadata"), word(part(obj, "spec"), "clusterIP")
    labels, owner = words(meta, "labels"), _owner(meta)
    rosproxy = Name(word(meta, "namespace"), labels.get(names.PROXY_OF, ""))
    if not names.is_own(labels) or not owner or names.service_id(rosproxy) != name_of(meta):
        return None
    return ProxyService(
        of=rosproxy,
        owner=owner,
        uid=word(meta, "uid"),
        cluster_ip="" if address == "None" else address,
        fingerprint=word(part(meta, "annotations"), names.FINGERPRINT),
        deleting=is_deleted(meta),
    )


def master_service(obj: Json) -> MasterService:
    """A Service, as far as a master's matters."""
    spec, ports = part(obj, "spec"), parts(part(obj, "spec"), "ports")
    return MasterService(
        id=name_of(part(obj, "metadata")),
        address=word(spec, "clusterIP"),
        type=word(spec, "type"),
        ports=frozenset(number(port, "port") for port in ports),
        allowed=allowed_from(obj),
    )


def policy(obj: Json) -> ProxyPolicy | None:
    """A NetworkPolicy; None if the object is not one that this operator made."""
    meta = part(obj, "metadata")
    labels, owner = words(meta, "labels"), _owner(meta)
    rosproxy = Name(word(meta, "namespace"), labels.get(names.PROXY_OF, ""))
    id = name_of(meta)
    if not names.is_own(labels) or not owner:
        return None
    if id not in (names.policy_id(rosproxy), names.pods_policy_id(rosproxy)):
        return None
    return ProxyPolicy(id, rosproxy, owner, word(meta, "uid"), part(obj, "spec"), is_deleted(meta))


def allowed_from(service: Json) -> frozenset[str]:
    """The namespaces whose RosProxies may name a Service as their master; ``*`` for all."""
    text = word(part(service, "metadata", "annotations"), names.ALLOW_FROM)
    namespaces = (namespace.strip() for namespace in text.split(","))
    return frozenset(n for n in namespaces if n == "*" or is_label(n))


def name_of(metadata: Json) -> Name:
    """An object's namespace and name."""
    return Name(word(metadata, "namespace"), word(metadata, "name"))


def is_deleted(metadata: Json) -> bool:
    """Whether an object is about to go."""
    return metadata.get("deletionTimestamp") is not None


def _is_ready(status: Json) -> bool:
    conditions = parts(status, "conditions")
    return any(c.get("type") == "Ready" and c.get("status") == "True" for c in conditions)


def _container(obj: Json) -> PodContainer:
    """What a container's own variables and its image say of ROS 2."""
    variables = {
        name: ELSEWHERE if variable.get("valueFrom") is not None else word(variable, "value")
        for variable in parts(obj, "env")
        if (name := word(variable, "name")) in ROS2_VARIABLES
    }
    return PodContainer(word(obj, "image"), variables)


def _host_ports(spec: Json, protocol: str) -> Iterator[int]:
    """Those of containers that run all the time, as the scheduler counts them.

    That is ``GetHostPorts`` in k8s.io/kubernetes, pkg/scheduler/util/utils.go.
    """
    inits = parts(spec, "initContainers")
    sidecars = (c for c in inits if c.get("restartPolicy") == "Always")
    for container in (*parts(spec, "containers"), *sidecars):
        for port in parts(container, "ports"):
            if port.get("protocol", "TCP") == protocol and (taken := number(port, "hostPort")):
                yield taken


def _masters(spec: Json) -> Iterator[str]:
    for container in (*parts(spec, "initContainers"), *parts(spec, "containers")):
        for variable in parts(container, "env"):
            if variable.get("name") == VARIABLE:
                value = word(variable, "value")
                is_indirect = variable.get("valueFrom") is not None or "$(" in value
                yield ELSEWHERE if is_indirect else value


def _controller(meta: Json) -> str:
    """The kind of the controller that made an object; empty if none did."""
    owners = parts(meta, "ownerReferences")
    return next((word(owner, "kind") for owner in owners if owner.get("controller") is True), "")


def _owner(meta: Json) -> str:
    """The uid of the RosProxy that owns an object, empty if none does."""
    for owner in parts(meta, "ownerReferences"):
        group = word(owner, "apiVersion").partition("/")[0]
        if group == names.GROUP and owner.get("kind") == names.KIND and owner.get("controller"):
            return word(owner, "uid")
    return ""
