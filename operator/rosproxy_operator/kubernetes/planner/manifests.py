"""What the operator creates in a cluster, as the API server takes it."""

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort, is_address
from rosproxy_operator.common.policy import AWAITED, as_variable
from rosproxy_operator.common.port_negotiation import overlap
from rosproxy_operator.common.ros2 import discovery_port, well_known_ports
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    Json,
    MasterSpec,
    Name,
    RosProxy,
    RosProxySpec,
)
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
    PROXY,
    own_labels,
    proxy_id,
    service_id,
)
from rosproxy_operator.kubernetes.resources.pod_defaults import USER
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.proxy_spec.environment import environment, variable
from rosproxy_operator.proxy_spec.fingerprint import LIVE_VARIABLES, digest
from rosproxy_operator.proxy_spec.spec import WISHES

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
"""What pods of DaemonSets tolerate.

``AddOrUpdateDaemonPodTolerations`` in k8s.io/kubernetes, pkg/controller/daemon/util.
"""
_LOCAL_PORTS = (PortRange(1024, 11000), PortRange(32768, 60999), PortRange(12000, 30000))
"""Where a proxy's outgoing connections may start: never on a port that it is to listen on."""


_FINGERPRINTS: dict[Name, tuple[object, str]] = {}
"""By the pod's name: what its fingerprint was last worked out from, and that fingerprint."""
_MAX_FINGERPRINTS = 8192


class ProxySite(msgspec.Struct, frozen=True):
    """A proxy on a node.

    ``master`` is the real master as the proxy is told it: with a ``uri`` even if it is a Service,
    ``address`` empty if its name is to be resolved, ``publish`` 0 where that port can't be had.
    ``peers`` are all of ROS 2: those of the RosProxy, and its proxies on other nodes.
    ``relay_secret`` is what the proxy and its LAN relay share.
    """

    rosproxy: RosProxy
    node: ClusterNode
    advertise_host: str
    ports: PortRange
    master: MasterSpec
    token_hash: str = ""
    peers: tuple[str, ...] = ()
    relay_secret: str = ""

    @property
    def own_ports(self) -> PortRange:
        """The proxy's own ports of the range: with a LAN relay the last one is the LAN relay's."""
        ports = self.ports
        return PortRange(ports.first, ports.last - 1) if self.rosproxy.spec.multicast else ports

    @property
    def lan_relay(self) -> HostPort | None:
        """Where on the node the proxy's LAN relay listens for it; None without a LAN relay."""
        lan = lan_address(self.node, self.advertise_host)
        multicast = self.rosproxy.spec.multicast and lan
        return HostPort(lan, self.ports.last) if multicast else None


def lan_address(node: ClusterNode, advertise_host: str) -> str:
    """A node's own IPv4 address on the LAN; empty if it has none.

    It is the advertised one, if that is the node's own, else its InternalIP.
    """
    ipv4 = [a for a in node.addresses.values() if is_address(a) and ":" not in a]
    internal = node.addresses.get("InternalIP", "")
    return next((a for a in (advertise_host, internal) if a in ipv4), "")


def image_of(rosproxy: RosProxy, settings: ClusterSettings) -> str:
    """The image of a RosProxy's proxies."""
    return rosproxy.spec.image or settings.image


def policy_of(rosproxy: RosProxy, settings: ClusterSettings) -> tuple[PolicyLayer, ...]:
    """The layers of a RosProxy's proxies; each further layer can only narrow."""
    return (*settings.policy, *rosproxy.spec.policy)


