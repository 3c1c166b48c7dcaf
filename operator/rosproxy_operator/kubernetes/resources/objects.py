"""Readers of nodes, pods, Services and NetworkPolicies, from the JSON of the API server.

The field names are from k8s.io/api, core/v1/types.go. The API server has checked the types. A
missing field counts as empty.
"""

from collections.abc import Iterator
from itertools import islice
from typing import Any

from rosproxy_operator.common import ros2_variables
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.common.zenoh import OVERRIDE
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.checks import (
    int_at,
    is_label,
    port_range,
    submap,
    submaps,
    text_at,
    texts_at,
)
from rosproxy_operator.kubernetes.resources.cluster import (
    SERVICE_IDS,
    HelperPod,
    MasterService,
    ProxyPod,
    ProxyPolicy,
    ProxyService,
)
from rosproxy_operator.kubernetes.resources.misspelt_names import misspelt_names
from rosproxy_operator.kubernetes.resources.model import (
    REFERENCE,
    VALUE_AT_RUNTIME,
    ClusterNode,
    Json,
    Name,
    Pod,
    PodContainer,
)
from rosproxy_operator.kubernetes.resources.pod_failures import pod_failure

MASTER_VARIABLE = "ROS_MASTER_URI"
ROS_VARIABLE = "ROSPROXY_ROS"
"""Variable of a proxy with the versions of ROS that the proxy serves."""
ROS2_VARIABLES = ros2_variables.ROS2_VARIABLES | {"ROS_DISTRO", OVERRIDE}
"""Variables from which the operator tells what does not work with ROS 2 in a pod."""
_WHOLE = (OVERRIDE, "CYCLONEDDS_URI")
MOST_LABELS = 128
"""Labels that are kept of a pod, first the labels of rosproxy.io.

The operator keeps all pods of the cluster in memory, and a pod may have a megabyte of labels.
"""
_TEMPLATE_HASH = "pod-template-hash"
_RESTARTABLE_KINDS = ("StatefulSet", "DaemonSet")
"""Kinds of pods' controllers that `kubectl rollout restart` takes directly."""
MOST_CONTAINERS = 64
"""Containers that are kept of a pod, and as many values of ROS_MASTER_URI, to bound the memory."""
MOST_TEXT_CHARACTERS = 2048
"""Characters that are kept of a variable, an annotation or an image. No usable URI is longer."""
_MOST_LIST_CHARACTERS = 16 * 1024
"""Characters that are read of the annotation `names.ALLOW_FROM`."""


def node(obj: Json) -> ClusterNode:
    """Return a node of the cluster."""
    meta = submap(obj, "metadata")
    spec = submap(obj, "spec")
    status = submap(obj, "status")
    networks = spec.get("podCIDRs") or (text_at(spec, "podCIDR"),)
    # In reverse, so that the first address of each type stays in the map.
    addresses = reversed(submaps(status, "addresses"))
    return ClusterNode(
        name=text_at(meta, "name"),
        labels=texts_at(meta, "labels"),
        addresses={text_at(address, "type"): text_at(address, "address") for address in addresses},
        advertise_host=text_at(submap(meta, "annotations"), names.ADVERTISE_HOST).strip(),
        pod_networks=tuple(network for network in networks if network and isinstance(network, str)),
        ready=_is_ready(status),
        deleting=is_deleted(meta),
        misspelt=misspelt_names(meta, "nodes"),
    )


