"""RosProxies, and the operator's objects for RosProxies."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tests.docker.engine import wait_until
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.pods import Pod

PROXY_OF = "rosproxy.io/proxy-of"
NOWHERE = {"uri": "http://192.0.2.9:11311"}
"""A master that tests do not need to reach."""


@dataclass(frozen=True)
class Event:
    type: str
    reason: str
    message: str
    count: int


@dataclass(frozen=True)
class Proxy(Pod):
    """A proxy's pod for the node ``on``, with the range ``ports``."""

    uid_then: str
    on: str
    ports: str

    @property
    def first_port(self) -> int:
        return int(self.ports.split("-")[0])

    @property
    def restarts(self) -> int:
        statuses = self.body.get("status", {}).get("containerStatuses", [])
        return sum(int(status["restartCount"]) for status in statuses)


@dataclass(frozen=True)
class RosProxy:
    namespace: str
    name: str

    @property
    def body(self) -> Json:
        return api.get("rosproxies", self.namespace, self.name)

    @property
    def status(self) -> Json:
        status: Json = self.body.get("status", {})
        return status

    @property
    def service(self) -> Json:
        return api.get("services", self.namespace, f"rosproxy-{self.name}")

    @property
    def proxies(self) -> list[Proxy]:
        """The proxies' pods, without pods that are being deleted."""
        selector = f"{PROXY_OF}={self.name},app.kubernetes.io/component=proxy"
        bodies = api.objects("pods", self.namespace, selector)
        return [proxy(body) for body in bodies if "deletionTimestamp" not in body["metadata"]]

    def proxy_on(self, node: str) -> Proxy | None:
        return next((proxy for proxy in self.proxies if proxy.on == node), None)

    def the_proxy(self, node: str = "node1", seconds: float = 30) -> Proxy:
        """Wait until the proxy on a node is ready. Return the proxy."""

        ready: list[Proxy] = []

        def has_ready_proxy() -> bool:
            ready[:] = [
                candidate for candidate in self.proxies if candidate.on == node and candidate.ready
            ]
            return bool(ready)

        wait_until(has_ready_proxy, seconds, lambda: f"a proxy of {self} on {node}: {self.tell()}")
        return ready[0]

    def condition(self, kind: str) -> Json:
        conditions = [c for c in self.status.get("conditions", []) if c["type"] == kind]
        return conditions[0] if conditions else {}

    def wait_for(
        self, kind: str, status: str = "True", reason: str = "", seconds: float = 40
    ) -> Json:
        """Wait for a condition. Return the condition."""

        def is_met() -> bool:
            condition = self.condition(kind)
            return condition.get("status") == status and reason in ("", condition.get("reason"))

        wait_until(is_met, seconds, lambda: f"{kind}={status} {reason} of {self.tell()}")
        return self.condition(kind)

    def wait_status(
        self, predicate: Callable[[Json], bool], message: str, seconds: float = 40
    ) -> Json:
        wait_until(lambda: predicate(self.status), seconds, lambda: f"{message}: {self.tell()}")
        return self.status

    def on(self, node: str) -> Json:
        """The row of a node in the status."""
        rows = [row for row in self.status.get("perNode", []) if row["name"] == node]
        return rows[0] if rows else {}

    @property
    def events(self) -> list[Event]:
        return events(self.namespace, self.name, "RosProxy")

    def wait_event(self, reason: str, text: str = "", seconds: float = 30) -> Event:
        return wait_event(self.namespace, self.name, "RosProxy", reason, text, seconds)

    def change(self, **spec: Any) -> None:
        """Change fields of the spec. None removes a field."""
        api.patch("rosproxies", self.namespace, self.name, {"spec": spec})

    def remove(self) -> None:
        api.delete("rosproxies", self.namespace, self.name)

    def tell(self) -> str:
        pods = [(p.name, p.on, p.ports, p.ready, p.body.get("status")) for p in self.proxies]
        return f"{self.name}: status {self.status}\nproxies {pods}\nevents {self.events}"


def rosproxy(namespace: str, name: str = "robot", **spec: Any) -> RosProxy:
    """Create a RosProxy."""
    api.create(rosproxy_body(namespace, name, **spec))
    return RosProxy(namespace, name)


def rosproxy_body(namespace: str, name: str = "robot", **spec: Any) -> Json:
    return {
        "apiVersion": "rosproxy.io/v1alpha1",
        "kind": "RosProxy",
        "metadata": {"name": name, "namespace": namespace},
        "spec": spec,
    }


def proxy(body: Json) -> Proxy:
    metadata = body["metadata"]
    notes = metadata.get("annotations", {})
    return Proxy(
        metadata["namespace"], metadata["name"], metadata["uid"],
        notes.get("rosproxy.io/node", ""), notes.get("rosproxy.io/port-range", ""),
    )  # fmt: skip


def all_proxies() -> list[Json]:
    """The pods of all proxies in the cluster."""
    return api.objects("pods", "", PROXY_OF)


def events(namespace: str, name: str, kind: str) -> list[Event]:
    """The events about an object."""
    own_events = []
    for body in api.objects("events", namespace):
        about = body["involvedObject"]
        if about.get("name") == name and about.get("kind") == kind:
            own_events.append(
                Event(body["type"], body["reason"], body["message"], body.get("count") or 1)
            )
    return own_events


def wait_event(
    namespace: str, name: str, kind: str, reason: str, text: str = "", seconds: float = 30
) -> Event:
    def matching() -> list[Event]:
        every = events(namespace, name, kind)
        return [event for event in every if event.reason == reason and text in event.message]

    wait_until(
        lambda: bool(matching()), seconds,
        lambda: f"event {reason} about {name}: {events(namespace, name, kind)}",
    )  # fmt: skip
    return matching()[0]
