"""Pods whose ROS 1 nodes a proxy has unregistered are told, also if all is as before again."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.ports import PortRange
from rosproxy_operator.kubernetes.planner.actions import DeleteProxy, EvictPod, PatchStatus
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyReport
from rosproxy_operator.kubernetes.resources.model import MasterSpec, Pod, RosProxy, Selector
from rosproxy_operator.kubernetes.resources.spec import rosproxy as read
from tests.unit.operator.kubernetes.builders_api import rosproxy_obj
from tests.unit.operator.kubernetes.objects import (
    SETTINGS,
    node,
    observed,
    pod,
    proxy,
    rosproxy,
    service,
    told,
)

BEFORE = "2026-01-01T00:00:00Z"
THEN = "2026-01-01T01:00:00Z"
A_SECOND_LATER = "2026-01-01T01:00:01Z"
LATER = "2026-01-01T02:00:00Z"
OTHER_MASTER = MasterSpec("http://other:11311")
WITH_NODES = ProxyReport(answered=True, nodes={"10.244.1.7": ("/talker",)})
WITHOUT_NODES = ProxyReport(answered=True)
OF_THE_POD = ProxyReport(answered=True, nodes={pod().ip: ("/talker",)})
RETIRED = ProxyReport(answered=True, retired=True)


def running(**changes: Any) -> Pod:
    more = {"running_since": BEFORE, "workload": "deployment/talker", "controller": "ReplicaSet"}
    return pod(**{**more, **changes})


def seen(*objects: Any, of: RosProxy, report: ProxyReport | None = WITH_NODES) -> ClusterSnapshot:
    """A cluster with a proxy that has the report."""
    reports = {proxy().pod.uid: report} if report else {}
    return observed(of, service(of), node(), *objects, reports=reports)


def look(
    snapshot: ClusterSnapshot,
    state: ClusterState | None = None,
    stamp: str = LATER,
    now: float = 100.0,
) -> ClusterPlan:
    return plan(snapshot, SETTINGS, state or ClusterState(begun=True), now, stamp)


def retires(plan: ClusterPlan) -> bool:
    return any(isinstance(action, DeleteProxy) and action.retire for action in plan.actions)


def stored(of: RosProxy, plan: ClusterPlan) -> RosProxy:
    """The RosProxy with the status that a plan has written, as the operator reads it again."""
    (status,) = [a.status for a in plan.actions if isinstance(a, PatchStatus)]
    again = read({**rosproxy_obj(), "status": status})
    kept = {"former_ranges": again.former_ranges, "unregistered_at": again.unregistered_at}
    return replace(of, status=status, **kept)


def test_another_master_and_back_leaves_older_pods_unregistered() -> None:
    changed = rosproxy(master=OTHER_MASTER)
    first = look(seen(running(), proxy(), of=changed), stamp=THEN)
    assert retires(first)
    (text,) = told(first, "NotWired")
    assert f"was started before {THEN}, when the proxy on node one unregistered" in text
    assert "The ROS nodes of this pod may have been unregistered" in text
    assert text.endswith(". Run kubectl -n ros rollout restart deployment/talker")

    back = stored(rosproxy(), first)
    assert told(look(seen(running(), proxy(), of=back)), "NotWired") == [text]
    started_later = running(created=BEFORE, running_since=A_SECOND_LATER)
    assert not told(look(seen(started_later, proxy(), of=back)), "NotWired")


def test_a_container_that_started_in_the_second_of_the_unregistration_is_told() -> None:
    """Kubernetes keeps whole seconds. The node may have registered a moment before."""
    of = replace(rosproxy(), unregistered_at={"one": THEN})
    started = running(created=BEFORE, running_since=THEN)
    assert told(look(seen(started, proxy(), of=of, report=WITHOUT_NODES)), "NotWired")
    assert not told(look(seen(started, proxy(), of=of, report=OF_THE_POD)), "NotWired")


def test_a_look_with_a_former_status_still_tells() -> None:
    first = look(seen(running(), proxy(), of=rosproxy(master=OTHER_MASTER)), stamp=THEN)
    again = look(seen(running(), proxy(), of=rosproxy()), first.state)
    assert told(again, "NotWired")
    (status,) = [a.status for a in again.actions if isinstance(a, PatchStatus)]
    assert [line["unregisteredAt"] for line in status["perNode"]] == [THEN]


def test_pods_that_are_selected_again_after_the_grace_are_told() -> None:
    none = rosproxy(pod_selector=Selector({"app": "x"}), grace=60.0)
    waiting = look(seen(running(), proxy(), of=none), stamp=BEFORE)
    gone = look(seen(running(), proxy(), of=none), waiting.state, THEN, now=161.0)
    assert (retires(waiting), retires(gone)) == (False, True)
    assert not told(gone, "NotWired")  # the pod is not selected

    back = stored(rosproxy(), gone)
    assert told(look(seen(running(), of=back)), "NotWired")


def test_other_ports_leave_older_pods_unregistered() -> None:
    of = rosproxy(window=PortRange(11420, 11499))
    first = look(seen(running(), proxy(), of=of), stamp=THEN)
    assert retires(first)
    assert told(first, "NotWired")


def test_the_unregistrations_of_a_node_that_has_left_are_forgotten() -> None:
    first = look(seen(running(), proxy(), of=rosproxy(master=OTHER_MASTER)), stamp=THEN)
    assert first.state.unregistered
    left = look(observed(rosproxy(), node("two")), first.state)
    assert not left.state.unregistered


def test_a_second_plan_of_the_same_deletion_keeps_the_time() -> None:
    """Otherwise pods would be told that start while the proxy unregisters its nodes."""
    changed = seen(running(), proxy(), of=rosproxy(master=OTHER_MASTER))
    first = look(changed, stamp=THEN)
    second = look(changed, first.state, LATER, now=200.0)
    assert retires(second)
    assert [at.at for at in second.state.unregistered.values()] == [THEN]


@pytest.mark.parametrize(("report", "tells"), [(WITHOUT_NODES, False), (None, True)])
def test_a_proxy_without_nodes_has_none_to_unregister(
    report: ProxyReport | None, tells: bool
) -> None:
    """A mistyped master that is corrected: the nodes still try to register."""
    of = rosproxy(master=OTHER_MASTER)
    first = look(seen(running(), proxy(), of=of, report=report), stamp=THEN)
    assert retires(first)
    assert bool(told(first, "NotWired")) == tells


@pytest.mark.parametrize(
    "of",
    [rosproxy(cleanup_after=7.0), rosproxy(image="rosproxy:2")],
    ids=["settings", "image"],
)
def test_a_proxy_that_finds_its_nodes_again_is_no_reason(of: RosProxy) -> None:
    first = look(seen(running(), proxy(), of=of), stamp=THEN)
    assert not told(first, "NotWired")
    assert not first.state.unregistered


def test_an_older_pod_with_nodes_at_its_proxy_is_neither_told_nor_evicted() -> None:
    """Its containers started later, or the clock of the operator is ahead of the API server's."""
    of = replace(rosproxy(), remakes=True, unregistered_at={"one": THEN}, created=LATER)
    found = look(seen(running(), proxy(), of=of, report=OF_THE_POD))
    assert not told(found, "NotWired")
    assert not [action for action in found.actions if isinstance(action, EvictPod)]
    two = seen(running(), running(name="listener"), proxy(), of=of, report=OF_THE_POD)
    (text,) = told(look(two), "NotWired")
    assert text.startswith("pod ros/listener: is older than RosProxy")


