"""Wires pods to the proxy at admission, and finds pods that are not wired.

The containers of a wired pod have ROS_MASTER_URI and ROS_IP, or ROS_STATIC_PEERS for DDS, or
ZENOH_CONFIG_OVERRIDE for rmw_zenoh. ROS_MASTER_URI, ROS_STATIC_PEERS and the endpoint in
ZENOH_CONFIG_OVERRIDE name the RosProxy's Service, which leads to the proxy on the same node. The
webhook uses `wire`. The planner finds pods that do not use their proxy: `wiring_finding` for ROS 1,
`ros2_pods` for DDS, `zenoh_pods` for rmw_zenoh.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from typing import Any

import msgspec

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.output.text import clean
from rosproxy.shared.uris import parse_slave_uri
from rosproxy_operator.common.problem import NOT_WIRED, Fault
from rosproxy_operator.common.ros2 import is_dds
from rosproxy_operator.common.zenoh import OVERRIDE, tcp_endpoint, with_client_override
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at, texts_at
from rosproxy_operator.kubernetes.resources.cluster import WebhookState
from rosproxy_operator.kubernetes.resources.model import (
    REFERENCE,
    VALUE_AT_RUNTIME,
    ClusterFinding,
    Json,
    Name,
    Pod,
    PodContainer,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    DOMAIN,
    INJECT,
    MASTER_PORT,
    MASTER_URI,
    REPLACED_URI,
    ROUTER_ENDPOINT,
    STATIC_PEERS,
    master_uri,
    router_of,
    service_id,
)
from rosproxy_operator.kubernetes.resources.objects import MASTER_VARIABLE
from rosproxy_operator.kubernetes.status.findings import pod_finding

MIRROR_ANNOTATION = "kubernetes.io/config.mirror"
"""Annotation of the mirror pod of a static pod. A change of a mirror pod changes no container."""
WEBHOOK_READY_AFTER = timedelta(minutes=1)
"""Time after which the webhook is sure to wire the pods of a new RosProxy.

The time starts when the RosProxy exists and the webhook is ready.
"""
UNKNOWN_WEBHOOK = WebhookState()
UNWIRED = "rosproxy: this pod was not wired to a proxy: "
"""The start of each warning at admission."""
_CONTAINER_FIELDS = ("initContainers", "containers")


class Wiring(msgspec.Struct, frozen=True):
    """The answer of the webhook about a pod. ``spec`` is the new spec, None without a change."""

    spec: Json | None = None
    annotations: Mapping[str, str] = {}
    warnings: tuple[str, ...] = ()


class PodVariables(msgspec.Struct, frozen=True):
    """The variables that the webhook sets in a pod. An empty value or None sets no variable.

    ``uri`` is for ROS_MASTER_URI, ``static_peers`` for ROS_STATIC_PEERS, ``domain`` for
    ROS_DOMAIN_ID, ``router`` for ZENOH_CONFIG_OVERRIDE. ``masters`` has the hosts and ports of the
    real master. The webhook replaces a ROS_MASTER_URI of the template that names this master.
    """

    uri: str = ""
    static_peers: str = ""
    domain: int | None = None
    masters: frozenset[HostPort] = frozenset()
    router: HostPort | None = None

    @property
    def name(self) -> str:
        """The variable, for messages."""
        if self.router:
            return OVERRIDE
        return "ROS_MASTER_URI and ROS_IP" if self.uri else "ROS_STATIC_PEERS"


def pod_variables(rosproxy: RosProxy, cluster_ip: str) -> PodVariables:
    """Return the variables for the pods of a RosProxy. ``cluster_ip``: the Service's address."""
    ros2 = rosproxy.spec.ros2
    return PodVariables(
        master_uri(cluster_ip) if rosproxy.spec.ros1 else "",
        cluster_ip if ros2 else "",
        ros2.domain if ros2 else None,
        _masters_of(rosproxy) if rosproxy.spec.ros1 else frozenset(),
        router_of(cluster_ip) if rosproxy.spec.zenoh else None,
    )


