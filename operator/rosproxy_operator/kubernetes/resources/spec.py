"""A reader of the custom resource RosProxy.

Names, types, bounds and defaults are the same as in the custom resource definition (CRD). The API
server checks objects against the CRD, but not again when the CRD becomes stricter. So the reader
repeats each check without which an object would harm other RosProxies. Examples: a label selector
that the API server refuses, or a host alias with which no pod is admitted.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar
from urllib.parse import urlsplit

from rosproxy.shared.addresses import HostPort, is_address, is_loopback, parse_address
from rosproxy.shared.domain_ports import LAST_DOMAIN
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode
from rosproxy.shared.policy.rules import Rule, RuleAction, RuleKind, parse_rule
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import read_topic_limit
from rosproxy.shared.settings import LEAST_PORTS_PER_DOMAIN, MOST_ZENOH_LIMITS, MOST_ZENOH_LINKS
from rosproxy.shared.uris import parse_slave_uri, slave_uri
from rosproxy.shared.zenoh_rules.key_expressions import check_limits
from rosproxy.shared.zenoh_rules.name_sets import check_layers
from rosproxy_operator.common.policy import excess_reason
from rosproxy_operator.common.ros2 import LEAST_PORTS, MOST_PEERS, read_peer_name
from rosproxy_operator.common.zenoh import read_link_name, read_router_name
from rosproxy_operator.kubernetes.resources.checks import (
    int_at,
    is_label,
    is_label_key,
    is_label_value,
    is_subdomain,
    port_range,
    quoted,
    submap,
    submaps,
    text_at,
    texts_at,
)
from rosproxy_operator.kubernetes.resources.fields import Field, InvalidField, stripped
from rosproxy_operator.kubernetes.resources.misspelt_names import misspelt_names
from rosproxy_operator.kubernetes.resources.model import (
    Advertise,
    InvalidRosProxy,
    Json,
    LinkSpec,
    ListenSpec,
    ListenType,
    MasterSpec,
    MaxUnavailable,
    Name,
    PodEgress,
    Ros2Spec,
    RosProxy,
    RosProxySpec,
    Selector,
    ZenohSpec,
)
from rosproxy_operator.kubernetes.resources.names import (
    GROUP,
    MASTER_PORT,
    REMAKE,
    router_host,
    service_id,
)
from rosproxy_operator.kubernetes.resources.objects import is_deleted, name_of
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, WISHES, ProxySpec, words

OWN_PORTS = 32
"""The default of ``spec.ports``."""
MOST_PORTS = 500
MOST_LINK_RULES = 64
"""Rules of ``spec.link.policy`` at most."""
MOST_NAME_CHARACTERS = 46
"""Characters of a RosProxy's name. With more, a proxy's name would not fit in a host name."""
_FIELDS_BY_VERSION = {"1": ("master", WISHES["udp"].field), "2": ("domain", "multicast")}
"""The fields that belong to a single ROS version."""
_ALL_VERSIONS = ("1", "2", "1,2", "zenoh")
_NOT_OF_ZENOH = {
    "ports": "ports",
    "portWindow": "window",
    "advertise": "advertise",
    "cleanupAfterSeconds": "cleanup_after",
}
"""Fields that have no effect on proxies for rmw_zenoh, each with the field of `RosProxySpec`.

