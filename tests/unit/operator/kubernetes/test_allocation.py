"""Which ports a proxy gets on its node, and when it leaves them."""

from dataclasses import replace
from typing import Any

import pytest

from rosproxy.leases.ports import PortRange
from rosproxy_operator.kubernetes.planner.actions import CreateProxy, DeleteProxy
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.model import (
    ClusterSnapshot,
    MasterSpec,
    Name,
    ProxyPlace,
    Stuck,
)
from tests.unit.operator.kubernetes.objects import (
    RANGE,
    ROBOT,
    SETTINGS,
    done,
    look,
    node,
    observed,
    pod,
    ports_of,
    proxy,
    rosproxy,
    service,
    status,
    told,
)

HERE = ProxyPlace(ROBOT, "one")
NEXT = PortRange(11404, 11407)
ARM = {names.INJECT: "arm"}
OURS = {names.INJECT: "robot"}


def scene(*more: Any, of: Any = None) -> ClusterSnapshot:
    """A pod that wants a proxy, and other things."""
    of = of or rosproxy()
    return observed(of, service(of), pod(), *more)


def created(found: ClusterPlan) -> str:
    (action,) = done(found)
    assert isinstance(action, CreateProxy), action
    return ports_of(action)


def publishing(port: int) -> Any:
    return rosproxy(master=MasterSpec("http://robot:11311", publish=port))


def host_ports(found: ClusterPlan) -> list[int]:
    (action,) = done(found)
    assert isinstance(action, CreateProxy)
    return [one["hostPort"] for one in action.body["spec"]["containers"][0]["ports"]]


# a new range


def test_the_first_ports_of_the_window_that_no_pod_on_the_node_holds() -> None:
    others = [pod("web", ports=[11401]), pod("ending", ports=[11403], deleting=True)]
    assert created(look(scene(*others))) == "11404-11407"


@pytest.mark.parametrize(
    "other",
    [
        pod("ended", ports=[11401], phase="Succeeded"),
        pod("elsewhere", "two", ports=[11401]),
        pod("unbound", "", ports=[11401]),
    ],
    ids=lambda one: one.id.name,
)
def test_ports_that_nobody_holds_on_this_node_are_free(other: Any) -> None:
    assert created(look(scene(other))) == "11400-11403"


def test_never_the_proxys_own_ports() -> None:
    of = rosproxy(window=PortRange(11309, 11330))
    assert created(look(scene(of=of))) == "11313-11316"


def test_never_ports_of_the_api_server_or_of_the_kernel() -> None:
    of = rosproxy(window=PortRange(29998, 40000))
    settings = replace(
        SETTINGS, node_ports=PortRange(30000, 31000), ephemeral=PortRange(31003, 39000)
    )
    assert created(look(scene(of=of), settings=settings)) == "39001-39004"


def test_what_the_status_names_is_given_again() -> None:
    of = rosproxy(former={"one": PortRange(11450, 11453)})
    assert created(look(scene(of=of))) == "11450-11453"


def test_what_the_status_names_is_not_given_if_somebody_holds_it() -> None:
    of = rosproxy(former={"one": PortRange(11450, 11453)})
    assert created(look(scene(pod("web", ports=[11451]), of=of))) == "11400-11403"


def test_two_rosproxies_get_different_ports_on_a_node_and_the_same_on_two() -> None:
    arm, robot = rosproxy("arm"), rosproxy()
    pods = [pod("a", labels=ARM), pod("b", labels=OURS), pod("c", "two", labels=OURS)]
    found = look(
        observed(arm, robot, service(arm), service(robot), node("one"), node("two"), *pods)
    )
    given = {(one.of.name, one.node): ports_of(one) for one in done(found)}  # type: ignore[union-attr]
    assert given == {
        ("arm", "one"): "11400-11403",
        ("robot", "one"): "11404-11407",
        ("robot", "two"): "11400-11403",
    }


def test_former_ports_of_another_rosproxy_are_left_alone_if_there_are_others() -> None:
    arm, robot = rosproxy("arm", former={"one": RANGE}), rosproxy()
    found = look(observed(arm, robot, service(arm), service(robot), pod("b", labels=OURS)))
    assert created(found) == "11404-11407"


def test_former_ports_of_another_rosproxy_are_taken_if_there_are_no_others() -> None:
    arm, robot = rosproxy("arm", former={"one": RANGE}), rosproxy(window=RANGE)
    found = look(observed(arm, robot, service(arm), service(robot), pod("b", labels=OURS)))
    assert created(found) == "11400-11403"


def test_when_there_are_none_it_is_told_who_holds_them_and_what_to_do() -> None:
    of = rosproxy(window=PortRange(11400, 11406))
    found = look(scene(pod("web", ports=[11403]), of=of))
    assert done(found) == []
    (text,) = told(found, "PortsExhausted")
    assert text == (
        "node one: no 4 free ports in a row between 11400 and 11406: 6 of 7 are free, "
        "3 at most in a row; others are held by ros/web: enlarge spec.portWindow (11400-11406), "
        "lower spec.ports (4), or let one of those pods go"
    )
    assert "ports" not in status(found)["perNode"][0]


