"""Actions for RosProxies: Services, and a proxy on each node with pods."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.planner.actions import (
    CreateProxy,
    CreateService,
    DeleteProxy,
    DeleteService,
    Emit,
)
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPod, ProxyReport
from rosproxy_operator.kubernetes.resources.model import (
    Advertise,
    InvalidRosProxy,
    MasterSpec,
    Name,
    Reference,
)
from tests.unit.operator.kubernetes.objects import (
    ROBOT,
    complete,
    creation,
    done,
    kinds,
    look,
    node,
    node_of,
    observed,
    pod,
    proxy,
    rosproxy,
    scene,
    service,
    status,
    told,
    written,
)

PROXY = names.proxy_id(ROBOT, "one")
MASTER = Name("ros", "roscore")
INSIDE = MasterSpec(service=MASTER)


def env(action: Any) -> dict[str, str]:
    variables = action.body["spec"]["containers"][0]["env"]
    return {variable["name"]: variable["value"] for variable in variables}


def reasons(plan: ClusterPlan) -> list[str]:
    return [action.reason for action in plan.actions if isinstance(action, Emit)]


def test_a_rosproxy_gets_a_service_and_a_proxy_on_each_node_with_selected_pods() -> None:
    nodes = [node("one"), node("two"), node("three")]
    pods = [pod("a", "one"), pod("b", "two"), pod("c", "two")]
    plan = look(observed(rosproxy(), *nodes, *pods))
    assert [(type(action), node_of(action)) for action in done(plan)] == [
        (CreateService, ""),
        (CreateProxy, "one"),
        (CreateProxy, "two"),
    ]
    assert reasons(plan) == ["ProxyCreated", "ProxyCreated"]


def test_a_service_is_there_before_any_pod_is() -> None:
    assert kinds(look(observed(rosproxy()))) == [CreateService]


def test_when_all_is_there_nothing_is_done() -> None:
    first = look(complete())
    assert done(first) == []
    of = rosproxy(status=status(first), cluster_ip="10.96.1.1")
    second = look(complete(rosproxies=(of,)), first.state, 101.0)
    assert (second.actions, second.next_look_in) == ((), None)


def test_a_second_rosproxy_takes_no_proxy_from_a_wired_pod() -> None:
    """Not even after the grace: the nodes of the pod would be unregistered for good."""
    of = rosproxy(cluster_ip="10.96.1.1", grace=2.0)
    second = rosproxy("second", cluster_ip="10.96.1.2")
    wired = replace(pod(), wired_master_uri=names.master_uri("10.96.1.1"))
    services = (service(of), service(second, "10.96.1.2"))
    seen = observed(of, second, wired, proxy(), *services)

    first = look(seen)
    later = look(seen, first.state, 200.0)

    assert done(first) == done(later) == []
    texts = told(later, "Ambiguous")
    assert len(texts) == len([of, second])
    assert all("stays with robot, but a new pod" in text for text in texts)


@pytest.mark.parametrize(
    "other_pod",
    [
        pod("ended", phase="Succeeded"),
        pod("going", deleting=True),
        pod("nowhere", on=""),
        pod("on-a-node-nobody-knows", on="four"),
        pod("no-label", labels={}),
        pod("off", labels={names.INJECT: "false"}),
        replace(pod("elsewhere"), id=Name("other", "elsewhere")),
        pod("a-proxy", labels=names.own_labels("robot") | {names.INJECT: "true"}),
    ],
    ids=lambda other_pod: other_pod.id.name,
)
def test_other_pods_get_no_proxy(other_pod: Any) -> None:
    assert done(look(observed(rosproxy(), service(), other_pod))) == []


def test_on_a_node_that_is_not_ready_nothing_is_created_nor_deleted() -> None:
    away = node(ready=False)
    plan = look(scene(away))
    assert done(plan) == []
    (text,) = told(plan, "NodeNotReady")
    assert text.startswith("node one: is not ready")
    assert "kubectl describe node one" in text
    alone = observed(rosproxy(grace=0.0), service(), away, proxy())
    assert done(look(alone)) == []


def test_a_node_that_is_being_deleted_gets_no_proxy() -> None:
    assert done(look(scene(node(deleting=True)))) == []


def test_a_proxy_that_no_pod_wants_stays_for_the_grace_and_is_retired() -> None:
    alone = written(observed(rosproxy(grace=30.0), service(), proxy()))
    first = look(alone, now=100.0)
    assert (done(first), first.next_look_in) == ([], 30.0)
    second = look(alone, first.state, 120.0)
    assert (done(second), second.next_look_in) == ([], 10.0)
    (gone,) = done(look(alone, second.state, 130.0))
    assert gone == DeleteProxy(
        ROBOT,
        PROXY,
        "uid-proxy-robot-one",
        "no pod on node one has needed the proxy for 30 s",
        retire=True,
    )


def test_the_grace_begins_anew_when_pods_come_back() -> None:
    alone = written(observed(rosproxy(grace=30.0), service(), proxy()))
    memory = look(complete(), look(alone, now=100.0).state, 110.0).state
    assert look(alone, memory, 135.0).next_look_in == 30.0


def test_a_proxy_on_a_node_that_is_gone_is_deleted_after_a_while() -> None:
    gone = written(observed(rosproxy(), service(), node("two"), proxy()))
    first = look(gone)
    assert (done(first), first.next_look_in) == ([], 10.0)
    (deleted,) = done(look(gone, first.state, 110.0))
    assert isinstance(deleted, DeleteProxy)
    assert (deleted.why, deleted.retire) == ("its node is gone", False)


@pytest.mark.parametrize(
    "changes",
    [
        {"master": MasterSpec("http://robot2:11311")},
        {"ports": 5},
        {"cleanup_after": 5.0},
        {"slave_control": "master"},
        {"data_plane": "kernel"},
        {"image_pull_policy": "Never"},
        {"resources": {"limits": {"memory": "1Gi"}}},
        {"tolerations": ({"operator": "Exists"},)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_any_other_change_makes_the_pod_anew_once_the_old_one_is_gone(changes: dict) -> None:
    of = rosproxy(**changes)
    first = look(complete(rosproxies=(of,)))
    (deleted,) = done(first)
    assert isinstance(deleted, DeleteProxy)
    assert deleted.retire == ("master" in changes)
    assert deleted.why.startswith("replaced, since ")
    second = look(scene(proxy(deleting=True), of=of), first.state, 101.0)
    assert done(second) == []
    third = look(scene(of=of), second.state, 102.0)
    assert kinds(third) == [CreateProxy]


@pytest.mark.parametrize(
    ("seen", "retire"),
    [
        (complete(nodes={"one": node(advertise_host="gate.example")}), True),
        (complete(nodes={"one": node(pod_networks=())}), False),
        (complete(rosproxies=(rosproxy(window=PortRange(11410, 11420)),)), True),
        (complete(rosproxies=(rosproxy(ports=2),)), False),
    ],
)
def test_who_is_not_found_again_at_the_master_is_unregistered(
    seen: ClusterSnapshot, retire: bool
) -> None:
    (deleted,) = done(look(seen))
    assert isinstance(deleted, DeleteProxy)
    assert deleted.retire == retire


# RosProxies that are gone, or can't be read


def test_what_a_deleted_rosproxy_has_made_goes() -> None:
    plan = look(complete(rosproxies=()))
    why = "its RosProxy is gone"
    assert done(plan) == [
        DeleteProxy(ROBOT, PROXY, "uid-proxy-robot-one", why, retire=True),
        DeleteService(ROBOT, Name("ros", "rosproxy-robot"), "uid-service-robot", why),
    ]


def test_a_proxy_that_the_garbage_collector_deletes_is_retired_nonetheless() -> None:
    plan = look(complete(rosproxies=(), proxies=(proxy(deleting=True),)))
    assert [getattr(action, "retire", None) for action in done(plan)] == [True, None]
    never = proxy(deleting=True, phase="Pending")
    assert kinds(look(complete(rosproxies=(), proxies=(never,)))) == [DeleteService]


def test_a_rosproxy_that_is_being_deleted_counts_as_gone() -> None:
    plan = look(complete(rosproxies=(rosproxy(deleting=True),)))
    assert [type(action) for action in plan.actions] == [DeleteProxy, DeleteService]


def test_a_rosproxy_of_the_same_name_takes_over_once_all_is_gone() -> None:
    """The pods are wired to an address, so the new Service gets the same address."""
    new = rosproxy(uid="uid-new")
    first = look(complete(rosproxies=(new,)))
    assert [(type(action), getattr(action, "retire", None)) for action in done(first)] == [
        (DeleteProxy, False),
        (DeleteService, None),
    ]
    service_, proxy_ = done(look(observed(new, pod()), first.state, 110.0))
    assert isinstance(service_, CreateService)
    assert service_.body["spec"]["clusterIP"] == "10.96.1.1"
    assert isinstance(proxy_, CreateProxy)


def test_what_an_unreadable_rosproxy_has_stays_as_it_is() -> None:
    bad = InvalidRosProxy(ROBOT, "uid-robot", 2, "spec.ports: is no number: write one")
    plan = look(complete(rosproxies=(), unusable={ROBOT: bad}))
    assert done(plan) == []
    assert told(plan, "Invalid") == ["rosproxy ros/robot: spec.ports: is no number: write one"]
    (event,) = (action for action in plan.actions if isinstance(action, Emit))
    assert (event.type, event.reason, event.message) == ("Warning", "Invalid", bad.text)
    assert event.about == Reference("RosProxy", ROBOT, "uid-robot")
    assert status(plan)["conditions"][0]["reason"] == "Invalid"


def test_ports_of_an_unreadable_rosproxy_are_not_given_to_others() -> None:
    bad = InvalidRosProxy(ROBOT, "uid-robot", 2, "bad")
    arm = rosproxy("arm")
    plan = look(observed(arm, proxy(), pod(), service(arm), unusable={ROBOT: bad}))
    (created,) = done(plan)
    assert isinstance(created, CreateProxy)
    assert env(created)["ROSPROXY_PORT_RANGE"] == "11404-11407"


# obstacles


def test_a_pod_of_somebody_else_that_has_our_name_is_never_touched() -> None:
    namesake = pod(PROXY.name, labels={})
    plan = look(scene(namesake))
    assert done(plan) == []
    (text,) = told(plan, "NameTaken")
    assert f"a pod {PROXY} exists already that the operator did not create" in text
    assert "Delete that pod" in text


def test_a_proxy_under_a_name_of_former_times_goes_first() -> None:
    old = replace(proxy(), pod=replace(proxy().pod, id=Name("ros", "rosproxy-old")))
    first = look(scene(old))
    assert [getattr(action, "id", None) for action in done(first)] == [Name("ros", "rosproxy-old")]
    second = look(scene(), first.state, 101.0)
    assert kinds(second) == [CreateProxy]


@pytest.mark.parametrize(
    ("advertise", "annotated", "host"),
    [
        (Advertise.INTERNAL_IP, "", "192.0.2.1"),
        (Advertise.HOSTNAME, "", "one"),
        (Advertise.INTERNAL_IP, "gate", "gate"),
    ],
)
def test_outside_is_told_the_address_that_spec_names_if_the_node_has_no_annotation(
    advertise: Advertise, annotated: str, host: str
) -> None:
    seen = scene(node(advertise_host=annotated), of=rosproxy(advertise=advertise))
    assert env(creation(look(seen)))["ROSPROXY_ADVERTISE_HOST"] == host


@pytest.mark.parametrize(
    ("annotated", "why"),
    [
        ("a b", ["node one: annotation rosproxy.io/advertise-host: 'a b'"]),
        ("", ["node one: has no address of type ExternalIP (types of its addresses: Hostname, "
              "InternalIP)",
              "kubectl annotate node one rosproxy.io/advertise-host=HOST"]),
    ],
)  # fmt: skip
def test_a_node_that_outside_does_not_reach_gets_no_proxy_and_it_is_told_why(
    annotated: str, why: list[str]
) -> None:
    of = rosproxy(advertise=Advertise.EXTERNAL_IP)
    plan = look(scene(node(advertise_host=annotated), of=of))
    assert done(plan) == []
    (text,) = told(plan, "NoAdvertiseHost")
    assert all(fragment in text for fragment in why)


def test_a_master_in_the_cluster_is_given_by_name_and_address() -> None:
    seen = replace(scene(of=rosproxy(master=INSIDE)), masters={MASTER: ("10.96.0.9", None)})
    created = env(creation(look(seen)))
    assert created["ROS_MASTER_URI"] == "http://roscore.ros.svc:11311"
    assert created["ROSPROXY_MASTER_ADDRESS"] == "10.96.0.9"


@pytest.mark.parametrize("masters", [{}, {MASTER: ("", Fault("does not exist"))}])
def test_while_the_masters_service_is_missing_everything_stays(masters: dict) -> None:
    of = rosproxy(master=INSIDE)
    plan = look(replace(scene(proxy(), of=of), masters=masters))
    assert done(plan) == []
    assert "spec.master.service: Service ros/roscore" in told(plan, "MasterUnknown")[0]


def test_pods_on_nodes_that_the_node_selector_leaves_out_are_named() -> None:
    plan = look(scene(pod("a"), of=rosproxy(node_selector={"zone": "a"})))
    assert done(plan) == []
    (text,) = told(plan, "NodeLeftOut")
    assert "node one does not match spec.nodeSelector" in text
    assert "ros/a, ros/talker" in text


def test_each_of_two_rosproxies_names_the_pod_that_both_select() -> None:
    """The status must not advise the label value true, which is the fault."""
    plan = look(observed(rosproxy("arm"), rosproxy("leg"), pod()))
    for name in ("arm", "leg"):
        ready = status(plan, Name("ros", name))["conditions"][0]
        assert ready["message"] == (
            "no pod has a proxy. pod ros/talker: is selected by RosProxy arm and leg, so the pod "
            "gets no proxy. Set the label to the name of one RosProxy, such as "
            "rosproxy.io/inject=arm in the template, then run kubectl -n ros delete pod talker, "
            "and create the pod again"
        )


def test_a_pod_that_is_not_wired_is_told() -> None:
    plan = look(complete(pods=(pod(wired_master_uri=""),)))
    assert "kubectl -n ros delete pod talker" in told(plan, "NotWired")[0]


def test_a_pod_that_is_older_than_the_service_is_told_so() -> None:
    late = service(created="2026-01-01T00:00:10Z")
    old = pod(wired_master_uri="", created="2026-01-01T00:00:09Z")
    plan = look(complete(pods=(old,), services={ROBOT: late}))
    assert "is older than Service rosproxy-robot of the RosProxy" in told(plan, "NotWired")[0]


def test_a_pod_of_a_former_rosproxy_gets_a_finding() -> None:
    """The pod's nodes may be unregistered, though the new Service has the same address."""
    of = replace(rosproxy(), created="2026-01-01T00:00:10Z")
    deployment = "deployment/talker"
    former = pod(running_since="2026-01-01T00:00:09Z", workload=deployment)
    seen = complete(pods=(former,), rosproxies=(of,))
    # The nodes of the pod may be registered, as long as the proxy does not answer.
    assert not told(look(seen), "NotWired")
    assert not told(look(replace(seen, reports={proxy().pod.uid: ProxyReport(False)})), "NotWired")
    plan = look(replace(seen, reports={proxy().pod.uid: ProxyReport(True)}))
    (text,) = told(plan, "NotWired")
    assert "is older than RosProxy robot" in text
    assert text.endswith(". Run kubectl -n ros rollout restart deployment/talker")
    of_now = pod(created="2026-01-01T00:00:09Z", running_since=of.created, workload=deployment)
    assert not told(look(complete(pods=(of_now,), rosproxies=(of,))), "NotWired")


