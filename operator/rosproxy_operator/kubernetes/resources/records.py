"""Records: the parts of watched objects that the operator keeps in memory.

A cluster may have tens of thousands of pods, and most pods do not use rosproxy. Such a pod takes a
few hundred bytes. Texts that many pods share, such as labels and node names, are kept once.
"""

import sys
from collections.abc import Callable, Mapping

from msgspec.structs import replace

from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.checks import submap, text_at, texts_at
from rosproxy_operator.kubernetes.resources.cluster import (
    MasterService,
    OwnPod,
    ProxyPolicy,
    ProxyService,
)
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import (
    ClusterNode,
    InvalidRosProxy,
    Json,
    Name,
    Pod,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import PLURAL
from rosproxy_operator.kubernetes.resources.spec import invalid, rosproxy

PodRecord = Pod | OwnPod
Record = (
    RosProxy
    | InvalidRosProxy
    | ClusterNode
    | PodRecord
    | ProxyService
    | MasterService
    | ProxyPolicy
)
Change = tuple[str, Record | None]
"""An object's key, and the object's new record. None: the object is gone, or has no record."""
POLICIES = "networkpolicies"


def key_of(obj: Json) -> str:
    """Return the key of an object: the uid, which Kubernetes never uses again."""
    return text_at(submap(obj, "metadata"), "uid")


def pod_record(obj: Json) -> PodRecord:
    """Return the record of a pod, an `OwnPod` for a pod of the operator."""
    if names.is_own(texts_at(submap(obj, "metadata"), "labels")):
        own_pod = objects.proxy_pod(obj) or objects.helper_pod(obj)
        if own_pod is not None:
            return own_pod
    return _shared(objects.pod(obj))


def rosproxy_record(obj: Json) -> RosProxy | InvalidRosProxy:
    """Return the record of a RosProxy, an `InvalidRosProxy` if a field is invalid."""
    try:
        return rosproxy(obj)
    except InvalidField as error:
        return invalid(obj, error)


def service_record(obj: Json) -> ProxyService | MasterService:
    """Return the record of a Service, a `ProxyService` for a Service of the operator."""
    return objects.service(obj) or objects.master_service(obj)


READERS: Mapping[str, Callable[[Json], Record | None]] = {
    PLURAL: rosproxy_record,
    "nodes": objects.node,
    "pods": pod_record,
    "services": service_record,
    POLICIES: objects.policy,
}
"""The reader for each watched kind. A reader returns None for an object without use here."""


def _shared(pod: Pod) -> Pod:
    """Return the same pod, with interned texts: a text that many pods share is in memory once."""
    intern = sys.intern
    return replace(
        pod,
        id=Name(intern(pod.id.namespace), pod.id.name),
        node=intern(pod.node),
        phase=intern(pod.phase),
        controller=intern(pod.controller),
        labels={intern(key): intern(value) for key, value in pod.labels.items()},
        # Most pods have a single address: then `ips` and `ip` share the text.
        ips=(pod.ip,) if pod.ips == (pod.ip,) else pod.ips,
        containers=tuple(replace(c, image=intern(c.image)) for c in pod.containers),
        misspelt=tuple(map(intern, pod.misspelt)),
    )