def test_ports_that_no_pod_may_have_are_named() -> None:
    found = look(scene(of=rosproxy(window=PortRange(30000, 40000))))
    (text,) = told(found, "PortsExhausted")
    assert "NodePorts are 30000-32767, the nodes' ephemeral ports are 32768-60999" in text


# changes of what is asked for


def changed(**changes: Any) -> tuple[str, ClusterPlan]:
    """The range that a running proxy gets when its RosProxy changes."""
    of = rosproxy(**changes)
    found = look(observed(of, service(of), pod(), proxy()))
    assert found.state.given[HERE] == found.state.given[HERE]
    return str(found.state.given[HERE]), found


@pytest.mark.parametrize(
    ("changes", "ports"),
    [
        ({"ports": 2}, "11400-11401"),
        ({"ports": 6}, "11400-11405"),
        ({"window": PortRange(11402, 11499)}, "11402-11405"),
        ({"window": PortRange(11400, 11403)}, "11400-11403"),
        ({"master": MasterSpec("http://robot:11311", publish=11402)}, "11403-11406"),
    ],
)
def test_a_change_moves_no_more_than_need_be(changes: dict, ports: str) -> None:
    given, found = changed(**changes)
    assert given == ports
    assert [type(one) for one in done(found)] == [DeleteProxy] * (ports != str(RANGE))


def test_ports_are_not_left_because_there_could_be_more_elsewhere() -> None:
    of = rosproxy(ports=8)
    found = look(observed(of, service(of), pod(), proxy(), pod("web", ports=[11405])))
    assert found.state.given[HERE] == RANGE
    (text,) = told(found, "PortsExhausted")
    assert "spec.ports is 8, but the proxy on node one keeps its 4 at 11400-11403" in text
    assert "11404-11407 are not free" in text


def test_who_has_left_his_ports_is_told() -> None:
    _, found = changed(window=PortRange(11410, 11420))
    (text,) = told(found, "PortConflict")
    assert "has left ports 11400-11403 for 11410-11413" in text
    assert "restart their pods" in text


# conflicts


def served(**more: Any) -> ClusterState:
    """The memory of an operator that has seen the proxy serve."""
    return look(scene(proxy()), **more).state


def test_ports_that_never_served_are_left_at_once_if_they_can_not_be_had() -> None:
    first = look(scene())
    stuck = scene(proxy(stuck=Stuck.PORTS))
    second = look(stuck, first.state, 101.0)
    (deleted,) = done(second)
    assert isinstance(deleted, DeleteProxy)
    assert deleted.why == "made anew: its ports are to be 11404-11407 instead of 11400-11403"
    third = look(scene(), second.state, 102.0)
    assert created(third) == "11404-11407"
    assert "nothing needs to be done" in told(third, "PortConflict")[0]
    assert not told(look(scene(proxy(ports=NEXT)), third.state, 170.0), "PortConflict")


def test_the_next_range_begins_after_the_port_that_a_pod_is_seen_to_hold() -> None:
    first = look(scene())
    stuck = scene(proxy(stuck=Stuck.PORTS), pod("web", ports=[11400]))
    assert str(look(stuck, first.state, 101.0).state.given[HERE]) == "11401-11404"


def test_ports_that_have_served_are_tried_for_a_while() -> None:
    stuck = scene(proxy(stuck=Stuck.PORTS))
    first = look(stuck, served(), 101.0)
    assert done(first) == []
    assert told(first, "PortConflict")
    second = look(stuck, first.state, 120.9)
    assert done(second) == []
    third = look(stuck, second.state, 121.0)
    assert [type(one) for one in done(third)] == [DeleteProxy]
    assert third.state.given[HERE] == NEXT
    assert any("restart their pods" in text for text in told(third, "PortConflict"))


def test_the_controller_looks_again_when_that_while_is_over() -> None:
    stuck = scene(proxy(stuck=Stuck.PORTS))
    first = look(stuck, served(), 101.0)
    second = look(stuck, first.state, 119.0)
    assert second.again_in == 2.0


def test_a_rejected_pod_is_made_anew_on_the_same_ports_for_a_while() -> None:
    failed = scene(replace(proxy(phase="Failed"), stuck=Stuck.PORTS))
    first = look(failed, served(), 101.0)
    assert [type(one) for one in done(first)] == [DeleteProxy]
    second = look(scene(), first.state, 102.0)
    assert created(second) == "11400-11403"
    third = look(failed, second.state, 122.0)
    assert third.state.given[HERE] == NEXT


def test_who_gets_his_ports_back_in_time_stays() -> None:
    first = look(scene(proxy(stuck=Stuck.PORTS)), served(), 101.0)
    second = look(scene(proxy()), first.state, 110.0)
    third = look(scene(proxy(stuck=Stuck.PORTS)), second.state, 125.0)
    assert done(third) == []


