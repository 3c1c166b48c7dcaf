"""Pods that come, end, are deleted, evicted and made anew."""

import time

import pytest

from tests.docker.engine import wait_until
from tests.docker.nodes import LIBRARIES
from tests.kubernetes import release
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.measured import note
from tests.kubernetes.pods import Namespace, Pod, unique
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import RosProxy, rosproxy
from tests.kubernetes.traffic import START, wait_for_service


def new_topic() -> str:
    return f"/{unique('topic').replace('-', '_')}"


def talker(net: Namespace, library: str, topic: str, on: str = "node1", **more: str) -> Pod:
    return net.node(library, "pub", "--topic", topic, "--word", "inside", on=on, **more)


@pytest.fixture
def made(net: Namespace, robot: Robot) -> RosProxy:
    created = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    wait_for_service(net)
    return created


@pytest.mark.parametrize("has_proxy", [True, False], ids=["proxy there", "proxy not there"])
@pytest.mark.parametrize("library", LIBRARIES)
def test_how_long_the_first_message_takes(
    library: str, has_proxy: bool, made: RosProxy, net: Namespace, robot: Robot
) -> None:
    if has_proxy:
        net.idle(on="node1")
        made.the_proxy()
    name = new_topic()
    listener = robot.node(f"listener{name[1:]}", "roscpp", "sub", "--topic", name)
    created = time.time()
    pod = talker(net, library, name)
    pod.wait_ready()
    ready = time.time()
    heard = listener.wait_for("inside", seconds=START)
    proxy = "there" if has_proxy else "not there"
    note(f"first message, {library}, proxy {proxy}: {heard - ready:.1f} s after the pod is Ready, "
         f"{heard - created:.1f} s after its creation")  # fmt: skip


@pytest.mark.parametrize("library", LIBRARIES)
def test_deleted_pod_is_unregistered_at_once_and_comes_back(
    library: str, made: RosProxy, net: Namespace, robot: Robot
) -> None:
    """Without grace the node cannot unregister itself."""
    name = new_topic()
    listener = robot.node(f"listener{name[1:]}", library, "sub", "--topic", name)
    pod = talker(net, library, name)
    listener.wait_for("inside", seconds=START)

    pod.remove(grace=0)
    gone = wait_until(lambda: not robot.uri(pod.node), 25, lambda: str(robot.nodes()))
    note(f"pod deleted, {library}: unregistered {gone:.1f} s after its end")

    again = time.time()
    new = talker(net, library, name, name=pod.name)
    listener.wait_for("inside", since=again, seconds=60)
    assert new.node == pod.node


def test_pod_that_ends_by_itself(made: RosProxy, net: Namespace, robot: Robot) -> None:
    """A Job's pod stays as Succeeded, but no longer counts, and the proxy goes."""
    made.change(graceSeconds=1)
    job = "until [ -e /tmp/done ]; do sleep 0.1; done"  # no end before the operator's look
    pod = net.pod("sh", "-c", job, on="node1", restartPolicy="Never")
    made.the_proxy()
    pod.run("touch", "/tmp/done")
    wait_until(lambda: pod.body["status"].get("phase") == "Succeeded", 60, lambda: str(pod.body))
    wait_until(lambda: not made.proxies, 60, made.tell)


def test_container_that_restarts_in_its_pod(made: RosProxy, net: Namespace, robot: Robot) -> None:
    """The same address, another process: the node comes back by itself."""
    name = new_topic()
    listener = robot.node(f"listener{name[1:]}", "rospy", "sub", "--topic", name)
    pod = talker(net, "roscpp", name)
    listener.wait_for("inside", seconds=START)
    killed = time.time()
    pod.crash()
    listener.wait_for("inside", since=killed + 0.5, seconds=60)
    assert robot.knows_proxied(pod.node, "node1")


def test_cordoned_and_drained_node(made: RosProxy, net: Namespace, robot: Robot) -> None:
    """Drain leaves the proxy until the last pod is gone, and does not wait for the proxy
    for ever.
    """
    name = new_topic()
    made.change(graceSeconds=2)
    listener = robot.node(f"listener{name[1:]}", "rospy", "sub", "--topic", name)
    pod = talker(net, "rospy", name, on="node2")
    listener.wait_for("inside", seconds=START)
    try:
        kubectl("cordon", "node2")
        assert made.the_proxy("node2").ready
        kubectl("drain", "node2", "--force", "--ignore-daemonsets", "--delete-emptydir-data",
                "--timeout=60s", seconds=90)  # fmt: skip
        wait_until(lambda: not robot.uri(pod.node), 25, lambda: str(robot.nodes()))
        wait_until(lambda: not made.proxies, 40, made.tell)
    finally:
        kubectl("uncordon", "node2")
    release.wait_operator()  # an operator may have been on that node
    talker(net, "rospy", name, on="node2")
    listener.wait_for("inside", since=time.time(), seconds=60)
