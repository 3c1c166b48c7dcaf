"""Nodes of ROS 2: in pods of two nodes of the cluster and on a robot, in all directions."""

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from tests.docker.engine import wait_until
from tests.docker.nodes import UNNOTICED, Log
from tests.docker.ros2 import wait_for_line
from tests.kubernetes import api, release
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.conftest import cluster
from tests.kubernetes.measured import note
from tests.kubernetes.mistakes import errors
from tests.kubernetes.pods import Namespace, Pod, namespace
from tests.kubernetes.ros2 import (
    ADDRESS,
    Robot2,
    lan_relays,
    leased,
    node,
    ports_are_kept,
    robot_with_ros2,
)
from tests.kubernetes.rosproxies import Proxy, RosProxy, events, rosproxy, wait_event
from tests.kubernetes.test_doctor import doctor
from tests.kubernetes.traffic import wait_for_service

NODES = ("node1", "node2")
START = 120
"""Seconds that all nodes get to start and to meet, all at once."""


@pytest.fixture(scope="module")
def robot2(_release: None) -> Iterator[Robot2]:
    with robot_with_ros2() as started_robot:
        yield started_robot


@dataclass
class World:
    """Nodes in pods and on the robot, by the expected messages, replies and results."""

    net: Namespace
    rosproxy: RosProxy
    heard: dict[str, tuple[Log, str]] = field(default_factory=dict)
    replies: dict[str, Log] = field(default_factory=dict)
    results: dict[str, Log] = field(default_factory=dict)
    pods: list[Pod] = field(default_factory=list)

    def pod(self, vendor: str, kind: str, topic: str, *options: str, on: str) -> Log:
        self.pods.append(node(self.net, vendor, kind, topic, *options, on=on))
        return self.pods[-1].log

    @property
    def flows(self) -> dict[str, tuple[Log, str]]:
        """A log and a word for each way."""
        return {
            "outward": self.heard["the robot hears /one"],
            "inward": self.heard["jazzy on node1 hears /robot"],
            "across": self.heard["jazzy on node2 hears /one"],
        }

    def gaps(self, since: float) -> str:
        """The longest times without messages, and how many were lost."""
        return ", ".join(
            f"{way} {log.longest_gap(text, since, time.time()):.1f}, lost {log.lost(text, since)}"
            for way, (log, text) in self.flows.items()
        )


@pytest.fixture(scope="module")
def world(robot2: Robot2) -> Iterator[World]:
    """All nodes at once, to wait only once. Outside is discovered on the LAN."""
    with namespace() as net:
        made = World(net, rosproxy(net.name, ros=2, multicast=True, ports=64))
        wait_for_service(net)
        _fill(made, robot2)
        try:
            yield made
        finally:
            robot2.end_all()


def _fill(made: World, robot2: Robot2) -> None:
    pod = made.pod
    robot = robot2.node
    pod("jazzy", "pub", "/one", "--word", "one", on="node1")
    pod("kilted", "pub", "/two", "--word", "two", on="node2")
    pod("cyclone", "pub", "/cyclone", "--word", "cyclone", on="node1")
    robot("jazzy", "pub", "/robot", "--word", "robot")
    for topic in ("one", "two", "cyclone"):
        made.heard[f"the robot hears /{topic}"] = (robot("jazzy", "sub", f"/{topic}"), topic)
    made.heard["Cyclone on the robot hears /one"] = (robot("cyclone", "sub", "/one"), "one")
    for vendor, on, topic in (
        ("jazzy", "node1", "robot"), ("cyclone", "node2", "robot"),
        ("kilted", "node1", "one"), ("jazzy", "node2", "one"), ("jazzy", "node1", "two"),
        ("jazzy", "node1", "cyclone"),
    ):  # fmt: skip
        listener = pod(vendor, "sub", f"/{topic}", on=on)
        made.heard[f"{vendor} on {on} hears /{topic}"] = (listener, topic)
    pod("jazzy", "serve", "/add", on="node1")
    robot("kilted", "serve", "/robot_add")
    made.replies["the robot calls a pod"] = robot("jazzy", "call", "/add")
    made.replies["a pod calls the robot"] = pod("jazzy", "call", "/robot_add", on="node2")
    made.replies["a pod calls one on another node"] = pod("kilted", "call", "/add", on="node2")
    pod("jazzy", "act", "/fibonacci", on="node2")
    robot("jazzy", "act", "/robot_fibonacci")
    made.results["the robot pursues"] = robot("jazzy", "pursue", "/fibonacci")
    made.results["a pod pursues"] = pod("jazzy", "pursue", "/robot_fibonacci", on="node1")


