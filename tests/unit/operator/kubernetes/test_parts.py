"""Planning a cluster part by part gives the same actions as planning all at once."""

import copy
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rosproxy_operator.kubernetes.planner.actions import Action
from rosproxy_operator.kubernetes.planner.partition import (
    Partition,
    merge_state,
    partition_of,
    partition_snapshot,
    partition_state,
    partitions,
)
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan, plan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from tests.unit.operator.kubernetes.clusters import Clusters
from tests.unit.operator.kubernetes.simulation import SETTINGS, STAMP
from tests.unit.operator.kubernetes.test_plan_convergence import MEDDLING, NODES, PODS, ROSPROXIES

ALIKE = {"one": "192.0.2.1", "two": "192.0.2.2", "three": "192.0.2.3"}
APART = {"four": "192.0.2.4", "five": "192.0.2.5", "six": "192.0.2.6"}


HAPPENINGS = (PODS, PODS, NODES, ROSPROXIES, MEDDLING, (Clusters.step, Clusters.step, Clusters.lag))
EVENTS = st.tuples(
    st.booleans(),
    st.one_of(*map(st.sampled_from, HAPPENINGS)),
    st.integers(0, 59),
    st.integers(0, 59),
)


class Together:
    """Two clusters as one, in separate namespaces, on the same nodes or on different nodes."""

    def __init__(self, shared: bool) -> None:
        nodes = ALIKE if shared else APART
        self.worlds = Clusters("ros", ALIKE), Clusters("arms", nodes)
        self.state = ClusterState()
        self.now = 1000.0

    def observe(self) -> ClusterSnapshot:
        first, second = (world.observe() for world in self.worlds)
        return replace(
            first,
            rosproxies=first.rosproxies + second.rosproxies,
            nodes={**second.nodes, **first.nodes},
            pods=first.pods + second.pods,
            misspelt_pods=first.misspelt_pods + second.misspelt_pods,
            proxies=first.proxies + second.proxies,
            lan_relays=first.lan_relays + second.lan_relays,
            services={**first.services, **second.services},
            masters={**second.masters, **first.masters},
            selected=first.selected | second.selected,
            policies={**first.policies, **second.policies},
            reports={**first.reports, **second.reports},
            failures={**first.failures, **second.failures},
        )

    def carry_out(self, whole: ClusterPlan) -> None:
        for world in self.worlds:
            mine = [action for action in whole.actions if action.of.namespace == world.namespace]
            world.controller.carry_out(replace(whole, actions=tuple(mine)))
            for uid, briefing in whole.briefings.items():
                if uid in world.cluster.ros:
                    world.cluster.ros[uid] -= set(briefing.gone)


def by_rosproxy(actions: tuple[Action, ...]) -> dict[Any, list[Action]]:
    """The actions of each RosProxy, in order."""
    grouped: dict[Any, list[Action]] = {}
    for action in actions:
        grouped.setdefault(action.of, []).append(action)
    return grouped


def all_of(observed: ClusterSnapshot) -> Partition:
    """All parts as one. The next look at all parts forgets the memory of everything else."""
    all_partitions = [*partitions(observed)]
    return Partition(
        frozenset(namespace for partition in all_partitions for namespace in partition.namespaces),
        frozenset(node for partition in all_partitions for node in partition.nodes),
    )


def check(
    whole: ClusterPlan,
    pieces: list[tuple[Partition, ClusterPlan]],
    state: ClusterState,
    union: Partition,
) -> None:
    merged: dict[Any, list[Action]] = {}
    for _, part_plan in pieces:
        for of, actions in by_rosproxy(part_plan.actions).items():
            assert of not in merged, "two parts have the same RosProxy"
            merged[of] = actions
    assert merged == by_rosproxy(whole.actions)
    both = {uid: told for _, part_plan in pieces for uid, told in part_plan.briefings.items()}
    assert both == whole.briefings
    assert {problem for _, part_plan in pieces for problem in part_plan.problems} == {
        *whole.problems
    }
    waits = [
        part_plan.next_look_in for _, part_plan in pieces if part_plan.next_look_in is not None
    ]
    assert min(waits, default=None) == whole.next_look_in
    remembered = partition_state(whole.state, union)
    for name in state.__struct_fields__:
        assert getattr(state, name) == getattr(remembered, name), name


@given(st.booleans(), st.lists(EVENTS, min_size=5, max_size=25))
def test_planning_by_parts_is_planning_it_all(shared: bool, events: list) -> None:
    both = Together(shared)
    for which, happen, n, m in events:
        happen(both.worlds[which], n, m)
        if m % 2:
            continue  # several things happen between two looks
        observed = both.observe()
        union = all_of(observed)
        both.state = partition_state(both.state, union)
        whole = plan(observed, SETTINGS, both.state, both.now, STAMP)
        pieces = []
        state = ClusterState(begun=both.state.begun)
        for partition in partitions(observed):
            before = partition_state(both.state, partition)
            part_plan = plan(
                partition_snapshot(observed, partition), SETTINGS, before, both.now, STAMP
            )
            state = merge_state(state, partition, part_plan.state)
            pieces.append((partition, part_plan))
        check(whole, pieces, replace(state, begun=True), union)
        both.state = whole.state
        both.carry_out(whole)
        both.now += 1.0 + n % 7


@given(st.booleans(), st.lists(EVENTS, min_size=5, max_size=25))
def test_what_is_not_touched_stays_as_it_is(shared: bool, events: list) -> None:
    """Planning a part again after a whole plan keeps the memory of the other parts."""
    both = Together(shared)
    for which, happen, n, m in events:
        happen(both.worlds[which], n, m)
    observed = both.observe()
    whole = plan(observed, SETTINGS, both.state, both.now, STAMP)
    for partition in partitions(observed):
        before = copy.copy(whole.state)
        part_plan = plan(
            partition_snapshot(observed, partition),
            SETTINGS,
            partition_state(before, partition),
            both.now,
            STAMP,
        )
        after = merge_state(before, partition, part_plan.state)
        other_partitions = [
            other_partition
            for other_partition in partitions(observed)
            if other_partition != partition
        ]
        for other_partition in other_partitions:
            assert partition_state(after, other_partition) == partition_state(
                whole.state, other_partition
            )


def test_who_shares_a_node_is_one_part() -> None:
    both = Together(shared=True)
    for world in both.worlds:
        world.run(0, 0)
    observed = both.observe()
    (partition,) = [p for p in partitions(observed) if p.nodes]
    assert partition.namespaces == {"ros", "arms"}
    assert partition_of(observed, ["arms"]) == partition
    assert partition_of(observed, [], partition.nodes) == partition


def test_who_shares_no_node_is_apart() -> None:
    both = Together(shared=False)
    for world in both.worlds:
        world.run(0, 0)
    observed = both.observe()
    assert [partition.namespaces for partition in partitions(observed)] == [{"arms"}, {"ros"}]
    assert partition_of(observed, ["ros"]).namespaces == {"ros"}
    assert partition_of(observed, [], ["nowhere"]) == Partition()
