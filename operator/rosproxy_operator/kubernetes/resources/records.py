"""What is kept of an object that is watched: its key, and no more than a look wants to know.

There may be tens of thousands of pods, most of them others': of those some hundred bytes are kept
each. What many have in common, as labels and nodes, is kept once.
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
"""An object's key and what it is now; None: gone."""
POLICIES = "networkpolicies"


def key_of(obj: Json) -> str:
    """What an object is known by: its uid, which no other has, before or after it."""
    return text_at(submap(obj, "metadata"), "uid")


def pod_record(obj: Json) -> PodRecord:
    """A pod, as one of the operator's if it is one."""
    if names.is_own(texts_at(submap(obj, "metadata"), "labels")):
        own_pod = objects.proxy_pod(obj) or objects.helper_pod(obj)
        if own_pod is not None:
            return own_pod
    return _shared(objects.pod(obj))


def rosproxy_record(obj: Json) -> RosProxy | InvalidRosProxy:
    """A RosProxy, or what is left of one that can't be read."""
    try:
        return rosproxy(obj)
    except InvalidField as error:
        return invalid(obj, error)


def service_record(obj: Json) -> ProxyService | MasterService:
    """A Service, as one of the operator's if it is one."""
    return objects.service(obj) or objects.master_service(obj)


READERS: Mapping[str, Callable[[Json], Record | None]] = {
    PLURAL: rosproxy_record,
    "nodes": objects.node,
    "pods": pod_record,
    "services": service_record,
    POLICIES: objects.policy,
}
"""By watched kind, how an object is read; None if the operator does not need the object."""


def _shared(pod: Pod) -> Pod:
    """The same pod, with texts interned that many pods have in common."""
    intern = sys.intern
    return replace(
        pod,
        id=Name(intern(pod.id.namespace), pod.id.name),
        node=intern(pod.node),
        phase=intern(pod.phase),
        controller=intern(pod.controller),
        labels={intern(key): intern(value) for key, value in pod.labels.items()},
        # One address is most often all.
        ips=(pod.ip,) if pod.ips == (pod.ip,) else pod.ips,
        containers=tuple(replace(c, image=intern(c.image)) for c in pod.containers),
        misspelt=tuple(map(intern, pod.misspelt)),
    )
