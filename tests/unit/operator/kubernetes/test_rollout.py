"""A change of image or settings: the proxies in turn, and no image that a node cannot run."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateHelper,
    CreateProxy,
    DeleteHelper,
    DeleteProxy,
    Emit,
    SetImage,
)
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.planner.steps.reconcile import IMAGE_CHANGE_RESTART_S
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.cluster import (
    ClusterSnapshot,
    HelperPod,
    PodFailure,
    ProxyPod,
)
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import MaxUnavailable
from rosproxy_operator.kubernetes.resources.spec import rosproxy as read_rosproxy
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    SETTINGS,
    creation,
    done,
    kinds,
    look,
    node,
    observed,
    pod,
    proxy,
    rosproxy,
    service,
)

NODES = ("one", "three", "two")
NEXT = "rosproxy:2"


def running(name: str, **changes: Any) -> ProxyPod:
    """The proxy of a node, with the current settings and the former image."""
    of = rosproxy()
    made = creation(look(observed(of, service(), node(name), pod(on=name))))
    there = proxy(on=node(name), **changes)
    return replace(there, fingerprint=made.body["metadata"]["annotations"][names.FINGERPRINT])


def cluster(*proxies: ProxyPod, checks: tuple[HelperPod, ...] = (), **spec: Any) -> ClusterSnapshot:
    """Three nodes with a pod each. The RosProxy asks for the next image."""
    of = rosproxy(**{"image": NEXT, **spec})
    pods = [pod(name, on=name, ip=f"10.244.{number}.5") for number, name in enumerate(NODES)]
    return observed(of, service(of), *map(node, NODES), *pods, *proxies, image_checks=checks)


def check(plan: ClusterPlan, phase: str = "Succeeded", **changes: Any) -> HelperPod:
    """The image check of a plan, in a later phase."""
    (action,) = (a for a in plan.actions if isinstance(a, CreateHelper))
    parsed = objects.helper_pod({**action.body, "status": {"phase": phase}})
    assert parsed is not None
    place = replace(parsed.pod, uid=f"uid-check-{parsed.node}", node=parsed.node)
    return replace(parsed, pod=place, **changes)


def all_running() -> list[ProxyPod]:
    return [running(name) for name in NODES]


def images(actions: list[Action]) -> list[str]:
    """The nodes where the proxy gets another image."""
    by_id = {names.proxy_id(ROBOT, name): name for name in NODES}
    return [by_id[action.id] for action in actions if isinstance(action, SetImage)]


def test_the_next_image_is_tried_on_the_first_node() -> None:
    (action,) = done(look(cluster(*all_running())))
    assert isinstance(action, CreateHelper)
    (container,) = action.body["spec"]["containers"]
    assert (container["image"], container["command"]) == (NEXT, ["rosproxy", "--version"])
    assert action.body["spec"]["restartPolicy"] == "Never"
    assert "ports" not in container


def test_the_default_image_is_that_of_the_settings() -> None:
    snapshot = cluster(*all_running(), image="")
    (action,) = done(look(snapshot, settings=replace(SETTINGS, image="rosproxy:9")))
    assert isinstance(action, CreateHelper)
    assert action.body["spec"]["containers"][0]["image"] == "rosproxy:9"


@pytest.mark.parametrize("phase", ["Pending", "Running"])
def test_nothing_changes_while_it_is_tried(phase: str) -> None:
    proxies = all_running()
    trying = check(look(cluster(*proxies)), phase)
    assert done(look(cluster(*proxies, checks=(trying,)))) == []


def test_one_proxy_gets_the_image_after_the_other() -> None:
    proxies = all_running()
    plan = look(cluster(*proxies))
    checks: tuple[HelperPod, ...] = ()
    turns = []
    now = 100.0
    for index, name in enumerate(NODES):
        checks = (*checks, check(plan))
        plan = look(cluster(*proxies, checks=checks), plan.state, now)
        turns.append(images(done(plan)))
        proxies[index] = replace(proxies[index], image=NEXT)
        # The kubelet has not restarted the container yet, so the pod is still ready.
        plan = look(cluster(*proxies, checks=checks), plan.state, now + 1)
        assert kinds(plan) in ([], [DeleteHelper])
        proxies[index] = replace(proxies[index], restarts=1)
        checks = tuple(c for c in checks if c.node != name)
        now += 10
        plan = look(cluster(*proxies, checks=checks), plan.state, now)
    assert turns == [[name] for name in NODES]
    assert done(plan) == []


def test_a_kubelet_that_does_not_restart_it_holds_up_nothing_for_good() -> None:
    proxies = all_running()
    first = look(cluster(*proxies))
    changed = look(cluster(*proxies, checks=(check(first),)), first.state, 100.0)
    proxies[0] = replace(proxies[0], image=NEXT)
    waiting = look(cluster(*proxies), changed.state, 101.0)
    assert done(waiting) == []
    later = look(cluster(*proxies), waiting.state, 100.0 + IMAGE_CHANGE_RESTART_S)
    assert kinds(later) == [CreateHelper]


@pytest.mark.parametrize(
    ("most", "expected"), [(MaxUnavailable(2), 2), (MaxUnavailable(50, is_percent=True), 2)]
)
def test_so_many_at_a_time_as_the_rosproxy_says(most: MaxUnavailable, expected: int) -> None:
    assert kinds(look(cluster(*all_running(), max_unavailable=most))) == [CreateHelper] * expected
    settings = rosproxy(cleanup_after=7.0, max_unavailable=most)
    snapshot = replace(cluster(*all_running()), rosproxies=(settings,))
    assert kinds(look(snapshot)) == [DeleteProxy] * expected


@pytest.mark.parametrize(
    ("failure", "text"),
    [
        ({"stuck": PodFailure.IMAGE, "message": "not found"}, "can't get the image rosproxy:2"),
        ({"phase": "Failed", "message": "exec: rosproxy: not found"}, "does not run rosproxy"),
        (
            {"stuck": PodFailure.SCHEDULING, "message": "no room"},
            "tests the image rosproxy:2 does not run (no room)",
        ),
    ],
)
def test_an_image_that_a_node_can_not_run_stops_the_rollout(
    failure: dict[str, Any], text: str
) -> None:
    proxies = all_running()
    failed = check(look(cluster(*proxies)), **{"phase": "Pending", **failure})
    plan = look(cluster(*proxies, checks=(failed,)))
    assert done(plan) == []
    (problem,) = plan.problems
    assert (problem.reason, problem.subject, problem.fatal) == ("ImageUnusable", "node one", False)
    assert text in problem.message
    assert "keeps the image rosproxy:1" in problem.message
    (event,) = (action for action in plan.actions if isinstance(action, Emit))
    assert (event.type, event.reason) == ("Warning", "ImageUnusable")


def test_another_choice_of_image_ends_the_check() -> None:
    proxies = all_running()
    failed = check(look(cluster(*proxies)), "Pending", stuck=PodFailure.IMAGE)
    (action,) = done(look(cluster(*proxies, checks=(failed,), image="rosproxy:1")))
    assert isinstance(action, DeleteHelper)
    assert action.component == names.IMAGE_CHECK
    # The name is taken until the former check has gone.
    created, deleted = done(look(cluster(*proxies, checks=(failed,), image="rosproxy:3")))
    assert isinstance(deleted, DeleteHelper)
    assert isinstance(created, CreateHelper)
    assert created.body["metadata"]["annotations"][names.NODE] != "one"


def test_a_proxy_that_does_not_run_gets_the_image_at_once() -> None:
    stuck = replace(running("one"), image="wrong:1", stuck=PodFailure.IMAGE, ready=False)
    actions = done(look(cluster(stuck, running("three"), running("two"))))
    assert images(actions) == ["one"]
    assert not [action for action in actions if isinstance(action, CreateHelper)]


@pytest.mark.parametrize("cause", [PodFailure.CRASHING, PodFailure.SCHEDULING])
def test_a_proxy_that_does_not_work_with_the_change_stops_it(cause: PodFailure) -> None:
    broken = replace(running("one"), image=NEXT, stuck=cause, ready=False)
    assert done(look(cluster(broken, running("three"), running("two")))) == []


def test_a_proxy_that_waits_for_ports_stops_nothing() -> None:
    waiting = replace(running("one"), image=NEXT, stuck=PodFailure.PORTS, ready=False)
    plan = look(cluster(waiting, running("three"), running("two")))
    assert CreateHelper in kinds(plan)


def test_where_no_master_is_reached_the_rollout_goes_on() -> None:
    """A proxy is ready only with a reachable master, and the robot may be off for the weekend."""
    proxies = [replace(each, ready=False) for each in all_running()]
    assert kinds(look(cluster(*proxies))) == [CreateHelper]
    proxies[1] = replace(proxies[1], ready=True)
    proxies[0] = replace(proxies[0], image=NEXT)
    # The first does not reach the master with the change, and another one does.
    plan = look(cluster(*proxies))
    assert [a for a in done(plan) if isinstance(a, SetImage | DeleteProxy)] == []


def test_new_settings_wait_for_their_image() -> None:
    proxies = all_running()
    seen = cluster(*proxies, cleanup_after=7.0)
    plan = look(seen)
    assert kinds(plan) == [CreateHelper]
    assert kinds(look(cluster(*proxies, cleanup_after=7.0, checks=(check(plan),)))) == [DeleteProxy]


def test_a_new_node_needs_no_check() -> None:
    assert kinds(look(cluster(running("one"), running("two")))).count(CreateProxy) == 1


@pytest.mark.parametrize(
    ("value", "expected"),
    [(1, 1), (3, 3), ("10%", 1), ("34%", 4), ("100%", 10)],
)
def test_max_unavailable(value: Any, expected: int) -> None:
    assert read(value).of(10) == expected


@pytest.mark.parametrize("value", [0, -1, "0%", "101%", "50", "x%", "", True, 1.5, [1]])
def test_what_is_no_number_of_proxies(value: Any) -> None:
    with pytest.raises(InvalidField, match="maxUnavailable"):
        read(value)


def read(value: Any) -> MaxUnavailable:
    spec = {"master": {"uri": "http://robot:11311"}, "maxUnavailable": value}
    meta = {"name": "robot", "namespace": "ros", "uid": "u", "generation": 1}
    return read_rosproxy({"metadata": meta, "spec": spec}).spec.max_unavailable
