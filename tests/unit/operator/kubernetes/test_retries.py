"""Refused or short-lived actions are repeated: soon, then ever later, never in a loop."""

from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import CreateProxy, CreateService, PatchStatus
from rosproxy_operator.kubernetes.planner.retries import Retries, RetryRecord, Task
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.model import Name
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    complete,
    done,
    kinds,
    look,
    node,
    observed,
    pod,
    proxy,
    rosproxy,
    scene,
    told,
    written,
)

PROXY = names.proxy_id(ROBOT, "one")
EVICTION = Task(ROBOT, "remake", ROBOT)


def refusing(name: Name = PROXY, text: str = "violates PodSecurity baseline") -> dict:
    return {ROBOT: {name: text}}


def test_what_is_refused_is_told_and_tried_again_ever_later() -> None:
    seen = replace(scene(), failures=refusing())
    plan = look(replace(seen, failures={}))
    now = 100.0
    pauses = []
    assert kinds(plan) == [CreateProxy]
    for _ in range(8):
        seen = written(seen, look(seen, plan.state, now))
        plan = look(seen, plan.state, now)
        assert done(plan) == []
        assert "kubectl label namespace ros" in told(plan, "ProxyNotAdmitted")[0]
        assert plan.next_look_in is not None
        pauses.append(plan.next_look_in)
        now += plan.next_look_in
        plan = look(seen, plan.state, now)
        assert kinds(plan) == [CreateProxy]
    assert pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]


def test_a_refusal_stays_told_until_the_object_is_there() -> None:
    seen = scene()
    memory = look(seen).state
    memory = look(replace(seen, failures=refusing()), memory, 100.5).state
    plan = look(seen, memory, 101.0)
    assert told(plan, "ProxyNotAdmitted")
    assert not told(look(complete(), plan.state, 102.0), "ProxyNotAdmitted")


def test_what_was_created_and_is_not_listed_yet_is_not_created_again_at_once() -> None:
    seen = observed(rosproxy(), pod())
    first = look(seen, now=100.0)
    second = look(seen, first.state, 101.0)
    assert (done(second), second.next_look_in) == ([], 2.0)
    third = look(seen, second.state, 103.0)
    assert kinds(third) == [CreateService, CreateProxy]


def test_what_was_deleted_and_is_still_listed_is_not_deleted_again_at_once() -> None:
    changed = complete(rosproxies=(rosproxy(ports=5),))
    first = look(changed)
    assert done(first)
    assert done(look(changed, first.state, 101.0)) == []


def test_a_proxy_that_ends_is_made_anew_and_not_in_a_tight_loop() -> None:
    without = scene()
    evicted = scene(proxy(phase="Failed"))
    memory = ClusterState()
    now = 100.0
    created = 0
    for _ in range(100):
        plan = look(without, memory, now)
        if any(isinstance(action, CreateProxy) for action in done(plan)):
            created += 1
            plan = look(evicted, plan.state, now)
        memory = plan.state
        now = now + 1.0
    assert 5 <= created <= 12


def test_a_delayed_creation_is_due_without_an_event() -> None:
    """The operator then had no reason to look again until the next resync."""
    memory = ClusterState()
    now = 100.0
    pauses = []
    for _ in range(10):
        plan = look(scene(), memory, now)
        if not done(plan):
            idle = look(written(scene(), plan), plan.state, now)
            assert idle.next_look_in is not None
            pauses.append(idle.next_look_in)
            now += idle.next_look_in
            plan = look(scene(), idle.state, now)
        assert kinds(plan) == [CreateProxy]
        failed = scene(proxy(phase="Failed"))
        plan = look(failed, plan.state, now)
        memory = look(written(failed, plan), plan.state, now).state
    assert pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0]


def test_a_delayed_eviction_is_due_without_an_event() -> None:
    retries = Retries({EVICTION: RetryRecord(5, 100.0, effect=True)}, {}, 101.0)
    retries.note_effect(EVICTION)
    assert list(retries.pauses()) == []
    assert not retries.is_due(EVICTION)
    assert list(retries.pauses()) == [3.0]


def test_a_proxy_that_was_well_is_made_anew_at_once_when_it_is_gone() -> None:
    without = scene()
    memory = ClusterState()
    for now in range(100, 200, 10):
        plan = look(without, memory, now)
        assert kinds(plan) == [CreateProxy]
        memory = look(complete(), plan.state, now + 1).state


def test_a_status_is_not_written_over_and_over_again_if_that_does_not_help() -> None:
    first = look(complete())
    second = look(complete(), first.state, 101.0)
    assert not [action for action in second.actions if isinstance(action, PatchStatus)]
    third = look(complete(), second.state, 104.0)
    assert [type(action) for action in third.actions] == [PatchStatus]


def test_another_status_is_written_at_once() -> None:
    first = look(complete())
    second = look(complete(nodes={"one": node(ready=False)}), first.state, 100.1)
    assert [action for action in second.actions if isinstance(action, PatchStatus)]
