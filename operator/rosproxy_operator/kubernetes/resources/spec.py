"""The custom resource RosProxy, read.

The API server checks objects against the CRD, but not those that were there before the CRD became
stricter; all that would harm others (a label selector that is refused, a host alias with which no
pod is admitted) is checked here again. Types and bounds of single fields stand in the structures
below, whose names and defaults are those of the CRD; rules that need more than one field, or that
say why, are the functions after them.
"""

import re
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar
from urllib.parse import urlsplit

from msgspec import Meta, field

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort, is_address, is_loopback, parse_address
from rosproxy.ros1.protocol.uris import parse_slave_uri, slave_uri
from rosproxy.settings import DataPlane, SettingError, parse_range
from rosproxy_operator.kubernetes.resources.api_objects import ObjectFields
from rosproxy_operator.kubernetes.resources.fields import (
    ApiFields,
    InvalidField,
    invalid_field,
    lenient,
    strict,
)
from rosproxy_operator.kubernetes.resources.model import (
    Advertise,
    InvalidRosProxy,
    Json,
    MasterSpec,
    Name,
    RosProxy,
    RosProxySpec,
    Selector,
)
from rosproxy_operator.kubernetes.resources.names import service_id
from rosproxy_operator.kubernetes.resources.values import (
    is_label,
    is_label_key,
    is_label_value,
    is_subdomain,
    part,
    parts,
    word,
)

V = TypeVar("V")
MOST_PORTS = 500
MOST_NAME = 46
"""Characters of a RosProxy's name, so that a proxy's still fits into a pod's host name."""
MASTER_PORT = 11311
RESOURCES: Json = {
    "requests": {"cpu": "50m", "memory": "64Mi"},
    "limits": {"memory": "512Mi"},
}
_SLAVE_CONTROL = {"Any": "any", "Master": "master"}
_DATA_PLANE: dict[str, DataPlane] = {
    "Auto": "auto",
    "Kernel": "kernel",
    "Splice": "splice",
    "Copy": "copy",
}
_ADVERTISE = {one.value: one for one in Advertise}
_PULL_POLICY = {policy: policy for policy in ("", "Always", "IfNotPresent", "Never")}
_OPERATORS = {one: one for one in ("In", "NotIn", "Exists", "DoesNotExist")}
_PATH = re.compile(r"[\w./~%-]*", re.ASCII)
_EXAMPLE = "http://robot.example:11311"

_Port = Annotated[int, Meta(ge=1, le=65535)]
_HighPort = Annotated[int, Meta(ge=1024, le=65535)]
_Seconds = Annotated[float, Meta(ge=0, le=86400)]


class _Service(ApiFields, frozen=True):
    name: str = ""
    namespace: str = ""
    port: _Port = MASTER_PORT


class _Master(ApiFields, frozen=True):
    uri: str | None = None
    address: str | None = None
    service: _Service | None = None
    publish: _HighPort = 0


class _Window(ApiFields, frozen=True):
    first: _HighPort = 11400
    last: _HighPort = 29999


class _Expression(ApiFields, frozen=True):
    key: str = ""
    operator: str = ""
    values: tuple[str, ...] = ()


class _Selector(ApiFields, frozen=True):
    match_labels: dict[str, str] = field(default_factory=dict)
    match_expressions: tuple[_Expression, ...] = ()


class _Policy(ApiFields, frozen=True):
    slave_control: str = "Any"


class _HostAlias(ApiFields, frozen=True):
    ip: str = ""
    hostnames: tuple[str, ...] = ()


class _Spec(ApiFields, frozen=True):
    master: _Master = _Master()
    ports: Annotated[int, Meta(ge=1, le=MOST_PORTS)] = 32
    port_window: _Window = _Window()
    pod_selector: _Selector | None = None
    node_selector: dict[str, str] = field(default_factory=dict)
    tolerations: tuple[dict[str, Any], ...] = ()
    advertise: str = Advertise.INTERNAL_IP.value
    cleanup_after_seconds: _Seconds = 30.0
    grace_seconds: _Seconds = 60.0
    policy: _Policy = _Policy()
    data_plane: str = "Auto"
    image: str = ""
    image_pull_policy: str = ""
    image_pull_secrets: tuple[dict[str, Any], ...] = ()
    resources: dict[str, Any] | None = None
    host_aliases: tuple[_HostAlias, ...] = ()


