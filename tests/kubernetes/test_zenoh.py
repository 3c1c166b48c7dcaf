"""Nodes of rmw_zenoh: in pods of two nodes of the cluster, and behind a robot's router."""

import itertools
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import pytest

from tests.docker.engine import docker, inspect, wait_until
from tests.docker.images import ZENOH, build_image
from tests.docker.nodes import Log
from tests.docker.zenoh import NODE, Node
from tests.kubernetes import api, release
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.images import load_images
from tests.kubernetes.cluster.network import plug_in_robot, unplug_robot
from tests.kubernetes.measured import note
from tests.kubernetes.names import cluster_dns
from tests.kubernetes.pods import Namespace, namespace, unique
from tests.kubernetes.rosproxies import Proxy, RosProxy, rosproxy, wait_event
from tests.kubernetes.traffic import wait_for_service

NAME = "rosproxy-cluster-zenoh"
ADDRESS = "10.88.0.52"
CABLE = "rpxzenoh"
START = 120
"""Seconds that nodes get to start and to find each other, all at once."""
GOT = "got hello "
OVERRIDE = "ZENOH_CONFIG_OVERRIDE"
_numbers = itertools.count(1)


@dataclass(frozen=True)
class Robot:
    """A machine outside of the cluster, with a router. ``root`` is its file system."""

    root: Path

    def start_router(self) -> None:
        self._start("router", "rmw_zenohd")
        log = self.root / "tmp/router.log"
        wait_until(lambda: log.exists() and "router runs" in log.read_text(), 30, "the router runs")

    def node(self, kind: str, topic: str, override: str = "") -> Node:
        """Start a node with its output in a file; with ``override`` as a laptop does."""
        name = f"robot_{kind}_{next(_numbers)}"
        variable = (f"ZENOH_CONFIG_OVERRIDE={quote(override)}",) if override else ()
        self._start(name, " ".join(("env", *variable, *NODE, kind, name, topic)))
        path = self.root / f"tmp/{name}.log"
        return Node(name, Log(lambda: path.read_text() if path.exists() else ""))

    def end(self, name: str) -> None:
        """Kill a program."""
        docker("exec", NAME, "sh", "-c", f"kill -KILL $(cat /tmp/{name}.pid)")

    def _start(self, name: str, words: str) -> None:
        script = f"echo $$ >/tmp/{name}.pid; exec {words} >/tmp/{name}.log 2>&1"
        docker("exec", "--detach", NAME, "setsid", "sh", "-c", script)


@pytest.fixture(scope="module")
def robot(_release: None) -> Iterator[Robot]:
    """The robot with its router, the image of the nodes in the cluster, and the cluster's DNS."""
    load_images(build_image(ZENOH))
    docker("rm", "--force", NAME, check=False)
    docker("run", "--detach", "--init", "--network", "none", "--name", NAME,
           ZENOH, "sleep", "infinity")  # fmt: skip
    process = str(inspect(NAME)["State"]["Pid"])
    plug_in_robot(process, ADDRESS, CABLE)
    made = Robot(Path(f"/proc/{process}/root"))
    try:
        made.start_router()
        with cluster_dns():
            yield made
    finally:
        docker("rm", "--force", NAME, check=False)
        unplug_robot(CABLE)


@dataclass(frozen=True)
class World:
    """A namespace with a RosProxy for rmw_zenoh, and the robot."""

    net: Namespace
    rosproxy: RosProxy
    robot: Robot

    def pod(self, kind: str, topic: str, on: str, **more: Any) -> Node:
        """Start a pod with a node, as a user would: an image, a command and a label."""
        name = unique(kind)
        pod = self.net.pod(*NODE, kind, name, topic, name=name, on=on, image=ZENOH, **more)
        return Node(name, pod.log)

    def proxy(self, on: str) -> Proxy:
        return self.rosproxy.the_proxy(on, 60)

    def describe(self) -> str:
        return kubectl("-n", self.net.name, "describe", "rosproxy", self.rosproxy.name)


@pytest.fixture(scope="module")
def world(robot: Robot) -> Iterator[World]:
    without_host_ports = {"pod-security.kubernetes.io/enforce": "baseline"}
    with namespace(labels=without_host_ports) as net:
        made = World(net, rosproxy(net.name, ros="zenoh", peers=[ADDRESS]), robot)
        wait_for_service(net)
        yield made


@pytest.fixture(scope="module")
def talker(world: World) -> Node:
    """A publisher of chatter on node1."""
    return world.pod("pub", "chatter", "node1")