def wire(pod: Json, wanted: PodVariables, host_aliases: Iterable[Json] = ()) -> Wiring:
    """Return the wiring of a pod at admission, with ``host_aliases`` added to the pod's aliases.

    Each container and init container gets these variables, unless the template sets the variable:

    - ROS 1: ROS_MASTER_URI, and ROS_IP if the template sets no ROS_HOSTNAME either.
    - ROS 2: ROS_STATIC_PEERS, and ROS_DOMAIN_ID if the RosProxy names a domain.
    - rmw_zenoh: ZENOH_CONFIG_OVERRIDE, unless the container uses DDS (`wired_override`).

    New variables come first, because Kubernetes expands ``$(ROS_MASTER_URI)`` only in the variables
    after it. The webhook replaces a ROS_MASTER_URI that names the real master of the RosProxy, and
    keeps the first such value in an annotation. A copy of a wired pod may have a former address of
    the proxy. The webhook knows this address from another annotation, and replaces the address. A
    second wiring of the same pod changes nothing.

    The caller must not pass a pod in the host's network: see `selection.select_rosproxy`.
    """
    annotations = texts_at(pod, "metadata", "annotations")
    if MIRROR_ANNOTATION in annotations:
        warning = (
            f"{UNWIRED}the pod is a static pod, made from a file on its node. Set {wanted.name} "
            "in that file, or run an ordinary pod"
        )
        return Wiring(warnings=(warning,))
    spec = submap(pod, "spec")
    wired: dict[str, Any] = {
        kind: [_wired(container, wanted, annotations) for container in submaps(spec, kind)]
        for kind in _CONTAINER_FIELDS
        if spec.get(kind)
    }
    aliases = _merged(submaps(spec, "hostAliases"), host_aliases)
    if aliases:
        wired["hostAliases"] = aliases
    changed = any(spec.get(key) != value for key, value in wired.items())
    replaced = _replaced_uri(spec, wanted) or annotations.get(REPLACED_URI, "")
    new_annotations = {
        annotation: value
        for annotation, variable, value in _wired_variables(wanted)
        if any(_value(c, variable) == value for c in _containers(wired))
    }
    if wanted.router:
        endpoint = tcp_endpoint(wanted.router)
        if any(endpoint in _value(c, OVERRIDE) for c in _containers(wired)):
            new_annotations[ROUTER_ENDPOINT] = endpoint
    if replaced and MASTER_URI in new_annotations:
        new_annotations[REPLACED_URI] = replaced
    if DOMAIN not in annotations and all(map(_has_domain, _containers(spec))):
        new_annotations.pop(DOMAIN, None)  # all values are the template's
    return Wiring({**spec, **wired} if changed else None, new_annotations)


def wiring_finding(
    pod: Pod, rosproxy: RosProxy, cluster_ip: str, webhook: WebhookState = UNKNOWN_WEBHOOK
) -> ClusterFinding | None:
    """Return a finding (reason NotWired) if the ROS 1 nodes of a selected pod do not use its proxy.

    Also if the pod has to be recreated: the ROS nodes may not be registered any more. Else None.
    ``cluster_ip`` is the address of the RosProxy's Service.
    """
    fault = _why_not_wired(pod, rosproxy, cluster_ip, webhook)
    return pod_finding(pod, rosproxy, NOT_WIRED, fault, fatal=False) if fault else None


