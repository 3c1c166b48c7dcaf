"""A cluster with random events, and its invariants.

Each event is a method of two numbers, which choose the object.
"""

import contextlib
from collections.abc import Sequence
from typing import Any, TypeVar

from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.model import Name
from tests.unit.operator.kubernetes.simulation import (
    BAD_IMAGE,
    NAMESPACE,
    Object,
    Refused,
    deleting,
    is_own,
    meta,
    name_of,
    node_of,
)
from tests.unit.operator.kubernetes.worlds import FIRST, World, spec

ROSPROXIES = ("robot", "arm")
SERVICE = {"service": {"name": "roscore", "namespace": NAMESPACE, "port": 11311}}
CHANGES: tuple[dict[str, Any], ...] = (
    {"ports": 2},
    {"ports": 3},
    {"ports": 6},
    {"master": {"uri": "http://robot:11311"}},
    {"master": {"uri": "http://192.0.2.77:11311"}},
    {"master": SERVICE},
    {"master": {**SERVICE, "publish": 11500}},
    {"master": {**SERVICE, "publish": 11403}},
    {"image": "rosproxy:2"},
    {"image": BAD_IMAGE},
    {"image": "rosproxy:1"},
    {"portWindow": {"first": 11400, "last": 11409}},
    {"portWindow": {"first": 11405, "last": 11416}},
    {"portWindow": {"first": 11306, "last": 11315}},
    {"nodeSelector": {"zone": "e"}},
    {"nodeSelector": {}},
    {"podSelector": {"matchLabels": {"app": "x"}}},
    {"podSelector": None},
    {"advertise": "ExternalIP"},
    {"advertise": "InternalIP"},
    {"cleanupAfterSeconds": 7},
    {"ros": 2, "multicast": True, "peers": ["robot"]},
    {"ros": 2, "multicast": None, "domain": 7},
    {"ros": "1,2", "multicast": True},
    {"ros": "zenoh", "peers": ["robot"]},
    {"ros": "zenoh", "listen": {"type": "NodePort"}},
    {"ros": "zenoh", "link": {"to": ["tls/cloud"], "secretName": "link", "limits": ["/a=2Hz"]}},
    {"ros": 1},
)
LABELS = ({names.INJECT: "true"}, {names.INJECT: "robot", "app": "x"}, {names.INJECT: "arm"},
          {"rosproxy.io/injekt": "true"})  # fmt: skip
T = TypeVar("T")


def mended(spec: Object) -> Object:
    """A spec that the API server accepts, for any version of ROS."""
    ros = str(spec.get("ros", 1))
    if ros == "zenoh":  # only defaults, as the API server fills in
        window = {"first": 11412, "last": 29999}
        absent = dict.fromkeys(
            ("master", "multicast", "domain", "advertise", "cleanupAfterSeconds")
        )
        return spec | absent | {"ports": 32, "portWindow": window}
    spec = spec | {"listen": None, "link": None}
    if "1" not in ros:
        spec = spec | {"master": None}
    elif not spec["master"]:
        spec = spec | {"master": {"uri": "http://robot:11311"}}
    if "2" not in ros:
        return spec | dict.fromkeys(("multicast", "peers", "domain"))
    return spec | {"ports": max(spec["ports"], 5)}


def pick(items: Sequence[T], number: int) -> T:
    return items[number % len(items)]


