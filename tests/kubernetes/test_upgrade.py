"""helm test, and helm upgrade with traffic running."""

import itertools
import os
import time
from pathlib import Path

import pytest

from tests.docker.engine import wait_until
from tests.docker.images import PROXY
from tests.docker.nodes import LIBRARIES
from tests.kubernetes import api, former, release
from tests.kubernetes.measured import note
from tests.kubernetes.mistakes import errors
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rollout import Absence, watched
from tests.kubernetes.rosproxies import Proxy, rosproxy
from tests.kubernetes.traffic import START, Flow, flow, wait_for_service


def test_helm_test() -> None:
    started = time.time()
    release.helm("test", release.NAME, "--namespace", release.NAMESPACE, seconds=300)
    note(f"helm test: {time.time() - started:.0f} s")


def test_upgrade_of_the_operator_only(net: Namespace, robot: Robot) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    with flow(net, robot, "roscpp") as traffic:
        before = made.the_proxy()
        started = time.time()
        release.upgrade(log={"level": "debug"})
        release.wait_operator()
        traffic.wait(since=time.time())
        gaps = traffic.gaps(started)
        assert gaps.unnoticed, gaps
        assert made.the_proxy().uid_then == before.uid_then


def test_the_image_changes_on_one_node_at_a_time(net: Namespace, robot: Robot) -> None:
    """A proxy is ready again, and so reaches the master, before the next proxy is stopped.

    Meanwhile the messages of the other node flow without a loss.
    """
    other = release.other_image()
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    with (
        flow(net, robot, "roscpp", on="node1") as one,
        flow(net, robot, "rospy", on="node2") as two,
    ):
        before = {node: made.the_proxy(node) for node in ("node1", "node2")}
        with watched(made) as rollout:
            started = time.time()
            release.upgrade(proxy={"image": {"tag": other}})
            wait_until(
                lambda: {absence.node for absence in rollout.ended} == before.keys(),
                120,
                lambda: f"{rollout.absences()}: {made.tell()}",
            )
            for traffic in (one, two):
                traffic.wait(since=time.time(), seconds=60)
        flows = {"node1": one, "node2": two}
        _assert_in_turn(rollout.absences(), flows)
        for node, traffic in flows.items():
            note(f"other image on two nodes, {node}: {traffic.gaps(started)}")
            after = made.the_proxy(node)
            assert (after.uid_then, after.restarts) == (before[node].uid_then, 1)
            assert after.body["spec"]["containers"][0]["image"] == f"rosproxy:{other}"
    release.upgrade()


@pytest.mark.skipif(
    not former.is_known() and os.environ.get("CI") != "true",
    reason="the history of git is not here",
)
def test_upgrade_from_a_former_chart(net: Namespace, robot: Robot, tmp_path: Path) -> None:
    """The proxies are recreated in turn, on the same ports, and running pods go on."""
    release.install_former(former.prepare(tmp_path), former.TAG)
    try:
        release.wait_operator()
        made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
        with (
            flow(net, robot, "roscpp", on="node1") as one,
            flow(net, robot, "rospy", on="node2") as two,
        ):
            flows = {"node1": one, "node2": two}
            before = {node: made.the_proxy(node) for node in flows}
            with watched(made) as rollout:
                started = time.time()
                release.upgrade()
                wait_until(
                    lambda: {absence.node for absence in rollout.ended} == flows.keys(),
                    180,
                    lambda: f"{rollout.absences()}: {made.tell()}",
                )
                for traffic in flows.values():
                    traffic.wait(since=time.time(), seconds=60)
            _assert_in_turn(rollout.absences(), flows)
            for node, traffic in flows.items():
                note(f"helm upgrade from {former.COMMIT[:7]}, {node}: {traffic.gaps(started)}")
                after = made.the_proxy(node)
                assert after.ports == before[node].ports
                assert after.body["spec"]["containers"][0]["image"] == PROXY
    finally:
        release.remove()
        release.install()
        release.wait_operator()


def _assert_in_turn(absences: list[Absence], flows: dict[str, Flow]) -> None:
    """Each proxy is away once and never two at once, and the messages of other nodes flow."""
    assert sorted(absence.node for absence in absences) == sorted(flows), absences
    for one, following in itertools.pairwise(absences):
        assert one.end <= following.begin, absences
    for absence in absences:
        for node, traffic in flows.items():
            if node != absence.node:
                _assert_no_loss(absence, traffic)


def _assert_no_loss(absence: Absence, traffic: Flow) -> None:
    for log, word in ((traffic.outward, "inside"), (traffic.inward, "outside")):
        numbers = absence.numbers(log, word)
        assert numbers, f"no message {word} during {absence}"
        assert numbers == [*range(numbers[0], numbers[-1] + 1)], absence


@pytest.mark.parametrize("library", LIBRARIES)
def test_upgrade_of_the_proxies(library: str, net: Namespace, robot: Robot) -> None:
    """The image changes in place: the same pod, the same ports."""
    other = release.other_image()
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    with flow(net, robot, library) as traffic:
        before = made.the_proxy()
        started = time.time()
        release.upgrade(proxy={"image": {"tag": other}})
        wait_until(lambda: made.the_proxy().restarts == 1, 60, made.tell)
        traffic.wait(since=time.time(), seconds=60)
        after = made.the_proxy()
        note(f"helm upgrade, other image of the proxy, {library}: {traffic.gaps(started)}")
        assert (after.uid_then, after.ports) == (before.uid_then, before.ports)
        assert after.body["spec"]["containers"][0]["image"] == f"rosproxy:{other}"
    release.upgrade()