def rosproxy(obj: Json) -> RosProxy:
    """A RosProxy. Raises InvalidField."""
    meta, status = lenient(obj, ObjectFields).metadata, part(obj, "status")
    id = Name(meta.namespace, meta.name)
    if not is_label(id.name) or len(id.name) > MOST_NAME:
        fix = f"a RosProxy's name has at most {MOST_NAME} characters a-z, 0-9 and -"
        raise invalid_field("metadata.name", id.name, "does not fit", fix)
    return RosProxy(
        id=id,
        uid=meta.uid,
        generation=meta.generation,
        spec=_spec(strict(part(obj).get("spec"), _Spec, "spec"), id),
        former=_former(status),
        cluster_ip=_cluster_ip(status),
        status=status,
        deleting=meta.deleting,
    )


def invalid(obj: Json, error: InvalidField) -> InvalidRosProxy:
    """What is left of a RosProxy that can't be read. Never raises."""
    meta = lenient(obj, ObjectFields).metadata
    id = Name(meta.namespace, meta.name)
    return InvalidRosProxy(id, meta.uid, meta.generation, str(error), part(obj, "status"))


def _spec(given: _Spec, of: Name) -> RosProxySpec:
    selector = given.pod_selector
    return RosProxySpec(
        master=_master(given.master, of),
        ports=given.ports,
        window=_window(given.port_window, given.ports),
        pod_selector=None if selector is None else _selector(selector),
        node_selector=given.node_selector,
        tolerations=given.tolerations,
        advertise=_one_of("spec.advertise", given.advertise, _ADVERTISE),
        cleanup_after=given.cleanup_after_seconds,
        grace=given.grace_seconds,
        slave_control=_one_of(
            "spec.policy.slaveControl", given.policy.slave_control, _SLAVE_CONTROL
        ),
        data_plane=_one_of("spec.dataPlane", given.data_plane, _DATA_PLANE),
        image=given.image,
        image_pull_policy=_one_of("spec.imagePullPolicy", given.image_pull_policy, _PULL_POLICY),
        image_pull_secrets=given.image_pull_secrets,
        resources=RESOURCES if given.resources is None else given.resources,
        host_aliases=tuple(
            _host_alias(f"spec.hostAliases[{i}]", one) for i, one in enumerate(given.host_aliases)
        ),
    )


def _one_of(path: str, value: str, allowed: Mapping[str, V]) -> V:
    if value not in allowed:
        fix = f"write one of {', '.join(sorted(filter(None, allowed)))}"
        raise invalid_field(path, value, "is unknown", fix)
    return allowed[value]


def _window(window: _Window, ports: int) -> PortRange:
    if window.last - window.first + 1 < ports:
        raise InvalidField(
            f"spec.portWindow: {window.first}-{window.last} has not the {ports} ports that "
            "spec.ports asks for: make the window larger, or spec.ports smaller"
        )
    return PortRange(window.first, window.last)


def _host_alias(path: str, alias: _HostAlias) -> Json:
    """One that the API server takes: pods with another would not be admitted.

    That is ``ValidateHostAliases`` in k8s.io/kubernetes, pkg/apis/core/validation/validation.go.
    """
    if not is_address(alias.ip) or "%" in alias.ip:
        fix = "write the host's address, e.g. 192.0.2.7"
        raise invalid_field(f"{path}.ip", alias.ip, "is not an IP address", fix)
    names = [name.lower() for name in alias.hostnames]
    for i, name in enumerate(names):
        if not is_subdomain(name):
            fix = "it has letters, digits, - and dots only"
            raise invalid_field(f"{path}.hostnames[{i}]", name, "is not a host name", fix)
    return {"ip": alias.ip, "hostnames": names}


def _selector(selector: _Selector) -> Selector:
    """As strict as the API server, which is asked for pods with it and refuses what is malformed.

    That is k8s.io/apimachinery, pkg/labels/selector.go and pkg/util/validation/validation.go.
    """
    path = "spec.podSelector.matchLabels"
    for key, value in selector.match_labels.items():
        _check_label(path, f"{path}.{key}", key, value)
    return Selector(
        labels=selector.match_labels,
        expressions=tuple(
            _expression(f"spec.podSelector.matchExpressions[{i}]", one)
            for i, one in enumerate(selector.match_expressions)
        ),
    )