def proxy_pod(site: ProxySite, settings: ClusterSettings) -> Json:
    """A proxy's pod.

    The fingerprint says what the pod is made of, except its image, which can be exchanged, its
    policy and its peers; then under what its nodes know the proxy, see `keeps_registrations`.
    """
    rosproxy = site.rosproxy
    container = _container(site, settings)
    annotations = {
        NODE: site.node.name,
        PORT_RANGE: str(site.ports),
        ADVERTISE_HOST: site.advertise_host,
    }
    meta = pod_metadata(rosproxy, proxy_id(rosproxy.id, site.node.name), annotations, settings)
    # A running proxy is told new peers as well, which come and go with the nodes.
    live = {*LIVE_VARIABLES, variable("ros2_peer")}
    env = [v for v in container["env"] if v["name"] not in live]
    spec = {**_spec(site, settings), "containers": [{**container, "image": "", "env": env}]}
    body = {"apiVersion": "v1", "kind": "Pod", "metadata": meta, "spec": spec}
    ros2 = rosproxy.spec.ros2
    graph = f"{site.master.uri}{f' domain {ros2.number}' if ros2 else ''} {site.advertise_host}"
    identity = hashlib.sha256(graph.encode()).hexdigest()[:8]
    # The fingerprint is worked out without itself, and is on the pod then.
    meta["annotations"][FINGERPRINT] = f"{digest(body)}-{identity}"
    return {**body, "spec": {**spec, "containers": [container]}}


def proxy_fingerprint(site: ProxySite, settings: ClusterSettings) -> str:
    """The fingerprint of a proxy's pod, worked out anew only if what it is made of has changed.

    With a thousand proxies it would take half the time of a look. Peers are no part of it.
    """
    rosproxy = site.rosproxy
    inputs = (rosproxy.uid, rosproxy.spec, site.node, site.advertise_host, site.ports, site.master)
    key = (*inputs, site.token_hash, site.relay_secret, settings)
    name = proxy_id(rosproxy.id, site.node.name)
    cached = _FINGERPRINTS.get(name)
    if cached is None or cached[0] != key:
        if len(_FINGERPRINTS) >= _MAX_FINGERPRINTS:
            _FINGERPRINTS.clear()
        cached = _FINGERPRINTS[name] = key, fingerprint_of(proxy_pod(site, settings))
    return cached[1]


def service(rosproxy: RosProxy, cluster_ip: str = "") -> Json:
    """A RosProxy's Service: its one address leads each pod to the proxy on the pod's own node."""
    annotations: dict[str, str] = {}
    meta = metadata(rosproxy, service_id(rosproxy.id), annotations)
    spec: dict[str, Any] = {
        "type": "ClusterIP",
        "selector": meta["labels"],
        "internalTrafficPolicy": "Local",
        # A proxy that does not reach its master must still be there to say so.
        "publishNotReadyAddresses": True,
        "ports": [*_service_ports(rosproxy)],
    }
    body = {"apiVersion": "v1", "kind": "Service", "metadata": meta, "spec": spec}
    annotations[FINGERPRINT] = digest(body)
    # No part of the fingerprint: a Service that has got another address is not made anew for that.
    if cluster_ip:
        spec["clusterIP"] = cluster_ip
    return body


def _service_ports(rosproxy: RosProxy) -> Iterator[Json]:
    listening = []
    if rosproxy.spec.ros1:
        listening.append(("master", MASTER_PORT, "TCP"))
    if rosproxy.spec.ros2:
        listening.append(("discovery", discovery_port(rosproxy.spec.ros2.number), "UDP"))
    for name, port, protocol in listening:
        yield {"name": name, "port": port, "targetPort": port, "protocol": protocol}


def keeps_registrations(old: str, new: str) -> bool:
    """Whether a new proxy finds at its master the former one's nodes, by both fingerprints.

    It does if both have the same master, or domain, and the same advertised host.
    """
    return old.partition("-")[2] in ("", new.partition("-")[2])


def fingerprint_of(body: Json) -> str:
    """The fingerprint that is written on an object."""
    return str(body["metadata"]["annotations"][FINGERPRINT])


def without_cluster_ip(body: Json) -> Json:
    """A Service that takes any address, for when another Service has its former one now."""
    spec = {key: value for key, value in body["spec"].items() if key != "clusterIP"}
    return {**body, "spec": spec}


def metadata(
    rosproxy: RosProxy, id: Name, annotations: dict[str, str], component: str = PROXY
) -> dict[str, Any]:
    """The metadata of an object that belongs to a RosProxy and goes with it."""
    owner = {
        "apiVersion": API_VERSION,
        "kind": KIND,
        "name": rosproxy.id.name,
        "uid": rosproxy.uid,
        "controller": True,
    }
    return {
        "name": id.name,
        "namespace": id.namespace,
        "labels": own_labels(rosproxy.id.name, component),
        "annotations": annotations,
        "ownerReferences": [owner],
    }