The API server fills in the defaults. So a default does not count as given.
"""
# Above the ports of roscore (11311) and rosserial (11411), and below the NodePorts (from 30000).
_WINDOW = PortRange(11412, 29999)
_POLICY_MODE = {"Enforce": PolicyMode.ENFORCE, "Audit": PolicyMode.AUDIT}
_ACTION = {"Allow": RuleAction.ALLOW, "Deny": RuleAction.DENY}
RULE_KINDS = {
    "Publish": RuleKind.PUBLISH,
    "Serve": RuleKind.SERVE,
    "Subscribe": RuleKind.SUBSCRIBE,
    "Call": RuleKind.CALL,
    "GetParam": RuleKind.GET_PARAM,
    "SetParam": RuleKind.SET_PARAM,
    "Slave": RuleKind.SLAVE,
}
_GLOB = re.compile(r"[^\s;]{1,256}")
_POD_EGRESS: dict[str, PodEgress] = {"Any": "any", "Proxy": "proxy"}
_LISTEN_TYPES: dict[str, ListenType] = {"NodePort": "NodePort", "LoadBalancer": "LoadBalancer"}
_ADVERTISE = {a.value: a for a in Advertise}
_PULL_POLICY = {policy: policy for policy in ("", "Always", "IfNotPresent", "Never")}
_OPERATORS = {operator: operator for operator in ("In", "NotIn", "Exists", "DoesNotExist")}
_PATH = re.compile(r"[\w./~%-]*", re.ASCII)
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", re.ASCII)
_EXAMPLE = "http://robot.example:11311"
_LISTEN_PORTS = (1024, 65535)
"""Ports that a proxy may listen on."""
_DAY_S = 86400
_Value = TypeVar("_Value")


def rosproxies(
    objs: Iterable[Json],
) -> tuple[dict[Name, RosProxy], dict[Name, InvalidRosProxy]]:
    """Return the RosProxies, and the records of RosProxies with an invalid field, by name."""
    usable: dict[Name, RosProxy] = {}
    unusable: dict[Name, InvalidRosProxy] = {}
    for obj in objs:
        id = name_of(submap(obj, "metadata"))
        try:
            usable[id] = rosproxy(obj)
        except InvalidField as error:
            unusable[id] = invalid(obj, error)
    return usable, unusable


def rosproxy(obj: Json) -> RosProxy:
    """Return a RosProxy. Raises InvalidField."""
    meta = submap(obj, "metadata")
    status = submap(obj, "status")
    id = name_of(meta)
    service = parse_slave_uri(text_at(status, "masterURI"))
    others = text_at(status, "staticPeers") or router_host(text_at(status, "routerEndpoint"))
    address = service.host if service else others
    if not is_label(id.name) or len(id.name) > MOST_NAME_CHARACTERS:
        fix = f"Use at most {MOST_NAME_CHARACTERS} characters a-z, 0-9 and -"
        raise Field("metadata.name", id.name).error("can't be the name of a RosProxy", fix)
    return RosProxy(
        id=id,
        uid=text_at(meta, "uid"),
        generation=int_at(meta, "generation"),
        spec=_spec(Field("spec", stripped(obj.get("spec"))), id),
        former_ranges=_former_ranges(status),
        cluster_ip=address if is_address(address) else "",
        status=status,
        deleting=is_deleted(meta),
        remakes=texts_at(meta, "annotations").get(REMAKE) == "true",
        created=text_at(meta, "creationTimestamp"),
        unregistered_at=_unregistered_at(status),
        misspelt=misspelt_names(meta, "RosProxies"),
    )


def invalid(obj: Json, error: InvalidField) -> InvalidRosProxy:
    """Return the record of a RosProxy with an invalid field. Never raises."""
    meta = submap(obj, "metadata")
    status = submap(obj, "status")
    uid = text_at(meta, "uid")
    generation = int_at(meta, "generation")
    text, fix = error.fault
    return InvalidRosProxy(name_of(meta), uid, generation, text, fix, status)


def _spec(field: Field, of: Name) -> RosProxySpec:
    ports = field["ports"].number(OWN_PORTS, 1, MOST_PORTS)
    for_ros = _versions(field["ros"])
    _check_versions(field, for_ros)
    ros2 = _ros2_spec(field) if "2" in for_ros else None
    least = LEAST_PORTS if ros2 and ros2.multicast else LEAST_PORTS_PER_DOMAIN
    if ros2 and ports < least:
        fix = f"Write at least {least}: a participant takes up to three ports"
        raise field["ports"].error("is too low for ROS 2", fix)
    spec = RosProxySpec(
        ros1="1" in for_ros,
        ros2=ros2,
        zenoh=_zenoh_spec(field) if "zenoh" in for_ros else None,
        master=_master(field["master"], of) if "1" in for_ros else MasterSpec(),
        ports=ports,
        window=_window(field["portWindow"], ports),
        pod_selector=_selector(field["podSelector"]),
        node_selector=_given(field["nodeSelector"], Field.texts),
        tolerations=_given(field["tolerations"], _maps),
        advertise=field["advertise"].one_of(_ADVERTISE, Advertise.INTERNAL_IP.value),
        cleanup_after=field["cleanupAfterSeconds"].number(30.0, 0, _DAY_S),
        grace=field["graceSeconds"].number(60.0, 0, _DAY_S),
        max_unavailable=_max_unavailable(field["maxUnavailable"]),
        proxy=_proxy_spec(field),
        policy=_policy(field["policy"], of),
        pod_egress=_pod_egress(field, needs_direction="zenoh" not in for_ros),
        image=field["image"].text(),
        image_pull_policy=field["imagePullPolicy"].one_of(_PULL_POLICY, ""),
        image_pull_secrets=_given(field["imagePullSecrets"], _maps),
        resources=_given(field["resources"], Field.map),
        host_aliases=tuple(_host_alias(alias) for alias in field["hostAliases"].items()),
    )
    if spec.zenoh:
        _check_zenoh(field, spec)
    return spec


def _versions(field: Field) -> tuple[str, ...]:
    """Return the ROS versions in ``spec.ros``: 1 (the default), 2, both for "1,2", or zenoh."""
    value = "1" if field.value is None else field.value
    text = str(value).replace(" ", "") if type(value) in (int, str) else ""
    if text not in _ALL_VERSIONS:
        fix = "Write 1, 2 or '1,2', or zenoh alone. A pod has a single RosProxy: run nodes of "
        raise field.error("is unknown", f"{fix}rmw_zenoh in pods of their own")
    return tuple(text.split(","))


def _check_versions(field: Field, for_ros: tuple[str, ...]) -> None:
    """Raise InvalidField for a field of a ROS version that the RosProxy does not serve."""
    for ros, names in _FIELDS_BY_VERSION.items():
        for name in names if ros not in for_ros else ():
            _check_absent(field[name], ros, for_ros)
    if for_ros == ("1",):
        _check_absent(field["peers"], "2", for_ros)
    for name in ("listen", "link") if "zenoh" not in for_ros else ():
        if field[name].value is not None:
            fix = "Remove the field, or set spec.ros: zenoh"
            raise field[name].error(f"is for rmw_zenoh, but spec.ros is {for_ros[0]}", fix)


def _check_absent(field: Field, ros: str, for_ros: tuple[str, ...]) -> None:
    if field.value not in (None, [], False):
        fix = "Remove the field" + (", or set spec.ros: 2" if ros == "2" else "")
        raise field.error(f"is for ROS {ros}, but spec.ros is {for_ros[0]}", fix)


def _check_zenoh(field: Field, spec: RosProxySpec) -> None:
    """Raise InvalidField for a field that has no effect on rmw_zenoh, or that zenoh can't hold."""
    default = RosProxySpec(MasterSpec(), OWN_PORTS, _WINDOW)
    unused = [f for f, n in _NOT_OF_ZENOH.items() if getattr(spec, n) != getattr(default, n)]
    wishes = ((w.field, name) for name, w in WISHES.items() if "zenoh" not in w.ros)
    unused += [f for f, name in wishes if getattr(spec.proxy, name) != getattr(OWN_SPEC, name)]
    if unused:
        raise _at(field, unused[0]).error("has no effect with spec.ros: zenoh", "Remove the field")
    _check_zenoh_rules(field["policy"]["rules"], spec.policy)