def pod(obj: Json) -> Pod:
    """Return a pod. At admission, a pod may lack name, uid, node and address."""
    meta = submap(obj, "metadata")
    spec = submap(obj, "spec")
    status = submap(obj, "status")
    notes = texts_at(meta, "annotations")
    wired = _short(notes.get(names.MASTER_URI, ""))
    masters = islice(map(_short, _masters(spec)), MOST_CONTAINERS)
    return Pod(
        id=name_of(meta),
        uid=text_at(meta, "uid"),
        labels=_kept_labels(meta),
        node=text_at(spec, "nodeName"),
        phase=text_at(status, "phase") or "Pending",
        ip=text_at(status, "podIP"),
        host_ports=frozenset(_host_ports(spec, "TCP")),
        udp_ports=frozenset(_host_ports(spec, "UDP")),
        host_network=spec.get("hostNetwork") is True,
        deleting=is_deleted(meta),
        own_masters=tuple(uri for uri in masters if not wired or uri != wired),
        wired_master_uri=wired,
        replaced_master_uri=_short(notes.get(names.REPLACED_URI, "")),
        static_peers=_short(notes.get(names.STATIC_PEERS, "")),
        wired_domain=_short(notes.get(names.DOMAIN, "")),
        router_endpoint=_short(notes.get(names.ROUTER_ENDPOINT, "")),
        not_wired_because=_short(notes.get(names.NOT_WIRED_BECAUSE, "")),
        labelled_later=_is_labelled_later(meta),
        containers=tuple(map(_container, submaps(spec, "containers")[:MOST_CONTAINERS])),
        ips=tuple(filter(None, (text_at(pod_ip, "ip") for pod_ip in submaps(status, "podIPs")))),
        controller=text_at(_controller(meta), "kind"),
        workload=_workload(meta),
        created=text_at(meta, "creationTimestamp"),
        running_since=_running_since(obj),
        misspelt=misspelt_names(meta, "pods"),
    )


def proxy_pod(obj: Json) -> ProxyPod | None:
    """Return a proxy's pod. None: the pod is not a proxy's, or lacks a required part."""
    containers = submaps(submap(obj, "spec"), "containers")
    container = next((c for c in containers if c.get("name") == names.CONTAINER), None)
    ports = port_range(texts_at(obj, "metadata", "annotations"), names.PORT_RANGE)
    if container is None or ports is None or _component(obj) != names.PROXY:
        return None
    variables = {text_at(v, "name"): text_at(v, "value") for v in submaps(container, "env")}
    statuses = submaps(submap(obj, "status"), "containerStatuses")
    return ProxyPod(
        **_own_pod(obj, container),
        range=ports,
        token=variables.get(names.TOKEN_VARIABLE, ""),
        restarts=sum(int_at(c, "restartCount") for c in statuses),
        runs=any(submap(c, "state").get("running") for c in statuses),
        of_zenoh=variables.get(ROS_VARIABLE) == "zenoh",
    )


def helper_pod(obj: Json) -> HelperPod | None:
    """Return a LAN relay or an image check. None: another pod, or a required part is missing."""
    container = next(iter(submaps(submap(obj, "spec"), "containers")), {})
    component = _component(obj)
    if component in ("", names.PROXY):
        return None
    return HelperPod(**_own_pod(obj, container), component=component)


def _component(obj: Json) -> str:
    """Return the component of a pod (`names.component`).

    Empty: the pod is not the operator's, or lacks the annotation `names.NODE` or the owner.
    """
    meta = submap(obj, "metadata")
    is_whole = texts_at(meta, "annotations").get(names.NODE) and _owner(meta)
    return names.component(texts_at(meta, "labels")) if is_whole else ""


def _own_pod(obj: Json, container: Json) -> dict[str, Any]:
    """Return the fields of `OwnPod`."""
    meta = submap(obj, "metadata")
    status = submap(obj, "status")
    notes = texts_at(meta, "annotations")
    reason, message = pod_failure(status)
    return {
        "pod": pod(obj),
        "of": Name(text_at(meta, "namespace"), texts_at(meta, "labels")[names.PROXY_OF]),
        "owner": _owner(meta),
        "node": notes[names.NODE],
        "fingerprint": notes.get(names.FINGERPRINT, ""),
        "image": text_at(container, "image"),
        "ready": _is_ready(status),
        "stuck": reason,
        "message": message,
    }


