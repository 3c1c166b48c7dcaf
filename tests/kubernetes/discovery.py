"""A replacement for Prometheus' discovery of Kubernetes, over HTTP.

Debian builds Prometheus without that discovery. Targets and labels follow the documentation of the
roles `pod` and `endpoints`. The chart's monitors choose and relabel the targets.
"""

import contextlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.pods import ready

_META = "__meta_kubernetes_"
Labels = dict[str, str]


@contextmanager
def discovery() -> Iterator[str]:
    """Serve it. A role and a namespace are added to the URL; with no namespace all are meant."""
    with ThreadingHTTPServer(("127.0.0.1", 0), _Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


class _Handler(BaseHTTPRequestHandler):
    """Serves targets. Without the API server there is no answer, and Prometheus keeps its
    targets.
    """

    def do_GET(self) -> None:
        _, role, namespace = self.path.split("/")
        groups = {"pod": _pods, "endpoints": _endpoints}[role](namespace)
        with contextlib.suppress(OSError):  # Prometheus has a short time limit
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.end_headers()
            self.wfile.write(json.dumps(list(groups)).encode())

    def log_message(self, *_: object) -> None:
        """Say nothing: Prometheus asks each second."""


def _group(address: str, labels: Labels) -> Json:
    return {"targets": [address], "labels": labels}


def _pods(namespace: str) -> Iterator[Json]:
    """Each declared port of each container, and each container without any."""
    for body in api.objects("pods", namespace):
        address = body["status"].get("podIP")
        if not address:
            continue
        spec = body["spec"]
        labels = _pod_labels(body)
        for container in [*spec["containers"], *spec.get("initContainers", [])]:
            ports = container.get("ports", [])
            for port in ports:
                number = port["containerPort"]
                yield _group(f"{address}:{number}", labels | _container_labels(container, port))
            if not ports:
                yield _group(address, labels | _container_labels(container, {}))


def _endpoints(namespace: str) -> Iterator[Json]:
    """Each port of each address, with the labels of its Service and its pod.

    Ports of such a pod without a Service are left out. A monitor with a port name drops these.
    """
    services = _by_name("services", namespace)
    pods = _by_name("pods", namespace)
    for body in api.objects("endpoints", namespace):
        service = services.get(body["metadata"]["name"])
        shared = _service_labels(service) if service else {}
        for subset in body.get("subsets", []):
            for kind, is_ready in (("addresses", "true"), ("notReadyAddresses", "false")):
                for address in subset.get(kind, []):
                    pod = pods.get(address.get("targetRef", {}).get("name", ""))
                    for port in subset["ports"]:
                        labels = _endpoint_labels(address, port) | shared
                        labels[f"{_META}endpoint_ready"] = is_ready
                        labels |= _backing_labels(pod, port["port"]) if pod else {}
                        yield _group(f"{address['ip']}:{port['port']}", labels)


def _by_name(resource: str, namespace: str) -> dict[str, Json]:
    return {body["metadata"]["name"]: body for body in api.objects(resource, namespace)}


def _pod_labels(body: Json) -> Labels:
    metadata = body["metadata"]
    status = body["status"]
    return {
        f"{_META}namespace": metadata["namespace"],
        f"{_META}pod_name": metadata["name"],
        f"{_META}pod_uid": metadata["uid"],
        f"{_META}pod_ip": status.get("podIP", ""),
        f"{_META}pod_host_ip": status.get("hostIP", ""),
        f"{_META}pod_node_name": body["spec"].get("nodeName", ""),
        f"{_META}pod_phase": status["phase"],
        f"{_META}pod_ready": str(ready(body)).lower(),
        **_labels_of("pod", body),
    }


def _container_labels(container: Json, port: Json) -> Labels:
    prefix = f"{_META}pod_container_"
    labels = {f"{prefix}name": container["name"], f"{prefix}image": container["image"]}
    if port:
        labels[f"{prefix}port_name"] = port.get("name", "")
        labels[f"{prefix}port_number"] = str(port["containerPort"])
        labels[f"{prefix}port_protocol"] = port["protocol"]
    return labels


def _backing_labels(pod: Json, number: int) -> Labels:
    """The labels of the pod behind an endpoint, and of the container that has the port."""
    for container in pod["spec"]["containers"]:
        for port in container.get("ports", []):
            if port["containerPort"] == number:
                return _pod_labels(pod) | _container_labels(container, port)
    return _pod_labels(pod)


def _endpoint_labels(address: Json, port: Json) -> Labels:
    pod = address.get("targetRef", {})
    return {
        f"{_META}endpoint_port_name": port.get("name", ""),
        f"{_META}endpoint_port_protocol": port["protocol"],
        f"{_META}endpoint_node_name": address.get("nodeName", ""),
        f"{_META}endpoint_address_target_kind": pod.get("kind", ""),
        f"{_META}endpoint_address_target_name": pod.get("name", ""),
    }


def _service_labels(body: Json) -> Labels:
    metadata = body["metadata"]
    return {
        f"{_META}namespace": metadata["namespace"],
        f"{_META}service_name": metadata["name"],
        **_labels_of("service", body),
    }


def _labels_of(kind: str, body: Json) -> Labels:
    """An object's own labels, in characters that Prometheus allows."""
    labels: Labels = {}
    for name, value in body["metadata"].get("labels", {}).items():
        clean = re.sub(r"\W", "_", name)
        labels[f"{_META}{kind}_label_{clean}"] = value
        labels[f"{_META}{kind}_labelpresent_{clean}"] = "true"
    return labels