def test_each_node_hears_all_others(world: World) -> None:
    """Pods of the same node and of both nodes, and a robot; two releases of Fast DDS, and Cyclone
    DDS.
    """
    for listener, (log, text) in world.heard.items():
        print(listener)
        log.wait_for(text, seconds=START)


def test_services(world: World) -> None:
    for who, log in world.replies.items():
        print(who)
        wait_for_line(log, "^reply ", seconds=START)


def test_actions(world: World) -> None:
    for who, log in world.results.items():
        print(who)
        wait_for_line(log, "^feedback ", seconds=START)
        wait_for_line(log, "^result 0 1 1 2 3 5 8 13 21$", count=1, seconds=START)


def test_what_users_are_told(world: World) -> None:
    of = world.rosproxy
    count = len(world.pods)

    of.wait_for("Ready", reason="Serving")
    of.wait_for("PortsReachable")
    status = of.wait_status(lambda told: told.get("participants") == count, "all participants")

    assert (status["domain"], status["proxies"]) == (0, "2/2")
    assert {"master", "masterURI"}.isdisjoint(status)
    assert status["staticPeers"] == of.service["spec"]["clusterIP"]
    assert {condition["type"] for condition in status["conditions"]} == {
        "Ready",
        "PortsAllocated",
        "PortsReachable",
        "Degraded",
    }
    assert "participants of domain 0" in of.condition("Ready")["message"]
    assert sum(line["participants"] for line in status["perNode"]) == count
    assert "Domain" in kubectl("-n", of.namespace, "describe", "rosproxy", of.name)
    (pod, *_) = world.pods
    port = of.service["spec"]["ports"][0]
    assert pod.environment["ROS_STATIC_PEERS"] == status["staticPeers"]
    assert (port["protocol"], port["port"]) == ("UDP", 7410)
    relays = {relay["metadata"]["name"] for relay in lan_relays(of)}
    assert len(relays) == len(NODES)
    findings = doctor(world.net.name)[1]
    assert not [f for f in findings if any(relay in f["subject"] for relay in relays)]


def test_seconds_to_the_first_message(world: World, robot2: Robot2) -> None:
    """From a new pod on a node with a proxy, to a waiting robot."""
    listener = robot2.node("jazzy", "sub", "/late", name="listener")
    world.heard["the robot hears /one"][0].wait_for("one", since=time.time())
    late = node(world.net, "jazzy", "pub", "/late", "--word", "late", on="node1")
    late.wait_ready()
    ready = time.time()
    wait_for_line(late.log, "^sent 0$", count=1)
    sent = time.time()
    first = listener.wait_for("late")
    note(f"ROS 2: the first message outside {first - ready:.1f} s after the pod was Ready, "
         f"{first - sent:.1f} s after its sending")  # fmt: skip
    late.remove()
    robot2.end("listener")


def test_a_pod_that_is_gone_takes_its_participant_with_it(world: World, robot2: Robot2) -> None:
    """Without a dispose message the robot would keep the participant for the lease duration of 20
    s.
    """
    watcher = robot2.node("jazzy", "names", "/any", name="watcher")
    pod = node(world.net, "jazzy", "pub", "/any", on="node2")
    wait_for_line(watcher, rf"^nodes .*\b{pod.node}\b")

    pod.crash()  # without a dispose message of its own
    pod.remove(grace=0)

    def gone() -> bool:
        line = re.findall("^nodes .* end$", watcher.read(), re.MULTILINE)[-1]
        return pod.node not in line.split()

    took = wait_until(gone, 15, watcher.read)
    robot2.end("watcher")
    note(f"ROS 2: outside has forgotten a pod's node {took:.1f} s after the pod was gone")


def _lan_relay_of(of: RosProxy) -> Pod:
    (name,) = (e["metadata"]["name"] for e in lan_relays(of) if e["spec"]["nodeName"] == "node1")
    return Pod(of.namespace, name)


