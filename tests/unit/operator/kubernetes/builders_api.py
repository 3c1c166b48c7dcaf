"""Objects in the form of the API server, for tests."""

from typing import Any

from rosproxy.shared.documents.status_document import RangeProbeStatus
from rosproxy.shared.ports import PortRange
from rosproxy_operator.kubernetes.resources.cluster import (
    PodFailure,
    ProxyPod,
    ProxyReport,
    RosProxyOnNode,
)
from rosproxy_operator.kubernetes.resources.model import (
    ClusterFinding,
    Json,
    MasterSpec,
    Name,
    Pod,
    RosProxy,
    RosProxySpec,
    Selector,
)
from rosproxy_operator.kubernetes.resources.names import own_labels, proxy_id, service_id
from rosproxy_operator.kubernetes.status.findings import findings
from rosproxy_operator.kubernetes.status.rosproxy_status import Addresses, status_of

Obj = dict[str, Any]

NAMESPACE = "robots"
ROBOT = "http://robot:11311"
CLUSTER_IP = "10.96.7.7"
URI = f"http://{CLUSTER_IP}:11311"
RANGE = PortRange(11400, 11431)
INJECT = {"rosproxy.io/inject": "true"}
STAMP = "2026-11-21T14:00:00Z"
REACHED = RangeProbeStatus(True, "ok", "ok", "tcp")
LATER = "2026-11-21T15:00:00Z"


def rosproxy_obj(spec: Any = None, name: str = "arm", status: Obj | None = None) -> Obj:
    """A RosProxy with the required fields and ``spec``."""
    return {
        "apiVersion": "rosproxy.io/v1alpha1",
        "kind": "RosProxy",
        "metadata": {"name": name, "namespace": NAMESPACE, "uid": f"uid-{name}", "generation": 3},
        "spec": {"master": {"uri": ROBOT}, **(spec or {})},
        "status": status or {},
    }


def pod_obj(name: str = "talker", labels: Obj | None = None, **spec: Any) -> Obj:
    """A user's pod that runs."""
    meta: Obj = {"name": name, "namespace": NAMESPACE, "uid": f"uid-{name}", "labels": labels or {}}
    containers = [{"name": "ros", "image": "ros"}]
    return {
        "metadata": meta,
        "spec": {"nodeName": "node1", "containers": containers, **spec},
        "status": {"phase": "Running", "podIP": "10.244.1.5"},
    }


def proxy_obj(of: str = "arm", node: str = "node1", status: Obj | None = None) -> Obj:
    """A proxy's pod."""
    name = proxy_id(Name(NAMESPACE, of), node).name
    owner = {
        "apiVersion": "rosproxy.io/v1alpha1",
        "kind": "RosProxy",
        "name": of,
        "uid": f"uid-{of}",
        "controller": True,
    }
    return {
        "metadata": {
            "name": name,
            "namespace": NAMESPACE,
            "uid": f"uid-{name}",
            "labels": own_labels(of),
            "annotations": {
                "rosproxy.io/node": node,
                "rosproxy.io/port-range": str(RANGE),
                "rosproxy.io/fingerprint": "0123456789abcdef",
                "rosproxy.io/advertise-host": "192.0.2.11",
            },
            "ownerReferences": [owner],
        },
        "spec": {
            "nodeName": node,
            "containers": [
                {
                    "name": "proxy",
                    "image": "rosproxy:1",
                    "ports": [
                        {"containerPort": port, "hostPort": port, "protocol": "TCP"}
                        for port in RANGE.ports()
                    ],
                }
            ],
        },
        "status": status or {"phase": "Running", "podIP": "10.244.1.9"},
    }


def service_obj(of: str = "arm", **meta: Any) -> Obj:
    """The Service of a RosProxy."""
    owners = proxy_obj(of)["metadata"]["ownerReferences"]
    return {
        "metadata": {
            "name": service_id(Name(NAMESPACE, of)).name,
            "namespace": NAMESPACE,
            "uid": "uid-service",
            "labels": own_labels(of),
            "annotations": {"rosproxy.io/fingerprint": "f"},
            "ownerReferences": owners,
            **meta,
        },
        "spec": {"clusterIP": CLUSTER_IP},
    }


def rosproxy(name: str = "arm", selector: Selector | None = None, **more: Any) -> RosProxy:
    """A RosProxy that has been read."""
    master = more.pop("master", MasterSpec(uri=ROBOT))
    spec = RosProxySpec(master, 32, PortRange(11400, 29999), pod_selector=selector)
    namespace = more.pop("namespace", NAMESPACE)
    return RosProxy(Name(namespace, name), f"uid-{name}", 3, spec, **more)


def pod(name: str = "talker", labels: Obj | None = None, **more: Any) -> Pod:
    """A pod that has been read; labelled unless told otherwise."""
    given = {"rosproxy.io/inject": "true"} if labels is None else labels
    id = Name(more.pop("namespace", NAMESPACE), name)
    return Pod(id, f"uid-{name}", given, **{"node": "node1", "phase": "Running", **more})


def proxy(node: str = "node1", ready: bool = True, **more: Any) -> ProxyPod:
    """A proxy that has been read."""
    name = proxy_id(Name(NAMESPACE, "arm"), node).name
    own = pod(name, own_labels("arm"), node=node, ip="10.244.1.9", **more.pop("pod", {}))
    of = Name(NAMESPACE, "arm")
    return ProxyPod(own, of, "uid-arm", node, "f", "rosproxy:1", range=RANGE, ready=ready, **more)


def stuck_proxy(why: PodFailure, message: str = "because") -> ProxyPod:
    """A proxy that does not run."""
    return proxy(ready=False, stuck=why, message=message)


def answer(*names: str, **more: Any) -> ProxyReport:
    """The answer of a proxy in order, with ROS nodes in a single pod."""
    nodes = {"10.244.1.5": names} if names else {}
    given = {"answered": True, "master_up": True, "nodes": nodes, "range_probe": REACHED}
    return ProxyReport(**{**given, **more})


def state(node: str = "node1", **more: Any) -> RosProxyOnNode:
    """A node, by default with a pod, a proxy and the proxy's answer."""
    fields = {
        "proxy": proxy(node),
        "pods": (pod(),),
        "answer": answer("/talker", topics=frozenset({"/chatter"})),
        **more,
    }
    return RosProxyOnNode(node, "192.0.2.11", fields.pop("range", RANGE), **fields)


def status(
    *states: RosProxyOnNode,
    of: RosProxy | None = None,
    more: tuple[ClusterFinding, ...] = (),
    **given: Any,
) -> Json:
    """The status for some nodes, with ``more`` problems besides the problems of the nodes."""
    resource = of or rosproxy()
    problems = (*findings(resource, states, given.get("failures", {})), *more)
    stamp = given.get("stamp", STAMP)
    addresses = Addresses(given.get("cluster_ip", CLUSTER_IP), ROBOT, given.get("outside"))
    waiting = given.get("unscheduled", ())
    return status_of(resource, states, problems, addresses, stamp, waiting)


def condition(rosproxy_status: Json, type: str) -> Any:
    (matching,) = [c for c in rosproxy_status["conditions"] if c["type"] == type]
    return matching


def judged(rosproxy_status: Json, type: str) -> tuple[str, str]:
    matching = condition(rosproxy_status, type)
    return matching["status"], matching["reason"]


def message(rosproxy_status: Json, type: str = "Ready") -> str:
    return str(condition(rosproxy_status, type)["message"])
