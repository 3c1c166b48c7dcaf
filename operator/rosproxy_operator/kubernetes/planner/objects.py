"""Objects of the API server, read: nodes, pods, Services.

The API server has checked their types; what is missing is as if it were empty.
"""

from collections.abc import Iterator

from rosproxy.leases.ports import PortRange
from rosproxy.settings import SettingError, parse_range
from rosproxy_operator.kubernetes.planner import names
from rosproxy_operator.kubernetes.planner.model import (
    ELSEWHERE,
    ClusterNode,
    Json,
    Name,
    Pod,
    ProxyPod,
    ProxyService,
)
from rosproxy_operator.kubernetes.planner.pod_failures import stuck
from rosproxy_operator.kubernetes.planner.values import number, part, parts, word, words

VARIABLE = "ROS_MASTER_URI"


def node(obj: Json) -> ClusterNode:
    """A node."""
    meta, spec, status = part(obj, "metadata"), part(obj, "spec"), part(obj, "status")
    addresses: dict[str, str] = {}
    for one in parts(status, "addresses"):
        addresses.setdefault(word(one, "type"), word(one, "address"))
    networks = spec.get("podCIDRs") or [spec.get("podCIDR")]
    return ClusterNode(
        name=word(meta, "name"),
        labels=words(meta, "labels"),
        addresses=addresses,
        advertise_host=words(meta, "annotations").get(names.ADVERTISE_HOST, "").strip(),
        pod_networks=tuple(one for one in networks if one),
        ready=condition(obj, "Ready").get("status") == "True",
        cordoned=spec.get("unschedulable") is True,
        deleting="deletionTimestamp" in meta,
    )


def pod(obj: Json, namespace: str = "") -> Pod:
    """A pod. ``namespace`` is used where the object has none, as at admission.

    There it may have no name, uid, node and address either.
    """
    meta, spec, status = part(obj, "metadata"), part(obj, "spec"), part(obj, "status")
    wired = words(meta, "annotations").get(names.MASTER_URI, "")
    host_network = spec.get("hostNetwork") is True
    return Pod(
        id=Name(word(meta, "namespace") or namespace, word(meta, "name")),
        uid=word(meta, "uid"),
        labels=words(meta, "labels"),
        node=word(spec, "nodeName"),
        phase=word(status, "phase") or "Pending",
        ip=word(status, "podIP"),
        host_ports=frozenset(_host_ports(spec)),
        host_network=host_network,
        deleting="deletionTimestamp" in meta,
        own_masters=tuple(uri for uri in _masters(spec) if not wired or uri != wired),
        wired=wired,
    )


def proxy_pod(obj: Json) -> ProxyPod | None:
    """A proxy's pod; None if the object is not one that this controller made, or not whole."""
    found, notes = pod(obj), words(obj, "metadata", "annotations")
    container = _container(part(obj, "spec"))
    ports = _range(notes.get(names.PORT_RANGE, ""))
    on, owner = notes.get(names.NODE, ""), _owner(obj)
    if not names.is_own(found.labels) or ports is None or not (on and owner and container):
        return None
    reason, message = stuck(obj)
    return ProxyPod(
        pod=found,
        of=Name(found.id.namespace, found.labels[names.PROXY_OF]),
        owner=owner,
        on=on,
        range=ports,
        fingerprint=notes.get(names.FINGERPRINT, ""),
        image=word(container, "image"),
        token=_variable(container, names.TOKEN_VARIABLE),
        ready=condition(obj, "Ready").get("status") == "True",
        stuck=reason,
        message=message,
        restarts=sum(
            number(one, "restartCount") for one in parts(part(obj, "status"), "containerStatuses")
        ),
    )


def service(obj: Json) -> ProxyService | None:
    """A Service; None if the object is not one that this controller made."""
    meta = part(obj, "metadata")
    labels, owner = words(meta, "labels"), _owner(obj)
    if not names.is_own(labels) or not owner:
        return None
    of = Name(word(meta, "namespace"), labels[names.PROXY_OF])
    if names.service_id(of) != Name(of.namespace, word(meta, "name")):
        return None
    address = word(part(obj, "spec"), "clusterIP")
    return ProxyService(
        of=of,
        owner=owner,
        uid=word(meta, "uid"),
        cluster_ip="" if address == "None" else address,
        fingerprint=words(meta, "annotations").get(names.FINGERPRINT, ""),
        deleting="deletionTimestamp" in meta,
    )


def condition(obj: Json, type: str) -> Json:
    """One of the conditions in an object's status, empty if it is not there."""
    found = (one for one in parts(part(obj, "status"), "conditions") if one.get("type") == type)
    return next(found, {})


def _host_ports(spec: Json) -> Iterator[int]:
    """Those of containers that run all the time, as the scheduler counts them.

    That is ``GetHostPorts`` in k8s.io/kubernetes, pkg/scheduler/util/utils.go.
    """
    lasting = (one for one in parts(spec, "initContainers") if one.get("restartPolicy") == "Always")
    for container in (*parts(spec, "containers"), *lasting):
        for port in parts(container, "ports"):
            if port.get("protocol", "TCP") == "TCP" and number(port, "hostPort"):
                yield number(port, "hostPort")


def _masters(spec: Json) -> Iterator[str]:
    for container in (*parts(spec, "initContainers"), *parts(spec, "containers")):
        for variable in parts(container, "env"):
            if word(variable, "name") == VARIABLE:
                value = word(variable, "value")
                later = "valueFrom" in variable or "$(" in value
                yield ELSEWHERE if later else value


def _container(spec: Json) -> Json:
    found = (one for one in parts(spec, "containers") if one.get("name") == names.CONTAINER)
    return next(found, {})


def _variable(container: Json, name: str) -> str:
    found = (one for one in parts(container, "env") if one.get("name") == name)
    return word(next(found, {}), "value")


def _owner(obj: Json) -> str:
    """The uid of the RosProxy that owns an object, empty if none does."""
    for owner in parts(part(obj, "metadata"), "ownerReferences"):
        group = word(owner, "apiVersion").partition("/")[0]
        if group == names.GROUP and owner.get("kind") == names.KIND and owner.get("controller"):
            return word(owner, "uid")
    return ""


def _range(text: str) -> PortRange | None:
    try:
        return parse_range(names.PORT_RANGE, text)
    except SettingError:
        return None