def needs_recreation(pod: Pod, rosproxy: RosProxy, cluster_ip: str) -> bool:
    """Whether a pod does not use its proxy, and the webhook would wire a recreated pod.

    True if ROS_MASTER_URI, ROS_STATIC_PEERS, ROS_DOMAIN_ID or the endpoint in ZENOH_CONFIG_OVERRIDE
    is missing or outdated, or if the ROS 1 nodes of the pod may be unregistered for good. A
    variable that the template sets does not count, except a ROS_MASTER_URI that names the real
    master of the RosProxy, and a ZENOH_CONFIG_OVERRIDE that the webhook can extend. False for a pod
    without the label.
    """
    masters = _masters_of(rosproxy)
    lacks_master = (
        rosproxy.spec.ros1
        and all(_names_master(uri, masters) for uri in pod.own_masters)
        and (pod.wired_master_uri != master_uri(cluster_ip) or bool(_why_lost(pod, rosproxy)))
    )
    # A container without the endpoint in a wired pod comes from a later webhook.
    router = router_of(cluster_ip)
    lacks_router = (
        rosproxy.spec.zenoh is not None
        and pod.router_endpoint != tcp_endpoint(router)
        and any(wired_override(c.variables, router, pod.router_endpoint) for c in pod.containers)
    )
    peers = {c.variables["ROS_STATIC_PEERS"] for c in pod.containers if has_peers(c)}
    lacks_peers = (
        rosproxy.spec.ros2 is not None
        and peers <= {pod.static_peers}
        and pod.static_peers != cluster_ip
    )
    lacks_domain = any(is_of_former_domain(c, pod, rosproxy) for c in pod.containers)
    return INJECT in pod.labels and (lacks_master or lacks_peers or lacks_domain or lacks_router)


def is_of_former_domain(container: PodContainer, pod: Pod, rosproxy: RosProxy) -> bool:
    """Whether a container was wired before the domain of the RosProxy changed.

    Without ROS_DOMAIN_ID, the RosProxy had no domain then. But the image may set the variable.
    """
    ros2 = rosproxy.spec.ros2
    if ros2 is None:
        return False
    own = container.variables.get("ROS_DOMAIN_ID")
    if own is None:
        is_discovered = rosproxy.discovered & {pod.ip, *pod.ips}
        return bool(pod.static_peers and ros2.domain and not is_discovered)
    return own == pod.wired_domain != str(ros2.number) and own != ""


def wired_override(variables: Mapping[str, str], router: HostPort, former: str) -> str:
    """Return the ZENOH_CONFIG_OVERRIDE with which a container uses a router.

    ``variables`` are those of the container, ``former`` is the endpoint that the webhook has set
    before. The result is empty if the container stays as it is: the container uses DDS, its own
    value names an endpoint or a mode, or its own value is only known at run time.
    """
    own = variables.get(OVERRIDE, "")
    if uses_dds(variables) or REFERENCE in own:
        return ""
    endpoint = tcp_endpoint(router)
    if former and former != endpoint and f'"{former}"' in own:
        return own.replace(f'"{former}"', f'"{endpoint}"')
    return with_client_override(own, router)


def uses_dds(variables: Mapping[str, str]) -> bool:
    """Whether a container's own variables say that its ROS 2 nodes use DDS."""
    rmw = variables.get("RMW_IMPLEMENTATION", "")
    return bool(rmw) and is_dds(rmw) and REFERENCE not in rmw


def has_peers(container: PodContainer) -> bool:
    """Whether a container has the variable ROS_STATIC_PEERS."""
    return "ROS_STATIC_PEERS" in container.variables


def recreate_command(pod: Pod) -> str:
    """The kubectl command that recreates a pod."""
    if pod.workload:
        return f"kubectl -n {pod.id.namespace} rollout restart {pod.workload}"
    command = f"kubectl -n {pod.id.namespace} delete pod {pod.id.name}"
    return command if pod.controller else f"{command}, and create the pod again"


def recreate_fix(pod: Pod) -> str:
    """The fix that recreates a pod. A pod at admission has no uid, and may have no name."""
    return f"run {recreate_command(pod)}" if pod.uid or pod.workload else "create the pod again"


