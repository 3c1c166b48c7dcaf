"""The Kubernetes objects that the operator creates, as JSON for the API server."""

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from rosproxy.shared.addresses import HostPort, is_address
from rosproxy.shared.domain_ports import first_unicast_port
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.ports import STAND_IN_PORTS, PortRange
from rosproxy_operator.common.policy import POLICY_WAIT_S, as_variable
from rosproxy_operator.common.port_ranges import LOCAL_PORTS, first_fitting, local_ports
from rosproxy_operator.common.zenoh import LINK_DIRECTORY, LINK_FILES, link_settings
from rosproxy_operator.kubernetes.planner.proxy_ports import fixed_ports
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    Json,
    LinkSpec,
    ListenSpec,
    MasterSpec,
    Name,
    RosProxy,
    RosProxySpec,
    ZenohSpec,
)
from rosproxy_operator.kubernetes.resources.names import (
    ADMIN_PORT,
    ADVERTISE_HOST,
    API_VERSION,
    CONTAINER,
    FINGERPRINT,
    HUB_PORT,
    KIND,
    MASTER_PORT,
    NODE,
    OUTSIDE_PORT,
    OUTSIDE_SERVICE_PORT,
    PORT_RANGE,
    PROXY,
    ROUTERS,
    hubs_service_id,
    outside_service_id,
    own_labels,
    proxy_id,
    service_id,
)
from rosproxy_operator.kubernetes.resources.pod_defaults import USER
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.proxy_spec.environment import environment, variable
from rosproxy_operator.proxy_spec.fingerprint import LIVE_VARIABLES, digest
from rosproxy_operator.proxy_spec.spec import WISHES, options

TERMINATION_GRACE_S = 5
"""Seconds from the deletion of a proxy until the kubelet kills the proxy, `_LINGER_S` included."""
_LINGER_S = 2
"""Seconds that a proxy goes on after its deletion.

The garbage collector deletes the proxies of a deleted RosProxy before the operator knows of the
deletion. In these seconds the operator has the proxies unregister their nodes at the master.
"""
_TAINTS = (
    ("not-ready", "NoExecute"),
    ("unreachable", "NoExecute"),
    ("disk-pressure", "NoSchedule"),
    ("memory-pressure", "NoSchedule"),
    ("pid-pressure", "NoSchedule"),
    ("unschedulable", "NoSchedule"),
)
"""Taints that pods of DaemonSets tolerate, with the effect of each taint.

``AddOrUpdateDaemonPodTolerations`` in k8s.io/kubernetes, pkg/controller/daemon/util.
"""
LINK_VOLUME = "link"
_FORMER_LOCAL_PORTS = (*LOCAL_PORTS, PortRange(12000, 30000))
"""The ranges of former operators, for the fingerprint. The last range has ports of stand-ins."""

_FINGERPRINTS: dict[Name, tuple[object, str]] = {}
"""Cache of `proxy_fingerprint`, by the name of the pod: the inputs, and the fingerprint."""
_MAX_FINGERPRINTS = 8192


class ProxySite(msgspec.Struct, frozen=True):
    """A proxy on a node.

    ``master`` is the real master for the proxy's settings. The ``uri`` is set even if the master is
    a Service. If ``address`` is empty, the proxy resolves the host name. If ``publish`` is 0, the
    proxy does not publish the master. ``relay_secret`` is the shared secret of the proxy and the
    LAN relay. ``hub_certificate`` has the key and the certificate that the hubs of a RosProxy for
    rmw_zenoh share.

    Only the site of a new proxy has ``peers`` and ``hubs``. ``peers`` has the ROS 2 peers: the
    peers that the RosProxy names, and the proxies on other nodes. ``hubs`` has the proxies for
    rmw_zenoh on other nodes.
    """

    rosproxy: RosProxy
    node: ClusterNode
    advertise_host: str
    ports: PortRange
    master: MasterSpec
    token_hash: str = ""
    peers: tuple[str, ...] = ()
    relay_secret: str = ""
    hubs: tuple[str, ...] = ()
    hub_certificate: str = ""

    @property
    def own_ports(self) -> PortRange:
        """The ports of the range for the proxy itself. A LAN relay takes the last port."""
        ports = self.ports
        return PortRange(ports.first, ports.last - 1) if self.rosproxy.spec.multicast else ports

    @property
    def lan_relay(self) -> HostPort | None:
        """The address at which the LAN relay listens for the proxy; None without a LAN relay."""
        lan = lan_address(self.node, self.advertise_host)
        multicast = self.rosproxy.spec.multicast and lan
        return HostPort(lan, self.ports.last) if multicast else None