def test_a_wrong_image_of_the_proxies(net: Namespace, robot: Robot) -> None:
    """Proxies go on with their image, and the RosProxy reports the fault."""
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    with flow(net, robot, "roscpp") as traffic:
        before = made.the_proxy()
        started = time.time()
        release.upgrade(proxy={"image": {"tag": "missing"}})
        made.wait_event("ImageUnusable", "rosproxy:missing")
        assert "rosproxy:missing" in made.wait_for("Degraded", "True")["message"]
        (text,) = [text for text in errors(net.name) if "rosproxy:missing" in text]
        assert "the node can't get the image rosproxy:missing (" in text
        assert f"keeps the image {PROXY}. Load the image on the node, or correct spec.image" in text
        assert made.wait_for("Ready", "True")
        release.upgrade()
        made.wait_for("Degraded", "False")
        traffic.wait(since=time.time())
        gaps = traffic.gaps(started)
        assert gaps.unnoticed, gaps
        after = made.the_proxy()
        assert (after.uid_then, after.restarts) == (before.uid_then, before.restarts)
    wait_until(lambda: not api.objects("pods", net.name, release.IMAGE_CHECKS), 60, made.tell)


def test_other_defaults_of_the_proxies(net: Namespace, robot: Robot) -> None:
    """Proxies are recreated with the defaults, on the same ports, and ROS nodes go on."""
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    with flow(net, robot, "roscpp") as traffic:
        before = made.the_proxy()
        release.upgrade(proxy={"pod": {"labels": {"team": "arms"}, "runAsUser": None}})
        wait_until(
            lambda: before.uid_then not in [proxy.uid_then for proxy in made.proxies],
            60,
            made.tell,
        )
        after = made.the_proxy()
        assert after.ports == before.ports
        assert after.body["metadata"]["labels"]["team"] == "arms"
        assert "runAsUser" not in after.body["spec"]["securityContext"]
        traffic.wait(since=time.time(), seconds=60)
    release.upgrade()


@pytest.mark.parametrize("library", LIBRARIES)
def test_other_bounds_of_the_proxies(library: str, net: Namespace, robot: Robot) -> None:
    """Proxies are recreated with the bounds, on the same ports, and ROS nodes go on."""
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    with flow(net, robot, library) as traffic:
        before = made.the_proxy()
        started = time.time()
        release.upgrade(proxy={"bounds": {"maxBuffered": 16}})
        wait_until(lambda: made.the_proxy().uid_then != before.uid_then, 60, made.tell)
        traffic.wait(since=time.time(), seconds=60)
        after = made.the_proxy()
        note(f"helm upgrade, other bounds of the proxy, {library}: {traffic.gaps(started)}")
        assert after.ports == before.ports
        assert after.environment["ROSPROXY_MAX_BUFFERED"] == "16"
    release.upgrade()


def test_another_key_of_the_tokens(net: Namespace, robot: Robot) -> None:
    """Proxies are recreated on the same ports, in turn, and ROS nodes go on."""
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    for node in ("node1", "node2"):
        net.idle(on=node)
    with flow(net, robot, "roscpp") as traffic:
        before = {node: made.the_proxy(node) for node in ("node1", "node2")}
        hashes = {node: _hash(proxy) for node, proxy in before.items()}
        counts: list[int] = []

        def anew() -> bool:
            now = {proxy.on: proxy for proxy in made.proxies}
            counts.append(len(now))
            return now.keys() == before.keys() and not (
                {proxy.uid_then for proxy in now.values()}
                & {proxy.uid_then for proxy in before.values()}
            )

        started = time.time()
        api.patch("secrets", release.NAMESPACE, f"{release.FULL_NAME}-key", {"data": None})
        wait_until(anew, 90, made.tell)
        assert min(counts) == 1
        for node, proxy in before.items():
            after = made.the_proxy(node)
            assert after.ports == proxy.ports
            assert _hash(after) not in ("", hashes[node])
        traffic.wait(since=time.time(), seconds=60)
        note(f"another key, two proxies made anew: {traffic.gaps(started)}")


def _hash(proxy: Proxy) -> str:
    return str(proxy.environment["ROSPROXY_ADMIN_TOKEN_HASH"])


def test_webhook_turned_off(net: Namespace, robot: Robot) -> None:
    """Pods still start, and set the master themselves."""
    release.upgrade(webhook={"enabled": False})
    release.wait_operator()
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=8)
    wait_for_service(net)
    pod = net.idle(on="node1")
    assert pod.environment == {}
    uri = f"http://{made.service['spec']['clusterIP']}:11311"
    talker = net.node("rospy", "pub", "--topic", "/by_hand", "--word", "inside", on="node1",
                      env={"ROS_MASTER_URI": uri})  # fmt: skip
    listener = robot.node("listener_by_hand", "rospy", "sub", "--topic", "/by_hand")
    listener.wait_for("inside", seconds=START)
    assert robot.knows_proxied(talker.node, "node1")
    release.upgrade()
    release.wait_operator()