@pytest.mark.parametrize(
    "seen",
    [
        complete(pods=(pod(wired_master_uri="", phase="Succeeded"),)),
        complete(pods=(pod(wired_master_uri="", deleting=True),)),
        complete(pods=(pod(wired_master_uri=""),), services={}),
        complete(pods=(pod(wired_master_uri=""),), services={ROBOT: service(ip="")}),
        complete(pods=(pod(wired_master_uri=""),), services={ROBOT: service(owner="uid-old")}),
    ],
)
def test_nothing_is_said_of_pods_that_end_or_before_there_is_a_service(
    seen: ClusterSnapshot,
) -> None:
    assert told(look(seen), "NotWired") == []


# Services


def test_a_service_that_is_lost_is_made_with_the_address_that_it_had() -> None:
    plan = look(observed(rosproxy(cluster_ip="10.96.3.3"), proxy(), pod()))
    (created,) = done(plan)
    assert isinstance(created, CreateService)
    assert created.body["spec"]["clusterIP"] == "10.96.3.3"


def test_a_service_of_former_times_is_made_anew() -> None:
    plan = look(complete(services={ROBOT: service(fingerprint="other")}))
    (deleted,) = done(plan)
    assert isinstance(deleted, DeleteService)
    assert deleted.why.startswith("replaced, since ")


