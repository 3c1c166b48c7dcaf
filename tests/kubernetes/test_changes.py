"""Changes and deletion of a RosProxy while proxies serve."""

import time

import pytest

from tests.docker.engine import wait_until
from tests.docker.nodes import node_command
from tests.kubernetes import api
from tests.kubernetes.measured import note
from tests.kubernetes.mistakes import Site, restart_as_told
from tests.kubernetes.pods import INJECT, Namespace, Pod, unique
from tests.kubernetes.robot import Robot, robot_with_master
from tests.kubernetes.rosproxies import NOWHERE, RosProxy, rosproxy
from tests.kubernetes.test_doctor import doctor
from tests.kubernetes.traffic import START, wait_for_service


def talker(net: Namespace, topic: str, library: str = "rospy", **more: str) -> str:
    """Start a publisher once the Service of the proxy exists. Return the ROS name."""
    wait_for_service(net)
    pod = net.node(library, "pub", "--topic", topic, "--word", "inside", on="node1", **more)
    return pod.node


def test_another_master(net: Namespace, robot: Robot) -> None:
    """New nodes register at the new master, and no node is left at the old master."""
    topic = f"/{unique('moved').replace('-', '_')}"
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    old = talker(net, topic)
    robot.node("listener_before", "rospy", "sub", "--topic", topic).wait_for(
        "inside", seconds=START
    )
    before = made.the_proxy()
    with robot_with_master() as other:
        made.change(master={"uri": other.master_uri})
        made.wait_status(lambda s: other.master_uri in s.get("master", ""), "the new master")
        wait_until(lambda: made.the_proxy().uid_then != before.uid_then, 40, made.tell)
        wait_until(lambda: not robot.uri(old), 25, lambda: str(robot.nodes()))
        name = talker(net, topic, "roscpp")
        listener = other.node("listener_after", "roscpp", "sub", "--topic", topic)
        listener.wait_for("inside", seconds=60)
        assert other.knows_proxied(name)


def test_another_selector(net: Namespace) -> None:
    """Pods that are no longer selected keep a proxy on the node for the grace period only."""
    made = rosproxy(net.name, master=NOWHERE, ports=4, graceSeconds=2)
    net.idle(on="node1")
    net.idle(on="node2", labels={INJECT: "true", "app": "x"})
    wait_until(lambda: {p.on for p in made.proxies} == {"node1", "node2"}, 60, made.tell)
    made.change(podSelector={"matchLabels": {"app": "x"}})
    wait_until(lambda: {p.on for p in made.proxies} == {"node2"}, 60, made.tell)
    made.change(podSelector=None)
    wait_until(lambda: {p.on for p in made.proxies} == {"node1", "node2"}, 60, made.tell)


def test_a_second_rosproxy_takes_no_node_of_running_pods(net: Namespace, robot: Robot) -> None:
    """Several RosProxies select the pod, and the pod stays with the first RosProxy."""
    topic = f"/{unique('second').replace('-', '_')}"
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8, graceSeconds=2)
    name = talker(net, topic)
    listener = robot.node("listener_second", "rospy", "sub", "--topic", topic)
    listener.wait_for("inside", seconds=START)
    before = made.the_proxy()

    second = rosproxy(net.name, "second", master=NOWHERE, ports=4)
    second.wait_status(
        lambda s: any(c["reason"] == "Ambiguous" for c in s.get("conditions", [])), "it is told"
    )
    started = time.time()
    listener.wait_for("inside", count=200, since=started, seconds=60)  # 10 s, longer than the grace

    assert made.the_proxy().uid_then == before.uid_then
    assert robot.knows_proxied(name)
    assert listener.lost("inside", started) == 0
    second.remove()


def test_node_selector(net: Namespace) -> None:
    labels = {"kubernetes.io/hostname": "node2"}
    made = rosproxy(net.name, master=NOWHERE, ports=4, nodeSelector=labels)
    net.idle(on="node1")
    net.idle(on="node2")
    wait_until(lambda: {p.on for p in made.proxies} == {"node2"}, 60, made.tell)


def test_advertised_host_of_a_node(net: Namespace, robot: Robot) -> None:
    """An annotation of the node overrides the node's address."""
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=4)
    api.patch("nodes", "", "node2", {"metadata": {"annotations": {_ADVERTISE: "10.88.0.12"}}})
    try:
        net.idle(on="node2")
        made.wait_status(lambda s: bool(made.on("node2")), "node2 has a row")
        assert made.on("node2")["advertiseHost"] == "10.88.0.12"
        api.patch("nodes", "", "node2", {"metadata": {"annotations": {_ADVERTISE: "robot-2"}}})
        made.wait_status(
            lambda s: made.on("node2").get("advertiseHost") == "robot-2", "the annotation counts"
        )
    finally:
        api.patch("nodes", "", "node2", {"metadata": {"annotations": {_ADVERTISE: None}}})


