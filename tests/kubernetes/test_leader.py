"""Two operators: the leader is killed, stopped and upgraded, while pods are created."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.docker.engine import wait_until
from tests.kubernetes import api, release
from tests.kubernetes.measured import note
from tests.kubernetes.pods import INJECT, Namespace, Pod, environment
from tests.kubernetes.rosproxies import NOWHERE, RosProxy, rosproxy, wait_event
from tests.kubernetes.test_operator_killed import no_operator

EVERY = 0.2
"""Seconds between two pods."""
REMAKE = "rosproxy.io/remake-unwired"


@pytest.fixture
def made(net: Namespace) -> RosProxy:
    """A RosProxy with a proxy on each node. The proxies wait for a master."""
    release.wait_operator()
    created = rosproxy(net.name, master=NOWHERE, ports=4)
    for node in ("node1", "node2"):
        net.idle(on=node)
    wait_until(lambda: len(created.proxies) == 2, 60, created.tell)
    return created


@contextmanager
def pods_all_the_while(net: Namespace) -> Iterator[list[Pod]]:
    """Create five pods a second in this context.

    The pods fit no node, because only admission matters here.
    """
    pods: list[Pod] = []
    ended = threading.Event()

    def make() -> None:
        while not ended.wait(EVERY):
            pods.append(net.idle(nodeSelector={"nowhere": "true"}))

    thread = threading.Thread(target=make)
    thread.start()
    try:
        wait_until(lambda: len(pods) > 5, 30, "pods are made")
        yield pods
    finally:
        ended.set()
        thread.join()


def unwired(net: Namespace) -> list[str]:
    """The pods of users without the proxy's variable."""
    return [
        body["metadata"]["name"]
        for body in net.pods(INJECT)
        if "ROS_MASTER_URI" not in environment(body["spec"]["containers"][0])
    ]


def check_once(made: RosProxy, uids: set[str]) -> None:
    """Check that each proxy is unchanged, and was made once."""
    assert {proxy.uid_then for proxy in made.proxies} == uids, made.tell()
    events = [event for event in made.events if event.reason == "ProxyCreated"]
    assert [event.count for event in events] == [1, 1], made.tell()
    assert not [event for event in made.events if event.reason == "ProxyDeleted"], made.tell()


def wait_other(before: str) -> float:
    """Wait until another operator leads. Return the seconds."""

    def other() -> bool:
        return release.holder() not in ("", before)

    return wait_until(other, 60, lambda: f"another leader than {before}: {release.holder()}")


def serves(net: Namespace, made: RosProxy) -> None:
    """Wait until the leader serves a new RosProxy."""
    nobody = {"matchLabels": {"a": "b"}}
    other = rosproxy(net.name, f"{made.name}-2", master=NOWHERE, ports=4, podSelector=nobody)
    wait_until(lambda: bool(other.service), 60, other.tell)


@pytest.mark.parametrize("turn", [1, 2])
def test_the_leader_is_killed(turn: int, net: Namespace, made: RosProxy) -> None:
    """While kube-proxy still leads to the dead operator, pods may be unwired."""
    uids = {proxy.uid_then for proxy in made.proxies}
    before = release.holder()
    with pods_all_the_while(net) as pods:
        release.kill_operator()
        took = wait_other(before)
        serves(net, made)
        release.wait_operator()
        since = len(pods)
        wait_until(lambda: len(pods) > since + 10, 60, "more pods are created")
    left = unwired(net)
    note(f"leader killed: another led after {took:.1f} s; "
         f"{len(left)} of {len(pods)} pods not wired")  # fmt: skip
    assert not {pod.name for pod in pods[since:]} & set(left)
    for name in left:
        wait_event(net.name, name, "Pod", "NotWired")
    check_once(made, uids)


def test_the_leader_is_stopped(net: Namespace, made: RosProxy) -> None:
    uids = {proxy.uid_then for proxy in made.proxies}
    before = release.holder()
    with pods_all_the_while(net) as pods:
        release.operator().remove(wait=False)
        took = wait_other(before)
        serves(net, made)
        release.wait_operator()
    note(f"leader stopped: another led after {took:.1f} s; {len(pods)} pods made")
    assert unwired(net) == []
    check_once(made, uids)


def test_a_rolling_upgrade(net: Namespace, made: RosProxy) -> None:
    uids = {proxy.uid_then for proxy in made.proxies}
    former = {pod.name for pod in release.operators()}
    with pods_all_the_while(net) as pods:
        release.upgrade(podAnnotations={"upgraded": str(time.time())})
        release.wait_operator()
    assert not former & {pod.name for pod in release.operators()}
    note(f"rolling upgrade: {len(pods)} pods made, all wired")
    assert unwired(net) == []
    check_once(made, uids)


def test_they_are_on_nodes_of_their_own() -> None:
    release.wait_operator()
    nodes = [pod.body["spec"]["nodeName"] for pod in release.operators()]
    assert sorted(nodes) == ["node1", "node2"]


def test_unwired_pods_are_evicted_on_request(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE, ports=4)
    wait_until(lambda: bool(made.service), 60, made.tell)
    template = net.pod_body("unused", "sleep", "infinity", on="node1")
    labels = {**template["metadata"]["labels"], "app": "talker"}
    spec = {**template["spec"], "terminationGracePeriodSeconds": 0}
    with no_operator():
        alone = net.idle(on="node1")
        api.create({
            "apiVersion": "apps/v1", "kind": "Deployment",
            "metadata": {"name": "talker", "namespace": net.name},
            "spec": {"replicas": 2, "selector": {"matchLabels": {"app": "talker"}},
                     "template": {"metadata": {"labels": labels}, "spec": spec}},
        })  # fmt: skip
        wait_until(lambda: len(net.pods("app=talker")) == 2, 60, "the Deployment has its pods")
    pods = [body["metadata"]["name"] for body in net.pods("app=talker")]
    for name in (*pods, alone.name):
        wait_event(net.name, name, "Pod", "NotWired")
    assert sorted(unwired(net)) == sorted((*pods, alone.name))

    annotations = {"annotations": {REMAKE: "true"}}
    api.patch("rosproxies", net.name, made.name, {"metadata": annotations})
    wait_until(lambda: unwired(net) == [alone.name], 120, lambda: f"{unwired(net)} {made.tell()}")
    for name in pods:
        made.wait_event("PodEvicted", name)
    assert alone.uid, "no controller would recreate the pod"