def _expression(path: str, one: _Expression) -> tuple[str, str, frozenset[str]]:
    operator = _one_of(f"{path}.operator", one.operator, _OPERATORS)
    _check_label(f"{path}.key", "", one.key, "")
    for i, value in enumerate(one.values):
        _check_label("", f"{path}.values[{i}]", one.key, value)
    if bool(one.values) != (operator in ("In", "NotIn")):
        wrong = f"{'is not' if one.values else 'is'} empty, but the operator is {operator}"
        fix = "leave the values out" if one.values else "name at least one value"
        raise invalid_field(f"{path}.values", list(one.values), wrong, fix)
    return one.key, operator, frozenset(one.values)


def _check_label(key_path: str, value_path: str, key: str, value: str) -> None:
    fix = "write it as in the pod's labels"
    if not is_label_key(key):
        raise invalid_field(key_path, key, "is no label's key", fix)
    if not is_label_value(value):
        raise invalid_field(value_path, value, "is no label's value", fix)


def _master(given: _Master, of: Name) -> MasterSpec:
    if (given.uri is None) == (given.service is None):
        raise InvalidField(
            "spec.master: give either uri, for a master outside of the cluster, or service, for "
            "one in it, and not both"
        )
    address = _address(given.address)
    if given.service is None:
        return MasterSpec(uri=_uri(given.uri or "", of), address=address, publish=given.publish)
    if address:
        raise InvalidField("spec.master.address: goes with uri only: leave it out")
    service = _service(given.service, of)
    return MasterSpec(service=service, service_port=given.service.port, publish=given.publish)


def _uri(text: str, of: Name) -> str:
    """A master's URI in its one form: host in lower case, with a port, no slash at the end."""
    where = parse_slave_uri(text) or parse_slave_uri(_with_port(text))
    path = urlsplit(text).path.rstrip("/") if where else ""
    if where is None or not where.host.isascii() or not _PATH.fullmatch(path):
        fix = f"write it like {_EXAMPLE}"
        raise invalid_field("spec.master.uri", text, "is not a master's URI", fix)
    host = where.host.lower()
    if is_loopback(host):
        raise invalid_field(
            "spec.master.uri",
            text,
            "would be the proxy's own pod, where no master runs",
            "give the master's host as the nodes of the cluster reach it, or, for a master in the "
            "cluster, service instead",
        )
    if _is_service(host, service_id(of)):
        fix = f"give the real master, as {_EXAMPLE}"
        raise invalid_field("spec.master.uri", text, "is this RosProxy's own Service", fix)
    return slave_uri(HostPort(host, where.port), path)


def _with_port(text: str) -> str:
    """The same URI with the master's usual port."""
    try:
        parts = urlsplit(text)
        bare = parts.port is None and bool(parts.netloc) and not parts.netloc.endswith(":")
    except ValueError:
        return ""
    return parts._replace(netloc=f"{parts.netloc}:{MASTER_PORT}").geturl() if bare else ""


def _is_service(host: str, service: Name) -> bool:
    """Whether a host's name is that of a Service in the cluster's DNS, seen from its namespace."""
    full = f"{service.name}.{service.namespace}.svc"
    return host == service.name or f"{full}.".startswith(f"{host}.") or host.startswith(f"{full}.")


def _service(given: _Service, of: Name) -> Name:
    path, found = "spec.master.service", Name(given.namespace or of.namespace, given.name)
    if not is_label(found.name):
        fix = "write it as kubectl get service shows it"
        raise invalid_field(f"{path}.name", found.name, "is not a Service's name", fix)
    if not is_label(found.namespace):
        fix = "leave it out or mend it"
        raise invalid_field(f"{path}.namespace", found.namespace, "is not a namespace's name", fix)
    if found == service_id(of):
        fix = "name that of the real master"
        raise invalid_field(f"{path}.name", found.name, "is this RosProxy's own Service", fix)
    return found


def _address(given: str | None) -> str:
    if given is None:
        return ""
    address = parse_address(given)
    if address is None or is_loopback(address):
        fix = "give that of the master's host, e.g. 192.0.2.7"
        raise invalid_field("spec.master.address", given, "is not an IP address", fix)
    return address


def _former(status: Json) -> dict[str, PortRange]:
    """The ranges in a status. What can't be read there is no range that was ever given."""
    found = {}
    for line in parts(status, "perNode"):
        try:
            found[word(line, "name")] = parse_range("ports", word(line, "ports"))
        except SettingError:
            continue
    return found


def _cluster_ip(status: Json) -> str:
    where = parse_slave_uri(word(status, "masterURI"))
    return where.host if where and is_address(where.host) else ""
