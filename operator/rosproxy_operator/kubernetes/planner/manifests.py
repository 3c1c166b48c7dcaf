"""What the operator creates in a cluster, as the API server takes it."""

import copy
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.allocation import overlap
from rosproxy_operator.kubernetes.planner.settings import ClusterSettings
from rosproxy_operator.kubernetes.resources.model import ClusterNode, Json, RosProxy
from rosproxy_operator.kubernetes.resources.names import (
    ADMIN_PORT,
    ADVERTISE_HOST,
    API_VERSION,
    CONTAINER,
    FINGERPRINT,
    KIND,
    MASTER_PORT,
    NODE,
    PORT_RANGE,
    TOKEN_VARIABLE,
    own_labels,
    proxy_name,
    service_name,
)

USER = 10001
"""The image's own user."""
STOPS_WITHIN = 5
"""Seconds that a proxy has to end before it is killed, `_LINGERS` included."""
_LINGERS = 2
"""Seconds for which a proxy goes on after its deletion.

The garbage collector deletes the proxies of a RosProxy that is gone before the operator knows:
this is the time to tell them that nobody takes over.
"""
_TAINTS = (
    ("not-ready", "NoExecute"),
    ("unreachable", "NoExecute"),
    ("disk-pressure", "NoSchedule"),
    ("memory-pressure", "NoSchedule"),
    ("pid-pressure", "NoSchedule"),
    ("unschedulable", "NoSchedule"),
)
"""What pods of DaemonSets tolerate."""
_LOCAL_PORTS = (PortRange(1024, 11000), PortRange(32768, 60999), PortRange(12000, 30000))
"""Where a proxy's outgoing connections may start: never on a port that it is to listen on."""


@dataclass(frozen=True, slots=True)
class Upstream:
    """The real master as a proxy is told it. ``address`` is empty if its name is to be resolved."""

    uri: str
    address: str = ""


@dataclass(frozen=True, slots=True)
class Site:
    """A proxy on a node. ``publish`` is the port for a master in the cluster, 0 for none."""

    rosproxy: RosProxy
    node: ClusterNode
    advertise_host: str
    ports: PortRange
    upstream: Upstream
    publish: int = 0


def image_of(rosproxy: RosProxy, settings: ClusterSettings) -> str:
    """The image of a RosProxy's proxies."""
    return rosproxy.spec.image or settings.image


def proxy_pod(site: Site, settings: ClusterSettings) -> Json:
    """A proxy's pod. Its token is empty: see `with_token`."""
    of = site.rosproxy
    metadata: dict[str, Any] = {
        "name": proxy_name(of.id.name, site.node.name),
        "namespace": of.id.namespace,
        "labels": own_labels(of.id.name),
        "annotations": {
            NODE: site.node.name,
            PORT_RANGE: str(site.ports),
            ADVERTISE_HOST: site.advertise_host,
        },
        "ownerReferences": [_owner(of)],
    }
    body = {"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": _spec(site, settings)}
    metadata["annotations"][FINGERPRINT] = f"{fingerprint(body)}-{_known_as(site)}"
    return body


def _known_as(site: Site) -> str:
    return hashlib.sha256(f"{site.upstream.uri} {site.advertise_host}".encode()).hexdigest()[:8]


def service(rosproxy: RosProxy, cluster_ip: str = "") -> Json:
    """A RosProxy's Service, under one address the proxy on each pod's own node."""
    labels = own_labels(rosproxy.id.name)
    metadata: dict[str, Any] = {
        "name": service_name(rosproxy.id.name),
        "namespace": rosproxy.id.namespace,
        "labels": labels,
        "annotations": {},
        "ownerReferences": [_owner(rosproxy)],
    }
    spec: dict[str, Any] = {
        "type": "ClusterIP",
        "selector": labels,
        "internalTrafficPolicy": "Local",
        # A proxy that does not reach its master must still be there to say so.
        "publishNotReadyAddresses": True,
        "ports": [
            {"name": "master", "port": MASTER_PORT, "targetPort": MASTER_PORT, "protocol": "TCP"}
        ],
    }
    body = {"apiVersion": "v1", "kind": "Service", "metadata": metadata, "spec": spec}
    metadata["annotations"][FINGERPRINT] = fingerprint(body)
    if cluster_ip:
        spec["clusterIP"] = cluster_ip
    return body


def fingerprint(body: Json) -> str:
    """What an object is made of, in 16 hex digits, but for the image, which can be exchanged."""
    bare = copy.deepcopy(dict(body))
    for container in bare["spec"].get("containers", ()):
        container["image"] = ""
    return hashlib.sha256(json.dumps(bare, sort_keys=True).encode()).hexdigest()[:16]


def finds_again(old: str, new: str) -> bool:
    """Whether a proxy finds at its master the nodes of another one, by their fingerprints.

    It does if both have the same master and the same advertised host.
    """
    return old.partition("-")[2] in ("", new.partition("-")[2])


def fingerprint_of(body: Json) -> str:
    """The fingerprint that is written on an object."""
    return str(body["metadata"]["annotations"][FINGERPRINT])