def test_deleted_rosproxy_leaves_only_the_users_pods(net: Namespace, robot: Robot) -> None:
    topic = f"/{unique('left').replace('-', '_')}"
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    name = talker(net, topic)
    robot.node("listener_left", "rospy", "sub", "--topic", topic).wait_for("inside", seconds=START)
    pods = {body["metadata"]["uid"] for body in net.pods(INJECT)}

    made.remove()

    wait_until(lambda: not made.body, 60, "the RosProxy is gone: no finalizer")
    wait_until(lambda: not made.proxies and not made.service, 40, made.tell)
    assert {body["metadata"]["uid"] for body in net.pods(INJECT)} == pods
    wait_until(lambda: not robot.uri(name), 25, lambda: f"unregistered: {robot.nodes()}")


@pytest.mark.parametrize("who", ["user", "operator"])
def test_rosproxy_deleted_and_created_at_once(who: str, net: Namespace, robot: Robot) -> None:
    """The user restarts the pods as told, or the operator replaces the pods where necessary.

    It is not necessary if the new proxy has found the nodes at the master before the operator
    looks.
    """
    topic = f"/{unique('anew').replace('-', '_')}"
    site = Site(net, robot)
    made = site.rosproxy
    site.create_rosproxy()
    wait_for_service(net)
    site.create_app(command=node_command("roscpp", "pub", "--topic", topic, "--word", "inside"))
    listener = robot.node(f"listener_{who}", "roscpp", "sub", "--topic", topic)
    listener.wait_for("inside", seconds=START)
    (before,) = net.pods(INJECT)

    deleted = time.time()
    made.remove()
    wait_until(lambda: not made.body, 60, made.tell)
    site.create_rosproxy()
    if who == "operator":
        annotation = {"rosproxy.io/remake-unwired": "true"}
        api.patch("rosproxies", net.name, made.name, {"metadata": {"annotations": annotation}})
    else:
        restart_as_told(site)
        uid = before["metadata"]["uid"]
        wait_until(
            lambda: uid not in {p["metadata"]["uid"] for p in net.pods(INJECT)}, 120, made.tell
        )

    wait_until(site.is_well, 120, made.tell)
    listener.wait_for("inside", since=time.time(), seconds=START)
    gap = listener.longest_gap("inside", deleted, time.time())
    note(f"RosProxy deleted and created, pods restarted by the {who}: {gap:.1f} s without messages")


@pytest.mark.parametrize(
    ("change", "fix"), [("master", "restart"), ("selector", "restart"), ("master", "crash")]
)
def test_a_change_that_is_taken_back_is_told_to_running_pods(
    change: str, fix: str, net: Namespace, robot: Robot
) -> None:
    """The proxy has unregistered the ROS nodes. A ROS node registers only at the start.

    A new container is enough: its ROS node registers.
    """
    topic = f"/{unique('back').replace('-', '_')}"
    site = Site(net, robot)
    made = site.rosproxy
    site.create_rosproxy(graceSeconds=2)
    wait_for_service(net)
    site.create_app(command=node_command("roscpp", "pub", "--topic", topic, "--word", "inside"))
    listener = robot.node(f"listener_{change}_{fix}", "roscpp", "sub", "--topic", topic)
    listener.wait_for("inside", seconds=START)
    made.wait_status(lambda s: s.get("rosNodes") == 1, "the ROS node is counted")
    (pod,) = net.pods(INJECT)
    node = pod["spec"]["nodeName"]
    before = made.the_proxy(node)

    changes: dict[str, tuple[api.Json, api.Json]] = {
        "master": ({"master": NOWHERE}, {"master": {"uri": robot.master_uri}}),
        "selector": ({"podSelector": {"matchLabels": {"app": "other"}}}, {"podSelector": None}),
    }
    other, same = changes[change]
    made.change(**other)
    wait_until(
        lambda: before.uid_then not in {proxy.uid_then for proxy in made.proxies}, 60, made.tell
    )
    made.change(**same)
    made.wait_status(lambda _: bool(made.on(node).get("unregisteredAt")), "the time is kept")
    made.the_proxy(node)
    wait_until(lambda: bool(site.texts("NotWired")), 60, made.tell)
    assert any("may have been unregistered" in found["text"] for found in doctor(net.name)[1])

    if fix == "restart":
        restart_as_told(site)
    else:
        Pod(net.name, pod["metadata"]["name"]).crash()
    listener.wait_for("inside", since=time.time(), seconds=START)
    wait_until(site.is_well, 120, made.tell)


def test_deleted_service_comes_back_at_its_address(net: Namespace) -> None:
    """Running pods know only the address."""
    made = rosproxy(net.name, master=NOWHERE, ports=4)
    wait_until(lambda: bool(made.service), 60, made.tell)
    before = made.service
    made.wait_status(lambda s: bool(s.get("masterURI")), "the address is kept")
    api.delete("services", net.name, before["metadata"]["name"])
    wait_until(lambda: _uid(made) not in ("", before["metadata"]["uid"]), 60, made.tell)
    assert made.service["spec"]["clusterIP"] == before["spec"]["clusterIP"]


def _uid(made: RosProxy) -> str:
    return str(made.service.get("metadata", {}).get("uid", ""))


_ADVERTISE = "rosproxy.io/advertise-host"