def pod_metadata(
    rosproxy: RosProxy,
    id: Name,
    annotations: dict[str, str],
    settings: ClusterSettings,
    component: str = PROXY,
) -> dict[str, Any]:
    """The metadata of a pod of a RosProxy, with the administrator's labels and annotations."""
    defaults = settings.pod
    meta = metadata(rosproxy, id, {**defaults.annotations, **annotations}, component)
    return {**meta, "labels": {**defaults.labels, **meta["labels"]}}


def helper_pod(
    site: ProxySite, id: Name, settings: ClusterSettings, container: Json, spec: Json
) -> Json:
    """A pod beside a proxy, with these fields of its container and its spec, and without rights.

    The container has the name of the component.
    """
    policy = site.rosproxy.spec.image_pull_policy or settings.image_pull_policy
    own_container = {
        **container,
        **({"imagePullPolicy": policy} if policy else {}),
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
    }
    meta = pod_metadata(site.rosproxy, id, {NODE: site.node.name}, settings, container["name"])
    own_spec = {
        **bound_to(site.node.name, site.rosproxy.spec, settings),
        "terminationGracePeriodSeconds": 1,
        "securityContext": pod_security_context(settings),
        "containers": [own_container],
        **spec,
    }
    body = {"apiVersion": "v1", "kind": "Pod", "metadata": meta, "spec": own_spec}
    meta["annotations"][FINGERPRINT] = digest(body)
    return body


def _spec(site: ProxySite, settings: ClusterSettings) -> dict[str, Any]:
    """The spec of a proxy's pod but for its container.

    The pod is bound to its node through the scheduler, as a DaemonSet's: it checks the ports.
    """
    spec = site.rosproxy.spec
    aliases = [dict(alias) for alias in spec.host_aliases]
    # No kubelet has to allow it: k8s.io/kubernetes, pkg/kubelet/sysctl/safe_sysctls.go.
    sysctls = [{"name": "net.ipv4.ip_local_port_range", "value": _local_ports(site)}]
    return {
        **bound_to(site.node.name, spec, settings),
        "terminationGracePeriodSeconds": STOPS_WITHIN,
        "securityContext": {**pod_security_context(settings), "sysctls": sysctls},
        **({"hostAliases": aliases} if aliases else {}),
    }


def pod_security_context(settings: ClusterSettings) -> dict[str, Any]:
    """The ``securityContext`` of pods of the proxies' image.

    The programs for the kernel plane belong to the image's group. Container runtimes refuse a
    runAsGroup without a runAsUser.
    """
    user = settings.pod.run_as_user
    in_group = {"runAsUser": user, "runAsGroup": USER} if user else {"supplementalGroups": [USER]}
    return {
        "runAsNonRoot": True,
        **in_group,
        "seccompProfile": {"type": "RuntimeDefault"},
    }