@pytest.fixture(scope="module")
def listeners(world: World, talker: Node) -> dict[str, Node]:
    """Subscribers of chatter, by place."""
    return {
        "same node": world.pod("sub", "chatter", "node1"),
        "other node": world.pod("sub", "chatter", "node2"),
        "robot": world.robot.node("sub", "chatter"),
    }


def test_topics_pass_between_pods_and_the_robot(world: World, listeners: dict[str, Node]) -> None:
    world.robot.node("pub", "robot")
    inward = {on: world.pod("sub", "robot", on) for on in ("node1", "node2")}
    for where, node in {**listeners, **inward}.items():
        print(where)
        node.wait_for(GOT, 3, START)


def test_services_and_the_graph_pass(world: World) -> None:
    server = world.pod("serve", "add", "node2")
    robot_server = world.robot.node("serve", "robot_add")
    callers = [
        (world.pod("call", "add", "node1"), server),
        (world.robot.node("call", "add"), server),
        (world.pod("call", "robot_add", "node1"), robot_server),
    ]
    graphs = [world.pod("graph", "-", "node1"), world.robot.node("graph", "-")]
    for caller, answers in callers:
        caller.wait_for(f"answer of {answers.name}", 3, START)
    for graph in graphs:
        for node in (server, robot_server):
            seen = partial(graph.has, f"seen {node.name}")
            wait_until(seen, START, graph.log.read)


def test_what_users_are_told(world: World, listeners: dict[str, Node]) -> None:
    of = world.rosproxy
    of.wait_for("Ready", reason="Serving")
    of.wait_for("PeersReachable", reason="Reached")
    of.wait_for("Degraded", "False", seconds=60)
    for on in ("node1", "node2"):
        of.wait_status(partial(is_linked, on), f"the links of {on}")
    status = of.status
    assert status["routerEndpoint"].endswith(":7448")
    assert not {"PortsAllocated", "PortsReachable"} & {c["type"] for c in status["conditions"]}
    print(world.describe())
    for proxy in of.proxies:
        ports = [p for c in proxy.body["spec"]["containers"] for p in c.get("ports", ())]
        assert not [port for port in ports if port.get("hostPort")]
        assert proxy.body["spec"]["hostname"] == proxy.name


def is_linked(on: str, status: Json) -> bool:
    """Whether the proxy on a node has all links, and sessions."""
    rows = [row for row in status.get("perNode", ()) if row["name"] == on]
    return all(
        (row.get("peers"), row.get("hubs")) == ("1/1", "1/1") and row.get("sessions")
        for row in rows or [{}]
    )


LOSSES: dict[str, Callable[[Proxy], object]] = {
    "container killed": lambda proxy: proxy.crash(),
    "pod deleted": lambda proxy: proxy.remove(wait=False),
    "pod deleted without grace": lambda proxy: proxy.remove(grace=0, wait=False),
}


@pytest.mark.parametrize("on", ["node1", "node2"])
@pytest.mark.parametrize("how", LOSSES)
def test_messages_flow_again_after_the_loss_of_a_proxy(
    how: str, on: str, world: World, listeners: dict[str, Node]
) -> None:
    before = world.proxy(on)
    restarts = before.restarts
    first = {where: node.latest() for where, node in listeners.items()}
    for node in listeners.values():
        node.wait_for(GOT, 3, START)
    lost = time.time()
    LOSSES[how](before)

    def is_replaced() -> bool:
        now = world.rosproxy.proxy_on(on)
        return (
            now is not None
            and now.ready
            and (now.uid_then != before.uid_then or now.restarts > restarts)
        )

    wait_until(is_replaced, 90, world.rosproxy.tell)
    for node in listeners.values():
        node.wait_for(GOT, 10, START)
    passed = time.time() - lost
    time.sleep(8)  # a former proxy may have served until now
    outages = {where: f"{node.outage(first[where]):.1f} s" for where, node in listeners.items()}
    note(f"zenoh, {how} on {on}: all is back {passed:.1f} s after; longest outages {outages}")
    world.rosproxy.wait_for("Ready", reason="Serving", seconds=60)


