"""Masters that run in the cluster: the Services that RosProxies name."""

from collections.abc import Collection
from ipaddress import ip_address

from rosproxy_operator.kubernetes.api import Api, Found
from rosproxy_operator.kubernetes.errors import ApiError, ErrorKind
from rosproxy_operator.kubernetes.planner.model import Name


def master_service(api: Api, id: Name, ports: Collection[int]) -> tuple[str, str]:
    """A Service's cluster IP and what is wrong with it; one of them is empty. Raises ApiError.

    ``ports`` are those that RosProxies name; one of them has to be there.
    """
    try:
        return read_master(api.get("services", id), id, ports)
    except ApiError as error:
        if error.kind is not ErrorKind.GONE:
            raise
        return "", f"there is no Service {id.name} in the namespace {id.namespace}: create it"


def read_master(service: Found, id: Name, ports: Collection[int]) -> tuple[str, str]:
    """The same, from a Service as the API server gives it."""
    spec = service.get("spec") or {}
    address = str(spec.get("clusterIP") or "")
    if not _is_address(address):
        return "", (
            f"the Service {id} has no cluster IP ({spec.get('type') or 'headless'}): "
            "make it one of type ClusterIP with an address of its own"
        )
    offered = {port.get("port") for port in spec.get("ports") or () if isinstance(port, dict)}
    if not offered & set(ports):
        has, wanted = (", ".join(sorted(map(str, some))) or "none" for some in (offered, ports))
        return (
            "",
            f"the Service {id} has no port {wanted} (it has {has}): set spec.master.service.port",
        )
    return address, ""


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True