def _check_zenoh_rules(field: Field, layers: tuple[PolicyLayer, ...]) -> None:
    """Raise InvalidField for rules that the routers of rmw_zenoh can't enforce."""
    try:
        check_layers(layers)
    except ValueError as error:
        raise InvalidField(f"{field.path}: {error}") from None


def _ros2_spec(field: Field) -> Ros2Spec:
    domain = field["domain"]
    return Ros2Spec(
        domain=None if domain.value is None else domain.number(0, 0, LAST_DOMAIN),
        peers=_peers(field, _read_ipv4_peer),
        multicast=field["multicast"].boolean(),
    )


def _zenoh_spec(field: Field) -> ZenohSpec:
    return ZenohSpec(
        _peers(field, read_router_name),
        _given(field["listen"], _listen),
        _given(field["link"], _link),
    )


def _link(field: Field) -> LinkSpec:
    """Return the links to other sites."""
    secret = field["secretName"]
    if not is_subdomain(secret.text()):
        fix = "Copy the name from kubectl get secrets"
        raise secret.error("can't be the name of a Secret", fix)
    to = _entries(field["to"], MOST_ZENOH_LINKS, read_link_name)
    if not to:
        fix = "Write the other sites, such as tls/cloud.example:7447, or remove spec.link"
        raise field["to"].error("is empty", fix)
    rules = _entries(field["policy"], MOST_LINK_RULES, _read_rule)
    _check_zenoh_rules(field["policy"], (PolicyLayer(field["policy"].path, rules),))
    return LinkSpec(
        to=tuple(dict.fromkeys(to)),
        secret=secret.text(),
        limits=_entries(field["limits"], MOST_ZENOH_LIMITS, _read_limit),
        rules=rules,
    )


