"""Random events in a cluster, and an operator that is killed anywhere, end in the wanted state.

After each event the test checks the invariants (`Clusters.check`). In pauses without events the
operator must come to rest, with everything as wished.
"""

from hypothesis import example, given
from hypothesis import strategies as st

from tests.unit.operator.kubernetes.clusters import Clusters

PODS = (
    Clusters.run, Clusters.remove, Clusters.end, Clusters.stranger, Clusters.namesake,
    Clusters.register,
)  # fmt: skip
NODES = (
    Clusters.toggle_ready, Clusters.cordon, Clusters.lose_node, Clusters.join_node,
    Clusters.annotate,
)  # fmt: skip
ROSPROXIES = (Clusters.change, Clusters.create, Clusters.delete, Clusters.replace)
MEDDLING = (
    Clusters.delete_proxy, Clusters.reject, Clusters.delete_service, Clusters.forbid,
    Clusters.toggle_master, Clusters.meddle_with_policy, Clusters.change_key,
)  # fmt: skip
CONTROLLER = (
    Clusters.look, Clusters.look_and_be_killed, Clusters.look_and_stall, Clusters.step,
    Clusters.wait, Clusters.lag, Clusters.come_to_rest,
)  # fmt: skip
EVENTS = st.tuples(
    st.one_of(*map(st.sampled_from, (PODS, NODES, ROSPROXIES, MEDDLING, CONTROLLER, CONTROLLER))),
    st.integers(0, 59),
    st.integers(0, 59),
)


BAD_IMAGE = (Clusters.change, 0, 9)
OTHER_MASTER = (Clusters.change, 0, 4)


@given(st.integers(1, 3), st.lists(EVENTS, min_size=10, max_size=30))
@example(1, [BAD_IMAGE, OTHER_MASTER])
def test_everything_comes_to_rest_as_wished(pods: int, events: list) -> None:
    world = Clusters()
    for number in range(pods):
        world.run(number, number)
    world.come_to_rest()
    for happen, n, m in events:
        happen(world, n, m)
        world.check()
    world.come_to_rest()
