"""The chart's value ``proxy.pod``: defaults for the pods of all proxies, and a strict reader.

Without the reader, the API server would refuse each new pod, long after the user wrote a wrong
value.
"""

import re
from collections.abc import Mapping
from typing import Any

import msgspec

from rosproxy_operator.kubernetes.resources.checks import is_label_key, is_label_value, is_subdomain
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.fields import Field, stripped
from rosproxy_operator.kubernetes.resources.model import Json, RosProxy
from rosproxy_operator.kubernetes.resources.names import GROUP, NAME_LABEL

RESOURCES: Json = {
    "requests": {"cpu": "50m", "memory": "64Mi"},
    "limits": {"memory": "512Mi"},
}
USER = 10001
"""The uid and the gid in the proxy's image."""
_RESERVED_PREFIXES = (GROUP, NAME_LABEL.partition("/")[0])
"""Prefixes of the labels and annotations that the operator writes itself."""
_REPLACEABLE_FIELDS = ("image_pull_secrets", "node_selector", "tolerations", "resources")
"""Fields of a RosProxy's spec that replace defaults."""
_QUANTITY = re.compile(r"[0-9]+(\.[0-9]*)?([KMGTPE]i|[numkMGTPE]|[eE][+-]?[0-9]+)?", re.ASCII)
_OPERATORS = {operator: operator for operator in ("Equal", "Exists")}
_EFFECTS = {effect: effect for effect in ("", "NoSchedule", "PreferNoSchedule", "NoExecute")}


class PodDefaults(msgspec.Struct, frozen=True):
    """Defaults for the pods of proxies.

    A RosProxy's field of the same name replaces ``image_pull_secrets``, ``node_selector``,
    ``tolerations`` or ``resources``. LAN relays and image checks do not use ``resources``.
    With ``run_as_user`` None, the cluster or else the image chooses the user.
    """

    image_pull_secrets: tuple[Json, ...] = ()
    node_selector: Mapping[str, str] = {}
    tolerations: tuple[Json, ...] = ()
    resources: Json = msgspec.field(default_factory=lambda: RESOURCES)
    priority_class: str = ""
    labels: Mapping[str, str] = {}
    annotations: Mapping[str, str] = {}
    run_as_user: int | None = USER


def pod_defaults(value: Any) -> PodDefaults:
    """Return the defaults in the chart's value ``proxy.pod``. Raises InvalidField.

    A field that the value lacks has no default, also ``resources`` and ``runAsUser``.
    """
    field = Field("proxy.pod", stripped(value))
    _check_names(
        field,
        *("imagePullSecrets", "nodeSelector", "tolerations", "resources", "priorityClassName"),
        *("labels", "annotations", "runAsUser"),
    )
    for map_field in (field["labels"], field["annotations"]):
        _check_prefixes(map_field)
    return PodDefaults(
        image_pull_secrets=tuple(map(_secret, field["imagePullSecrets"].items())),
        node_selector=_labels(field["nodeSelector"]),
        tolerations=tuple(map(_toleration, field["tolerations"].items())),
        resources=_resources(field["resources"]),
        priority_class=_object_name(field["priorityClassName"]),
        labels=_labels(field["labels"]),
        annotations=_keyed(field["annotations"]),
        run_as_user=field["runAsUser"].number(0, 1, 2**31 - 1) or None,
    )


def with_pod_defaults(observed: ClusterSnapshot, defaults: PodDefaults) -> ClusterSnapshot:
    """Return the snapshot, with the defaults in all RosProxies' specs.

    An empty list or map in a spec counts as given: no default replaces the empty value.
    """
    rosproxies = tuple(_completed(rosproxy, defaults) for rosproxy in observed.rosproxies)
    return msgspec.structs.replace(observed, rosproxies=rosproxies)


def _completed(rosproxy: RosProxy, defaults: PodDefaults) -> RosProxy:
    spec = rosproxy.spec
    given = {
        name: getattr(defaults, name) for name in _REPLACEABLE_FIELDS if getattr(spec, name) is None
    }
    if not given:
        return rosproxy
    return msgspec.structs.replace(rosproxy, spec=msgspec.structs.replace(spec, **given))


def _check_names(field: Field, *names: str) -> None:
    for name in field.map():
        if name not in names:
            raise Field(field.path, name).error("is unknown", f"Use {', '.join(names)}")


def _check_prefixes(field: Field) -> None:
    for key in field.map():
        if key.partition("/")[0] in _RESERVED_PREFIXES:
            problem = "has a prefix that the operator uses itself"
            raise Field(field.path, key).error(problem, "Choose another prefix")


def _secret(field: Field) -> Json:
    _check_names(field, "name")
    if not _object_name(field["name"]):
        raise field.error("names no Secret", "Write {name: NAME}")
    return field.map()


def _object_name(field: Field) -> str:
    name = field.text()
    if name and not is_subdomain(name):
        raise field.error("can't be the name of an object", "Use a-z, 0-9, - and dots only")
    return name


def _keyed(field: Field) -> dict[str, str]:
    """Return a map of texts. Each key must be a valid key of a label or annotation."""
    for key in field.map():
        if not is_label_key(key):
            fix = "Write NAME or PREFIX/NAME of letters, digits, -, _ and dots"
            raise Field(field.path, key).error("can't be the key of a label or annotation", fix)
    return field.texts()


def _labels(field: Field) -> dict[str, str]:
    labels = _keyed(field)
    for key, value in labels.items():
        if not is_label_value(value):
            fix = "Use at most 63 letters, digits, -, _ and dots"
            raise field[key].error("can't be the value of a label", fix)
    return labels


def _toleration(field: Field) -> Json:
    """Return a toleration that satisfies the rules of a RosProxy's ``spec.tolerations``."""
    _check_names(field, "key", "operator", "value", "effect", "tolerationSeconds")
    key = field["key"].text()
    exists = field["operator"].one_of(_OPERATORS, "Equal") == "Exists"
    effect = field["effect"].one_of(_EFFECTS, "")
    if not key and not exists:
        raise field.error("has no key", "Write a key, or operator: Exists")
    if key and not is_label_key(key):
        raise field["key"].error("can't be the key of a taint", "Copy the key from the node")
    if field["value"].text() and exists:
        raise field["value"].error("goes with the operator Equal only", "Remove the value")
    seconds = field["tolerationSeconds"]
    if seconds.value is not None and effect != "NoExecute":
        raise seconds.error("goes with the effect NoExecute only", "Remove tolerationSeconds")
    seconds.number(0, 0, 2**31 - 1)
    return field.map()


def _resources(field: Field) -> Json:
    _check_names(field, "requests", "limits")
    for part in (field["requests"], field["limits"]):
        for name, quantity in part.map().items():
            if isinstance(quantity, bool) or not _QUANTITY.fullmatch(str(quantity)):
                raise part[name].error("is not a quantity", "Write a quantity such as 50m or 64Mi")
    return field.map()
