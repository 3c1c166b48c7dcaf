"""Uninstall removes everything of the operator, and nothing else."""

from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosproxy_operator.docker.engine_json import read_network
from rosproxy_operator.docker.planner.actions import RemoveNetwork
from rosproxy_operator.docker.planner.labels.members import LabelReading
from rosproxy_operator.docker.planner.model import STARTED, HostState
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import ROLE_REDIRECT, proxy_name, sandbox_name
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.planner.uninstall import Uninstall
from tests.unit.operator.docker.builders import (
    APP,
    PLACE,
    SETTINGS,
    UPLINK,
    both,
    container,
    observed,
)
from tests.unit.operator.docker.hosts import Hosts
from tests.unit.operator.docker.test_plan_convergence import EVENTS

OURS = replace(UPLINK, made_by_operator=True)


def look(uninstall: Uninstall, state: HostState) -> DockerPlan:
    return uninstall(state, LabelReading(), SETTINGS, DockerMemory(), 0.0)


@given(st.integers(1, 3), st.lists(EVENTS, max_size=30))
@example(1, [(Hosts.share, 0, 0), (Hosts.come_to_rest, 0, 0), (Hosts.change, 0, 1)])
def test_after_whatever_happened_nothing_is_left(containers: int, events: list) -> None:
    host = Hosts()
    for number in range(containers):
        host.run(number, number)
    for happen, n, m in events:
        happen(host, n, m)
        host.check()  # check also notes the ports of each place
    host.engine.redirects_fail = False
    host.engine.uninstalls = True
    before = [(box.id, box.name, box.state, dict(box.networks)) for box in host.strangers()]
    networks = {n.id for n in host.engine.networks.values() if not n.made_by_operator}

    problems = run(host)

    assert before == [(b.id, b.name, b.state, dict(b.networks)) for b in host.strangers()]
    assert networks <= {network.id for network in host.engine.networks.values()}
    stays = host.boxes(role=ROLE_REDIRECT)
    assert host.boxes() == stays
    assert not stays or (not host.engine.image and any("proxy image" in p for p in problems))
    for network in host.engine.networks.values():
        assert not network.made_by_operator or f"network {network.name}" in problems
    # Of a container that has ended the rules have gone with the namespace.
    namespaces = {box.namespace for box in host.strangers() if box.state in STARTED}
    for site in host.engine.rules:
        assert not host.engine.image or site in host.forgotten or site[0] not in namespaces


def run(host: Hosts) -> set[str]:
    """Uninstall to the end. Return the subjects of the remaining problems."""
    uninstall = Uninstall()
    for _ in range(20):
        planned = look(uninstall, host.engine.observe())
        host.controller.carry_out(planned)
        for box in host.boxes("removing"):
            host.engine.boxes.remove(box)
        if not planned.actions:
            return {problem.subject for problem in planned.problems}
    raise AssertionError(f"never comes to rest: {planned.actions}")


def test_containers_go_before_their_network() -> None:
    uninstall = Uninstall()
    first = look(uninstall, observed(container(), networks=(OURS, APP), **both()))
    assert {action.name for action in first.actions} == {proxy_name(PLACE), sandbox_name(PLACE)}
    assert all("rosproxy is uninstalled" in str(action) for action in first.actions)
    second = look(uninstall, observed(container(), networks=(OURS, APP)))
    assert second.actions == (RemoveNetwork(UPLINK.name),)
    third = look(uninstall, observed(container(), networks=(APP,)))
    assert (third.actions, third.problems) == ((), ())


def test_a_network_that_somebody_else_made_stays() -> None:
    planned = look(Uninstall(), observed(networks=(UPLINK, APP)))
    assert (planned.actions, planned.problems) == ((), ())


@pytest.mark.parametrize("state", ["running", "paused", "restarting"])
def test_who_is_still_on_the_uplink_is_named(state: str) -> None:
    guest = container("prometheus", {}, networks=(UPLINK.name,), state=state)
    planned = look(Uninstall(), observed(guest, networks=(OURS, APP)))
    assert planned.actions == ()
    (problem,) = planned.problems
    assert str(problem.subject) == "network 0-rosproxy"
    assert "docker network disconnect 0-rosproxy prometheus" in problem.message


def test_where_another_operator_makes_all_anew_it_stops() -> None:
    uninstall = Uninstall()
    look(uninstall, observed(container(), networks=(OURS, APP)))
    planned = look(uninstall, observed(container(), networks=(OURS, APP), **both()))
    assert planned.actions == ()
    (problem,) = planned.problems
    assert problem.fatal
    assert "another operator is running" in problem.message
    assert sandbox_name(PLACE) in problem.message


def test_the_label_says_which_networks_are_the_operators() -> None:
    row = {"Id": "n", "Name": "any", "Driver": "bridge"}
    assert not read_network(row).made_by_operator
    assert read_network({**row, "Labels": {"io.rosproxy.managed": "true"}}).made_by_operator