def lan_address(node: ClusterNode, advertise_host: str) -> str:
    """The IPv4 address of a node on the LAN; empty if the node has none.

    The advertised host comes first, if this is an address of the node, then the InternalIP.
    """
    ipv4 = [a for a in node.addresses.values() if is_address(a) and ":" not in a]
    internal = node.addresses.get("InternalIP", "")
    return next((a for a in (advertise_host, internal) if a in ipv4), "")


def image_of(rosproxy: RosProxy, settings: ClusterSettings) -> str:
    """The image of a RosProxy's proxies."""
    return rosproxy.spec.image or settings.image


def policy_of(rosproxy: RosProxy, settings: ClusterSettings) -> tuple[PolicyLayer, ...]:
    """The policy layers of a RosProxy's proxies: the administrator's, then the RosProxy's."""
    return (*settings.policy, *rosproxy.spec.policy)


def proxy_pod(site: ProxySite, settings: ClusterSettings) -> Json:
    """The pod of a proxy.

    The fingerprint has two parts with a hyphen between. The first part is a digest of the pod
    without image, policy and peers, which the operator changes without a new pod. The second part
    is a hash of master, domain and advertised host: see `keeps_registrations`.
    """
    rosproxy = site.rosproxy
    container = _container(site, settings)
    annotations = {
        NODE: site.node.name,
        PORT_RANGE: str(site.ports),
        ADVERTISE_HOST: site.advertise_host,
    }
    meta = pod_metadata(rosproxy, proxy_id(rosproxy.id, site.node.name), annotations, settings)
    # Peers and hubs come and go with the nodes. The operator sends new peers to a running proxy. A
    # running hub needs no names of new hubs, because new hubs dial this hub.
    live = {*LIVE_VARIABLES, *map(variable, ("ros2_peer", "zenoh_hub"))}
    env = [v for v in container["env"] if v["name"] not in live]
    # The digest has the ports of former operators, so a correction recreates no running proxy.
    former_ports = _container_ports(site, site.ports)
    former_container = {**container, "image": "", "env": env, "ports": former_ports}
    former_spec = _spec(site, settings, _former_local_ports(site))
    spec = {**former_spec, "containers": [former_container]}
    body = {"apiVersion": "v1", "kind": "Pod", "metadata": meta, "spec": spec}
    ros2 = rosproxy.spec.ros2
    graph = f"{site.master.uri}{f' domain {ros2.number}' if ros2 else ''} {site.advertise_host}"
    identity = hashlib.sha256(graph.encode()).hexdigest()[:8]
    # The digest is of the pod without the fingerprint annotation, which is added only now.
    meta["annotations"][FINGERPRINT] = f"{digest(body)}-{identity}"
    own_spec = _spec(site, settings, local_ports(_listening(site), [STAND_IN_PORTS]))
    return {**body, "spec": {**own_spec, "containers": [container]}}


def proxy_fingerprint(site: ProxySite, settings: ClusterSettings) -> str:
    """The fingerprint of a proxy's pod, from a cache while the inputs are the same.

    Without the cache, the fingerprints of a thousand proxies would take half the time of a look.
    The peers and hubs are no input.
    """
    rosproxy = site.rosproxy
    inputs = (rosproxy.uid, rosproxy.spec, site.node, site.advertise_host, site.ports, site.master)
    key = (*inputs, site.token_hash, site.relay_secret, site.hub_certificate, settings)
    name = proxy_id(rosproxy.id, site.node.name)
    cached = _FINGERPRINTS.get(name)
    if cached is None or cached[0] != key:
        if len(_FINGERPRINTS) >= _MAX_FINGERPRINTS:
            _FINGERPRINTS.clear()
        cached = _FINGERPRINTS[name] = key, fingerprint_of(proxy_pod(site, settings))
    return cached[1]


