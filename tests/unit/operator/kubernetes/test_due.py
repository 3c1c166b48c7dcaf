"""The parts that are planned: changed parts, due parts, and now and then all."""

from rosproxy_operator.kubernetes.plan_schedule import PlanSchedule
from rosproxy_operator.kubernetes.planner.partition import Partition
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from tests.unit.operator.kubernetes.builders_api import pod, rosproxy

APART = ClusterSnapshot(
    rosproxies=(rosproxy("arm"), rosproxy("leg", namespace="legs")),
    pods=(
        pod("one", node="node1", namespace="robots"),
        pod("two", node="node2", namespace="legs"),
    ),
    selected=frozenset({"uid-one", "uid-two"}),
)
ROBOTS = Partition(frozenset({"robots"}), frozenset({"node1"}))
LEGS = Partition(frozenset({"legs"}), frozenset({"node2"}))


def begun(now: float = 100.0, again_in: float | None = None) -> PlanSchedule:
    """After a first look at all."""
    due = PlanSchedule()
    assert due.is_all_due(now, 30.0)
    assert due.due_partition(APART, (), (), now) is None
    due.note_plan(None, APART, again_in, now)
    return due


def test_what_has_changed_is_planned() -> None:
    due = begun()
    assert due.due_partition(APART, ["robots"], (), 101.0) == ROBOTS
    assert due.due_partition(APART, (), ["node2"], 101.0) == LEGS
    assert due.due_partition(APART, (), ["nobody's"], 101.0) == Partition()


def test_all_is_planned_now_and_then_and_when_asked_for() -> None:
    due = begun()
    assert not due.is_all_due(129.0, 30.0)
    assert due.is_all_due(130.0, 30.0)
    due = begun()
    due.mark_all_due()
    assert due.is_all_due(100.0, 30.0)


def test_what_wants_to_be_planned_again_is_then() -> None:
    due = begun(again_in=5.0)
    assert due.again_in(101.0, None) == 4.0
    assert due.due_partition(APART, (), (), 104.0) == Partition()
    assert due.due_partition(APART, (), (), 105.0) == Partition(
        ROBOTS.namespaces | LEGS.namespaces, ROBOTS.nodes | LEGS.nodes
    )
    due.note_plan(ROBOTS, APART, None, 105.0)
    assert due.due_partition(APART, (), (), 105.0) == LEGS
    due.note_plan(LEGS, APART, None, 105.0)
    assert due.again_in(105.0, None) is None
    assert due.again_in(105.0, 3.0) == 3.0


def test_the_earlier_of_two_times_counts() -> None:
    due = begun()
    due.mark_due_at(["robots"], 110.0)
    due.mark_due_at(["robots"], 105.0)
    due.mark_due_at(["robots"], 120.0)
    assert due.again_in(100.0, 30.0) == 5.0
    due.mark_due_now(["robots"])
    assert due.again_in(100.0, None) == 0.0