def _entries(field: Field, most: int, read: Callable[[str], _Value]) -> tuple[_Value, ...]:
    """Return the entries of a list, in the order of the list, as ``read`` returns each."""
    entries = field.items()
    if len(entries) > most:
        raise field.error("has too many entries", f"Write at most {most}")
    try:
        return tuple(read(entry.text()) for entry in entries)
    except ValueError as error:
        raise InvalidField(f"{field.path}: {error}") from None


def _read_limit(text: str) -> str:
    """Return a limit of a link. Raises ValueError."""
    limit = read_topic_limit(text)
    if not _GLOB.fullmatch(limit.glob):  # blanks separate limits in the variable of the proxy
        raise ValueError(f"{quoted(text)} has a blank or a semicolon")
    check_limits([limit])
    return str(limit)


def _read_rule(text: str) -> Rule:
    """Return a rule of a link. Raises ValueError."""
    if ";" in text:  # separates rules in the variable of the proxy
        raise ValueError(f"{quoted(text)} has a semicolon. Write each rule as an entry of its own")
    return parse_rule(text)


def _listen(field: Field) -> ListenSpec:
    """Return the Service for outside."""
    listen_type = field["type"].one_of(_LISTEN_TYPES, "")
    balancer_class = field["loadBalancerClass"]
    if listen_type != "LoadBalancer" and balancer_class.text():
        raise balancer_class.error("is for type: LoadBalancer", "Remove the field")
    annotations = field["annotations"]
    for key in annotations.map():
        if not is_label_key(key) or key.startswith(f"{GROUP}/"):
            fix = f"Copy the key from the documentation of your load balancer, without {GROUP}/"
            raise Field(annotations.path, key).error("can't be the key of an annotation", fix)
    return ListenSpec(
        listen_type,
        node_port=field["nodePort"].number(0, 1, 65535),
        load_balancer_class=balancer_class.text(),
        annotations=annotations.texts(),
    )


def _read_ipv4_peer(text: str) -> str:
    """Return a peer of ROS 2, as `read_peer_name` does. The proxies use only IPv4 for ROS 2."""
    peer = read_peer_name(text)
    if peer.count(":") > 1:
        raise ValueError("an IPv6 address")
    return peer


def _peers(field: Field, read: Callable[[str], str]) -> tuple[str, ...]:
    """Return the peers, sorted, as ``read`` returns each."""
    peers = field["peers"].items()
    if len(peers) > MOST_PEERS:
        raise field["peers"].error("has too many hosts", f"Name at most {MOST_PEERS} hosts")
    return tuple(sorted({_peer(peer, read) for peer in peers}))


def _peer(field: Field, read: Callable[[str], str]) -> str:
    try:
        return read(field.text())
    except ValueError:
        fix = "Write the robot's name or address, or HOST:PORT of another proxy"
        raise field.error("is not a peer", fix) from None


def _given(field: Field, read: Callable[[Field], _Value]) -> _Value | None:
    """Return the value of a field, or None if the administrator's default holds."""
    return None if field.value is None else read(field)


def _maps(field: Field) -> tuple[Json, ...]:
    return tuple(item.map() for item in field.items())


def _max_unavailable(field: Field) -> MaxUnavailable:
    """Return ``spec.maxUnavailable``: a count from 1 on, or a text from 1% to 100%."""
    if isinstance(field.value, str):
        percent = field.value.removesuffix("%")
        if field.value == percent or not percent.isdecimal() or not 1 <= int(percent) <= 100:
            raise field.error("is not a percentage", "Write a number from 1 on, or 1% to 100%")
        return MaxUnavailable(int(percent), is_percent=True)
    return MaxUnavailable(int(field.number(1, 1, 10_000)))


def _pod_egress(field: Field, needs_direction: bool) -> PodEgress:
    """Return ``spec.podEgress``. ``needs_direction``: the value Proxy needs ``direction: Both``.

    With rmw_zenoh, the proxy carries both directions anyway.
    """
    egress = field["podEgress"].one_of(_POD_EGRESS, "Any")
    if egress == "proxy" and needs_direction and _proxy_spec(field).direction == "out":
        problem = "needs spec.direction: Both; otherwise the pods receive nothing from outside"
        raise field["podEgress"].error(problem, "Set spec.direction: Both")
    return egress


def _proxy_spec(field: Field) -> ProxySpec:
    spec = ProxySpec(**{name: _wish(field, name) for name in WISHES})
    if spec.udp and spec.direction == "out":
        problem = "needs spec.direction: Both; otherwise no datagrams reach the pods"
        raise field["udp"].error(problem, "Set spec.direction: Both")
    return spec


