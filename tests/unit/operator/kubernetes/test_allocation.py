"""The ports of a proxy on a node, and changes of ports."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.ports import PortRange
from rosproxy_operator.kubernetes.planner.actions import CreateProxy, DeleteProxy
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.planner.state import ClusterState
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, PodFailure
from rosproxy_operator.kubernetes.resources.model import MasterSpec, ProxyPlace, Ros2Spec
from tests.unit.operator.kubernetes.objects import (
    RANGE,
    ROBOT,
    SETTINGS,
    creation,
    done,
    kinds,
    look,
    node,
    node_of,
    observed,
    pod,
    ports_of,
    proxy,
    rosproxy,
    scene,
    service,
    status,
    told,
)

ROBOT_ON_ONE = ProxyPlace(ROBOT, "one")
NEXT = PortRange(11404, 11407)
FORMER = {"one": PortRange(11450, 11453)}
ARM = {names.INJECT: "arm"}
OURS = {names.INJECT: "robot"}


A = pod("a", labels=ARM)
B = pod("b", labels=OURS)


def two(*more: Any, arm: Any = None, robot: Any = None) -> ClusterSnapshot:
    """Two RosProxies with Services, and more objects."""
    arm = arm or rosproxy("arm")
    robot = robot or rosproxy()
    return observed(arm, robot, service(arm), service(robot), *more)


def created(plan: ClusterPlan) -> str:
    return ports_of(creation(plan))


def publishing(port: int, name: str = "robot") -> Any:
    return rosproxy(name, master=MasterSpec("http://robot:11311", publish=port))


def host_ports(action: CreateProxy) -> list[int]:
    return [port["hostPort"] for port in action.body["spec"]["containers"][0]["ports"]]


# a new range


@pytest.mark.parametrize(
    ("of", "other_pods", "ports"),
    [
        (rosproxy(), [pod("ended", ports=[11401], phase="Succeeded")], "11400-11403"),
        (rosproxy(), [pod("elsewhere", "two", ports=[11401])], "11400-11403"),
        (rosproxy(), [pod("unbound", "", ports=[11401])], "11400-11403"),
        (rosproxy(), [pod("a", ports=[11401]), pod("b", ports=[11403], deleting=True)],
         "11404-11407"),
        # never the proxy's own
        (rosproxy(window=PortRange(11309, 11330)), [], "11313-11316"),
        # the ports in the status, unless another pod holds them
        (rosproxy(former_ranges=FORMER), [], "11450-11453"),
        (rosproxy(former_ranges=FORMER), [pod("web", ports=[11451])], "11400-11403"),
    ],
)  # fmt: skip
def test_a_new_range(of: Any, other_pods: list, ports: str) -> None:
    assert created(look(scene(*other_pods, of=of))) == ports


def test_never_ports_of_the_api_server_or_of_the_kernel() -> None:
    of = rosproxy(window=PortRange(29998, 40000))
    settings = replace(
        SETTINGS, node_ports=PortRange(30000, 31000), ephemeral=PortRange(31003, 39000)
    )
    assert created(look(scene(of=of), settings=settings)) == "39001-39004"


def test_two_rosproxies_get_different_ports_on_a_node_and_the_same_on_two() -> None:
    plan = look(two(node("one"), node("two"), A, B, pod("c", "two", labels=OURS)))
    given = {(action.of.name, node_of(action)): ports_of(action) for action in done(plan)}
    assert given == {
        ("arm", "one"): "11400-11403",
        ("robot", "one"): "11404-11407",
        ("robot", "two"): "11400-11403",
    }


@pytest.mark.parametrize(("changes", "ports"), [({}, NEXT), ({"window": RANGE}, RANGE)])
def test_former_ports_of_another_rosproxy_are_left_alone_if_there_are_others(
    changes: dict, ports: PortRange
) -> None:
    arm = rosproxy("arm", former_ranges={"one": RANGE})
    assert created(look(two(B, arm=arm, robot=rosproxy(**changes)))) == str(ports)


@pytest.mark.parametrize(
    ("changes", "window", "others", "ports"),
    [
        ({}, (20_000, 40_000), [], "20000-20003"),
        ({"direction": "both"}, (19_999, 40_000), [], "32768-32771"),
        ({"ros2": Ros2Spec()}, (19_999, 40_000), [], "32768-32771"),
        # without other free ports
        ({"direction": "both"}, (20_000, 20_019), [], "20000-20003"),
        ({"direction": "both"}, (19_996, 20_019), [pod("web", ports=[19_998])], "19999-20002"),
    ],
)
def test_a_new_range_avoids_ports_of_stand_ins_if_possible(
    changes: dict, window: tuple[int, int], others: list, ports: str
) -> None:
    of = rosproxy(window=PortRange(*window), **changes)
    settings = replace(
        SETTINGS, node_ports=PortRange(50_000, 50_001), ephemeral=PortRange(50_002, 50_003)
    )
    assert created(look(scene(*others, of=of), settings=settings)) == ports


def test_a_running_proxy_keeps_a_range_with_ports_of_stand_ins() -> None:
    of = rosproxy(window=PortRange(11400, 29_999), direction="both")
    ports = PortRange(20_000, 20_003)
    plan = look(scene(proxy(of, ports=ports), of=of))
    assert (done(plan), plan.state.given[ROBOT_ON_ONE]) == ([], ports)


def test_without_free_ports_the_finding_names_the_holders_and_the_fix() -> None:
    of = rosproxy(window=PortRange(11400, 11406))
    plan = look(scene(pod("web", ports=[11403]), of=of))
    assert done(plan) == []
    (text,) = told(plan, "PortsExhausted")
    assert text == (
        "node one: no 4 free ports in a row between 11400 and 11406: 6 of 7 are free, "
        "the longest free stretch has 3. Not available: ports of pods ros/web. Widen "
        "spec.portWindow (11400-11406), or lower spec.ports (4), or delete one of these pods"
    )
    assert "ports" not in status(plan)["perNode"][0]


def test_ports_that_no_pod_may_have_are_named() -> None:
    plan = look(scene(of=rosproxy(window=PortRange(30000, 40000))))
    (text,) = told(plan, "PortsExhausted")
    assert "NodePorts 30000-32767, the nodes' ephemeral ports 32768-60999" in text


# changes of what is asked for


def changed(**changes: Any) -> tuple[str, ClusterPlan]:
    """The range of a running proxy after a change of the RosProxy."""
    of = rosproxy(**changes)
    plan = look(scene(proxy(), of=of))
    return str(plan.state.given[ROBOT_ON_ONE]), plan


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
    given, plan = changed(**changes)
    assert given == ports
    assert kinds(plan) == [DeleteProxy] * (ports != str(RANGE))


def test_ports_are_not_left_because_there_could_be_more_elsewhere() -> None:
    of = rosproxy(ports=8)
    plan = look(scene(proxy(), pod("web", ports=[11405]), of=of))
    assert plan.state.given[ROBOT_ON_ONE] == RANGE
    (text,) = told(plan, "PortsExhausted")
    assert (
        "the proxy on node one has only the 4 ports 11400-11403, although spec.ports is 8" in text
    )
    assert "11404-11407 are not all free" in text


def test_who_has_left_his_ports_is_told() -> None:
    _, plan = changed(window=PortRange(11410, 11420))
    (text,) = told(plan, "PortConflict")
    assert "has left ports 11400-11403 for 11410-11413" in text
    assert "Restart the nodes" in text


# conflicts


STUCK = scene(proxy(stuck=PodFailure.PORTS))


def served(**more: Any) -> ClusterState:
    """The memory of an operator that has seen the proxy serve."""
    return look(scene(proxy()), **more).state


def test_ports_that_never_served_are_left_at_once_if_they_can_not_be_had() -> None:
    first = look(scene())
    second = look(STUCK, first.state, 101.0)
    (deleted,) = done(second)
    assert isinstance(deleted, DeleteProxy)
    assert deleted.why == "replaced, since the ports change from 11400-11403 to 11404-11407"
    third = look(scene(), second.state, 102.0)
    assert created(third) == "11404-11407"
    assert "Nothing needs to be done" in told(third, "PortConflict")[0]
    assert not told(look(scene(proxy(ports=NEXT)), third.state, 170.0), "PortConflict")


def test_the_next_range_begins_after_the_port_that_a_pod_is_seen_to_hold() -> None:
    first = look(scene())
    stuck = scene(proxy(stuck=PodFailure.PORTS), pod("web", ports=[11400]))
    assert str(look(stuck, first.state, 101.0).state.given[ROBOT_ON_ONE]) == "11401-11404"


def test_ports_that_have_served_are_tried_for_a_while() -> None:
    first = look(STUCK, served(), 101.0)
    assert done(first) == []
    assert told(first, "PortConflict")
    assert look(STUCK, first.state, 119.0).next_look_in == 2.0
    second = look(STUCK, first.state, 120.9)
    assert done(second) == []
    third = look(STUCK, second.state, 121.0)
    assert kinds(third) == [DeleteProxy]
    assert third.state.given[ROBOT_ON_ONE] == NEXT
    assert any("Restart the nodes" in text for text in told(third, "PortConflict"))


def test_a_rejected_pod_is_made_anew_on_the_same_ports_for_a_while() -> None:
    failed = scene(replace(proxy(phase="Failed"), stuck=PodFailure.PORTS))
    first = look(failed, served(), 101.0)
    assert kinds(first) == [DeleteProxy]
    second = look(scene(), first.state, 102.0)
    assert created(second) == "11400-11403"
    third = look(failed, second.state, 122.0)
    assert third.state.given[ROBOT_ON_ONE] == NEXT


def test_who_gets_his_ports_back_in_time_stays() -> None:
    first = look(STUCK, served(), 101.0)
    second = look(scene(proxy()), first.state, 110.0)
    third = look(STUCK, second.state, 125.0)
    assert done(third) == []


def test_another_proxy_that_is_about_to_end_is_waited_for() -> None:
    waits = scene(proxy(stuck=PodFailure.PORTS), proxy(rosproxy("arm"), deleting=True))
    plan = look(waits)
    for now in (200.0, 300.0):
        assert not [action for action in done(plan) if action.of == ROBOT]
        plan = look(waits, plan.state, now)


def test_what_the_status_names_counts_as_served_after_a_restart_of_the_controller() -> None:
    of = rosproxy(former_ranges={"one": RANGE})
    assert done(look(scene(proxy(stuck=PodFailure.PORTS), of=of))) == []


def test_refused_ports_are_avoided_for_five_minutes() -> None:
    memory = look(STUCK, look(scene()).state, 101.0).state
    arm = rosproxy("arm")
    wants = observed(arm, service(arm), pod("a", labels=ARM))
    assert created(look(wants, memory, 400.0)) == "11404-11407"
    assert created(look(wants, memory, 401.0)) == "11400-11403"


def test_ports_of_a_pod_that_is_about_to_end_are_waited_for_by_who_has_served_there() -> None:
    ending = pod("web", ports=[11401], deleting=True)
    assert created(look(scene(ending), served(), 101.0)) == "11400-11403"


def test_ports_that_another_pod_has_taken_are_left_at_once() -> None:
    plan = look(scene(pod("web", ports=[11401])), served(), 101.0)
    assert created(plan) == "11402-11405"
    assert told(plan, "PortConflict")


def test_a_proxy_that_has_its_ports_stays_whatever_else_is_seen() -> None:
    """The list of pods may be old. The kubelet never admits two pods with the same port."""
    assert done(look(scene(proxy(), pod("web", ports=[11401])))) == []


WAITS = proxy(rosproxy("arm"), phase="Pending", node="")


def test_of_two_that_wait_with_the_same_ports_one_stays() -> None:
    plan = look(two(A, B, WAITS, proxy(phase="Pending", node="")))
    assert [(type(action), action.of.name) for action in done(plan)] == [(DeleteProxy, "robot")]
    assert plan.state.given[ROBOT_ON_ONE] == NEXT


def test_who_serves_comes_before_who_waits() -> None:
    assert [action.of.name for action in done(look(two(A, B, WAITS, proxy())))] == ["arm"]


# the port of a master in the cluster


def test_the_masters_port_is_published_besides_the_range_that_avoids_it() -> None:
    for port, first in ((11500, 11400), (11402, 11403)):
        action = creation(look(scene(of=publishing(port))))
        assert host_ports(action) == [*range(first, first + 4), port]


def test_a_masters_port_that_is_taken_is_told_and_the_rest_works() -> None:
    of = publishing(11500)
    plan = look(scene(pod("web", ports=[11500]), of=of))
    assert host_ports(creation(plan)) == list(RANGE.ports())
    (text,) = told(plan, "PortConflict")
    assert "not published on port 11500 of node one, since pod ros/web has this port" in text
    assert "spec.master.publish" in text


def test_only_one_of_two_gets_the_masters_port() -> None:
    plan = look(two(A, B, arm=publishing(11500, "arm"), robot=publishing(11500)))
    made = [action for action in done(plan) if isinstance(action, CreateProxy)]
    assert [11500 in host_ports(action) for action in made] == [True, False]


def test_who_has_the_masters_port_keeps_it() -> None:
    arm = publishing(11500, "arm")
    robot = publishing(11500)
    action = creation(look(two(A, B, proxy(robot, publish=11500), arm=arm, robot=robot)))
    assert action.of.name == "arm"
    assert host_ports(action) == list(NEXT.ports())


def test_a_masters_port_that_is_in_the_way_does_not_move_the_range() -> None:
    of = publishing(11500)
    stuck = proxy(of, stuck=PodFailure.PORTS, publish=11500)
    plan = look(scene(stuck, pod("web", ports=[11500]), of=of), look(scene(of=of)).state, 101.0)
    assert kinds(plan) == [DeleteProxy]
    assert plan.state.given[ROBOT_ON_ONE] == RANGE
