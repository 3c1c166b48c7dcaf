"""The custom resource RosProxy, read.

The API server checks objects against the CRD, but not those that were there before the CRD became
stricter; all that would harm others (a label selector that is refused, a host alias with which no
pod is admitted) is checked here again. Defaults are those of the CRD.
"""

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import is_address
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.settings import DataPlane, SettingError, parse_range
from rosproxy_operator.kubernetes.planner.model import (
    Advertise,
    InvalidRosProxy,
    Json,
    Name,
    RosProxy,
    RosProxySpec,
)
from rosproxy_operator.kubernetes.planner.spec_master import master
from rosproxy_operator.kubernetes.planner.spec_selector import selector
from rosproxy_operator.kubernetes.planner.values import (
    Field,
    InvalidField,
    is_label,
    is_subdomain,
    number,
    part,
    parts,
    word,
)

__all__ = ["MOST_PORTS", "InvalidField", "invalid", "rosproxy"]

MOST_PORTS = 500
MOST_NAME = 46
"""Characters of a RosProxy's name, so that a proxy's still fits into a pod's host name."""
WINDOW = PortRange(11400, 29999)
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
_PULL_POLICIES = ("", "Always", "IfNotPresent", "Never")


def rosproxy(obj: Json) -> RosProxy:
    """A RosProxy. Raises Unusable."""
    id = _id(obj)
    if not is_label(id.name) or len(id.name) > MOST_NAME:
        raise Field("metadata.name", id.name).wrong(
            "does not fit", f"a RosProxy's name has at most {MOST_NAME} characters a-z, 0-9 and -"
        )
    status = part(obj, "status")
    return RosProxy(
        id=id,
        uid=word(part(obj, "metadata"), "uid"),
        generation=number(part(obj, "metadata"), "generation"),
        spec=_spec(Field("spec", part(obj).get("spec")), id),
        former=_former(status),
        cluster_ip=_cluster_ip(status),
        status=status,
        deleting="deletionTimestamp" in part(obj, "metadata"),
    )


def invalid(obj: Json, error: InvalidField) -> InvalidRosProxy:
    """What is left of a RosProxy that can't be read. Never raises."""
    meta = part(obj, "metadata")
    return InvalidRosProxy(
        _id(obj), word(meta, "uid"), number(meta, "generation"), str(error), part(obj, "status")
    )


def _id(obj: Json) -> Name:
    meta = part(obj, "metadata")
    return Name(word(meta, "namespace"), word(meta, "name"))


def _spec(spec: Field, of: Name) -> RosProxySpec:
    ports = spec.child("ports").integer(32, 1, MOST_PORTS)
    return RosProxySpec(
        master=master(spec.child("master"), of),
        ports=ports,
        window=_window(spec.child("portWindow"), ports),
        pod_selector=selector(spec.child("podSelector")),
        node_selector=spec.child("nodeSelector").texts(),
        tolerations=spec.child("tolerations").maps(),
        advertise=Advertise(
            spec.child("advertise").choice([one.value for one in Advertise], "InternalIP")
        ),
        cleanup_after=spec.child("cleanupAfterSeconds").seconds(30.0),
        grace=spec.child("graceSeconds").seconds(60.0),
        slave_control=_SLAVE_CONTROL[
            spec.child("policy").child("slaveControl").choice(_SLAVE_CONTROL, "Any")
        ],
        data_plane=_DATA_PLANE[spec.child("dataPlane").choice(_DATA_PLANE, "Auto")],
        image=spec.child("image").text(),
        image_pull_policy=spec.child("imagePullPolicy").choice(_PULL_POLICIES, ""),
        image_pull_secrets=spec.child("imagePullSecrets").maps(),
        resources=_resources(spec.child("resources")),
        host_aliases=tuple(map(_host_alias, spec.child("hostAliases").list())),
    )


def _window(field: Field, ports: int) -> PortRange:
    first = field.child("first").integer(WINDOW.first, 1024, 65535)
    last = field.child("last").integer(WINDOW.last, 1024, 65535)
    if last - first + 1 < ports:
        raise InvalidField(
            f"{field.path}: {first}-{last} has not the {ports} ports that spec.ports asks for: "
            "make the window larger, or spec.ports smaller"
        )
    return PortRange(first, last)


def _resources(field: Field) -> Json:
    return field.map() if field.given else RESOURCES


def _host_alias(field: Field) -> Json:
    """One that the API server takes: pods with another would not be admitted.

    That is ``ValidateHostAliases`` in k8s.io/kubernetes, pkg/apis/core/validation/validation.go.
    """
    address, names = field.child("ip"), field.child("hostnames").list()
    if not is_address(address.text()) or "%" in address.text():
        raise address.wrong("is not an IP address", "write the host's address, e.g. 192.0.2.7")
    for name in names:
        if not is_subdomain(name.text().lower()):
            raise name.wrong("is not a host name", "it has letters, digits, - and dots only")
    return {"ip": address.text(), "hostnames": [name.text().lower() for name in names]}


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