class Clusters(World):
    """A world with labelled pods, and users that interfere."""

    # pods of users

    def run(self, n: int, m: int) -> None:
        if self.nodes:
            self.pods += 1
            node = pick(self.nodes, n)
            self.cluster.add_pod(f"pod-{self.pods}", node, pick(LABELS, m))

    def remove(self, n: int, _: int) -> None:
        if self.users():
            self.cluster.delete_pod(pick(self.users(), n))

    def end(self, n: int, _: int) -> None:
        if pods := [pod for pod in self.users() if not deleting(pod)]:
            pick(pods, n)["status"]["phase"] = "Succeeded"

    def stranger(self, n: int, m: int) -> None:
        """A pod that takes a hostPort, if this port is free."""
        if self.nodes:
            self.pods += 1
            with contextlib.suppress(Refused):
                node = pick(self.nodes, n)
                protocol = pick(("TCP", "UDP"), m // 14)
                self.cluster.add_pod(f"pod-{self.pods}", node, {}, [FIRST + m % 14], protocol)
            self.cluster.schedule()

    def namesake(self, n: int, m: int) -> None:
        """A pod that is called as a proxy would be."""
        id = names.proxy_id(Name(self.namespace, pick(ROSPROXIES, n)), pick(list(self.names), m))
        if self.nodes and id not in self.cluster.state.pods:
            self.cluster.add_pod(id.name, pick(self.nodes, n), {})

    def register(self, n: int, _: int) -> None:
        """ROS nodes of all pods on a node register at the proxies, before the operator looks."""
        if not self.nodes:
            return
        node = pick(self.nodes, n)
        uids = [meta(pod)["uid"] for pod in self.users() if node_of(pod) == node]
        addresses = {self.cluster.addresses[uid] for uid in uids if uid in self.cluster.addresses}
        for pod, proxy in self.proxies():
            if proxy.node == node and proxy.pod.uid in self.cluster.ros:
                self.cluster.ros[meta(pod)["uid"]] |= addresses

    # nodes

    def toggle_ready(self, n: int, _: int) -> None:
        if self.nodes:
            node = self.cluster.state.nodes[pick(self.nodes, n)]
            condition = node["status"]["conditions"][0]
            condition["status"] = "Unknown" if condition["status"] == "True" else "True"

    def cordon(self, n: int, m: int) -> None:
        if self.nodes:
            self.cluster.state.nodes[pick(self.nodes, n)]["spec"]["unschedulable"] = bool(m % 2)

    def lose_node(self, n: int, _: int) -> None:
        if len(self.nodes) > 1:
            node = pick(self.nodes, n)
            del self.cluster.state.nodes[node]
            self.served_ranges = {
                place: r for place, r in self.served_ranges.items() if place.node != node
            }

    def join_node(self, n: int, _: int) -> None:
        name = pick(list(self.names), n)
        if name not in self.nodes:
            self.cluster.add_node(name, self.names[name])

    def annotate(self, n: int, m: int) -> None:
        if self.nodes:
            host = pick(("gate.example", "bad host!", ""), m)
            node = self.cluster.state.nodes[pick(self.nodes, n)]
            meta(node)["annotations"] = {names.ADVERTISE_HOST: host}

    # RosProxies

    def change(self, n: int, m: int) -> None:
        if rosproxies := sorted(self.cluster.state.rosproxies.items()):
            _, rosproxy = pick(rosproxies, n)
            rosproxy["spec"] = mended(rosproxy["spec"] | pick(CHANGES, m))
            rosproxy["metadata"]["generation"] += 1

    def create(self, n: int, m: int) -> None:
        name = pick(ROSPROXIES, n)
        if Name(self.namespace, name) not in self.cluster.state.rosproxies:
            self.cluster.add_rosproxy(name, spec(m))

    def delete(self, n: int, _: int) -> None:
        if rosproxies := sorted(self.cluster.state.rosproxies):
            of = pick(rosproxies, n)
            del self.cluster.state.rosproxies[of]
            self.served_ranges = {
                place: r for place, r in self.served_ranges.items() if place.of != of
            }

    def replace(self, n: int, m: int) -> None:
        """Deleted and created again at once, as `kubectl replace --force` does."""
        self.delete(n, m)
        self.create(n, m)

    # what people and clusters do to what the operator has made

    def delete_proxy(self, n: int, _: int) -> None:
        if self.own():
            self.cluster.delete_pod(pick(self.own(), n))

    def reject(self, n: int, m: int) -> None:
        """The kubelet ends a proxy: the ports are taken, or the node lacks resources."""
        if pods := [pod for pod in self.own() if node_of(pod)]:
            pod = pick(pods, n)
            reason = pick(("NodePorts", "Evicted", "NodePorts"), m)
            pod["status"] = {"phase": "Failed", "reason": reason, "message": "so it is"}

    def delete_service(self, n: int, m: int) -> None:
        """A Service is deleted. Perhaps another Service gets the address."""
        if services := list(self.cluster.state.services):
            gone = self.cluster.state.services.pop(pick(services, n))
            if m % 3 == 0 and is_own(gone):
                other_service = {
                    "metadata": {"name": f"s-{self.cluster.uid('s')}", "namespace": self.namespace}
                }
                service_spec = {"clusterIP": gone["spec"]["clusterIP"]}
                with contextlib.suppress(Refused):
                    self.cluster.create_service({**other_service, "spec": service_spec})

    def meddle_with_policy(self, n: int, m: int) -> None:
        """A NetworkPolicy is deleted, or changed."""
        if policies := sorted(self.cluster.state.policies):
            policy = self.cluster.state.policies[pick(policies, n)]
            if m % 2:
                del self.cluster.state.policies[name_of(policy)]
            else:
                policy["spec"]["ingress"] = []

    def change_key(self, n: int, _: int) -> None:
        """The key of the proxies' tokens changes, as after its removal from the Secret."""
        self.cluster.key = bytes([n]) * 32

    def forbid(self, n: int, _: int) -> None:
        self.cluster.forbidden = bool(n % 2)

    def toggle_master(self, n: int, _: int) -> None:
        self.cluster.master_ip = pick(("10.96.0.7", "", "10.96.0.8"), n)

    # the operator

    def step(self, _n: int, _m: int) -> None:
        self.cluster.step()

    def wait(self, n: int, _: int) -> None:
        self.controller.old = None
        self.controller.now += pick((0.5, 5.0, 30.0), n)

    def lag(self, _n: int, _m: int) -> None:
        """From now on until something is waited for, nothing new is seen of pods and nodes."""
        self.controller.remember()

    def look(self, n: int, _: int) -> None:
        plan = self.seen()
        self.carry_out(plan)
        if n % 2:
            self.cluster.step()

    def look_and_be_killed(self, n: int, _: int) -> None:
        plan = self.seen()
        self.carry_out(plan, n % (len(plan.actions) + 1))
        self.controller.lose_memory()
        self.served_ranges = {
            place: r for place, r in self.served_ranges.items() if self.in_status(place) == r
        }

    def look_and_stall(self, n: int, _: int) -> None:
        plan = self.seen()
        self.carry_out(plan, n % (len(plan.actions) + 1))