def edit_fix(change: str, pod: Pod) -> str:
    """The fix that makes a ``change`` in the template of a pod, with the kubectl command."""
    if pod.workload:
        return f"{change}: kubectl -n {pod.id.namespace} edit {pod.workload}"
    return f"{change}, then {recreate_fix(pod)}"


def _why_lost(pod: Pod, rosproxy: RosProxy) -> str:
    """Return why the ROS 1 nodes of a wired pod may be unregistered for good; empty if they aren't.

    The proxy unregisters the nodes when the RosProxy is deleted, and when the operator moves the
    proxy or no longer needs the proxy (`unregistrations`). ROS 1 nodes don't register again by
    themselves. A container that was started later has new nodes, which register at their start. If
    a proxy has nodes at the address of the pod, the nodes of the pod are registered.
    """
    if not pod.running_since or rosproxy.registered & {pod.ip, *pod.ips}:
        return ""
    # The times are RFC 3339 in UTC with whole seconds, so texts sort like times.
    if pod.running_since < rosproxy.created:
        return (
            f"is older than RosProxy {rosproxy.id.name}: the former RosProxy of that name was "
            "deleted, and the ROS nodes of the pod may have been unregistered at the master"
        )
    at = rosproxy.unregistered_at.get(pod.node, "")
    if pod.running_since < at:
        return (
            f"was started before {at}, when the proxy on node {pod.node} unregistered ROS nodes "
            f"after a change of RosProxy {rosproxy.id.name} or of the selected pods. The ROS nodes "
            "of this pod may have been unregistered for good"
        )
    return ""


def _younger_object(pod: Pod, rosproxy: RosProxy, service_since: str) -> str:
    """The object that an unwired pod lacked at its creation; empty if both objects existed.

    A pod of the same second as the object lacked the object, too: otherwise the webhook would have
    wired the pod. The operator creates the Service, so the Service is younger than the RosProxy.
    """
    if pod.created and pod.created < rosproxy.created:
        return f"RosProxy {rosproxy.id.name}"
    if pod.created and pod.created <= service_since:
        return f"Service {service_id(rosproxy.id).name} of the RosProxy"
    return ""


def should_be_wired(
    pod: Pod, rosproxy: RosProxy, ready_since: str, service_since: str = ""
) -> bool:
    """Whether the webhook should have wired a pod when the pod was created.

    The pod must be at least `WEBHOOK_READY_AFTER` younger than the RosProxy, than the time
    ``ready_since`` at which the webhook became ready, and than the Service of the RosProxy
    (``service_since``; empty if unknown). False if another time is not known.
    """
    if not (pod.created and rosproxy.created and ready_since):
        return False
    others = filter(None, (rosproxy.created, ready_since, service_since))
    latest = max(datetime.fromisoformat(time) for time in others)
    return datetime.fromisoformat(pod.created) - latest >= WEBHOOK_READY_AFTER


def _why_not_wired(
    pod: Pod, rosproxy: RosProxy, cluster_ip: str, webhook: WebhookState
) -> Fault | None:
    """Return why the ROS 1 nodes of a pod do not use the proxy, and the fix; else None."""
    masters = _masters_of(rosproxy)
    bypassing = [
        uri for uri in pod.own_masters if not _leads_to_proxy(uri, rosproxy.id, cluster_ip)
    ]
    foreign = [uri for uri in bypassing if not _names_master(uri, masters)]
    if foreign:
        return Fault(
            f"variable ROS_MASTER_URI={clean(foreign[0])[:200]} of the template does not lead to "
            "the proxy, so the nodes bypass the proxy",
            edit_fix("Remove the variable from the template", pod),
        )
    if pod.wired_master_uri and pod.wired_master_uri != master_uri(cluster_ip):
        return Fault(
            f"was wired to {clean(pod.wired_master_uri)[:200]}, but the proxy is at "
            f"{master_uri(cluster_ip)} now",
            f"Run {recreate_command(pod)}",
        )
    if lost := _why_lost(pod, rosproxy):
        return Fault(lost, f"Run {recreate_command(pod)}")
    if not bypassing and (pod.wired_master_uri or pod.own_masters):
        return None
    return missing_variable("ROS_MASTER_URI", pod, rosproxy, webhook)