# status


def test_the_status_keeps_the_ranges_of_nodes_that_have_no_proxy_now() -> None:
    former = {"one": proxy().range, "gone": proxy().range}
    plan = look(observed(rosproxy(former_ranges=former), service()))
    assert [
        (node_status["name"], node_status["ports"]) for node_status in status(plan)["perNode"]
    ] == [("one", "11400-11403")]


def test_one_bad_rosproxy_does_not_stop_another() -> None:
    bad = rosproxy("arm", advertise=Advertise.EXTERNAL_IP)
    pods = [pod("a", labels={names.INJECT: "arm"}), pod("b", labels={names.INJECT: "robot"})]
    plan = look(observed(bad, rosproxy(), service(), service(bad), *pods))
    assert [(type(action), action.of.name) for action in done(plan)] == [(CreateProxy, "robot")]


# proxies that are recreated in turn


KEY = b"k" * 32


def two(*proxies: ProxyPod, key: bytes = KEY) -> ClusterSnapshot:
    """Two nodes with a pod each, and ``proxies``, which were made without ``key``."""
    pods = pod("a", ip="10.244.1.5"), pod("b", on="two", ip="10.244.2.5")
    nodes = node(), node("two")
    return observed(rosproxy(), service(), *nodes, *pods, *proxies, key=key)


def test_another_key_makes_one_proxy_anew_at_a_time() -> None:
    plan = look(two(proxy(), proxy(on=node("two"))))
    (action,) = done(plan)
    assert isinstance(action, DeleteProxy)
    assert (action.id, action.retire) == (PROXY, False)
    assert action.why.startswith("replaced, since the RosProxy, the node or the operator's options")
    assert plan.next_look_in == 1.0


@pytest.mark.parametrize("first", [(), (proxy(stuck=None, phase="Pending"),)])
def test_the_next_waits_until_the_one_before_runs(first: tuple[ProxyPod, ...]) -> None:
    plan = look(two(*first, proxy(on=node("two"))))
    assert DeleteProxy not in kinds(plan) or first
    assert not [action for action in done(plan) if getattr(action, "id", PROXY) != PROXY]
    assert plan.next_look_in == 1.0


def test_what_has_to_move_waits_for_nobody() -> None:
    of = rosproxy(window=PortRange(12000, 12099))
    seen = replace(two(proxy(), proxy(on=node("two")), key=b""), rosproxies=(of,))
    assert kinds(look(seen)) == [DeleteProxy, DeleteProxy]