def service(obj: Json) -> ProxyService | None:
    """Return a Service of the operator, None for another Service."""
    meta = submap(obj, "metadata")
    spec = submap(obj, "spec")
    address = text_at(spec, "clusterIP")
    labels = texts_at(meta, "labels")
    owner = _owner(meta)
    rosproxy = Name(text_at(meta, "namespace"), labels.get(names.PROXY_OF, ""))
    roles = (role for role, id_of in SERVICE_IDS.items() if id_of(rosproxy) == name_of(meta))
    role = next(roles, None)
    if not names.is_own(labels) or not owner or role is None:
        return None
    balancers = submaps(submap(obj, "status", "loadBalancer"), "ingress")
    hosts = (text_at(balancer, "ip") or text_at(balancer, "hostname") for balancer in balancers)
    return ProxyService(
        of=rosproxy,
        owner=owner,
        uid=text_at(meta, "uid"),
        cluster_ip="" if address == "None" else address,
        fingerprint=text_at(submap(meta, "annotations"), names.FINGERPRINT),
        deleting=is_deleted(meta),
        role=role,
        node_port=next((int_at(port, "nodePort") for port in submaps(spec, "ports")), 0),
        created=text_at(meta, "creationTimestamp"),
        balancer=next(filter(None, hosts), ""),
    )


def master_service(obj: Json) -> MasterService:
    """Return a Service that may be the Service of a master."""
    spec = submap(obj, "spec")
    ports = submaps(submap(obj, "spec"), "ports")
    return MasterService(
        id=name_of(submap(obj, "metadata")),
        address=text_at(spec, "clusterIP"),
        type=text_at(spec, "type"),
        ports=frozenset(int_at(port, "port") for port in ports),
        allowed=allowed_from(obj),
        misspelt=misspelt_names(submap(obj, "metadata"), "Services of masters"),
    )


def policy(obj: Json) -> ProxyPolicy | None:
    """Return a NetworkPolicy of the operator, None for another NetworkPolicy."""
    meta = submap(obj, "metadata")
    labels = texts_at(meta, "labels")
    owner = _owner(meta)
    rosproxy = Name(text_at(meta, "namespace"), labels.get(names.PROXY_OF, ""))
    id = name_of(meta)
    if not names.is_own(labels) or not owner:
        return None
    if id not in (names.policy_id(rosproxy), names.pods_policy_id(rosproxy)):
        return None
    return ProxyPolicy(
        id, rosproxy, owner, text_at(meta, "uid"), submap(obj, "spec"), is_deleted(meta)
    )


def allowed_from(service: Json) -> frozenset[str]:
    """Return the other namespaces whose RosProxies may name a Service as master; ``*`` for all."""
    text = text_at(submap(service, "metadata", "annotations"), names.ALLOW_FROM)[
        :_MOST_LIST_CHARACTERS
    ]
    namespaces = (namespace.strip() for namespace in text.split(","))
    return frozenset(n for n in namespaces if n == "*" or is_label(n))


def name_of(metadata: Json) -> Name:
    """Return an object's namespace and name."""
    return Name(text_at(metadata, "namespace"), text_at(metadata, "name"))


def is_deleted(metadata: Json) -> bool:
    """Whether an object is being deleted."""
    return metadata.get("deletionTimestamp") is not None


def _is_ready(status: Json) -> bool:
    conditions = submaps(status, "conditions")
    return any(c.get("type") == "Ready" and c.get("status") == "True" for c in conditions)


def _container(obj: Json) -> PodContainer:
    """Return a container: the image, and the ROS 2 variables that the container itself sets."""
    variables = {name: _short(value) for name, value in variables_of(obj).items()}
    return PodContainer(_short(text_at(obj, "image")), variables)


def variables_of(container: Json) -> dict[str, str]:
    """Return the ROS 2 variables that a container itself sets, with values of any length."""
    return {
        name: _value_of(variable)
        for variable in submaps(container, "env")
        if (name := text_at(variable, "name")) in ROS2_VARIABLES
    }


def _value_of(variable: Json) -> str:
    """Return the value of a variable, or `VALUE_AT_RUNTIME`.

    The callers decide about references in the values of `_WHOLE`.
    """
    value = text_at(variable, "value")
    is_reference = REFERENCE in value and variable.get("name") not in _WHOLE
    return VALUE_AT_RUNTIME if is_reference or variable.get("valueFrom") is not None else value