def missing_variable(variable: str, pod: Pod, rosproxy: RosProxy, webhook: WebhookState) -> Fault:
    """The fault of a pod without the variable: the reason and the fix."""
    text = f"has no variable {variable} with the address of the proxy"
    if INJECT not in pod.labels:
        label = f"{INJECT}={rosproxy.id.name}"
        fix = edit_fix(f"Add the label {label} to the template", pod)
        return Fault(f"{text}, since the pod has no label {INJECT}", fix)
    restart = f"Run {recreate_command(pod)}"
    if not webhook.served:
        fix = edit_fix(f"Set {variable} in the template", pod)
        reason = "the operator serves no webhook (webhook.enabled=false)"
        return Fault(f"{text}, since {reason}", fix)
    if pod.wired_master_uri or pod.static_peers or pod.router_endpoint:
        changed = f"spec.ros of RosProxy {rosproxy.id.name} has changed"
        return Fault(f"{text}, since {changed} after the pod was created", restart)
    if younger := _younger_object(pod, rosproxy, webhook.service_since):
        return Fault(f"{text}, since the pod is older than {younger}", restart)
    reason = (
        "no operator answered the API server at the webhook port (chart value webhook.port) when "
        "the pod was created"
    )
    if should_be_wired(pod, rosproxy, webhook.since, webhook.service_since):
        return Fault(
            f"{text}, since {reason}, although an operator was ready",
            "Allow connections from the API server to the webhook port of the operator's pods "
            f"(NetworkPolicy, firewall). {restart}",
        )
    return Fault(f"{text}, since {reason}", restart)


def _leads_to_proxy(uri: str, rosproxy_id: Name, cluster_ip: str) -> bool:
    """Whether a ROS_MASTER_URI leads to a RosProxy's Service, by address or by name.

    The operator can't see a value that is only known at run time, and accepts that value.
    """
    if uri == VALUE_AT_RUNTIME:
        return True
    master = parse_slave_uri(uri.strip())
    if master is None or master.port != MASTER_PORT:
        return False
    return is_of_service(master.host, rosproxy_id, cluster_ip)


def is_of_service(host: str, rosproxy_id: Name, cluster_ip: str) -> bool:
    """Whether a host is the address or a name of a RosProxy's Service."""
    service = service_id(rosproxy_id)
    name = f"{service.name}.{service.namespace}"
    host = host.lower().rstrip(".")
    return host in (cluster_ip.lower(), service.name, name) or f"{host}.".startswith(f"{name}.svc.")


def _masters_of(rosproxy: RosProxy) -> frozenset[HostPort]:
    """The hosts and ports by which pods may name the real master of a RosProxy, in lower case."""
    master = rosproxy.spec.master
    service = rosproxy.spec.master.service
    if service is None:
        named = parse_slave_uri(master.uri)
        hosts = {named.host, master.address} - {""} if named else set[str]()
        return frozenset(HostPort(host.lower(), named.port) for host in hosts if named)
    long_name = f"{service.name}.{service.namespace}"
    hosts = {long_name, f"{long_name}.svc", f"{long_name}.svc.cluster.local"}
    if service.namespace == rosproxy.id.namespace:
        hosts.add(service.name)
    return frozenset(HostPort(host, master.service_port) for host in hosts)


def _names_master(uri: str, masters: Collection[HostPort]) -> bool:
    """Whether a ROS_MASTER_URI names one of these masters, in upper or lower case."""
    plain = uri.strip().lower()
    named = parse_slave_uri(plain)
    if named is None or plain.removesuffix("/").count("/") != 2:  # a master's URI has no path
        return False
    return HostPort(named.host.rstrip("."), named.port) in masters