def service(rosproxy: RosProxy, cluster_ip: str = "") -> Json:
    """The Service of a RosProxy. The same address leads each pod to the proxy on its own node.

    If ``cluster_ip`` is empty, the API server chooses the address.
    """
    annotations: dict[str, str] = {}
    meta = metadata(rosproxy, service_id(rosproxy.id), annotations)
    spec: dict[str, Any] = {
        "type": "ClusterIP",
        "selector": meta["labels"],
        "internalTrafficPolicy": "Local",
        # A proxy that does not reach the master is not ready, but has to tell its nodes so.
        "publishNotReadyAddresses": True,
        "ports": [*_service_ports(rosproxy)],
    }
    body = {"apiVersion": "v1", "kind": "Service", "metadata": meta, "spec": spec}
    annotations[FINGERPRINT] = digest(body)
    # The address is no part of the fingerprint: the operator does not recreate a Service that got
    # another address.
    if cluster_ip:
        spec["clusterIP"] = cluster_ip
    return body


def hubs_service(rosproxy: RosProxy) -> Json:
    """The headless Service by which the hubs of a RosProxy for rmw_zenoh find each other.

    DNS then has a name for each pod with a host name and with this Service as its subdomain.
    """
    annotations: dict[str, str] = {}
    meta = metadata(rosproxy, hubs_service_id(rosproxy.id), annotations)
    spec: dict[str, Any] = {
        "type": "ClusterIP",
        "clusterIP": "None",
        "selector": meta["labels"],
        # Hubs link before their proxies are ready.
        "publishNotReadyAddresses": True,
        "ports": [_service_port("hub", HUB_PORT)],
    }
    body = {"apiVersion": "v1", "kind": "Service", "metadata": meta, "spec": spec}
    annotations[FINGERPRINT] = digest(body)
    return body


def outside_service(rosproxy: RosProxy, listen: ListenSpec) -> Json:
    """The Service at which outside reaches the proxies of a RosProxy for rmw_zenoh."""
    annotations = dict(listen.annotations)
    meta = metadata(rosproxy, outside_service_id(rosproxy.id), annotations)
    port = {**_service_port("zenoh", OUTSIDE_SERVICE_PORT), "targetPort": OUTSIDE_PORT}
    balancer_class = listen.load_balancer_class
    spec: dict[str, Any] = {
        "type": listen.type,
        "selector": meta["labels"],
        "ports": [{**port, **({"nodePort": listen.node_port} if listen.node_port else {})}],
        **({"loadBalancerClass": balancer_class} if balancer_class else {}),
    }
    body = {"apiVersion": "v1", "kind": "Service", "metadata": meta, "spec": spec}
    annotations[FINGERPRINT] = digest(body)
    return body


def _service_ports(rosproxy: RosProxy) -> Iterator[Json]:
    if rosproxy.spec.ros1:
        yield _service_port("master", MASTER_PORT)
    if rosproxy.spec.ros2:
        yield _service_port("discovery", first_unicast_port(rosproxy.spec.ros2.number), "UDP")
    if rosproxy.spec.zenoh:
        yield _service_port("router", ROUTERS.first)


def _service_port(name: str, port: int, protocol: str = "TCP") -> Json:
    return {"name": name, "port": port, "targetPort": port, "protocol": protocol}


def keeps_registrations(old: str, new: str) -> bool:
    """Whether a new proxy finds the nodes of the former proxy at the master.

    ``old`` and ``new`` are the fingerprints of the two pods. Both pods need the same master, domain
    and advertised host, that is the same second part. An old fingerprint may have no second part;
    then the function returns True.
    """
    return old.partition("-")[2] in ("", new.partition("-")[2])


def fingerprint_of(body: Json) -> str:
    """The fingerprint in the annotations of an object."""
    return str(body["metadata"]["annotations"][FINGERPRINT])


def without_cluster_ip(body: Json) -> Json:
    """The Service without a fixed address, for when another Service has the former address."""
    spec = {key: value for key, value in body["spec"].items() if key != "clusterIP"}
    return {**body, "spec": spec}


