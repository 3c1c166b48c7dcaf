"""Pods with ROS nodes in namespaces of the tests' own."""

import itertools
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from tests.docker.engine import wait_until
from tests.docker.images import ROS
from tests.docker.nodes import Log, node_command
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.layout import Node, node_named
from tests.kubernetes.cluster.node import crash_container, stop_container

INJECT = "rosproxy.io/inject"
_numbers = itertools.count(1)


def unique(prefix: str) -> str:
    return f"{prefix}-{os.getpid()}-{next(_numbers)}"


@dataclass(frozen=True)
class Pod:
    namespace: str
    name: str

    @property
    def node(self) -> str:
        """The ROS name of the test node in this pod."""
        return self.name.replace("-", "_")

    @property
    def log(self) -> Log:
        return Log(lambda: api.logs(self.namespace, self.name))

    @property
    def body(self) -> Json:
        return api.get("pods", self.namespace, self.name)

    @property
    def ip(self) -> str:
        return str(self.body.get("status", {}).get("podIP", ""))

    @property
    def uid(self) -> str:
        return str(self.body.get("metadata", {}).get("uid", ""))

    @property
    def ready(self) -> bool:
        return ready(self.body)

    @property
    def environment(self) -> dict[str, Any]:
        """The variables of the first container, fieldRefs as their path."""
        return environment(self.body["spec"]["containers"][0])

    def wait_ready(self, seconds: float = 30) -> float:
        return wait_until(
            lambda: self.ready, seconds, lambda: f"{self} is ready: {self.body.get('status')}"
        )

    def run(self, *command: str, seconds: float = 30, check: bool = True) -> str:
        """Run a command in the first container."""
        words = ("exec", "--namespace", self.namespace, self.name, "--", "timeout", str(seconds))
        return kubectl(*words, *command, check=check, seconds=seconds + 10)

    def crash(self) -> None:
        """Kill the first process of the first container, like the kernel."""
        crash_container(*self._first_container())

    def hang(self) -> None:
        """Let the first process of the first container hang."""
        stop_container(*self._first_container())

    def _first_container(self) -> tuple[Node, str]:
        """The node and the ID of the first container."""
        body = self.body
        container = body["status"]["containerStatuses"][0]["containerID"]
        return node_named(body["spec"]["nodeName"]), container.removeprefix("containerd://")

    def remove(self, grace: int | None = None, *, wait: bool = True) -> None:
        """Delete the pod, and wait until gone. Another pod may have the name then."""
        uid = self.uid
        api.delete("pods", self.namespace, self.name, grace=grace)
        if wait:
            wait_until(lambda: self.uid != uid, 60, f"{self} is gone")


def ready(body: Json) -> bool:
    conditions = body.get("status", {}).get("conditions", [])
    return any(c["type"] == "Ready" and c["status"] == "True" for c in conditions)


def environment(container: Json) -> dict[str, Any]:
    return {
        variable["name"]: variable.get(
            "value", variable.get("valueFrom", {}).get("fieldRef", {}).get("fieldPath")
        )
        for variable in container.get("env", [])
    }


@dataclass
class Namespace:
    """Makes pods in a Kubernetes namespace."""

    name: str
    labels: Mapping[str, str] = field(default_factory=lambda: {INJECT: "true"})

    def pod(self, *command: str, on: str = "", **more: Any) -> Pod:
        """Start a pod like a user: an image, a command and a label."""
        pod = Pod(self.name, more.pop("name", "") or unique("pod"))
        api.create(self.pod_body(pod.name, *command, on=on, **more))
        return pod

    def pod_body(
        self, name: str, *command: str, on: str = "", labels: Mapping[str, str] | None = None,
        env: Mapping[str, str] | None = None, ports: tuple[int, ...] = (),
        protocol: str = "TCP", image: str = ROS, **spec: Any,
    ) -> Json:  # fmt: skip
        container: Json = {
            "name": "ros", "image": image, "imagePullPolicy": "Never", "command": list(command),
            "env": [{"name": key, "value": value} for key, value in (env or {}).items()],
            "ports": [{"containerPort": port, "hostPort": port, "protocol": protocol}
                      for port in ports],
        }  # fmt: skip
        placement = {"nodeSelector": {"kubernetes.io/hostname": on}} if on else {}
        return {
            "apiVersion": "v1",
            "kind": "Pod",
            "metadata": {"name": name, "namespace": self.name,
                         "labels": dict(self.labels if labels is None else labels)},
            # roscpp, as the first process of a container, does not hear SIGTERM.
            "spec": {"containers": [container], "terminationGracePeriodSeconds": 1,
                     "automountServiceAccountToken": False, **placement, **spec},
        }  # fmt: skip

    def node(self, library: str, role: str, *options: str, **more: Any) -> Pod:
        """Start a test node in a pod. Both have the same name."""
        pod = Pod(self.name, more.setdefault("name", unique(role)))
        return self.pod(*node_command(library, role, *options, f"__name:={pod.node}"), **more)

    def idle(self, **more: Any) -> Pod:
        """Start a pod that runs no node."""
        return self.pod("sleep", "infinity", **more)

    def pods(self, selector: str = "") -> list[Json]:
        return api.objects("pods", self.name, selector)


@contextmanager
def namespace(name: str = "", labels: Mapping[str, str] | None = None) -> Iterator[Namespace]:
    """A namespace, deleted with its objects afterwards."""
    name = name or unique("test")
    api.create({"apiVersion": "v1", "kind": "Namespace",
                "metadata": {"name": name, "labels": dict(labels or {})}})  # fmt: skip
    wait_until(lambda: bool(api.get("serviceaccounts", name, "default")), 60, "a service account")
    try:
        yield Namespace(name)
    finally:
        api.delete("namespaces", "", name)