def _replaced_uri(spec: Json, wanted: PodVariables) -> str:
    """The first ROS_MASTER_URI of a template that the webhook replaces; empty without one."""
    own = (
        v for c in _containers(spec) for v in submaps(c, "env") if v.get("name") == MASTER_VARIABLE
    )
    values = (text_at(variable, "value") for variable in own)
    return next((value for value in values if _names_master(value, wanted.masters)), "")


def _containers(spec: Json) -> Iterator[Json]:
    """Yield the containers and init containers of a pod."""
    yield from (container for kind in _CONTAINER_FIELDS for container in submaps(spec, kind))


def _has_domain(container: Json) -> bool:
    return any(v.get("name") == "ROS_DOMAIN_ID" for v in submaps(container, "env"))


def _wired_variables(wanted: PodVariables) -> list[tuple[str, str, str]]:
    """The annotation, the variable and the value of each variable that an annotation records."""
    domain = "" if wanted.domain is None else str(wanted.domain)
    variables = (
        (MASTER_URI, MASTER_VARIABLE, wanted.uri),
        (STATIC_PEERS, "ROS_STATIC_PEERS", wanted.static_peers),
        (DOMAIN, "ROS_DOMAIN_ID", domain),
    )
    return [v for v in variables if v[2]]


def _wired(container: Json, wanted: PodVariables, annotations: Mapping[str, str]) -> Json:
    """Return a container with the wanted variables. ``annotations`` belong to the pod."""
    variables = list(submaps(container, "env"))
    names = {text_at(v, "name") for v in variables}
    added: list[Json] = []
    for annotation, name, value in _wired_variables(wanted):
        former = annotations.get(annotation)
        masters = wanted.masters if name == MASTER_VARIABLE else frozenset[HostPort]()
        for index, variable in enumerate(variables):
            own = text_at(variable, "value")
            is_ours = bool(former) and own == former
            if variable.get("name") == name and (is_ours or _names_master(own, masters)):
                variables[index] = {**variable, "value": value}
        if name not in names:
            added.append({"name": name, "value": value})
    if wanted.uri and not names & {"ROS_IP", "ROS_HOSTNAME"}:
        source = {"fieldRef": {"apiVersion": "v1", "fieldPath": "status.podIP"}}
        added.append({"name": "ROS_IP", "valueFrom": source})
    env = [*added, *variables]
    if wanted.router:
        env = _with_router(container, env, wanted.router, annotations.get(ROUTER_ENDPOINT, ""))
    return {**container, "env": env} if env else container


def _with_router(container: Json, env: list[Json], router: HostPort, former: str) -> list[Json]:
    """Return the variables of a container with ZENOH_CONFIG_OVERRIDE for a router."""
    value = wired_override(objects.ros2_variables(container), router, former)
    if not value:
        return env
    others = [variable for variable in env if variable.get("name") != OVERRIDE]
    return [{"name": OVERRIDE, "value": value}, *others]


def _value(container: Json, name: str) -> str:
    """The value of a variable of a container. The last of equal names counts."""
    env = submaps(container, "env")
    return next((text_at(v, "value") for v in reversed(env) if v.get("name") == name), "")


def _merged(own: Iterable[Json], added: Iterable[Json]) -> list[Json]:
    """Host aliases of a pod with ``added`` aliases. Each address has a single entry.

    The API server merges by address, too.
    """
    merged = list(own)
    for alias in added:
        index = next((i for i, a in enumerate(merged) if a.get("ip") == alias.get("ip")), None)
        if index is None:
            merged.append(alias)
            continue
        hostnames = list(merged[index].get("hostnames") or ())
        missing = [name for name in alias.get("hostnames") or () if name not in hostnames]
        if missing:
            merged[index] = {**merged[index], "hostnames": [*hostnames, *missing]}
    return merged