def metadata(
    rosproxy: RosProxy, id: Name, annotations: dict[str, str], component: str = PROXY
) -> dict[str, Any]:
    """The metadata of an object of a RosProxy.

    The garbage collector deletes the object after the RosProxy (``ownerReferences``).
    """
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
    """A pod beside a proxy, without capabilities and without a token for the API server.

    ``container`` and ``spec`` are the fields that differ between the kinds of pods. The name of the
    container is also the component label of the pod.
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


def _spec(site: ProxySite, settings: ClusterSettings, local_ports: PortRange) -> dict[str, Any]:
    """The spec of a proxy's pod, without the container.

    Outgoing connections get their source ports from ``local_ports``.
    """
    spec = site.rosproxy.spec
    aliases = [dict(alias) for alias in spec.host_aliases]
    # A safe sysctl, which every kubelet allows: k8s.io/kubernetes,
    # pkg/kubelet/sysctl/safe_sysctls.go.
    value = f"{local_ports.first} {local_ports.last}"
    id = proxy_id(site.rosproxy.id, site.node.name)
    hub = {"hostname": id.name, "subdomain": hubs_service_id(site.rosproxy.id).name}
    sysctls = [{"name": "net.ipv4.ip_local_port_range", "value": value}]
    return {
        **bound_to(site.node.name, spec, settings),
        "terminationGracePeriodSeconds": TERMINATION_GRACE_S,
        "securityContext": {
            **pod_security_context(settings, forwards=spec.proxy.data_plane == "kernel"),
            "sysctls": sysctls,
        },
        **({"hostAliases": aliases} if aliases else {}),
        **(hub if spec.zenoh else {}),
        **({"volumes": [_link_volume(link)]} if (link := _link_of(spec)) else {}),
    }


def _link_of(spec: RosProxySpec) -> LinkSpec | None:
    return spec.zenoh.link if spec.zenoh else None


def _link_volume(link: LinkSpec) -> Json:
    """The volume with the files of the links.

    The volume is optional, so that a proxy without its Secret serves its pods without links, and
    says which file is missing. The kubelet adds files to the volume later.
    """
    items = [{"key": name, "path": name} for name in LINK_FILES.values()]
    secret = {"secretName": link.secret, "items": items, "optional": True}
    return {"name": LINK_VOLUME, "secret": secret}


def pod_security_context(settings: ClusterSettings, forwards: bool = False) -> dict[str, Any]:
    """The ``securityContext`` of pods with the proxy's image.

    With ``forwards``, for the kernel plane, the process has to be in the image's group, to which
    the programs for the kernel plane belong. Container runtimes refuse runAsGroup without
    runAsUser: then the group is a supplemental group. Without the kernel plane the pod names no
    group then, since OpenShift's SCCs may refuse groups outside the range of the namespace.
    """
    user = settings.pod.run_as_user
    in_group: dict[str, Any] = {"runAsUser": user, "runAsGroup": USER} if user else {}
    if forwards and not user:
        in_group = {"supplementalGroups": [USER]}
    return {
        "runAsNonRoot": True,
        **in_group,
        "seccompProfile": {"type": "RuntimeDefault"},
    }


def bound_to(node: str, spec: RosProxySpec, settings: ClusterSettings) -> dict[str, Any]:
    """The fields that the specs of all pods of the operator share.

    The affinity binds the pod to the node, as for the pods of a DaemonSet. So the scheduler still
    checks hostPorts, resources and taints.
    """
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
        # Otherwise the kubelet sets variables ROSPROXY_… for Services rosproxy-…, and the proxy
        # reads these variables as options.
        "enableServiceLinks": False,
        **({"imagePullSecrets": secrets} if secrets else {}),
        **({"priorityClassName": priority} if priority else {}),
    }


def _former_local_ports(site: ProxySite) -> PortRange:
    """The ports that former operators gave to outgoing connections."""
    used = _listening(site)
    return first_fitting(_FORMER_LOCAL_PORTS, used) or _FORMER_LOCAL_PORTS[0]


def _listening(site: ProxySite) -> list[PortRange]:
    """The ports on which a proxy listens, without the ports of stand-ins."""
    fixed = {*fixed_ports(site.rosproxy.spec), site.master.publish}
    return [site.ports, *(PortRange(port, port) for port in fixed if port)]


def _container(site: ProxySite, settings: ClusterSettings) -> dict[str, Any]:
    """The container of a proxy.

    The programs that write kernel rules get NET_ADMIN from a file capability. Kubernetes allows
    this only with ``allowPrivilegeEscalation``.
    """
    spec = site.rosproxy.spec
    policy = spec.image_pull_policy or settings.image_pull_policy
    always = ("port_range", "master_port", "cleanup_after", "slave_control")
    variables = environment("kubernetes", _settings_fields(site, settings), always)
    forwards = spec.proxy.data_plane == "kernel"
    mount = {"name": LINK_VOLUME, "mountPath": LINK_DIRECTORY, "readOnly": True}
    return {
        "name": CONTAINER,
        "image": image_of(site.rosproxy, settings),
        **({"imagePullPolicy": policy} if policy else {}),
        "env": [{"name": name, "value": value} for name, value in variables.items()],
        "ports": _container_ports(site, site.own_ports),
        "resources": dict(spec.resources or {}),
        **({"volumeMounts": [mount]} if _link_of(spec) else {}),
        "livenessProbe": _probe("/healthz", 10),
        "readinessProbe": _probe("/readyz", 2),
        "lifecycle": {"preStop": {"exec": {"command": ["sleep", str(_LINGER_S)]}}},
        # The container's status then has the last log lines, which `pod_failures.py` quotes.
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": {
            "allowPrivilegeEscalation": forwards,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"], **({"add": ["NET_ADMIN"]} if forwards else {})},
        },
    }


def _container_ports(site: ProxySite, tcp_ports: PortRange) -> list[Json]:
    """The hostPorts of a proxy: ``tcp_ports`` for ROS 1, its own ports for UDP, and the master."""
    spec = site.rosproxy.spec
    publish = [site.master.publish] if site.master.publish else []
    host_ports = [("TCP", [*tcp_ports.ports(), *publish])] if spec.ros1 else []
    host_ports += [("UDP", [*site.own_ports.ports()])] if spec.takes_udp else []
    return [
        {"containerPort": port, "hostPort": port, "protocol": protocol}
        for protocol, ports in host_ports
        for port in ports
    ]


def _settings_fields(site: ProxySite, settings: ClusterSettings) -> Mapping[str, Any]:
    """The settings of a proxy, by field of `Settings`, in the order of the variables."""
    zenoh = site.rosproxy.spec.zenoh
    policy = policy_of(site.rosproxy, settings)
    return {
        **(_zenoh_settings_fields(site, zenoh) if zenoh else _ros_settings_fields(site, settings)),
        **msgspec.structs.asdict(settings.proxy_bounds),
        # Without a policy the proxy does not wait, because a wait costs a second at each restart.
        "await_policy": POLICY_WAIT_S if policy else None,
        "policy_layers": as_variable(policy),
    }


def _ros_settings_fields(site: ProxySite, settings: ClusterSettings) -> Mapping[str, Any]:
    """The settings of a proxy of ROS 1 or DDS, without those that all proxies have."""
    spec = site.rosproxy.spec
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
        # The order of operators of former releases. With another order, an upgrade of the operator
        # would change the fingerprints and recreate all proxies.
        **dict.fromkeys(("slave_control", "direction", "udp", "data_plane")),
        **msgspec.structs.asdict(spec.proxy),
        # A RosProxy may only narrow what the operator's option allows.
        "slave_control": WISHES["slave_control"].first(
            (settings.bounds.slave_control, spec.proxy.slave_control)
        ),
        "admin_token_hash": site.token_hash,
        "ros": (*(["1"] if spec.ros1 else []), *(["2"] if spec.ros2 else [])),
        "ros2_domain": spec.ros2.number if spec.ros2 else None,
        "ros2_peer": site.peers,
        "ros2_lan_relay": site.lan_relay,
        "ros2_lan_relay_secret": site.relay_secret if site.lan_relay else None,
    }


def _zenoh_settings_fields(site: ProxySite, spec: ZenohSpec) -> Mapping[str, Any]:
    """The settings of a proxy of rmw_zenoh, without those that all proxies have."""
    return {
        "admin": HostPort("0.0.0.0", ADMIN_PORT),
        "admin_token_hash": site.token_hash,
        "ros": ("zenoh",),
        "zenoh_ports": ROUTERS,
        "zenoh_peer": spec.peers,
        "zenoh_hub": site.hubs,
        "zenoh_hub_listen": HUB_PORT,
        "zenoh_hub_certificate": site.hub_certificate,
        "zenoh_listen": OUTSIDE_PORT if spec.listen else None,
        **options(site.rosproxy.spec.proxy, "zenoh"),
        **(link_settings(spec.link.to, spec.link.limits, spec.link.rules) if spec.link else {}),
    }


def _probe(path: str, period: int) -> dict[str, Any]:
    target = {"path": path, "port": ADMIN_PORT}
    return {"httpGet": target, "periodSeconds": period, "timeoutSeconds": 3}
