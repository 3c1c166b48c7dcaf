"""The administrator's defaults for the pods of proxies, where a RosProxy leaves a field out."""

from msgspec.structs import replace

from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import RosProxy
from rosproxy_operator.kubernetes.resources.pod_defaults import PodDefaults

_FIELDS = ("image_pull_secrets", "node_selector", "tolerations", "resources")


def with_pod_defaults(observed: ClusterSnapshot, defaults: PodDefaults) -> ClusterSnapshot:
    """What is seen, with RosProxies whose specs have the defaults.

    An empty list or map in a spec is no missing field: the RosProxy wants nothing there.
    """
    rosproxies = tuple(_completed(rosproxy, defaults) for rosproxy in observed.rosproxies)
    return replace(observed, rosproxies=rosproxies)


def _completed(rosproxy: RosProxy, defaults: PodDefaults) -> RosProxy:
    missing = [name for name in _FIELDS if getattr(rosproxy.spec, name) is None]
    if not missing:
        return rosproxy
    given = {name: getattr(defaults, name) for name in missing}
    return replace(rosproxy, spec=replace(rosproxy.spec, **given))
