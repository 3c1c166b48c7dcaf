"""Wires pods to the proxy at admission.

The containers of a wired pod have ROS_MASTER_URI and ROS_IP, or ROS_STATIC_PEERS for DDS, or
ZENOH_CONFIG_OVERRIDE for rmw_zenoh. ROS_MASTER_URI, ROS_STATIC_PEERS and the endpoint in
ZENOH_CONFIG_OVERRIDE name the RosProxy's Service, which leads to the proxy on the same node. The
webhook uses `wire`. The planner finds pods that do not use their proxy: `ros1_pods`, `ros2_pods`
(DDS) and `zenoh_pods`.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import msgspec

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_slave_uri
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.common.ros2 import is_dds
from rosproxy_operator.common.zenoh import OVERRIDE, tcp_endpoint, with_client_override
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at, texts_at
from rosproxy_operator.kubernetes.resources.model import (
    REFERENCE,
    Json,
    Name,
    PodContainer,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    DOMAIN,
    MASTER_URI,
    NOT_WIRED_BECAUSE,
    REPLACED_URI,
    ROUTER_ENDPOINT,
    STATIC_PEERS,
    master_uri,
    router_of,
    service_id,
)
from rosproxy_operator.kubernetes.resources.objects import MASTER_VARIABLE

MIRROR_ANNOTATION = "kubernetes.io/config.mirror"
"""Annotation of the mirror pod of a static pod. A change of a mirror pod changes no container."""
UNWIRED = "rosproxy: this pod was not wired to a proxy: "
"""The start of each warning at admission."""
MOST_REASON_CHARACTERS = 500
"""Characters of a reason in an annotation."""
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
        masters_of(rosproxy) if rosproxy.spec.ros1 else frozenset(),
        router_of(cluster_ip) if rosproxy.spec.zenoh else None,
    )


def left_alone(reason: str, warning: str = "") -> Wiring:
    """The answer about a pod that stays as it is. The warning is the reason, or longer."""
    kept = bounded(reason, MOST_REASON_CHARACTERS)
    return Wiring(None, {NOT_WIRED_BECAUSE: kept}, (UNWIRED + (warning or reason),))


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
        text = "the pod is a static pod, made from a file on its node"
        fix = f"Set {wanted.name} in that file, or run an ordinary pod"
        return Wiring(warnings=(f"{UNWIRED}{text}. {fix}",))
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
    if wanted.uri and MASTER_URI not in new_annotations:
        new_annotations[NOT_WIRED_BECAUSE] = "the template sets ROS_MASTER_URI"
    if DOMAIN not in annotations and all(map(_has_domain, _containers(spec))):
        new_annotations.pop(DOMAIN, None)  # all values are the template's
    return Wiring({**spec, **wired} if changed else None, new_annotations)


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


def is_of_service(host: str, rosproxy_id: Name, cluster_ip: str) -> bool:
    """Whether a host is the address or a name of a RosProxy's Service."""
    service = service_id(rosproxy_id)
    name = f"{service.name}.{service.namespace}"
    host = host.lower().rstrip(".")
    return host in (cluster_ip.lower(), service.name, name) or f"{host}.".startswith(f"{name}.svc.")


def masters_of(rosproxy: RosProxy) -> frozenset[HostPort]:
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


def names_master(uri: str, masters: Collection[HostPort]) -> bool:
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
    return next((value for value in values if names_master(value, wanted.masters)), "")


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
            if variable.get("name") == name and (is_ours or names_master(own, masters)):
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
    value = wired_override(objects.variables_of(container), router, former)
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