def with_token(body: Json, token: str) -> Json:
    """A proxy's pod with the token that its admin endpoint asks for."""
    whole: dict[str, Any] = copy.deepcopy(dict(body))
    for variable in whole["spec"]["containers"][0]["env"]:
        if variable["name"] == TOKEN_VARIABLE:
            variable["value"] = token
    return whole


def without_cluster_ip(body: Json) -> Json:
    """A Service that takes any address, where the one that it had is somebody else's now."""
    spec = {key: value for key, value in body["spec"].items() if key != "clusterIP"}
    return {**body, "spec": spec}


def _owner(rosproxy: RosProxy) -> dict[str, Any]:
    return {
        "apiVersion": API_VERSION,
        "kind": KIND,
        "name": rosproxy.id.name,
        "uid": rosproxy.uid,
        "controller": True,
    }


def _spec(site: Site, settings: ClusterSettings) -> dict[str, Any]:
    spec = site.rosproxy.spec
    more = {"imagePullSecrets": spec.image_pull_secrets, "hostAliases": spec.host_aliases}
    return {
        "affinity": _on(site.node.name),
        "tolerations": [*_tolerations(), *map(dict, spec.tolerations)],
        "restartPolicy": "Always",
        "terminationGracePeriodSeconds": STOPS_WITHIN,
        "automountServiceAccountToken": False,
        # Services called rosproxy-… would otherwise set variables that are the proxy's options.
        "enableServiceLinks": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": USER,
            "runAsGroup": USER,
            "seccompProfile": {"type": "RuntimeDefault"},
            "sysctls": [{"name": "net.ipv4.ip_local_port_range", "value": _local_ports(site)}],
        },
        "containers": [_container(site, settings)],
        **{key: [dict(one) for one in value] for key, value in more.items() if value},
    }


def _on(node: str) -> dict[str, Any]:
    """Bound to a node, but through the scheduler, as a DaemonSet's pods: it checks the ports."""
    field = {"key": "metadata.name", "operator": "In", "values": [node]}
    terms = {"nodeSelectorTerms": [{"matchFields": [field]}]}
    return {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": terms}}


def _tolerations() -> Iterable[dict[str, str]]:
    for taint, effect in _TAINTS:
        yield {"key": f"node.kubernetes.io/{taint}", "operator": "Exists", "effect": effect}


def _local_ports(site: Site) -> str:
    fixed = [PortRange(port, port) for port in (MASTER_PORT, ADMIN_PORT, site.publish) if port]
    listening = [site.ports, *fixed]
    free = (one for one in _LOCAL_PORTS if not any(overlap(one, other) for other in listening))
    ports = next(free, _LOCAL_PORTS[0])
    return f"{ports.first} {ports.last}"


def _container(site: Site, settings: ClusterSettings) -> dict[str, Any]:
    spec = site.rosproxy.spec
    policy = spec.image_pull_policy or settings.image_pull_policy
    return {
        "name": CONTAINER,
        "image": image_of(site.rosproxy, settings),
        **({"imagePullPolicy": policy} if policy else {}),
        "env": [{"name": name, "value": value} for name, value in _environment(site).items()],
        "ports": [
            {"containerPort": port, "hostPort": port, "protocol": "TCP"}
            for port in (*site.ports.ports(), *((site.publish,) if site.publish else ()))
        ],
        "resources": dict(spec.resources),
        "livenessProbe": _probe("/healthz", 10),
        "readinessProbe": _probe("/readyz", 2),
        "lifecycle": {"preStop": {"exec": {"command": ["sleep", str(_LINGERS)]}}},
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": _rights(spec.data_plane == "kernel"),
    }


def _rights(forwarding: bool) -> dict[str, Any]:
    """What a proxy may do; ``forwarding`` is by rules that it makes in the kernel.

    The programs for that have the capability from their files: Kubernetes calls it escalation.
    """
    add = {"add": ["NET_ADMIN"]} if forwarding else {}
    return {
        "allowPrivilegeEscalation": forwarding,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"], **add},
    }


def _environment(site: Site) -> Mapping[str, str]:
    spec = site.rosproxy.spec
    variables = {
        "ROS_MASTER_URI": site.upstream.uri,
        "ROSPROXY_MASTER_ADDRESS": site.upstream.address,
        "ROSPROXY_ADVERTISE_HOST": site.advertise_host,
        "ROSPROXY_PORT_RANGE": str(site.ports),
        "ROSPROXY_MASTER_PORT": str(MASTER_PORT),
        "ROSPROXY_PUBLISH_MASTER": str(site.publish or ""),
        "ROSPROXY_ADMIN_BIND": f"0.0.0.0:{ADMIN_PORT}",
        "ROSPROXY_INSIDE_NETWORKS": " ".join(site.node.pod_networks),
        "ROSPROXY_CLEANUP_AFTER": f"{spec.cleanup_after:g}",
        "ROSPROXY_SLAVE_CONTROL": spec.slave_control,
        "ROSPROXY_DATA_PLANE": "" if spec.data_plane == "auto" else spec.data_plane,
    }
    return {name: value for name, value in variables.items() if value} | {TOKEN_VARIABLE: ""}


def _probe(path: str, period: int) -> dict[str, Any]:
    return {
        "httpGet": {"path": path, "port": ADMIN_PORT},
        "periodSeconds": period,
        "timeoutSeconds": 3,
    }
