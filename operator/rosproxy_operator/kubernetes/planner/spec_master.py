"""Where the real master of a RosProxy is, read."""

import re
from urllib.parse import urlsplit

from rosproxy.net.addresses import HostPort, is_loopback, parse_address
from rosproxy.ros1.protocol.uris import parse_slave_uri, slave_uri
from rosproxy_operator.kubernetes.planner.model import MasterSpec, Name
from rosproxy_operator.kubernetes.planner.names import service_id
from rosproxy_operator.kubernetes.planner.values import Field, InvalidField, is_label

PORT = 11311
_PATH = re.compile(r"[\w./~%-]*", re.ASCII)
_EXAMPLE = "http://robot.example:11311"


def master(field: Field, of: Name) -> MasterSpec:
    """``spec.master`` of the RosProxy with this name. Raises Unusable."""
    uri, service = field.child("uri"), field.child("service")
    if uri.given == service.given:
        raise InvalidField(
            f"{field.path}: give either uri, for a master outside of the cluster, or service, for "
            "one in it, and not both"
        )
    publish = field.child("publish").integer(0, 1024, 65535)
    address = _address(field.child("address"))
    if service.given:
        if address:
            raise InvalidField(f"{field.path}.address: goes with uri only: leave it out")
        port = service.child("port").integer(PORT, 1, 65535)
        return MasterSpec(service=_service(service, of), service_port=port, publish=publish)
    return MasterSpec(uri=_uri(uri, of), address=address, publish=publish)


def _uri(field: Field, of: Name) -> str:
    """A master's URI in its one form: host in lower case, with a port, no slash at the end."""
    text = field.text()
    where = parse_slave_uri(text) or parse_slave_uri(_with_port(text))
    path = urlsplit(text).path.rstrip("/") if where else ""
    if where is None or not where.host.isascii() or not _PATH.fullmatch(path):
        raise field.wrong("is not a master's URI", f"write it like {_EXAMPLE}")
    host = where.host.lower()
    if is_loopback(host):
        raise field.wrong(
            "would be the proxy's own pod, where no master runs",
            "give the master's host as the nodes of the cluster reach it, or, for a master in the "
            "cluster, service instead",
        )
    if _is_service(host, service_id(of)):
        raise field.wrong("is this RosProxy's own Service", f"give the real master, as {_EXAMPLE}")
    return slave_uri(HostPort(host, where.port), path)


def _with_port(text: str) -> str:
    """The same URI with the master's usual port."""
    try:
        parts = urlsplit(text)
        bare = parts.port is None and bool(parts.netloc) and not parts.netloc.endswith(":")
    except ValueError:
        return ""
    return parts._replace(netloc=f"{parts.netloc}:{PORT}").geturl() if bare else ""


def _is_service(host: str, service: Name) -> bool:
    """Whether a host's name is that of a Service in the cluster's DNS, seen from its namespace."""
    full = f"{service.name}.{service.namespace}.svc"
    return host == service.name or f"{full}.".startswith(f"{host}.") or host.startswith(f"{full}.")


def _service(field: Field, of: Name) -> Name:
    name = field.child("name")
    namespace = field.child("namespace").text() or of.namespace
    if not is_label(name.text()):
        raise name.wrong("is not a Service's name", "write it as kubectl get service shows it")
    if not is_label(namespace):
        raise field.child("namespace").wrong("is not a namespace's name", "leave it out or mend it")
    found = Name(namespace, name.text())
    if found == service_id(of):
        raise name.wrong("is this RosProxy's own Service", "name that of the real master")
    return found


def _address(field: Field) -> str:
    if not field.given:
        return ""
    address = parse_address(field.text())
    if address is None or is_loopback(address):
        raise field.wrong("is not an IP address", "give that of the master's host, e.g. 192.0.2.7")
    return address
