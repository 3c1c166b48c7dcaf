"""Objects of the API server, read: what the planner wants to know of nodes, pods and Services.

The API server has checked their types; what is missing is as if it were empty.
"""

from collections.abc import Iterable, Iterator

from rosproxy.leases.ports import PortRange
from rosproxy.settings import SettingError, parse_range
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.api_objects import (
    Metadata,
    NodeObject,
    ObjectCondition,
    PodObject,
    PodSpec,
    ServiceObject,
)
from rosproxy_operator.kubernetes.resources.fields import lenient
from rosproxy_operator.kubernetes.resources.model import (
    ELSEWHERE,
    ClusterNode,
    Json,
    Name,
    Pod,
    ProxyPod,
    ProxyService,
)
from rosproxy_operator.kubernetes.resources.pod_failures import stuck

VARIABLE = "ROS_MASTER_URI"


def node(obj: Json) -> ClusterNode:
    """A node."""
    found = lenient(obj, NodeObject)
    meta, spec, status = found.metadata, found.spec, found.status
    return ClusterNode(
        name=meta.name,
        labels=meta.labels,
        addresses={one.type: one.address for one in reversed(status.addresses)},
        advertise_host=meta.annotations.get(names.ADVERTISE_HOST, "").strip(),
        pod_networks=tuple(filter(None, spec.pod_cidrs or (spec.pod_cidr,))),
        ready=_is_ready(status.conditions),
        cordoned=spec.unschedulable,
        deleting=meta.deleting,
    )


def pod(obj: Json, namespace: str = "") -> Pod:
    """A pod. ``namespace`` is used where the object has none, as at admission."""
    return _pod(lenient(obj, PodObject), namespace)


def _pod(found: PodObject, namespace: str = "") -> Pod:
    meta, spec, status = found.metadata, found.spec, found.status
    wired = meta.annotations.get(names.MASTER_URI, "")
    return Pod(
        id=Name(meta.namespace or namespace, meta.name),
        uid=meta.uid,
        labels=meta.labels,
        node=spec.node_name,
        phase=status.phase or "Pending",
        ip=status.pod_ip,
        host_ports=frozenset(_host_ports(spec)),
        host_network=spec.host_network,
        deleting=meta.deleting,
        own_masters=tuple(uri for uri in _masters(spec) if not wired or uri != wired),
        wired=wired,
    )


def proxy_pod(obj: Json) -> ProxyPod | None:
    """A proxy's pod; None if the object is not one that this operator made, or not whole."""
    found = lenient(obj, PodObject)
    meta, notes = found.metadata, found.metadata.annotations
    container = next((one for one in found.spec.containers if one.name == names.CONTAINER), None)
    ports = _range(notes.get(names.PORT_RANGE, ""))
    on, owner = notes.get(names.NODE, ""), _owner(meta)
    if not names.is_own(meta.labels) or ports is None or not (on and owner and container):
        return None
    reason, message = stuck(found.status)
    tokens = (one.value for one in container.env if one.name == names.TOKEN_VARIABLE)
    return ProxyPod(
        pod=_pod(found),
        of=Name(meta.namespace, meta.labels[names.PROXY_OF]),
        owner=owner,
        on=on,
        range=ports,
        fingerprint=notes.get(names.FINGERPRINT, ""),
        image=container.image,
        token=next(tokens, ""),
        ready=_is_ready(found.status.conditions),
        stuck=reason,
        message=message,
        restarts=sum(one.restart_count for one in found.status.container_statuses),
    )


def service(obj: Json) -> ProxyService | None:
    """A Service; None if the object is not one that this operator made."""
    found = lenient(obj, ServiceObject)
    meta, owner = found.metadata, _owner(found.metadata)
    if not names.is_own(meta.labels) or not owner:
        return None
    of = Name(meta.namespace, meta.labels[names.PROXY_OF])
    if names.service_id(of) != Name(of.namespace, meta.name):
        return None
    return ProxyService(
        of=of,
        owner=owner,
        uid=meta.uid,
        cluster_ip="" if found.spec.cluster_ip == "None" else found.spec.cluster_ip,
        fingerprint=meta.annotations.get(names.FINGERPRINT, ""),
        deleting=meta.deleting,
    )


def _is_ready(conditions: Iterable[ObjectCondition]) -> bool:
    return any(one.type == "Ready" and one.status == "True" for one in conditions)


def _host_ports(spec: PodSpec) -> Iterator[int]:
    """Those of containers that run all the time, as the scheduler counts them.

    That is ``GetHostPorts`` in k8s.io/kubernetes, pkg/scheduler/util/utils.go.
    """
    lasting = (one for one in spec.init_containers if one.restart_policy == "Always")
    for container in (*spec.containers, *lasting):
        for port in container.ports:
            if port.protocol == "TCP" and port.host_port:
                yield port.host_port


def _masters(spec: PodSpec) -> Iterator[str]:
    for container in (*spec.init_containers, *spec.containers):
        for variable in container.env:
            if variable.name == VARIABLE:
                later = variable.value_from is not None or "$(" in variable.value
                yield ELSEWHERE if later else variable.value


def _owner(meta: Metadata) -> str:
    """The uid of the RosProxy that owns an object, empty if none does."""
    for owner in meta.owner_references:
        group = owner.api_version.partition("/")[0]
        if group == names.GROUP and owner.kind == names.KIND and owner.controller:
            return owner.uid
    return ""


def _range(text: str) -> PortRange | None:
    try:
        return parse_range(names.PORT_RANGE, text)
    except SettingError:
        return None
