"""Unwired pods are evicted if the RosProxy asks for that."""

from itertools import pairwise
from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import Emit, EvictPod
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyReport
from rosproxy_operator.kubernetes.resources.model import MasterSpec, Pod, PodContainer, Ros2Spec
from rosproxy_operator.kubernetes.resources.names import master_uri
from rosproxy_operator.kubernetes.resources.spec import rosproxy as read
from tests.unit.operator.kubernetes.builders_api import pod_obj, rosproxy_obj
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    look,
    node,
    observed,
    pod,
    proxy,
    rosproxy,
    service,
)

IP = service().cluster_ip
WIRED = master_uri(IP)


def of_set(name: str = "a", **more: Any) -> Pod:
    return replace(pod(name), **{"controller": "ReplicaSet", "wired_master_uri": "", **more})


def cluster(*pods: Pod, remakes: bool = True) -> ClusterSnapshot:
    of = replace(rosproxy(), remakes=remakes)
    return observed(of, service(), node(), proxy(), *pods)


def evicted(plan: ClusterPlan) -> list[str]:
    return [action.id.name for action in plan.actions if isinstance(action, EvictPod)]


def test_an_unwired_pod_is_evicted() -> None:
    plan = look(cluster(of_set()))
    (action,) = [a for a in plan.actions if isinstance(a, EvictPod)]
    assert (action.of, action.uid) == (ROBOT, of_set().uid)
    (event,) = [a for a in plan.actions if isinstance(a, Emit)
                and a.reason == "PodEvicted"]  # fmt: skip
    assert event.type == "Normal"
    assert event.message.startswith("evicted pod a: not wired to its proxy")


def test_one_that_was_wired_to_a_former_address_is_evicted() -> None:
    assert evicted(look(cluster(of_set(wired_master_uri="http://10.96.0.200:11311")))) == ["a"]


def test_a_pod_of_a_former_rosproxy_is_evicted() -> None:
    seen = cluster(of_set(wired_master_uri=WIRED, running_since="2026-01-01T00:00:00Z"))
    (of,) = seen.rosproxies
    assert evicted(look(seen)) == []
    younger = replace(seen, rosproxies=(replace(of, created="2026-01-01T00:00:01Z"),))
    assert evicted(look(younger)) == []  # the proxy has not answered
    answered = {uid: ProxyReport(True) for uid in (p.pod.uid for p in seen.proxies)}
    assert evicted(look(replace(younger, reports=answered))) == ["a"]


@pytest.mark.parametrize(
    ("peers", "own", "goes"),
    [("", "", True), ("10.96.0.200", "10.96.0.200", True), ("", "robot", False), (IP, IP, False)],
)
def test_a_pod_without_static_peers_is_evicted(peers: str, own: str, goes: bool) -> None:
    container = PodContainer(variables={"ROS_STATIC_PEERS": own} if own else {})
    left = of_set(static_peers=peers, containers=(container,))
    of = replace(rosproxy(ros1=False, ros2=Ros2Spec(), master=MasterSpec()), remakes=True)
    assert bool(evicted(look(observed(of, service(), node(), left)))) == goes


@pytest.mark.parametrize("kind", ["ReplicationController", "StatefulSet", "DaemonSet"])
def test_whoever_makes_pods_anew(kind: str) -> None:
    assert evicted(look(cluster(of_set(controller=kind)))) == ["a"]


@pytest.mark.parametrize(
    "left",
    [
        of_set(wired_master_uri=WIRED),
        of_set(controller="Job"),
        of_set(controller=""),
        of_set(own_masters=("http://elsewhere:11311",)),
        of_set(phase="Succeeded"),
        of_set(phase="Pending"),
        of_set(deleting=True),
        of_set(labels={names.INJECT: "false"}),
    ],
)
def test_all_others_are_left_alone(left: Pod) -> None:
    assert evicted(look(cluster(left))) == []


def test_nobody_is_evicted_who_did_not_ask_for_it() -> None:
    assert evicted(look(cluster(of_set(), remakes=False))) == []


def test_no_pod_is_evicted_without_a_service() -> None:
    """The webhook could not wire the next pod either."""
    of = replace(rosproxy(), remakes=True)
    assert evicted(look(observed(of, node(), of_set()))) == []


def test_one_goes_at_a_time() -> None:
    a = of_set("a")
    b = of_set("b")
    plan = look(cluster(b, a), now=100.0)
    assert evicted(plan) == ["a"]
    going = look(cluster(replace(a, deleting=True), b), plan.state, 110.0)
    assert evicted(going) == []
    coming = look(
        cluster(of_set("c", wired_master_uri=WIRED, phase="Pending"), b), going.state, 120.0
    )
    assert evicted(coming) == []
    arrived = look(cluster(of_set("c", wired_master_uri=WIRED), b), coming.state, 130.0)
    assert evicted(arrived) == ["b"]


def test_a_webhook_that_does_not_work_costs_a_pod_a_minute() -> None:
    """Even if no pod exists for a moment between two pods."""
    state = ClusterState()
    gone = list[float]()
    for second in range(3600):
        snapshot = cluster(of_set(f"pod-{second}")) if second % 2 else cluster()
        plan = look(snapshot, state, 100.0 + second)
        state = plan.state
        if evicted(plan):
            gone.append(100.0 + second)
    assert len(gone) < 75
    pauses = [after - before for before, after in pairwise(gone)]
    assert min(pauses[20:]) >= 60.0


def test_what_is_read_of_a_rosproxy_and_of_a_pod() -> None:
    obj = rosproxy_obj()
    assert not read(obj).remakes
    obj["metadata"]["annotations"] = {names.REMAKE: "true"}
    assert read(obj).remakes
    obj["metadata"]["annotations"] = {names.REMAKE: "yes"}
    assert not read(obj).remakes
    made = pod_obj()
    assert objects.pod(made).controller == ""
    made["metadata"]["ownerReferences"] = [
        {"kind": "Thing"}, {"kind": "ReplicaSet", "controller": True},
    ]  # fmt: skip
    assert objects.pod(made).controller == "ReplicaSet"