def bound_to(node: str, spec: RosProxySpec, settings: ClusterSettings) -> dict[str, Any]:
    """What the specs of all pods have in common that the operator makes for a node."""
    field = {"key": "metadata.name", "operator": "In", "values": [node]}
    terms = {"nodeSelectorTerms": [{"matchFields": [field]}]}
    tolerations = [
        {"key": f"node.kubernetes.io/{taint}", "operator": "Exists", "effect": effect}
        for taint, effect in _TAINTS
    ]
    secrets = [dict(secret) for secret in spec.image_pull_secrets or ()]
    priority = settings.pod.priority_class
    return {
        "affinity": {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": terms}},
        "tolerations": [*tolerations, *map(dict, spec.tolerations or ())],
        "restartPolicy": "Always",
        "automountServiceAccountToken": False,
        # Services called rosproxy-… would otherwise set variables that are the proxy's options.
        "enableServiceLinks": False,
        **({"imagePullSecrets": secrets} if secrets else {}),
        **({"priorityClassName": priority} if priority else {}),
    }


def _local_ports(site: ProxySite) -> str:
    fixed = (MASTER_PORT, ADMIN_PORT, site.master.publish)
    ros2 = site.rosproxy.spec.ros2
    ros2_ports = sorted(well_known_ports(ros2.number)) if ros2 else ()
    listening = [site.ports, *(PortRange(port, port) for port in (*fixed, *ros2_ports) if port)]
    free = (r for r in _LOCAL_PORTS if not any(overlap(r, used) for used in listening))
    ports = next(free, _LOCAL_PORTS[0])
    return f"{ports.first} {ports.last}"


def _container(site: ProxySite, settings: ClusterSettings) -> dict[str, Any]:
    """A proxy's container.

    The programs that make rules in the kernel have their capability from their files: Kubernetes
    calls it escalation.
    """
    spec = site.rosproxy.spec
    policy = spec.image_pull_policy or settings.image_pull_policy
    publish = [site.master.publish] if site.master.publish else []
    host_ports = [("TCP", [*site.ports.ports(), *publish])] if spec.ros1 else []
    host_ports += [("UDP", [*site.own_ports.ports()])] if spec.takes_udp else []
    always = ("port_range", "master_port", "cleanup_after", "slave_control")
    variables = environment("kubernetes", _told(site, settings), always)
    forwards = spec.proxy.data_plane == "kernel"
    return {
        "name": CONTAINER,
        "image": image_of(site.rosproxy, settings),
        **({"imagePullPolicy": policy} if policy else {}),
        "env": [{"name": name, "value": value} for name, value in variables.items()],
        "ports": [
            {"containerPort": port, "hostPort": port, "protocol": protocol}
            for protocol, ports in host_ports
            for port in ports
        ],
        "resources": dict(spec.resources or {}),
        "livenessProbe": _probe("/healthz", 10),
        "readinessProbe": _probe("/readyz", 2),
        "lifecycle": {"preStop": {"exec": {"command": ["sleep", str(_LINGERS)]}}},
        # So the container's status has the last log lines, which `pod_failures` quotes.
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": {
            "allowPrivilegeEscalation": forwards,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"], **({"add": ["NET_ADMIN"]} if forwards else {})},
        },
    }


def _told(site: ProxySite, settings: ClusterSettings) -> Mapping[str, Any]:
    """The settings of a proxy, by their fields, in the order of `environment`."""
    spec = site.rosproxy.spec
    policy = policy_of(site.rosproxy, settings)
    return {
        "master_uri": site.master.uri,
        "master_address": site.master.address,
        "advertise_host": site.advertise_host,
        "port_range": site.own_ports,
        "master_port": MASTER_PORT if spec.ros1 else None,
        "publish_master": site.master.publish or None,
        "admin": HostPort("0.0.0.0", ADMIN_PORT),
        "inside_networks": site.node.pod_networks,
        "cleanup_after": spec.cleanup_after,
        # The order of former operators.
        **dict.fromkeys(("slave_control", "direction", "udp", "data_plane")),
        **msgspec.structs.asdict(spec.proxy),
        # The operator decides, the RosProxy may only narrow it.
        "slave_control": WISHES["slave_control"].first(
            (settings.bounds.slave_control, spec.proxy.slave_control)
        ),
        "admin_token_hash": site.token_hash,
        "ros": (*(["1"] if spec.ros1 else []), *(["2"] if spec.ros2 else [])),
        "ros2_domain": spec.ros2.number if spec.ros2 else None,
        "ros2_peer": site.peers,
        "ros2_lan_relay": site.lan_relay,
        "ros2_lan_relay_secret": site.relay_secret if site.lan_relay else None,
        **msgspec.structs.asdict(settings.proxy_bounds),
        # Without a policy there is nothing to wait for, which takes a second after each restart.
        "await_policy": AWAITED if policy else None,
        "policy_layers": as_variable(policy),
    }


def _probe(path: str, period: int) -> dict[str, Any]:
    target = {"path": path, "port": ADMIN_PORT}
    return {"httpGet": target, "periodSeconds": period, "timeoutSeconds": 3}