def _kept_labels(meta: Json) -> dict[str, str]:
    labels = texts_at(meta, "labels")
    if len(labels) <= MOST_LABELS:
        return labels
    own_first = sorted(labels, key=lambda name: (not name.startswith(f"{names.GROUP}/"), name))
    return {name: labels[name] for name in own_first[:MOST_LABELS]}


def _short(text: str) -> str:
    return bounded(text, MOST_TEXT_CHARACTERS)


def _host_ports(spec: Json, protocol: str) -> Iterator[int]:
    """Yield the hostPorts of containers and sidecars, as the scheduler counts hostPorts.

    Source: ``GetHostPorts`` in k8s.io/kubernetes, pkg/scheduler/util/utils.go.
    """
    inits = submaps(spec, "initContainers")
    sidecars = (c for c in inits if c.get("restartPolicy") == "Always")
    for container in (*submaps(spec, "containers"), *sidecars):
        for port in submaps(container, "ports"):
            if port.get("protocol", "TCP") == protocol and (taken := int_at(port, "hostPort")):
                yield taken


def _masters(spec: Json) -> Iterator[str]:
    for container in (*submaps(spec, "initContainers"), *submaps(spec, "containers")):
        for variable in submaps(container, "env"):
            if variable.get("name") == MASTER_VARIABLE:
                value = text_at(variable, "value")
                is_indirect = variable.get("valueFrom") is not None or "$(" in value
                yield VALUE_AT_RUNTIME if is_indirect else value


def _running_since(obj: Json) -> str:
    """Return the earliest start of a running container with a ROS_MASTER_URI; empty for none.

    A container that has restarted has new ROS nodes, also in an old pod. A container that does not
    run has no ROS nodes.
    """
    spec = submap(obj, "spec")
    status = submap(obj, "status")
    ours = {
        text_at(container, "name")
        for kind in ("initContainers", "containers")
        for container in submaps(spec, kind)
        for variable in submaps(container, "env")
        if variable.get("name") == MASTER_VARIABLE and text_at(variable, "value")
    }
    starts = (
        text_at(submap(container, "state", "running"), "startedAt")
        for kind in ("initContainerStatuses", "containerStatuses")
        for container in submaps(status, kind)
        if text_at(container, "name") in ours
    )
    return min(filter(None, starts), default="")


def _controller(meta: Json) -> Json:
    """Return the owner reference of an object's controller, empty without a controller."""
    owners = submaps(meta, "ownerReferences")
    return next((owner for owner in owners if owner.get("controller") is True), {})


def _is_labelled_later(meta: Json) -> bool:
    """Whether a pod got the label of the webhook after the creation.

    The creator of a pod has set fields of the spec. False without ``managedFields``.
    """
    owned = [submap(entry, "fieldsV1") for entry in submaps(meta, "managedFields")]
    label = f"f:{names.INJECT}"
    setters = [fields for fields in owned if label in submap(fields, "f:metadata", "f:labels")]
    return bool(setters) and not any("f:spec" in fields for fields in setters)


def _workload(meta: Json) -> str:
    """Return the object that has the template of a pod, empty for none.

    A Deployment names each ReplicaSet NAME-HASH. The pods of the ReplicaSet have the hash as label.
    """
    controller = _controller(meta)
    kind = text_at(controller, "kind")
    name = _short(text_at(controller, "name"))
    if kind in (*_RESTARTABLE_KINDS, "Job"):
        return f"{kind.lower()}/{name}"
    suffix = f"-{texts_at(meta, 'labels').get(_TEMPLATE_HASH, '')}"
    is_of_deployment = kind == "ReplicaSet" and len(suffix) > 1 and name.endswith(suffix)
    return f"deployment/{name.removesuffix(suffix)}" if is_of_deployment else ""


def _owner(meta: Json) -> str:
    """Return the uid of the RosProxy that owns an object, empty without such an owner."""
    for owner in submaps(meta, "ownerReferences"):
        group = text_at(owner, "apiVersion").partition("/")[0]
        if group == names.GROUP and owner.get("kind") == names.KIND and owner.get("controller"):
            return text_at(owner, "uid")
    return ""