def test_an_unregistration_that_is_called_off_leaves_no_pod_unregistered() -> None:
    changed = rosproxy(master=OTHER_MASTER)
    first = look(seen(running(), proxy(), of=changed, report=OF_THE_POD), stamp=THEN)
    assert retires(first)
    assert told(first, "NotWired"), "the report is older than the unregistration"
    back = look(seen(running(), proxy(), of=rosproxy(), report=OF_THE_POD), first.state)
    assert not told(back, "NotWired")


def test_a_proxy_that_has_retired_in_vain_is_replaced() -> None:
    """A pod is selected again, or the master is changed back, before the proxy is deleted."""
    found = look(seen(running(), proxy(), of=rosproxy(), report=RETIRED))
    (action,) = [a for a in found.actions if isinstance(a, DeleteProxy)]
    assert action.retire, "another operator may have to wait until the proxy has unregistered all"
    assert action.why == "the proxy has unregistered its nodes, and accepts no others"


def test_such_pods_are_evicted_if_the_rosproxy_asks_for_that() -> None:
    of = replace(rosproxy(), remakes=True, unregistered_at={"one": THEN})
    evicted = [a for a in look(seen(running(), proxy(), of=of)).actions if isinstance(a, EvictPod)]
    assert [action.id.name for action in evicted] == ["talker"]
    elsewhere = replace(of, unregistered_at={"two": THEN})
    restarted = running(created=BEFORE, running_since=LATER)
    for snapshot in (seen(running(), proxy(), of=elsewhere), seen(restarted, proxy(), of=of)):
        assert not [action for action in look(snapshot).actions if isinstance(action, EvictPod)]


@pytest.mark.parametrize("at", ["zzz", "", 7, None, "2026-01-01"])
def test_a_malformed_time_in_a_status_counts_as_missing(at: object) -> None:
    status = {"perNode": [{"name": "one", "unregisteredAt": at}]}
    assert read({**rosproxy_obj(), "status": status}).unregistered_at == {}


def test_a_rosproxy_that_is_gone_is_forgotten() -> None:
    first = look(seen(running(), proxy(), of=rosproxy(master=OTHER_MASTER)), stamp=THEN)
    assert first.state.unregistered
    assert not look(observed(running()), first.state).state.unregistered