LOSSES: dict[str, Callable[[RosProxy, Proxy], object]] = {
    "operator killed": lambda _of, _proxy: release.kill_operator(),
    "proxy crashes": lambda _of, proxy: proxy.crash(),
    "proxy's pod deleted": lambda _of, proxy: proxy.remove(),
    "proxy's pod deleted by force": lambda _of, proxy: proxy.remove(grace=0),
    "API server killed": lambda _of, _proxy: cluster("restart-apiserver"),
    "LAN relay crashes": lambda of, _proxy: _lan_relay_of(of).crash(),
    "LAN relay's pod deleted": lambda of, _proxy: _lan_relay_of(of).remove(),
}


@pytest.mark.parametrize("how", LOSSES)
def test_lost_parts_come_back(how: str, world: World, robot2: Robot2) -> None:
    """On the same ports, for the same participants; outside and inside hear on."""
    of = world.rosproxy
    flows = world.flows
    proxy = of.the_proxy("node1")
    _wait_until_ports_are_kept(world)
    before = leased(proxy)
    lost = time.time()

    LOSSES[how](of, proxy)

    now = of.the_proxy("node1", seconds=60)
    wait_until(lambda: leased(now) == before, 60, lambda: f"{leased(now)} is not {before}")
    wait_until(lambda: len(lan_relays(of)) == len(NODES), 60, of.tell)
    _lan_relay_of(of).wait_ready(60)
    release.wait_operator()
    end = time.time()
    for log, text in flows.values():
        log.wait_for(text, count=10, since=end)
    note(f"ROS 2, {how}: seconds without messages {world.gaps(lost)}")
    assert (now.ports, now.name) == (proxy.ports, proxy.name)
    late = robot2.node("jazzy", "sub", "/one", name="late")
    late.wait_for("one", since=end)
    robot2.end("late")  # keeps the number of nodes in all tests


def _wait_until_ports_are_kept(world: World) -> None:
    """Wait until all participants have discovered each other and keep all ports."""
    of = world.rosproxy
    now = time.time()
    for log, text in world.flows.values():
        log.wait_for(text, since=now)
    wait_until(
        lambda: all(ports_are_kept(of.the_proxy(on), of.on(on)["pods"]) for on in NODES),
        60, of.tell,
    )  # fmt: skip


def test_participants_rediscover_each_other_on_other_ports(world: World) -> None:
    """The RosProxy's window excludes the former ports."""
    of = world.rosproxy
    changed = time.time()

    of.change(portWindow={"first": 13000, "last": 13199})

    wait_until(lambda: all(of.the_proxy(on).first_port >= 13000 for on in NODES), 60, of.tell)
    end = time.time()
    for log, text in world.flows.values():
        log.wait_for(text, count=10, since=end)
    note(f"ROS 2, other ports: seconds without messages {world.gaps(changed)}")


def _all_leased(of: RosProxy) -> list[dict[str, list[int]]]:
    return [leased(of.the_proxy(on)) for on in NODES]


def test_another_image_of_the_proxies(world: World) -> None:
    """The image changes in place, for the proxies in turn: the same pods, the same ports."""
    of = world.rosproxy
    _wait_until_ports_are_kept(world)
    before = _all_leased(of)
    started = time.time()

    release.upgrade(proxy={"image": {"tag": release.other_image()}})
    wait_until(lambda: all(of.the_proxy(on).restarts > 0 for on in NODES), 90, of.tell)

    wait_until(lambda: _all_leased(of) == before, 60, lambda: f"{_all_leased(of)} is not {before}")
    end = time.time()
    for log, text in world.flows.values():
        log.wait_for(text, count=10, since=end)
    note(f"ROS 2, another image: seconds without messages {world.gaps(started)}")
    release.upgrade()
    release.wait_operator()


def test_a_node_is_stopped_and_comes_back(world: World) -> None:
    """Meanwhile the robot and the other node's pods hear each other. Afterwards all nodes do."""
    of = world.rosproxy
    lost_node = "node2"
    ports = of.the_proxy(lost_node).ports
    back = world.heard["the robot hears /two"], world.heard["jazzy on node2 hears /one"]
    lost = time.time()
    cluster("stop-node", lost_node)
    try:
        of.wait_status(lambda told: not of.on(lost_node).get("ready"), "the loss", 60)
        outward = world.flows["outward"]
        inward = world.flows["inward"]
        outside = max(log.longest_gap(text, lost, time.time()) for log, text in (outward, inward))
        assert outside < UNNOTICED, outside
    finally:
        cluster("start-node", lost_node)
    up = time.time()
    took = [log.wait_for(text, since=up, seconds=120) - up for log, text in back]
    assert of.the_proxy(lost_node, seconds=60).ports == ports
    note(f"ROS 2, node stopped: messages from its pods again {took[0]:.1f} s, and to its pods "
         f"{took[1]:.1f} s after the node is ready")  # fmt: skip
    release.wait_operator()


