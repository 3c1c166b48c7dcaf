"""Random events on a host, and an operator that is killed anywhere, end in the wanted state.

After each event the test checks the invariants (`Hosts.check`). In pauses without events the
operator must come to rest, with everything as wished.
"""

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from rosproxy_operator.docker.planner.model import Container
from tests.unit.operator.docker.builders import container, planned
from tests.unit.operator.docker.hosts import Hosts
from tests.unit.operator.docker.invariants import SETTINGS

CONTAINERS = (
    Hosts.run, Hosts.change, Hosts.remove, Hosts.attach, Hosts.detach, Hosts.rename, Hosts.stranger,
    Hosts.forge, Hosts.share, Hosts.fail_redirects, Hosts.run_zenoh,
)  # fmt: skip
SURROUNDINGS = (
    Hosts.make_network, Hosts.remove_network, Hosts.take_port, Hosts.take_own_port,
    Hosts.let_ports_go, Hosts.change_image, Hosts.wait,
)  # fmt: skip
PROXIES = (
    Hosts.meddle, Hosts.break_one, Hosts.start_by_hand, Hosts.engine_restarts, Hosts.remove_own,
    Hosts.rename_own, Hosts.detach_own,
)  # fmt: skip
CONTROLLER = (Hosts.look, Hosts.look_and_be_killed, Hosts.look_and_stall, Hosts.come_to_rest)
EVENTS = st.tuples(
    st.one_of(*map(st.sampled_from, (CONTAINERS, SURROUNDINGS, PROXIES, CONTROLLER))),
    st.integers(0, 59),
    st.integers(0, 59),
)


@given(st.integers(1, 3), st.lists(EVENTS, min_size=10, max_size=30))
def test_everything_comes_to_rest_as_wished(containers: int, events: list) -> None:
    host = Hosts()
    for number in range(containers):
        host.run(number, number)
    host.come_to_rest()
    for happen, n, m in events:
        happen(host, n, m)
        host.check()
    host.come_to_rest()


BAD = st.sampled_from(
    [
        container("bad", {"rosproxy.enable": "true"}),
        container("bad", {"rosproxy.enable": "maybe", "rosproxy.ports": "5"}),
        container("bad", {"rosproxy.enable": "true", "rosproxy.prots": "5"}, env="robot"),
        container("bad", networks=("bridge",)),
        container("bad", networks=("gone",)),
        container("bad", networks=(), mode="container:gone"),
        container("bad", {"io.rosproxy.managed": "true", "io.rosproxy.role": "ports"}),
        container("bad", state="no such state"),
    ]
)


@given(st.integers(1, 3), st.lists(EVENTS, max_size=20), BAD, st.text())
def test_a_bad_object_does_not_change_what_is_done_for_others(
    containers: int, events: list, bad: Container, more: str
) -> None:
    host = Hosts()
    for number in range(containers):
        host.run(number, number)
    for happen, n, m in events:
        happen(host, n, m)
    seen = host.engine.observe()
    memory = host.controller.memory
    now = host.controller.now
    bad = replace(bad, labels={**bad.labels, "rosproxy.advertise-host": more + " "})
    with_bad = replace(seen, containers=(bad, *seen.containers))
    alone = planned(seen, SETTINGS, memory, now)
    plan = planned(with_bad, SETTINGS, memory, now)
    assert plan.groups == alone.groups
    # The name of the bad container is remembered as any name of a container is.
    memory = replace(plan.memory, names=alone.memory.names)
    assert (memory, plan.again_in) == (alone.memory, alone.again_in)
    assert set(alone.problems) <= set(plan.problems)