def test_another_proxy_that_is_about_to_end_is_waited_for() -> None:
    other = rosproxy("arm")
    ending = proxy(other, deleting=True)
    found = look(scene(proxy(stuck=Stuck.PORTS), ending))
    for now in (200.0, 300.0):
        assert not [one for one in done(found) if getattr(one, "of", None) == ROBOT]
        found = look(scene(proxy(stuck=Stuck.PORTS), ending), found.state, now)


def test_what_the_status_names_counts_as_served_after_a_restart_of_the_controller() -> None:
    of = rosproxy(former={"one": RANGE})
    assert done(look(scene(proxy(stuck=Stuck.PORTS), of=of))) == []


def test_refused_ports_are_avoided_for_five_minutes() -> None:
    memory = look(scene(proxy(stuck=Stuck.PORTS)), look(scene()).state, 101.0).state
    arm = rosproxy("arm")
    wants = observed(arm, service(arm), pod("a", labels=ARM))
    assert created(look(wants, memory, 400.0)) == "11404-11407"
    assert created(look(wants, memory, 401.0)) == "11400-11403"


def test_ports_of_a_pod_that_is_about_to_end_are_waited_for_by_who_has_served_there() -> None:
    ending = pod("web", ports=[11401], deleting=True)
    assert created(look(scene(ending), served(), 101.0)) == "11400-11403"


def test_ports_that_another_pod_has_taken_are_left_at_once() -> None:
    found = look(scene(pod("web", ports=[11401])), served(), 101.0)
    assert created(found) == "11402-11405"
    assert told(found, "PortConflict")


def test_a_proxy_that_has_its_ports_stays_whatever_else_is_seen() -> None:
    """It can only be a list of former times: the kubelet sees to it that there are not two."""
    assert done(look(scene(proxy(), pod("web", ports=[11401])))) == []


def test_of_two_that_wait_with_the_same_ports_one_stays() -> None:
    arm, robot = rosproxy("arm"), rosproxy()
    pods = [pod("a", labels=ARM), pod("b", labels=OURS)]
    both = [proxy(arm, phase="Pending", node=""), proxy(robot, phase="Pending", node="")]
    found = look(observed(arm, robot, service(arm), service(robot), *pods, *both))
    (deleted,) = done(found)
    assert isinstance(deleted, DeleteProxy)
    assert deleted.of.name == "robot"
    assert found.state.given[HERE] == PortRange(11404, 11407)


def test_who_serves_comes_before_who_waits() -> None:
    arm, robot = rosproxy("arm"), rosproxy()
    pods = [pod("a", labels=ARM), pod("b", labels=OURS)]
    both = [proxy(arm, phase="Pending", node=""), proxy(robot)]
    found = look(observed(arm, robot, service(arm), service(robot), *pods, *both))
    assert [one.of.name for one in done(found)] == ["arm"]


# the port of a master in the cluster


def test_the_masters_port_is_published_besides_the_range() -> None:
    assert host_ports(look(scene(of=publishing(11500)))) == [11400, 11401, 11402, 11403, 11500]


def test_the_range_avoids_the_masters_port() -> None:
    ports = host_ports(look(scene(of=publishing(11402))))
    assert ports == [11403, 11404, 11405, 11406, 11402]


def test_a_masters_port_that_is_taken_is_told_and_the_rest_works() -> None:
    of = publishing(11500)
    found = look(scene(pod("web", ports=[11500]), of=of))
    assert host_ports(found) == list(RANGE.ports())
    (text,) = told(found, "PortConflict")
    assert "not published on port 11500 of node one, which is held by ros/web" in text
    assert "spec.master.publish" in text


def test_only_one_of_two_gets_the_masters_port() -> None:
    arm, robot = replace(publishing(11500), id=Name("ros", "arm"), uid="uid-arm"), publishing(11500)
    pods = [pod("a", labels=ARM), pod("b", labels=OURS)]
    found = look(observed(arm, robot, service(arm), service(robot), *pods))
    published = [
        11500 in [one["hostPort"] for one in action.body["spec"]["containers"][0]["ports"]]
        for action in done(found)
        if isinstance(action, CreateProxy)
    ]
    assert published == [True, False]


def test_who_has_the_masters_port_keeps_it() -> None:
    arm = replace(publishing(11500), id=Name("ros", "arm"), uid="uid-arm")
    robot = publishing(11500)
    pods = [pod("a", labels=ARM), pod("b", labels=OURS)]
    has = proxy(robot, publish=11500)
    found = look(observed(arm, robot, service(arm), service(robot), *pods, has))
    (action,) = done(found)
    assert isinstance(action, CreateProxy)
    assert action.of.name == "arm"
    assert host_ports(found) == [11404, 11405, 11406, 11407]


def test_a_masters_port_that_is_in_the_way_does_not_move_the_range() -> None:
    of = publishing(11500)
    stuck = proxy(of, stuck=Stuck.PORTS, publish=11500)
    found = look(scene(stuck, pod("web", ports=[11500]), of=of), look(scene(of=of)).state, 101.0)
    assert [type(one) for one in done(found)] == [DeleteProxy]
    assert found.state.given[HERE] == RANGE