def test_a_denied_topic_stays_inside(world: World, listeners: dict[str, Node]) -> None:
    world.pod("pub", "secret", "node1")
    outside = [world.robot.node("sub", "secret"), world.pod("sub", "secret", "node2")]
    for node in outside:
        node.wait_for(GOT, 3, START)
    rules = [{"action": "Deny", "kind": "Publish", "names": ["/secret"]}]

    world.rosproxy.change(policy={"rules": rules})

    def is_silent() -> bool:
        before = [node.count(GOT) for node in outside]
        time.sleep(2)
        return before == [node.count(GOT) for node in outside]

    wait_until(is_silent, 60, "the rule holds")
    for node in listeners.values():
        node.wait_for(GOT, 5, START)
    assert is_silent()
    world.rosproxy.change(policy={"rules": None})
    for node in outside:
        node.wait_for(GOT, 3, START)


def test_a_peer_that_is_down_is_told(world: World) -> None:
    of = world.rosproxy
    of.wait_for("PeersReachable", "True", seconds=60)
    world.robot.end("router")
    condition = of.wait_for("PeersReachable", "False", "PeerUnreachable", 60)
    assert f"zenoh peer {ADDRESS}:7447: connection refused" in condition["message"]
    of.wait_event("PeerUnreachable", "rmw_zenohd")
    world.robot.start_router()
    of.wait_for("PeersReachable", "True", seconds=60)
    of.wait_for("Degraded", "False", seconds=60)


def test_a_pod_without_the_certificate_has_no_session_with_a_hub(
    world: World, listeners: dict[str, Node]
) -> None:
    """The cluster of the tests does not enforce NetworkPolicies."""
    hub = world.proxy("node1").body["status"]["podIP"]
    wait = "connect/timeout_ms=-1"
    own = {OVERRIDE: f'mode="client";connect/endpoints=["tcp/{hub}:7447"];{wait}'}
    stranger = world.pod("sub", "chatter", "node1", labels={}, env=own)
    router = {OVERRIDE: own[OVERRIDE].replace("7447", "7448")}
    accepted = world.pod("sub", "chatter", "node1", labels={}, env=router)
    accepted.wait_for(GOT, 20, START)
    assert not stranger.has("ready")
    assert all(node.has(GOT) for node in listeners.values())


def test_a_laptop_uses_the_port_that_is_told(world: World, listeners: dict[str, Node]) -> None:
    of = world.rosproxy
    of.change(listen={"type": "NodePort"})
    of.wait_event("ServiceCreated", "port-of-rosproxy-")
    told = of.wait_for("Listening", reason="Listening", seconds=90)["message"]
    override = told.partition(f"{OVERRIDE}='")[2].rstrip("'")
    assert of.status["listen"] in override
    for on in ("node1", "node2"):
        of.wait_status(partial(is_linked, on), f"the links of {on}")
    laptop = world.robot.node("sub", "chatter", override)
    laptop.wait_for(GOT, 5, START)
    world.robot.node("pub", "laptop", override)
    world.pod("sub", "laptop", "node2").wait_for(GOT, 5, START)
    print(world.describe())

    of.change(listen=None)

    def is_gone() -> bool:
        service = api.get("services", of.namespace, f"port-of-rosproxy-{of.name}")
        return not service and "listen" not in of.status

    wait_until(is_gone, 60, of.tell)
    for node in listeners.values():
        node.wait_for(GOT, 5, START)
    assert "Listening" not in {c["type"] for c in of.status["conditions"]}


def test_a_pod_that_goes_its_own_way_is_told(world: World) -> None:
    own = {OVERRIDE: f'connect/endpoints=["tcp/{ADDRESS}:7447"]'}
    pod = world.net.idle(on="node1", env=own, image=ZENOH)
    wait_event(world.net.name, pod.name, "Pod", "NotWired", "connects the nodes past the proxy")
    assert pod.environment[OVERRIDE] == own[OVERRIDE]
    pod.remove(grace=0, wait=False)


def test_helm_test() -> None:
    """The test's two pods keep away from each other, so the answer passes two hubs."""
    release.upgrade(tests={"ros": "zenoh", "image": None})
    told = release.helm("test", release.NAME, "--namespace", release.NAMESPACE, seconds=300)
    assert re.search("PASSED: a question went to the pod on node node[12]", told), told
    assert "both pods are on node" not in told
    release.upgrade()


def test_nothing_is_left(world: World) -> None:
    world.rosproxy.remove()
    of = world.rosproxy

    def left() -> list[Any]:
        found = [
            api.get("services", of.namespace, f"{prefix}rosproxy-{of.name}")
            for prefix in ("", "hubs-of-", "port-of-")
        ]
        return [*filter(None, found), *of.proxies]

    wait_until(lambda: not left(), 60, lambda: str(left()))