def _at(field: Field, path: str) -> Field:
    """Return the field at a path such as ``policy.slaveControl``."""
    for key in path.split("."):
        field = field[key]
    return field


def _wish(field: Field, name: str) -> Any:
    """Return the value for a field of `ProxySpec`. In the CRD, words begin with a capital."""
    field = _at(field, WISHES[name].field)
    allowed = {word.capitalize(): word for word in words(name)}
    default = str(getattr(OWN_SPEC, name)).capitalize()
    return field.one_of(allowed, default) if allowed else field.boolean()


def _policy(field: Field, of: Name) -> tuple[PolicyLayer, ...]:
    """Return the layer of the RosProxy's policy, empty without rules."""
    mode = field["mode"].one_of(_POLICY_MODE, "Enforce")
    rules = tuple(rule for r in field["rules"].items() for rule in _rules(r))
    layers = (PolicyLayer(f"RosProxy {of}", rules, mode),) if rules else ()
    if problem := excess_reason(layers):
        raise InvalidField(f"{field['rules'].path}: {problem}", "Join names or nodes by globs")
    return layers


def _rules(field: Field) -> Iterator[Rule]:
    """Yield a rule for each listed name with each listed node."""
    action = field["action"].one_of(_ACTION, "")
    kind = field["kind"].one_of(RULE_KINDS, "")
    names = [_glob(name, kind is not RuleKind.SLAVE) for name in field["names"].items()]
    nodes = [_glob(node, True) for node in field["nodes"].items()]
    if not names:
        raise field["names"].error("is empty", "Write the names that the rule is about, or ['*']")
    for name in names:
        yield from (Rule(action, kind, name, node) for node in nodes or ["*"])


def _glob(field: Field, ros_name: bool) -> str:
    """Return a glob: with ``ros_name`` for ROS names, else for methods of the slave API."""
    glob = field.text()
    if not _GLOB.fullmatch(glob) or (ros_name and glob[0] not in "/*?"):
        begins = ", with /, * or ? at the beginning" if ros_name else ""
        fix = f"Write 1 to 256 characters without blanks and ;{begins}"
        raise field.error("is not a pattern of names", fix)
    return glob


def _window(field: Field, ports: int) -> PortRange:
    window = PortRange(
        field["first"].number(_WINDOW.first, *_LISTEN_PORTS),
        field["last"].number(_WINDOW.last, *_LISTEN_PORTS),
    )
    if window.last - window.first + 1 < ports:
        raise InvalidField(
            f"{field.path}: {window} has fewer than the {ports} ports of spec.ports",
            "Widen spec.portWindow, or lower spec.ports",
        )
    return window


def _host_alias(field: Field) -> Json:
    """Return a host alias. With an invalid host alias, the API server would refuse each pod.

    Source: ``ValidateHostAliases`` in k8s.io/kubernetes, pkg/apis/core/validation/validation.go.
    """
    ip = field["ip"].text()
    names = []
    if not is_address(ip) or "%" in ip:
        fix = "Write the address of the host, such as 192.0.2.7"
        raise field["ip"].error("is not an IP address", fix)
    for hostname in field["hostnames"].items():
        names.append(hostname.text().lower())
        if not is_subdomain(names[-1]):
            raise hostname.error("is not a host name", "Use letters, digits, - and dots only")
    return {"ip": ip, "hostnames": names}


def _selector(field: Field) -> Selector | None:
    """Return a label selector, checked by the rules of the API server.

    The API server would refuse a NetworkPolicy with a malformed selector. Source:
    k8s.io/apimachinery, pkg/labels/selector.go and pkg/util/validation/validation.go.
    """
    if field.value is None:
        return None
    labels = field["matchLabels"].texts()
    for key in labels:
        _check_key(field["matchLabels"], key)
        _check_value(field["matchLabels"][key])
    expressions = field["matchExpressions"].items()
    return Selector(labels=labels, expressions=tuple(_expression(e) for e in expressions))


def _expression(field: Field) -> tuple[str, str, frozenset[str]]:
    key = field["key"].text()
    operator = field["operator"].one_of(_OPERATORS, "")
    _check_key(field["key"], key)
    values = [_check_value(value) for value in field["values"].items()]
    if bool(values) != (operator in ("In", "NotIn")):
        problem = f"{'is not' if values else 'is'} empty, but the operator is {operator}"
        fix = "Remove the values" if values else "Write at least one value"
        raise field["values"].error(problem, fix)
    return key, operator, frozenset(values)