def test_helm_test(robot2: Robot2) -> None:
    """Through a proxy on either node: the test's two pods keep away from each other."""
    image = "rosproxy-test-ros2:latest"
    release.upgrade(tests={"ros": 2, "image": None, "ros2Image": image})
    told = release.helm("test", release.NAME, "--namespace", release.NAMESPACE, seconds=300)
    assert re.search("PASSED: a message went to the pod on node node[12] and back", told), told
    assert "both pods are on node" not in told
    release.upgrade()


def test_two_rosproxies_two_domains_without_multicast(robot2: Robot2) -> None:
    """By peers. The pods get the domain. Another pod holds ports in the window."""
    with namespace() as net:
        taken = net.idle(on="node1", ports=(12000, 12008), protocol="UDP", labels={})
        taken.wait_ready()
        window = {"first": 12000, "last": 12063}
        peers = ["10.88.0.51"]
        rosproxies = [
            rosproxy(net.name, f"domain-{number}", ros=2, domain=number, peers=peers,
                     portWindow=window, ports=10)
            for number in (5, 6)
        ]  # fmt: skip
        wait_for_service(net)
        robot_listeners = {n: robot2.node("jazzy", "sub", "/word", domain=n) for n in (5, 6)}
        for number in (5, 6):
            robot2.node("kilted", "pub", "/back", "--word", f"robot{number}", domain=number)
        pods = {}
        for number in (5, 6):
            label = {"rosproxy.io/inject": f"domain-{number}"}
            node(net, "jazzy", "pub", "/word", "--word", f"pod{number}", on="node1", labels=label)
            pods[number] = node(net, "jazzy", "sub", "/back", on="node1", labels=label)
        for number in (5, 6):
            robot_listeners[number].wait_for(f"pod{number}", count=10, seconds=START)
            pods[number].log.wait_for(f"robot{number}", count=10, seconds=START)
            other = 11 - number
            assert robot_listeners[number].got(f"pod{other}") == []
            assert pods[number].log.got(f"robot{other}") == []
            assert pods[number].environment["ROS_DOMAIN_ID"] == str(number)
        ranges = [of.the_proxy("node1").ports for of in rosproxies]
        assert ranges == ["12009-12018", "12019-12028"]
        assert all(of.status["domain"] == n for of, n in zip(rosproxies, (5, 6), strict=True))
        robot2.end_all()


def test_what_a_pod_cannot_have_is_told(net: Namespace) -> None:
    of = rosproxy(net.name, ros=2, domain=3, peers=["10.88.0.51"])
    wait_for_service(net)

    unable = {
        "NoDds": {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"},
        "TooOld": {"ROS_DISTRO": "humble"},
        "NotWired": {"ROS_STATIC_PEERS": "192.0.2.9"},
        "OtherDomain": {"ROS_DOMAIN_ID": "4"},
        "NotDiscovered": {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"},
    }
    pods = {reason: net.idle(on="node1", env=variables) for reason, variables in unable.items()}
    for reason, pod in pods.items():
        wait_event(net.name, pod.name, "Pod", reason, seconds=90)
    assert api.get("networkpolicies", net.name, f"rosproxy-{of.name}")


def test_a_pod_that_the_proxy_discovers_without_static_peers_is_well(
    net: Namespace, robot2: Robot2
) -> None:
    """The operator told an error although messages flowed: the proxy announces itself to pods."""
    of = rosproxy(net.name, ros=2, domain=4, peers=[ADDRESS], ports=16)
    wait_for_service(net)
    heard = robot2.node("jazzy", "sub", "/word", domain=4)
    elsewhere = {"ROS_STATIC_PEERS": "192.0.2.9", "ROS_LOCALHOST_ONLY": "1"}
    pod = node(net, "jazzy", "pub", "/word", "--word", "pod", on="node1", env=elsewhere)
    heard.wait_for("pod", seconds=START)
    of.wait_for("Degraded", "False")
    assert errors(net.name) == []
    assert not {event.reason for event in events(net.name, pod.name, "Pod")} & {
        "NotWired", "NotDiscovered"
    }  # fmt: skip
    robot2.end_all()
