"""The operator that leads is killed in the middle of anything; and while none is there."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.docker.engine import wait_until
from tests.kubernetes import api, release
from tests.kubernetes.measured import note
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import NOWHERE, rosproxy
from tests.kubernetes.traffic import flow


@contextmanager
def no_operator() -> Iterator[None]:
    """A cluster without an operator."""
    _scale(0)
    wait_until(lambda: not api.objects("pods", release.NAMESPACE, release.OPERATORS), 40, "the end")
    try:
        yield
    finally:
        _scale(2)
        release.wait_operator()


def _scale(replicas: int) -> None:
    api.patch("deployments", release.NAMESPACE, release.FULL_NAME, {"spec": {"replicas": replicas}})


def test_traffic_does_not_notice(net: Namespace, robot: Robot) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    with flow(net, robot, "roscpp") as traffic:
        before = made.the_proxy()
        killed = time.time()
        release.kill_operator()
        release.wait_operator()
        back = time.time() - killed
        traffic.wait(since=time.time())
        gaps = traffic.gaps(killed)
        note(f"operator killed: ready again after {back:.1f} s; {gaps}")
        assert gaps.unnoticed, gaps
        assert made.the_proxy().uid_then == before.uid_then


@pytest.mark.parametrize("delay", [0.0, 0.15, 0.4, 0.8])
def test_killed_in_the_middle_of_making_a_proxy(delay: float, net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE, ports=4)
    wait_until(lambda: bool(made.service), 60, made.tell)
    net.idle(on="node1")
    net.idle(on="node2")
    time.sleep(delay)
    release.kill_operator()
    wait_until(lambda: {proxy.on for proxy in made.proxies} == {"node1", "node2"}, 60, made.tell)
    assert len(made.proxies) == 2
    release.wait_operator()


def test_changes_while_the_operator_is_away(net: Namespace, robot: Robot) -> None:
    """Traffic goes on; pods are admitted unwired and told so; what was deleted is seen later."""
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    doomed = rosproxy(
        net.name, "doomed", master=NOWHERE, ports=4, podSelector={"matchLabels": {"a": "b"}}
    )
    with flow(net, robot, "rospy") as traffic:
        ports = made.the_proxy().ports
        with no_operator():
            pod = net.idle(on="node1")
            assert pod.environment == {}
            doomed.remove()
            wait_until(lambda: not doomed.body, 60, "no finalizer")
            made.the_proxy().remove(wait=False)
            uri = robot.uri(traffic.talker.node)
            traffic.listener.remove(grace=0)
        wait_until(lambda: made.proxy_on("node1") is not None, 40, made.tell)
        assert made.the_proxy().ports == ports
        traffic.outward.wait_for("inside", since=time.time(), seconds=60)
        assert robot.uri(traffic.talker.node) == uri
        wait_until(lambda: not robot.uri(traffic.listener.node), 60, lambda: str(robot.nodes()))
    wait_until(lambda: not doomed.service, 60, doomed.tell)