def _check_key(field: Field, key: str) -> None:
    if not is_label_key(key):
        raise Field(field.path, key).error("can't be the key of a label", _LABEL_FIX)


def _check_value(field: Field) -> str:
    if not is_label_value(field.text()):
        raise field.error("can't be the value of a label", _LABEL_FIX)
    return field.text()


_LABEL_FIX = "Copy the text from the labels of the pod"


def _master(field: Field, of: Name) -> MasterSpec:
    uri = field["uri"]
    address = field["address"]
    service = field["service"]
    publish = field["publish"].number(0, *_LISTEN_PORTS)
    if (uri.value is None) == (service.value is None):
        raise InvalidField(
            f"{field.path}: give exactly one of uri (a master outside of the cluster) and service "
            "(a master in the cluster)"
        )
    if service.value is None:
        return MasterSpec(uri=_uri(uri, of), address=_address(address), publish=publish)
    if address.value is not None:
        raise InvalidField(f"{address.path}: goes with uri only", "Remove the field")
    port = service["port"].number(MASTER_PORT, 1, 65535)
    return MasterSpec(service=_service(service, of), service_port=port, publish=publish)


def _uri(field: Field, of: Name) -> str:
    """Return a master's URI in canonical form: lower-case host, a port, no slash at the end."""
    text = field.text()
    master = parse_slave_uri(text) or parse_slave_uri(_with_port(text))
    path = urlsplit(text).path.rstrip("/") if master else ""
    if master is None or not master.host.isascii() or not _PATH.fullmatch(path):
        raise field.error("is not the URI of a master", f"Write a URI such as {_EXAMPLE}")
    host = master.host.lower()
    if is_loopback(host):
        raise field.error(
            "means the proxy's own pod, where no master runs",
            "Give the master's host as the nodes of the cluster reach it; for a master in the "
            "cluster, give spec.master.service instead",
        )
    if _is_service(host, service_id(of)):
        raise field.error(_OWN_SERVICE, f"Give the real master, such as {_EXAMPLE}")
    return slave_uri(HostPort(host, master.port), path)


_OWN_SERVICE = "is this RosProxy's own Service"


def _with_port(text: str) -> str:
    """Return a URI with the master's default port, empty if the URI has a port or is invalid."""
    try:
        uri = urlsplit(text)
        lacks_port = uri.port is None and bool(uri.netloc) and not uri.netloc.endswith(":")
    except ValueError:
        return ""
    return uri._replace(netloc=f"{uri.netloc}:{MASTER_PORT}").geturl() if lacks_port else ""


def _is_service(host: str, service: Name) -> bool:
    """Whether a host name means a Service, for a pod in the Service's namespace."""
    full = f"{service.name}.{service.namespace}.svc"
    return host == service.name or f"{full}.".startswith(f"{host}.") or host.startswith(f"{full}.")


def _service(field: Field, of: Name) -> Name:
    name = field["name"]
    namespace = field["namespace"]
    service = Name(namespace.text() or of.namespace, name.text())
    if not is_label(service.name):
        raise name.error("can't be the name of a Service", "Copy the name from kubectl get service")
    if not is_label(service.namespace):
        raise namespace.error("can't be the name of a namespace", "Correct or remove the field")
    if service == service_id(of):
        raise name.error(_OWN_SERVICE, "Give the Service of the real master")
    return service


def _address(field: Field) -> str:
    address = parse_address(field.text())
    if field.value is not None and (address is None or is_loopback(address)):
        fix = "Give the IP address of the master's host, such as 192.0.2.7"
        raise field.error("is not an IP address of another host", fix)
    return address or ""


def _former_ranges(status: Json) -> dict[str, PortRange]:
    """Return the ranges in a status, by node name. An unreadable range counts as missing."""
    ranges = {
        text_at(line, "name"): port_range(line, "ports") for line in submaps(status, "perNode")
    }
    return {name: ports for name, ports in ranges.items() if ports is not None}


def _unregistered_at(status: Json) -> dict[str, str]:
    """Return the times ``unregisteredAt`` in a status, by node name, without malformed times."""
    lines = submaps(status, "perNode")
    times = {text_at(line, "name"): text_at(line, "unregisteredAt") for line in lines}
    return {name: time for name, time in times.items() if _TIME.fullmatch(time)}
